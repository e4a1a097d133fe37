"""Cells of the rasterizer: the compiled float32 kernels against the float64 reference.

Both get the same float32 numbers, so what is measured is the kernels' own rounding. Pixels at which a rounding error of
1e-5 may flip a decision (skip, stop, clip, which of two hits is nearer) are left out of the smooth cells, and
have cells of their own.
"""

import math
from typing import Any

import torch
from torch import Tensor

from nbavatar.rendering.billboards.functional import render_billboards
from nbavatar.rendering.billboards.projection import project_billboards, texture_support
from nbavatar.rendering.billboards.reference import BlendSettings, critical_pixels
from nbavatar.rendering.ordering import canonical_rank, parse_order
from nbavatar.studies.extremes.cells import Level, Limit, Sample, cell
from nbavatar.studies.extremes.compare import gradient_error, gradients, relative

__all__ = ["Scene", "billboards", "compare", "tilted"]

_ORACLE = "float64 reference, one sort a pixel"
_SIZE = 24
_OPTIONS = {"near": 0.01, "alpha_min": 1 / 255, "alpha_max": 0.99, "t_min": 1e-4, "low_pass": 1.0}


class Scene:
    """Billboards, a camera and options; tensors float32 unless said otherwise."""

    def __init__(self, tensors: list[Tensor], K: Tensor, viewmat: Tensor | None = None, **options: float | str) -> None:
        self.tensors, self.K = tensors, K
        self.size = int(options.pop("size", _SIZE))
        self.viewmat = torch.eye(4, dtype=torch.float64) if viewmat is None else viewmat
        self.order = str(options.pop("order", "ray"))
        self.options = {**_OPTIONS, **{name: float(value) for name, value in options.items()}}

    def render(self, tensors: list[Tensor], backend: str) -> tuple[Tensor, Tensor]:
        """Features (C, H, W) and alpha (H, W)."""
        return render_billboards(
            *tensors, self.viewmat, self.K, self.size, self.size, order=self.order, backend=backend, **self.options
        )

    def doubtful(self) -> Tensor:
        """Pixels whose decisions hang on rounding, (H, W) bool."""
        o = self.options
        alpha = self.tensors[4]
        support = texture_support(alpha.shape[-1])
        projection = project_billboards(
            *self.tensors[:3], self.viewmat, self.K, near=o["near"], low_pass=o["low_pass"], support=support
        )
        rank = canonical_rank(projection.depth, *self.tensors)
        settings = BlendSettings(
            self.size,
            self.size,
            parse_order(self.order),
            o["near"],
            o["alpha_min"],
            o["alpha_max"],
            o["t_min"],
            support,
        )
        return critical_pixels(projection, rank, alpha, settings)


def billboards(count: int, *, depth: float = 1.0, size: float = 0.2, texels: int = 4, seed: int = 0) -> list[Tensor]:
    """Random billboards in front of a camera at the origin that looks along z, with half-extents `size` [m]."""
    random = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=random)

    means = (uniform(count, 3) - 0.5) * torch.tensor([0.6, 0.6, 0.4]) * depth + torch.tensor([0.0, 0.0, depth])
    quats = torch.randn(count, 4, generator=random)
    quats = torch.where(quats[:, :1] >= 0, quats, -quats) + torch.tensor([1.5, 0.0, 0.0, 0.0])
    extents = size * depth * (0.6 + 0.8 * uniform(count, 2))
    features = torch.randn(count, texels, texels, 3, generator=random)
    return [means, quats, extents, features, 0.2 + 0.6 * uniform(count, texels, texels)]


def camera(focal: float = 24.0, cx: float = _SIZE / 2, cy: float = _SIZE / 2) -> Tensor:
    """Intrinsics [px]."""
    return torch.tensor([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]], dtype=torch.float64)


def tilted(angle: float, *, size: float = 0.3, depth: float = 1.0, texels: int = 4, count: int = 3) -> list[Tensor]:
    """Billboards above one another that the view direction meets at `angle` [deg]."""
    tensors = billboards(count, depth=depth, size=size, texels=texels, seed=5)
    half = 0.5 * math.radians(90.0 - angle)
    tensors[0] = torch.tensor([[0.01 * i, 0.25 * (i - (count - 1) / 2), depth] for i in range(count)])
    quat = torch.tensor([math.cos(half), math.sin(half), 0.0, 0.0], dtype=torch.float64).float()
    tensors[1] = quat.expand(count, 4).clone()
    return tensors


def compare(scene: Scene, *, every_pixel: bool = False) -> Sample:
    """Errors of the float32 kernels: image and alpha, and the gradients by all five inputs."""
    tensors, size = scene.tensors, scene.size
    good = torch.ones(size, size, dtype=torch.bool) if every_pixel else ~scene.doubtful()
    random = torch.Generator().manual_seed(1)
    channels = tensors[3].shape[-1]
    probe = torch.randn(channels + 1, size, size, generator=random, dtype=torch.float64) * good
    images: dict[str, Tensor] = {}

    def run(backend: str) -> list[Tensor]:
        def loss(*leaves: Tensor) -> Tensor:
            image, alpha = scene.render(list(leaves), backend)
            images[backend] = torch.cat((image, alpha[None])).double() * good
            return (images[backend] * probe).sum()

        inputs = tensors if backend == "cpu" else [tensor.double() for tensor in tensors]
        return gradients(loss, inputs)[1]

    found, true = run("cpu"), run("reference")
    # A gradient that vanishes against the scale of the others is compared with that scale: the loss moves by
    # |gradient| |input|, and rounding is relative to the largest such movement.
    moves = [float(g.norm()) * float(t.double().norm()) for g, t in zip(true, tensors, strict=True)]
    least = [1e-6 * max(moves) / max(float(t.double().norm()), 1e-300) for t in tensors]
    errors = [gradient_error([f], [t], least=floor) for f, t, floor in zip(found, true, least, strict=True)]
    gradient = math.nan if any(map(math.isnan, errors)) else max(errors)
    return Sample(relative(images["cpu"], images["reference"], least=1e-6), gradient)


def _cell(condition: str, axis: str, levels: tuple[Level, ...], **more: Any):
    return cell("raster", "cpu float32", condition, axis, levels, oracle=_ORACLE, **more)


@_cell("grazing view", "angle to the plane [deg]", (45.0, 10.0, 3.0, 1.0, 0.1, 0.01, 1e-3, 0.0))
def _grazing(angle: float) -> Sample:
    return compare(Scene(tilted(angle), camera()))


@_cell(
    "grazing view, no low-pass",
    "angle to the plane [deg]",
    (45.0, 10.0, 3.0, 1.0, 0.1, 0.01, 1e-3, 0.0),
    limits=(Limit(lambda a: 0 < float(a) <= 1, 1e-3, 5e-2, "hits cover a sliver of the pixel grid"),),
)
def _grazing_sharp(angle: float) -> Sample:
    return compare(Scene(tilted(angle), camera(), low_pass=0.0))


@_cell(
    "sub-pixel size",
    "half-extent on screen [px]",
    (10.0, 1.0, 0.3, 0.1, 1e-2, 1e-3, 1e-5, 0.0),
    limits=(
        Limit(lambda size: float(size) <= 0.01, 1e-3, 1e-4, "opacity 1 - T is right to 6e-8 of full, not of itself"),
    ),
)
def _small(pixels: float) -> Sample:
    tensors = billboards(6)
    tensors[2] = torch.full_like(tensors[2], pixels / 24.0)
    return compare(Scene(tensors, camera()))


@_cell("one side of no length", "half-extent of the other [px]", (10.0, 1.0, 0.1))
def _line(pixels: float) -> Sample:
    tensors = billboards(6)
    tensors[2][:, 0], tensors[2][:, 1] = pixels / 24.0, 0.0
    return compare(Scene(tensors, camera()))


@_cell(
    "screen-filling size",
    "half-extent [image widths]",
    (0.5, 2.0, 10.0, 100.0, 1e3, 1e4, 1e6),
    limits=tuple(
        Limit(
            lambda widths, most=most: float(widths) == most,
            1e-5,
            1e-6 * most,
            "the image is a small part of one texel, whose coordinates have 24 bits",
        )
        for most in (1e3, 1e4, 1e6)
    ),
)
def _large(widths: float) -> Sample:
    tensors = tilted(80.0)
    tensors[2] = torch.full_like(tensors[2], widths)
    return compare(Scene(tensors, camera()))


@_cell("plane through the near plane", "depth of the centre [m]", (1.0, 0.3, 0.1, 0.02, 0.01, 0.0, -0.1, -1.0))
def _near(depth: float) -> Sample:
    tensors = tilted(35.0, size=0.5)
    tensors[0][:, 2] = depth
    return compare(Scene(tensors, camera()))


@_cell("ratio of depths", "far depth / near depth [1]", (1.0, 10.0, 1e2, 1e3, 1e4, 1e5, 1e6))
def _ratio(ratio: float) -> Sample:
    front, back = billboards(4, seed=1), billboards(4, depth=ratio, size=0.3, seed=2)
    return compare(Scene([torch.cat(pair) for pair in zip(front, back, strict=True)], camera()))


@_cell("distance of the whole scene", "depth [m]", (1.0, 1e-1, 10.0, 1e3, 1e5, 1e7))
def _distance(depth: float) -> Sample:
    return compare(Scene(billboards(8, depth=depth), camera()))


@_cell("scene far from the origin, float64 means", "offset [m]", (0.0, 1.0, 1e2, 1e4, 1e6))
def _offset(offset: float) -> Sample:
    tensors = billboards(8)
    viewmat = torch.eye(4, dtype=torch.float64)
    shift = torch.tensor([1.0, -0.7, 0.4], dtype=torch.float64) * offset
    viewmat[:3, 3] = -shift
    plain = Scene(tensors, camera())
    tensors = [tensors[0].double() + shift, *tensors[1:]]
    sample = compare(Scene(tensors, camera(), viewmat))
    moved, _ = Scene(tensors, camera(), viewmat).render(tensors, "cpu")
    still, _ = plain.render([t.double() for t in plain.tensors], "reference")
    good = ~plain.doubtful()
    return Sample(max(sample.forward, relative(moved * good, still * good)), sample.gradient)


@_cell("principal point off the image", "shift [px]", (0.0, 1e2, 1e3, 1e4, 1e5, 1e6))
def _principal(shift: float) -> Sample:
    tensors = billboards(8)
    focal = max(24.0, shift)
    tensors[0][:, :2] *= 24.0 / focal
    tensors[0][:, 0] -= tensors[0][:, 2] * shift / focal
    tensors[2] *= 24.0 / focal
    return compare(Scene(tensors, camera(focal, _SIZE / 2 + shift)))


@_cell("focal length", "f [px]", (24.0, 2.4, 240.0, 1e4, 1e6, 1e8))
def _focal(focal: float) -> Sample:
    tensors = billboards(8)
    tensors[0][:, :2] *= 24.0 / focal
    tensors[2] *= 24.0 / focal
    return compare(Scene(tensors, camera(focal)))


@_cell("parallel layers almost in one plane", "gap / depth [1]", (1e-2, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 0.0))
def _near_equal(gap: float) -> Sample:
    tensors = [tensor.double() for tensor in billboards(4, seed=3)]
    tensors[0] = torch.tensor([[0.02 * i, -0.03 * i, 1.0 + gap * i] for i in (2, 0, 3, 1)], dtype=torch.float64)
    tensors[1] = torch.tensor([[1.0, 0.1, -0.2, 0.05]], dtype=torch.float64).expand(4, 4).clone()
    tensors[3:] = [tensor.float() for tensor in tensors[3:]]
    return compare(Scene(tensors, camera()), every_pixel=True)


@_cell("layers on a pixel", "layers [1]", (1.0, 10.0, 100.0, 1e3, 1e4), quick=(10.0, 1e3))
def _layers(layers: float) -> Sample:
    return compare(_stack(int(layers), spread=1.0))


@_cell("layers in one plane", "layers [1]", (2.0, 32.0, 33.0, 1e3, 1e4), quick=(2.0, 33.0))
def _coplanar(layers: float) -> Sample:
    return compare(_stack(int(layers), spread=0.0), every_pixel=True)


@_cell("opaque layers", "layers [1]", (1.0, 3.0, 100.0, 1e4), quick=(1.0, 100.0))
def _opaque(layers: float) -> Sample:
    scene = _stack(int(layers), spread=1.0)
    scene.tensors[4].fill_(1.0)
    scene.options.update(alpha_min=1 / 255, alpha_max=0.98, t_min=1e-4)
    return compare(scene)


def _stack(layers: int, *, spread: float) -> Scene:
    """Sheets that cover the image, each nearly transparent, all blended: nothing skipped, no early stop."""
    tensors = billboards(layers, size=2.0, texels=2, seed=4)
    place = torch.arange(layers)[torch.randperm(layers, generator=torch.Generator().manual_seed(6))]
    tensors[0] = torch.zeros(layers, 3)
    tensors[0][:, 2] = 1.0 + spread * (place + 0.5) / layers
    tensors[1] = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(layers, 4).clone()
    tensors[2] = torch.full((layers, 2), 4.0)
    tensors[4] = tensors[4] * min(1.0, 3.0 / layers)
    return Scene(tensors, camera(8.0, 4.0, 4.0), alpha_min=0.0, t_min=0.0, size=8)


@_cell(
    "alpha of all texels",
    "alpha [1]",
    (0.5, 0.1, 1 / 255, 1e-3, 1e-30, 0.0, 0.98, 0.99, 0.999, 1.0),
    limits=(Limit(lambda a: a == 0.99, 1e-5, 2.0, "on the cap the slope is 0 or 1, and rounding says which"),),
)
def _alpha(value: float) -> Sample:
    tensors = tilted(50.0)
    tensors[4] = torch.full_like(tensors[4], value)
    return compare(Scene(tensors, camera(), alpha_min=0.5 / 255 if value == 1 / 255 else 1 / 255))


@_cell("alpha_max 1: no light passes an opaque layer", "layers [1]", (1.0, 2.0, 10.0))
def _black(layers: float) -> Sample:
    scene = _stack(int(layers), spread=1.0)
    scene.tensors[4].fill_(1.0)
    scene.options.update(alpha_max=1.0)
    return compare(scene, every_pixel=True)


@_cell("magnitude of features", "largest feature [1]", (1.0, 1e-30, 1e-10, 1e10, 1e30))
def _features(scale: float) -> Sample:
    tensors = billboards(6)
    tensors[3] = tensors[3] / tensors[3].abs().max() * scale
    found = compare(Scene([*tensors[:3], tensors[3], tensors[4]], camera()))
    return found


@_cell("norm of quaternions", "norm [1]", (1.0, 1e-3, 1e-10, 1e-18, 1e3, 1e10, 1e18))
def _norms(norm: float) -> Sample:
    tensors = billboards(6)
    tensors[1] = tensors[1] / tensors[1].norm(dim=-1, keepdim=True) * norm
    return compare(Scene(tensors, camera()))


@_cell("texture size", "texels a side [1]", (4.0, 1.0, 2.0, 16.0, 64.0))
def _texels(texels: float) -> Sample:
    return compare(Scene(billboards(6, texels=int(texels)), camera()))


@_cell("number of billboards", "billboards [1]", (8.0, 1.0, 0.0, 300.0))
def _count(count: float) -> Sample:
    return compare(Scene(billboards(int(count)), camera()))


@_cell("order and queue", "order", ("ray", "center", "kbuffer(1)", "kbuffer(8)"), quick=("ray", "kbuffer(8)"))
def _orders(order: str) -> Sample:
    return compare(Scene(billboards(20, seed=8), camera(), order=order))


@cell(
    "raster",
    "arguments",
    "what has no image",
    "case",
    (
        "NaN mean",
        "infinite extent",
        "NaN quaternion",
        "zero quaternion",
        "NaN alpha",
        "NaN camera",
        "focal length 0",
        "image without pixels",
        "near 0",
        "unknown order",
    ),
    quick=("NaN mean", "NaN alpha"),
    oracle="a one-line refusal",
    refuses=lambda case: True,
)
def _refused(case: str) -> Sample:
    tensors, K, width, options = billboards(3), camera(), _SIZE, {}
    viewmat = torch.eye(4)
    if case == "NaN mean":
        tensors[0][1, 0] = math.nan
    elif case == "infinite extent":
        tensors[2][1, 0] = math.inf
    elif case == "NaN quaternion":
        tensors[1][1, 0] = math.nan
    elif case == "zero quaternion":
        tensors[1][1] = 0.0
    elif case == "NaN alpha":
        tensors[4][:] = math.nan
    elif case == "NaN camera":
        viewmat[0, 3] = math.nan
    elif case == "focal length 0":
        K[0, 0] = 0.0
    elif case == "image without pixels":
        width = 0
    elif case == "near 0":
        options["near"] = 0.0
    else:
        options["order"] = "depth"
    render_billboards(*tensors, viewmat, K, width, _SIZE, backend="cpu", **options)
    return Sample(math.nan)
