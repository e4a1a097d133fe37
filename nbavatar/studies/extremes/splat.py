"""Cells of the Gaussian rasterizer: compiled float32 kernels against the float64 reference, same float32 numbers.

Pixels at which rounding of 1e-5 may flip a decision (skip, stop) are left out, as in the cells of the billboards.
"""

import math
from typing import Any

import torch
from torch import Tensor

from nbavatar.rendering.gaussians.functional import render_gaussians
from nbavatar.rendering.gaussians.projection import project_gaussians
from nbavatar.rendering.gaussians.reference import SplatSettings, critical_pixels
from nbavatar.rendering.ordering import canonical_rank
from nbavatar.studies.extremes.cells import Level, Sample, cell
from nbavatar.studies.extremes.compare import gradient_error, gradients, relative
from nbavatar.studies.extremes.raster import camera

__all__: list[str] = []

_ORACLE = "float64 reference, all Gaussians at every pixel"
_SIZE = 20


def _gaussians(count: int, *, depth: float = 1.0, size: float = 0.08, seed: int = 0) -> list[Tensor]:
    """Means, quaternions, standard deviations [m], opacities, colours; before a camera at the origin."""
    random = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=random)

    means = (uniform(count, 3) - 0.5) * torch.tensor([0.6, 0.6, 0.4]) * depth + torch.tensor([0.0, 0.0, depth])
    quats = torch.randn(count, 4, generator=random) + torch.tensor([1.0, 0.0, 0.0, 0.0])
    return [means, quats, size * depth * (0.3 + uniform(count, 3)), 0.2 + 0.7 * uniform(count), uniform(count, 3)]


def _compare(
    tensors: list[Tensor],
    *,
    K: Tensor | None = None,
    view: Tensor | None = None,
    size: int = _SIZE,
    every_pixel: bool = False,
    **options: float,
) -> Sample:
    K = camera(20.0, size / 2, size / 2) if K is None else K
    view = torch.eye(4, dtype=torch.float64) if view is None else view
    wide = [tensor.double() for tensor in tensors]
    good = torch.ones(size, size, dtype=torch.bool)
    if not every_pixel:
        projection = project_gaussians(
            *wide[:3], view, K, size, size, near=options.get("near", 0.01), low_pass=options.get("low_pass", 0.3)
        )
        settings = SplatSettings(
            size, size, options.get("alpha_min", 1 / 255), options.get("alpha_max", 0.99), options.get("t_min", 1e-4)
        )
        rank = canonical_rank(projection.depth, wide[0], wide[1], wide[2], wide[4], wide[3])
        good = ~critical_pixels(projection, rank, wide[3], settings)
    probe = torch.randn(4, size, size, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * good
    images: dict[str, Tensor] = {}

    def run(backend: str, inputs: list[Tensor]) -> list[Tensor]:
        def loss(*leaves: Tensor) -> Tensor:
            found = render_gaussians(*leaves, view, K, size, size, backend=backend, **options)
            images[backend] = torch.cat((found.colour, found.alpha[None])).double() * good
            return (images[backend] * probe).sum()

        return gradients(loss, inputs)[1]

    found, true = run("cpu", tensors), run("reference", wide)
    moves = [float(g.norm()) * float(t.norm()) for g, t in zip(true, wide, strict=True)]
    least = [1e-6 * max(moves, default=0.0) / max(float(t.norm()), 1e-300) for t in wide]
    errors = [gradient_error([f], [t], least=floor) for f, t, floor in zip(found, true, least, strict=True)]
    gradient = math.nan if any(map(math.isnan, errors)) else max(errors)
    return Sample(relative(images["cpu"], images["reference"], least=1e-6), gradient)


def _cell(condition: str, axis: str, levels: tuple[Level, ...], **more: Any):
    return cell("splat", "cpu float32", condition, axis, levels, oracle=_ORACLE, **more)


@_cell("flatness", "least scale / largest scale [1]", (1.0, 1e-2, 1e-4, 1e-8, 0.0))
def _flat(ratio: float) -> Sample:
    tensors = _gaussians(6)
    tensors[2] = 0.1 * torch.tensor([1.0, 0.7, ratio]).expand(6, 3).clone()
    return _compare(tensors)


@_cell("needles", "both small scales / largest [1]", (1.0, 1e-2, 1e-4, 1e-8, 0.0))
def _needle(ratio: float) -> Sample:
    tensors = _gaussians(6)
    tensors[2] = 0.1 * torch.tensor([1.0, ratio, ratio]).expand(6, 3).clone()
    return _compare(tensors)


@_cell("needles, no low-pass", "both small scales / largest [1]", (1.0, 0.1, 1e-2, 1e-3, 1e-5))
def _sharp(ratio: float) -> Sample:
    tensors = _gaussians(6)
    tensors[2] = 0.1 * torch.tensor([1.0, ratio, ratio]).expand(6, 3).clone()
    return _compare(tensors, low_pass=0.0)


@_cell("sub-pixel size", "standard deviation [px]", (2.0, 0.3, 1e-2, 1e-4, 1e-8, 0.0))
def _small(pixels: float) -> Sample:
    tensors = _gaussians(6)
    tensors[2] = torch.full_like(tensors[2], pixels / 20.0)
    return _compare(tensors)


@_cell("screen-filling size", "standard deviation [image widths]", (0.2, 1.0, 10.0, 1e3, 1e6, 1e12))
def _large(widths: float) -> Sample:
    tensors = _gaussians(4)
    tensors[2] = torch.full_like(tensors[2], widths)
    return _compare(tensors)


@_cell("means near the camera's plane", "depth of the means [m]", (1.0, 0.1, 0.02, 0.011, 0.01, 0.0, -1.0))
def _near(depth: float) -> Sample:
    tensors = _gaussians(5, size=0.03)
    tensors[0][:, 2] = depth
    tensors[0][:, :2] *= max(depth, 0.01)
    return _compare(tensors)


@_cell("means off the image", "angle off the axis [deg]", (10.0, 45.0, 60.0, 80.0, 89.9))
def _aside(angle: float) -> Sample:
    """Wide Gaussians whose means lie beside the image and that reach into it."""
    tensors = _gaussians(5, size=0.2)
    tensors[0][:, 0] = math.tan(math.radians(angle)) * tensors[0][:, 2]
    tensors[2] = tensors[2] * (1 + math.tan(math.radians(angle)))
    return _compare(tensors)


@_cell("ratio of depths", "far depth / near depth [1]", (1.0, 1e2, 1e4, 1e6))
def _ratio(ratio: float) -> Sample:
    front, back = _gaussians(4, seed=1), _gaussians(4, depth=ratio, seed=2)
    return _compare([torch.cat(pair) for pair in zip(front, back, strict=True)])


@_cell("scene far from the origin, float64 means", "offset [m]", (0.0, 1e2, 1e4, 1e6))
def _offset(offset: float) -> Sample:
    tensors = _gaussians(6)
    shift = torch.tensor([1.0, -0.7, 0.4], dtype=torch.float64) * offset
    view = torch.eye(4, dtype=torch.float64)
    view[:3, 3] = -shift
    return _compare([tensors[0].double() + shift, *tensors[1:]], view=view)


@_cell("layers on a pixel", "layers [1]", (1.0, 32.0, 1e3, 1e4), quick=(1.0, 1e3))
def _layers(layers: float) -> Sample:
    return _stack(int(layers), 1.0)


@_cell("layers in one plane", "layers [1]", (2.0, 33.0, 1e3), quick=(2.0, 33.0))
def _coplanar(layers: float) -> Sample:
    return _stack(int(layers), 0.0)


def _stack(layers: int, spread: float) -> Sample:
    tensors = _gaussians(layers, seed=4)
    place = torch.randperm(layers, generator=torch.Generator().manual_seed(6))
    tensors[0] = torch.zeros(layers, 3)
    tensors[0][:, 2] = 1.0 + spread * (place + 0.5) / layers
    tensors[2] = torch.full((layers, 3), 2.0)
    tensors[3] = tensors[3] * min(1.0, 3.0 / layers)
    return _compare(tensors, size=8, every_pixel=True, alpha_min=0.0, t_min=0.0)


@_cell("opacity", "opacity [1]", (0.5, 1 / 255, 1e-3, 1e-30, 0.0, 0.98, 0.99, 0.999, 1.0))
def _opacity(opacity: float) -> Sample:
    tensors = _gaussians(4)
    tensors[3] = torch.full_like(tensors[3], opacity)
    return _compare(tensors)


@_cell("norm of quaternions", "norm [1]", (1.0, 1e-10, 1e-18, 1e10, 1e18))
def _norms(norm: float) -> Sample:
    tensors = _gaussians(6)
    tensors[1] = tensors[1] / tensors[1].norm(dim=-1, keepdim=True) * norm
    return _compare(tensors)


@_cell("principal point off the image", "shift [px]", (0.0, 1e3, 1e5, 1e6))
def _principal(shift: float) -> Sample:
    tensors = _gaussians(6)
    focal = max(20.0, shift)
    tensors[0][:, :2] *= 20.0 / focal
    tensors[0][:, 0] -= tensors[0][:, 2] * shift / focal
    tensors[2] *= 20.0 / focal
    return _compare(tensors, K=camera(focal, _SIZE / 2 + shift, _SIZE / 2))


@cell("splat", "cpu float32", "harmonics", "size of the coefficients [1]", (0.3, 0.0, 1e-10, 1e3, 1e10), oracle=_ORACLE)
def _harmonics(size: float) -> Sample:
    tensors = _gaussians(6)
    tensors[4] = size * torch.randn(6, 16, 3, generator=torch.Generator().manual_seed(3))
    return _compare(tensors)


@cell(
    "splat",
    "arguments",
    "what has no image",
    "case",
    ("NaN mean", "negative scale", "infinite scale", "zero quaternion", "opacity 2", "NaN colour", "NaN camera"),
    quick=("NaN mean",),
    oracle="a one-line refusal",
    refuses=lambda case: True,
)
def _refused(case: Level) -> Sample:
    tensors, view = _gaussians(3), torch.eye(4)
    if case == "NaN mean":
        tensors[0][1, 0] = math.nan
    elif case == "negative scale":
        tensors[2][1, 0] = -1.0
    elif case == "infinite scale":
        tensors[2][1, 0] = math.inf
    elif case == "zero quaternion":
        tensors[1][1] = 0.0
    elif case == "opacity 2":
        tensors[3][1] = 2.0
    elif case == "NaN colour":
        tensors[4][1, 1] = math.nan
    else:
        view[0, 3] = math.nan
    render_gaussians(*tensors, view, camera(), _SIZE, _SIZE, backend="cpu")
    return Sample(math.nan)
