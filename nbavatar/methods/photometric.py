"""How much two pictures differ, as losses that all methods share: squared error, L1, and D-SSIM.

The paper's loss has the squared error. L1 and D-SSIM are the Gaussian methods' and, by option, the billboards'.
"""

import functools

import torch
from torch import Tensor

from nbavatar.math.blur import blur

__all__ = ["WINDOW", "loss_dssim", "loss_l1", "loss_mse"]

WINDOW = 11
"""Side of the window of D-SSIM [px]."""

# Stated here, not taken from the metric, whose edits must not train again.
_SIGMA, _C1, _C2 = 1.5, 0.01**2, 0.03**2


def loss_mse(image: Tensor, target: Tensor, *, pixels: int | None = None) -> Tensor:
    """Mean squared error of colours.

    Args:
        image, target: float [..., C, H, W] in [0, 1].
        pixels: number of pixels the mean runs over, when the images are a window of a larger frame whose remainder is
            equal in both (plain background); the window's own by default.

    Returns:
        Scalar.
    """
    squares = (image - target).square()
    if pixels is None:
        return squares.mean()
    return squares.sum() / (image.shape[-3] * pixels)


def loss_l1(image: Tensor, target: Tensor, *, pixels: int | None = None) -> Tensor:
    """Mean absolute difference of colours; arguments as in `loss_mse`."""
    return (image - target).abs().sum() / (image.shape[-3] * (pixels or image.shape[-2] * image.shape[-1]))


def loss_dssim(image: Tensor, target: Tensor, *, pixels: int | None = None) -> Tensor:
    """1 - SSIM as the Gaussian splatting codes compute it: Wang et al. 2004, equations 13 to 16, mean over channels.

    The window is Gaussian, 11 x 11, of 1.5 px of the images that are given: of a picture made smaller it spans more of
    the scene, as in multi-scale SSIM. Beyond the images both are zero, so every pixel has a value and no image is too
    small. (The metric that avatars are judged by, `nbavatar.metrics.ssim`, counts complete windows only.) A pixel
    without truth that is given one value in both says nothing itself, and its neighbours are compared as if it were
    right.

    Args:
        image, target: float32 or float64 [C, H, W] in [0, 1].
        pixels: as in `loss_mse`; what is equal in both must then reach 5 px into the images for the mean to be exact.

    Returns:
        Scalar in [0, 2]; 0 where the images are equal.
    """
    channels, height, width = image.shape
    # The variances count as their sum only, so the squares are blurred together.
    moments = torch.stack((image, target, image.square() + target.square(), image * target))
    blurred = blur(moments.flatten(0, 1), _taps(moments.dtype, image.device)).view(4, channels, height, width)
    mean_x, mean_y, squares, product = blurred
    means, energy = mean_x * mean_y, mean_x.square() + mean_y.square()
    ssim = (2 * means + _C1) * (2 * (product - means) + _C2)
    ssim = ssim / ((energy + _C1) * (squares - energy + _C2))
    return (1.0 - ssim).sum() / (channels * (pixels or height * width))


@functools.cache
def _taps(dtype: torch.dtype, device: torch.device) -> Tensor:
    offsets = torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2
    taps = torch.exp(-offsets.square() / (2 * _SIGMA**2))
    return (taps / taps.sum()).to(dtype=dtype, device=device)
