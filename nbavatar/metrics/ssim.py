"""Structural similarity, Wang et al. 2004, equations 13 to 16.

Window: Gaussian, 11 x 11, sigma 1.5 px, normalised to sum 1; K1 = 0.01, K2 = 0.03, L = 1; variances without Bessel's
correction (their eq. 14). Border: only windows that lie wholly inside the image count, so 5 px a side are cropped
and nothing is padded. Colour: computed per channel of sRGB and averaged. This is what scikit-image computes with
``gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1, channel_axis``. (Gaussian splatting
code bases pad with zeros instead: their values differ in the third digit on white backgrounds; torchmetrics gives the
same map inside, to 1e-12, but averages a reflected border with it: 0.734 for 0.737 on a blurred photograph of 128 px.)

Everything is computed in float64: E[x^2] - E[x]^2 loses its digits in float32 where images are flat.

    case                          answer
    equal images                  1
    two constant images a, b      (2ab + C1) / (a^2 + b^2 + C1)
    mask without any weight       NaN
    image below 11 px a side      DataError
    value outside [0, 1], NaN     DataError
"""

import torch
from torch import Tensor

from nbavatar.errors import DataError
from nbavatar.math.blur import blur
from nbavatar.metrics.psnr import check_images

__all__ = ["SIGMA", "WINDOW", "ssim", "ssim_map"]

WINDOW = 11
SIGMA = 1.5
_C1 = 0.01**2
_C2 = 0.03**2


def ssim_map(x: Tensor, y: Tensor) -> Tensor:
    """SSIM of every complete window, averaged over the channels.

    Args:
        x: float [B, C, H, W], sRGB in [0, 1], H and W at least 11.
        y: the same shape and range.

    Returns:
        float64 [B, H - 10, W - 10]; entry (i, j) belongs to the window centred at pixel (i + 5, j + 5).
    """
    check_images(x, y, None, "SSIM")
    if min(x.shape[-2:]) < WINDOW:
        raise DataError(f"SSIM: expected at least {WINDOW} px a side, found {list(x.shape)}")
    total = torch.zeros(
        (x.shape[0], x.shape[2] - WINDOW + 1, x.shape[3] - WINDOW + 1), dtype=torch.float64, device=x.device
    )
    # One channel at a time: at 1024 x 1024 the five moments of all channels together would take 240 MB.
    for channel in range(x.shape[1]):
        a, b = x[:, channel].double(), y[:, channel].double()
        mean_a, mean_b, square_a, square_b, product = _complete_windows(torch.stack((a, b, a * a, b * b, a * b)))
        luminance = mean_a * mean_b
        energy = mean_a.square() + mean_b.square()
        numerator = (2 * luminance + _C1) * (2 * (product - luminance) + _C2)
        denominator = (energy + _C1) * (square_a + square_b - energy + _C2)
        total = total + numerator / denominator
    return total / x.shape[1]


def ssim(x: Tensor, y: Tensor, mask: Tensor | None = None) -> Tensor:
    """Mean SSIM per image; differentiable.

    Args:
        x: float [B, C, H, W], sRGB in [0, 1].
        y: the same shape and range.
        mask: optional bool or float [B, H, W]: weight of the window centred at each pixel. Windows on the rim of
            the mask also see 5 px of its outside.

    Returns:
        float64 [B] in [-1, 1]; NaN where the mask (without its 5 px border) is empty.

    Raises:
        DataError: shapes disagree, a side below 11 px, or values outside [0, 1].
    """
    values = ssim_map(x, y)
    if mask is None:
        return values.mean(dim=(1, 2))
    check_images(x, y, mask, "SSIM")
    margin = WINDOW // 2
    weight = mask.double()[:, margin:-margin, margin:-margin]
    return (values * weight).sum(dim=(1, 2)) / weight.sum(dim=(1, 2))


def _complete_windows(images: Tensor) -> Tensor:
    """Means of images [..., H, W] in every window that lies wholly inside, [..., H - 10, W - 10]."""
    margin = WINDOW // 2
    offsets = torch.arange(WINDOW, dtype=images.dtype) - margin
    taps = torch.exp(-(offsets**2) / (2 * SIGMA**2))
    blurred = blur(images.flatten(0, -3), (taps / taps.sum()).to(images.device)).view(images.shape)
    return blurred[..., margin:-margin, margin:-margin]
