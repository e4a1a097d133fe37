"""Peak signal-to-noise ratio, of whole images or of a region.

    PSNR = -10 log10( sum_p w_p sum_c (x_pc - y_pc)^2 / (C sum_p w_p) )   [dB]

with w = 1 for the whole image. Images are sRGB in [0, 1] (peak 1), differences are summed in float64. The mean of
a set is the mean of its images' values, as papers of the field report it, not the PSNR of the mean error.

    case                          answer
    equal images                  +inf
    mask without any weight       NaN: there is nothing to compare
    value outside [0, 1], NaN     DataError (rounding up to 1e-6 is tolerated)
"""

import torch
from torch import Tensor

from nbavatar.errors import DataError

__all__ = ["check_images", "psnr"]

_TOLERANCE = 1e-6


def check_images(x: Tensor, y: Tensor, mask: Tensor | None, metric: str) -> None:
    """Refuses pairs that a metric in [0, 1] has no answer for.

    Args:
        x: float [B, C, H, W].
        y: float [B, C, H, W].
        mask: bool or float [B, H, W] in [0, 1], or None.
        metric: name that the error line begins with.

    Raises:
        DataError: shapes differ, integers, NaN, or values outside [0, 1].
    """
    if x.ndim != 4 or x.shape != y.shape or 0 in x.shape:
        raise DataError(f"{metric}: expected two images [B, C, H, W] of one size, found {_sizes(x, y)}")
    if mask is not None and tuple(mask.shape) != (x.shape[0], *x.shape[2:]):
        raise DataError(f"{metric}: expected a mask [B, H, W] for {_sizes(x, y)}, found {list(mask.shape)}")
    for name, image in (("first image", x), ("second image", y), ("mask", mask)):
        if image is None or image.dtype == torch.bool:
            continue
        if not image.is_floating_point():
            raise DataError(f"{metric}: {name}: expected floats in [0, 1], found {image.dtype}; divide by 255")
        low, high = (float(v) for v in torch.aminmax(image.detach()))
        if not (low >= -_TOLERANCE and high <= 1 + _TOLERANCE):  # also false for NaN
            raise DataError(f"{metric}: {name}: expected values in [0, 1], found {low:.6g} to {high:.6g}")


def psnr(x: Tensor, y: Tensor, mask: Tensor | None = None) -> Tensor:
    """PSNR per image [dB].

    Args:
        x: float [B, C, H, W], sRGB in [0, 1].
        y: the same shape and range.
        mask: optional bool or float [B, H, W]: weight of each pixel, such as a foreground mask.

    Returns:
        float64 [B]: +inf for equal images, NaN where the mask is empty.

    Raises:
        DataError: shapes disagree or values are outside [0, 1].
    """
    check_images(x, y, mask, "PSNR")
    error = (x.double() - y.double()).square().mean(dim=1)
    if mask is None:
        mse = error.mean(dim=(1, 2))
    else:
        weight = mask.double()
        mse = (error * weight).sum(dim=(1, 2)) / weight.sum(dim=(1, 2))
    return -10 * torch.log10(mse)


def _sizes(x: Tensor, y: Tensor) -> str:
    return f"{list(x.shape)} and {list(y.shape)}"
