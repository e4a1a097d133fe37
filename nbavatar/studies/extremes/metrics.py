"""Cells of the metrics: constant and equal images, tiny and one-pixel masks, empty masks, black."""

import math

import numpy as np
import torch
from torch import Tensor

from nbavatar.metrics.lpips import load_lpips
from nbavatar.metrics.psnr import psnr
from nbavatar.metrics.ssim import SIGMA, WINDOW, ssim
from nbavatar.studies.extremes.cells import Level, Limit, Refusal, Sample, Tolerance, cell
from nbavatar.studies.extremes.compare import gradient_error, gradients, precise, relative

__all__: list[str] = []

_EXACT = Tolerance(1e-9, 1e-6)
_DIGITS = "definition with 40 digits (mpmath)"


def _images(side: int = 14, seed: int = 0) -> tuple[Tensor, Tensor]:
    random = torch.Generator().manual_seed(seed)
    x = torch.rand(1, 3, side, side, generator=random)
    return x, (x + 0.1 * torch.randn(x.shape, generator=random)).clamp(0, 1)


def _psnr_true(x: Tensor, y: Tensor, mask: Tensor | None = None) -> float:
    import mpmath

    with mpmath.workdps(40):
        error = (precise(x.numpy()) - precise(y.numpy())) ** 2
        weight = precise(np.ones(x.shape) if mask is None else mask.double()[:, None].expand(x.shape).numpy())
        total = weight.sum()
        mse = (error * weight).sum() / total
        return math.inf if mse == 0 else float(-10 * mpmath.log10(mse))


def _ssim_true(x: Tensor, y: Tensor) -> float:
    """Mean SSIM by its definition: weighted moments of every window, variances about the mean."""
    import mpmath

    with mpmath.workdps(40):
        offsets = range(-(WINDOW // 2), WINDOW // 2 + 1)
        line = np.array([mpmath.exp(-mpmath.mpf(o * o) / (2 * mpmath.mpf(SIGMA) ** 2)) for o in offsets])
        window = np.outer(line, line) / line.sum() ** 2
        c1, c2 = mpmath.mpf("0.01") ** 2, mpmath.mpf("0.03") ** 2
        total, count = mpmath.mpf(0), 0
        for a, b in zip(precise(x[0].numpy()), precise(y[0].numpy()), strict=True):
            for row in range(a.shape[0] - WINDOW + 1):
                for column in range(a.shape[1] - WINDOW + 1):
                    p, q = (image[row : row + WINDOW, column : column + WINDOW] for image in (a, b))
                    mp, mq = (window * p).sum(), (window * q).sum()
                    vp, vq = (window * (p - mp) ** 2).sum(), (window * (q - mq) ** 2).sum()
                    both = (window * (p - mp) * (q - mq)).sum()
                    total += (2 * mp * mq + c1) * (2 * both + c2) / ((mp**2 + mq**2 + c1) * (vp + vq + c2))
                    count += 1
        return float(total / count)


@cell(
    "metrics",
    "psnr",
    "difference of the images",
    "difference [1]",
    (0.1, 1e-4, 1e-7, 1.0, 0.0),
    oracle=_DIGITS,
    exact=_EXACT,
)
def _psnr_close(gap: float) -> Sample:
    x = torch.full((1, 3, 5, 5), 0.5 if gap < 0.5 else 0.0)
    y = x + gap
    return Sample(relative(psnr(x, y), _psnr_true(x, y)))


@cell(
    "metrics",
    "psnr",
    "pixels of the mask",
    "weight of all pixels [1]",
    (25.0, 1.0, 1e-3, 1e-30, 0.0),
    oracle=_DIGITS,
    exact=_EXACT,
    refuses=lambda weight: weight == 0.0,
)
def _psnr_mask(weight: float) -> Sample | Refusal:
    x, y = _images(5)
    mask = torch.zeros(1, 5, 5)
    if weight > 1:
        mask[:] = weight / 25
    else:
        mask[0, 2, 2] = weight
    found = psnr(x, y, mask)
    if weight == 0.0:
        return _nothing(found)
    return Sample(relative(found, _psnr_true(x, y, mask)))


def _nothing(found: Tensor) -> Sample | Refusal:
    return Refusal("NaN: the mask is empty") if bool(torch.isnan(found).all()) else Sample(math.nan)


@cell(
    "metrics",
    "ssim",
    "contrast of the images",
    "amplitude [1]",
    (0.5, 1e-2, 1e-4, 1e-6, 0.0),
    oracle=_DIGITS,
    exact=_EXACT,
)
def _ssim_contrast(amplitude: float) -> Sample:
    x, y = (0.4 + amplitude * (image - 0.5) for image in _images(12))
    return Sample(relative(ssim(x, y), _ssim_true(x, y)))


@cell(
    "metrics",
    "ssim",
    "constant images",
    "levels",
    ("0 and 0", "0 and 1", "1 and 1", "0.3 and 0.7"),
    oracle=_DIGITS,
    exact=_EXACT,
    quick=("0 and 0", "0 and 1"),
)
def _ssim_constant(levels: str) -> Sample:
    a, b = (float(value) for value in levels.split(" and "))
    x, y = torch.full((1, 3, 12, 12), a), torch.full((1, 3, 12, 12), b)
    slope = gradients(lambda image: ssim(image, y).sum(), [x])[1]
    error = 0.0 if bool(torch.isfinite(slope[0]).all()) else math.nan
    return Sample(relative(ssim(x, y), _ssim_true(x, y)), error)


@cell(
    "metrics",
    "ssim",
    "pixels of the mask",
    "weight of all pixels [1]",
    (4.0, 1.0, 1e-30, 0.0),
    oracle="single window",
    exact=_EXACT,
    refuses=lambda weight: weight == 0.0,
)
def _ssim_mask(weight: float) -> Sample | Refusal:
    x, y = _images(12)
    mask = torch.zeros(1, 12, 12)
    mask[0, 5:7, 5:7] = weight / 4
    found = ssim(x, y, mask)
    return _nothing(found) if weight == 0.0 else Sample(relative(found, ssim(x, y)))


@cell(
    "metrics",
    "psnr and ssim",
    "what cannot be judged",
    "case",
    ("NaN pixel", "bytes", "values of 255", "sizes differ", "ten pixels for SSIM", "NaN mask"),
    quick=("NaN pixel",),
    oracle="a one-line refusal",
    refuses=lambda case: True,
)
def _refused(case: str) -> Sample:
    x, y = _images()
    if case == "NaN pixel":
        x[0, 0, 3, 3] = math.nan
    elif case == "bytes":
        x = (x * 255).byte()
    elif case == "values of 255":
        x = x * 255
    elif case == "sizes differ":
        x = x[..., 1:]
    elif case == "ten pixels for SSIM":
        ssim(x[..., :10, :10], y[..., :10, :10])
    else:
        psnr(x, y, torch.full((1, 14, 14), math.nan))
    psnr(x, y)
    return Sample(math.nan)


def _lpips(x: Tensor, y: Tensor, *, bound: float = 0.0) -> Sample:
    """AlexNet LPIPS in float32 against float64; an activation that rounding moves across a kink moves the gradient."""
    single, double = load_lpips("alex"), load_lpips("alex").double()
    values: list[Tensor] = []

    def loss(module):
        def run(image: Tensor) -> Tensor:
            values.append(module(image, y.to(image.dtype)))
            return values[-1].sum()

        return run

    found = gradients(loss(single), [x])[1]
    true = gradients(loss(double), [x.double()])[1]
    return Sample(relative(values[0], values[1], least=1e-3), gradient_error(found, true, least=1e-4))


_NET = "the same network in float64"


@cell(
    "metrics",
    "lpips float32",
    "difference of the images",
    "standard deviation [1]",
    (0.1, 1e-2, 1e-4, 1e-6, 0.0),
    oracle=_NET,
    quick=(0.1, 0.0),
    limits=(Limit(lambda gap: 0 < float(gap) <= 1e-2, 1e-4, 5e-2, "the difference of two nearly equal unit vectors"),),
)
def _lpips_close(gap: float) -> Sample:
    x, _ = _images(40)
    noise = torch.randn(x.shape, generator=torch.Generator().manual_seed(9))
    return _lpips(x, (x + gap * noise).clamp(0, 1))


@cell(
    "metrics",
    "lpips float32",
    "constant images",
    "levels",
    ("0 and 0", "0 and 1", "1 and 1", "0.5 and 0.5"),
    oracle=_NET,
    quick=("0 and 0",),
    limits=(Limit(lambda case: case == "0 and 1", 1e-5, 1e-3, "activations at a kink of a rectifier"),),
)
def _lpips_constant(levels: Level) -> Sample:
    a, b = (float(value) for value in str(levels).split(" and "))
    return _lpips(torch.full((1, 3, 40, 40), a), torch.full((1, 3, 40, 40), b))


@cell(
    "metrics",
    "lpips float32",
    "what cannot be judged",
    "case",
    ("30 pixels", "one channel", "sizes differ"),
    oracle="a one-line refusal",
    quick=("30 pixels",),
    refuses=lambda case: True,
)
def _lpips_refused(case: Level) -> Sample:
    x, y = _images(40)
    module = load_lpips("alex")
    if case == "30 pixels":
        module(x[..., :30, :30], y[..., :30, :30])
    elif case == "one channel":
        module(x[:, :1], y[:, :1])
    else:
        module(x, y[..., 1:])
    return Sample(math.nan)
