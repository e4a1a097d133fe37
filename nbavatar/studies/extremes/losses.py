"""Cells of the loss terms, float32 (where said, half precision) against float64 on the same numbers."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from nbavatar.mesh.frames import FaceFrames
from nbavatar.methods.base import compose
from nbavatar.methods.billboards.billboards import Billboards, gaussian_alpha_logits
from nbavatar.methods.billboards.losses import knn_graph, loss_delta, loss_dice, loss_dice_haha, loss_knn
from nbavatar.methods.photometric import loss_mse
from nbavatar.studies.extremes.cells import Level, Limit, Sample, Tolerance, cell
from nbavatar.studies.extremes.compare import gradient_error, gradients, relative

__all__: list[str] = []

_ORACLE = "float64 on the same numbers"


def _compare(function: Callable[..., Tensor], inputs: list[Tensor], *, least: float = 1e-12) -> Sample:
    """Value and gradients in the inputs' own precision against float64."""
    value, found = gradients(lambda *leaves: function(*leaves).float(), inputs)
    true, slopes = gradients(function, [tensor.double() for tensor in inputs])
    return Sample(relative(value, true, least=least), gradient_error(found, slopes, least=min(least, 1e-12)))


def _uniform(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


@cell(
    "losses",
    "loss_mse",
    "difference of the images",
    "difference [1]",
    (0.1, 1e-4, 1e-15, 1e-25, 0.0),
    oracle=_ORACLE,
    limits=(Limit(lambda gap: 0 < float(gap) <= 1e-20, 1.0, 1e-4, "squares under 1e-45 are zero in float32"),),
)
def _mse(gap: float) -> Sample:
    target = torch.zeros(3, 8, 8)
    image = gap * _uniform(3, 8, 8)
    return _compare(lambda x: loss_mse(x, target.to(x.dtype)), [image], least=0.0)


@cell("losses", "loss_mse", "number of pixels", "side [px]", (8.0, 256.0, 1024.0), oracle=_ORACLE, quick=(8.0, 256.0))
def _mse_large(side: float) -> Sample:
    n = int(side)
    target = _uniform(3, n, n, seed=1)
    return _compare(lambda x: loss_mse(x, target.to(x.dtype)), [_uniform(3, n, n)])


@cell("losses", "loss_dice", "area of target and prediction", "pixels [1]", (16.0, 1.0, 0.0), oracle=_ORACLE)
def _dice(pixels: float) -> Sample:
    target = torch.zeros(1, 8, 8)
    target.view(-1)[: int(pixels)] = 1.0
    return _compare(lambda p: loss_dice(p, target.to(p.dtype)), [0.9 * target])


@cell(
    "losses",
    "loss_dice",
    "weak prediction, empty target",
    "opacity [1]",
    (1.0, 1e-2, 1e-5, 1e-12, 0.0),
    oracle=_ORACLE,
)
def _dice_weak(value: float) -> Sample:
    return _compare(lambda p: loss_dice(p, torch.zeros_like(p)), [torch.full((1, 8, 8), value)], least=1e-2)


@cell(
    "losses",
    "loss_dice",
    "number of pixels",
    "side [px]",
    (8.0, 256.0, 1024.0, 2048.0),
    oracle=_ORACLE,
    quick=(8.0, 256.0),
)
def _dice_large(side: float) -> Sample:
    n = int(side)
    target = (_uniform(n, n, seed=1) > 0.5).float()
    return _compare(lambda p: loss_dice(p, target.to(p.dtype)), [_uniform(n, n)])


@cell(
    "losses",
    "loss_dice float16",
    "area of target and prediction",
    "case",
    ("some", "none", "1024 x 1024 ones"),
    oracle=_ORACLE,
    quick=("some", "none"),
    limits=(
        Limit(lambda case: case == "1024 x 1024 ones", 1e-5, 0.1, "slopes of 1e-6 are subnormal in half precision"),
    ),
)
def _dice_half(case: str) -> Sample:
    side = 1024 if case == "1024 x 1024 ones" else 8
    target = torch.zeros(side, side) if case == "none" else torch.ones(side, side)
    return _compare(lambda p: loss_dice(p, target.to(p.dtype)), [(0.75 * target).half()])


@cell("losses", "loss_dice_haha", "area of target and prediction", "pixels [1]", (16.0, 1.0, 0.0), oracle=_ORACLE)
def _haha(pixels: float) -> Sample:
    target = torch.zeros(1, 8, 8)
    target.view(-1)[: int(pixels)] = 1.0
    return _compare(lambda p: loss_dice_haha(p, target.to(p.dtype)), [0.9 * target])


def _primitives(spread: float, count: int = 12, place: float = 0.0) -> tuple[list[Tensor], Tensor]:
    """Posed billboards that differ from their neighbours by `spread`, and the neighbours."""
    means = place + spread * (_uniform(count, 3, seed=2) - 0.5)
    quats = torch.tensor([0.9, -0.1, 0.3, 0.3]) + spread * (_uniform(count, 4, seed=3) - 0.5)
    extents = 0.01 * (1 + spread * _uniform(count, 2, seed=4))
    graph = knn_graph(_uniform(count, 3, seed=5), torch.zeros(count, dtype=torch.int64), 3)
    return [means, quats / quats.norm(dim=-1, keepdim=True), extents], graph


@cell(
    "losses",
    "loss_knn",
    "spread of the neighbours",
    "relative spread [1]",
    (0.5, 1e-2, 1e-4, 1e-6, 0.0),
    oracle=_ORACLE,
    limits=(Limit(lambda spread: float(spread) <= 1e-6, 1e-4, 1e-2, "differences of numbers of 24 bits"),),
)
def _knn(spread: float) -> Sample:
    tensors, graph = _primitives(spread)
    return _compare(lambda *values: loss_knn(*values, graph), tensors, least=1e-9)


@cell("losses", "loss_knn", "billboards far from the origin", "offset [m]", (0.0, 1.0, 1e2, 1e4), oracle=_ORACLE)
def _knn_far(offset: float) -> Sample:
    tensors, graph = _primitives(0.3, place=offset)
    return _compare(lambda *values: loss_knn(*values, graph), tensors)


@cell(
    "losses", "loss_knn", "signs of the quaternions", "share flipped [1]", (0.0, 0.5, 1.0), oracle="unflipped, float64"
)
def _knn_signs(share: float) -> Sample:
    tensors, graph = _primitives(0.3)
    flip = torch.where(_uniform(12, 1, seed=6) < share, -1.0, 1.0)
    value, slopes = gradients(lambda *values: loss_knn(*values, graph), [tensors[0], tensors[1] * flip, tensors[2]])
    true, wanted = gradients(lambda *values: loss_knn(*values, graph), [t.double() for t in tensors])
    slopes[1] = slopes[1] * flip
    return Sample(relative(value, true), gradient_error(slopes, wanted))


@cell(
    "losses",
    "knn_graph",
    "points",
    "case",
    ("random", "all in one place", "fewer than K", "one point", "1e4 m away"),
    oracle="distances in float64, one by one",
    exact=Tolerance(0.0, 0.0),
    unit="wrong neighbours",
)
def _graph(case: Level) -> Sample:
    points = _uniform(9, 3, seed=7)
    if case == "all in one place":
        points = torch.zeros(9, 3)
    elif case in ("fewer than K", "one point"):
        points = points[: 2 if case == "fewer than K" else 1]
    elif case == "1e4 m away":
        points = points + 1e4
    found = knn_graph(points, torch.zeros(len(points), dtype=torch.int64), 3)
    wrong = 0
    exact = points.double()
    for i, row in enumerate(found.tolist()):
        distances = (exact - exact[i]).square().sum(-1).sqrt()
        best = torch.sort(distances).values[: min(3, len(points))].tolist()
        best += best[-1:] * (3 - len(best))
        wrong += row[0] != i or any(abs(float(distances[j]) - d) > 1e-12 for j, d in zip(row, best, strict=True))
    return Sample(float(wrong))


@cell(
    "losses",
    "loss_delta",
    "size of the offsets",
    "offset [k]",
    (0.1, 1e-10, 1e-25, 0.0, 1e10),
    oracle=_ORACLE,
    limits=(Limit(lambda size: 0 < float(size) <= 1e-20, 1.0, 1e-4, "squares under 1e-45 are zero in float32"),),
)
def _delta(size: float) -> Sample:
    return _compare(loss_delta, [size * _uniform(9, 3)], least=0.0)


@cell("losses", "compose", "opacity", "alpha [1]", (0.5, 0.0, 1.0, 1e-7, 1e-38), oracle=_ORACLE)
def _compose(alpha: float) -> Sample:
    background = torch.tensor([0.2, 0.9, 0.4])
    weight = _uniform(3, 4, 4, seed=8).double() - 0.5
    return _compare(
        lambda colour, a: (compose(colour, a, background.to(a.dtype)) * weight.to(a.dtype)).sum(),
        [_uniform(3, 4, 4), torch.full((4, 4), alpha)],
    )


@cell(
    "losses",
    "alpha logits",
    "logit",
    "logit [1]",
    (0.0, 5.0, 20.0, 100.0, 1e4, -20.0, -80.0, -100.0, -1e4),
    oracle=_ORACLE,
    limits=(
        Limit(lambda x: float(x) <= -100, 1.0, 1.0, "opacity under 1e-38 is zero"),
        Limit(lambda x: float(x) >= 20, 1e-7, 1.0, "1 - opacity under 6e-8 is zero, and so is the slope"),
    ),
)
def _logits(value: float) -> Sample:
    return _compare(lambda x: torch.sigmoid(x).sum(), [torch.full((3,), value)], least=1e-38)


@cell(
    "losses",
    "gaussian_alpha_logits",
    "width of the Gaussian",
    "sigma [1]",
    (0.5, 1e-2, 1e-6, 1e-100, 1e6),
    oracle="formula in mpmath",
)
def _gaussian(sigma: float) -> Sample:
    import mpmath
    import numpy as np

    found = gaussian_alpha_logits(5, sigma=sigma, peak=0.9, floor=0.01)
    with mpmath.workdps(40):
        axis = [mpmath.mpf(i - 2) / 2 for i in range(5)]
        alpha = [
            [
                max(mpmath.mpf(0.9) * mpmath.exp(-(x * x + y * y) / (2 * mpmath.mpf(sigma) ** 2)), mpmath.mpf(0.01))
                for x in axis
            ]
            for y in axis
        ]
        true = np.array([[float(mpmath.log(a / (1 - a))) for a in row] for row in alpha])
    return Sample(relative(found, true))


@cell(
    "losses",
    "Billboards.pose",
    "logarithm of the scale",
    "log scale [1]",
    (0.0, -12.0, -100.0, 4.0, 100.0, 1e30),
    oracle=_ORACLE,
)
def _pose(log_scale: float) -> Sample:
    """Scales are held between e^-12 and e^4 face sizes; beyond, the gradient is zero."""
    billboards = Billboards(torch.ones(4, 2), torch.zeros(4, 2, 2, 3), torch.zeros(4, 2, 2))
    frames = FaceFrames(_uniform(4, 3), torch.eye(3).expand(4, 3, 3), torch.full((4,), 0.01))

    def extents(scale: Tensor) -> Tensor:
        billboards.to(scale.dtype)
        del billboards.log_scale
        billboards.log_scale = scale  # type: ignore[assignment]
        posed = billboards.pose(FaceFrames(*(value.to(scale.dtype) for value in frames)))
        return posed.half_extents.sum() + posed.means.sum() + posed.quats.sum()

    sample = _compare(extents, [torch.full((4, 2), log_scale)])
    return sample if math.isfinite(sample.forward) else Sample(math.nan)
