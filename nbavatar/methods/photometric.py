"""How much two pictures differ, as losses that all methods share: squared error, L1, and D-SSIM.

The paper's loss has the squared error. L1 and D-SSIM are the Gaussian methods' and, by option, the billboards'.
"""

import functools

import torch
from torch import Tensor
from torch.nn import functional as F

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
        image, target: float [C, H, W] in [0, 1].
        pixels: as in `loss_mse`; what is equal in both must then reach 5 px into the images for the mean to be exact.

    Returns:
        Scalar in [0, 2]; 0 where the images are equal.
    """
    channels, height, width = image.shape
    stacked = torch.stack((image, target))
    moments = torch.cat((stacked, stacked.square(), (image * target)[None]))
    blurred = _blur(moments.flatten(0, 1)[:, None]).view(5, channels, height, width)
    mean_x, mean_y, square_x, square_y, product = blurred
    covariance = product - mean_x * mean_y
    variances = (square_x - mean_x.square()) + (square_y - mean_y.square())
    ssim = (2 * mean_x * mean_y + _C1) * (2 * covariance + _C2)
    ssim = ssim / ((mean_x.square() + mean_y.square() + _C1) * (variances + _C2))
    return (1.0 - ssim).sum() / (channels * (pixels or height * width))


def _blur(planes: Tensor) -> Tensor:
    """Gaussian window over planes (B, 1, h, w), zeros beyond."""
    # One group a plane: torch has a fast kernel for that, and none for one channel in a batch.
    count, taps = len(planes), _taps(planes.dtype, planes.device).expand(len(planes), 1, WINDOW)
    rows = F.conv2d(planes.transpose(0, 1), taps[..., None], padding=(WINDOW // 2, 0), groups=count)
    return F.conv2d(rows, taps[:, :, None], padding=(0, WINDOW // 2), groups=count).transpose(0, 1)


@functools.cache
def _taps(dtype: torch.dtype, device: torch.device) -> Tensor:
    offsets = torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2
    taps = torch.exp(-offsets.square() / (2 * _SIGMA**2))
    return (taps / taps.sum()).to(dtype=dtype, device=device).view(1, 1, WINDOW)
