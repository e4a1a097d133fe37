"""Pictures and losses of the Gaussian baselines, on whole pictures but computed only where something is.

Outside a box around render and truth both are plain background: L1 and squared error are 0 there and SSIM is 1. So a
sum over the box, divided by the pixels of the picture, is the mean over the picture.
"""

import functools
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from nbavatar.data.views import Sample

__all__ = ["Pair", "compare", "dssim"]

_WINDOW, _SIGMA = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2


class Pair(NamedTuple):
    """Render and truth on one background, cut to the box where they may differ.

    Attributes:
        image, truth: (3, h, w).
        alpha: of the truth, (h, w).
        pixels: of the whole picture.
    """

    image: Tensor
    truth: Tensor
    alpha: Tensor
    pixels: int

    def l1(self) -> Tensor:
        """Mean absolute difference over the whole picture."""
        return (self.image - self.truth).abs().sum() / (3 * self.pixels)

    def mse(self) -> Tensor:
        """Mean squared difference over the whole picture."""
        return (self.image - self.truth).square().sum() / (3 * self.pixels)


def compare(colour: Tensor, alpha: Tensor, sample: Sample, background: Tensor) -> Pair:
    """Put a render and its truth on a background.

    Args:
        colour: premultiplied, (3, H, W); alpha: (H, W).
        sample: the truth. Pixels of parts that are in the picture but not in the model are taken from it for both.
        background: RGB (3,).
    """
    height, width = alpha.shape
    planes = alpha.new_zeros((5, height, width))
    h, w = sample.pixels.shape[-2:]
    planes[:, sample.y0 : sample.y0 + h, sample.x0 : sample.x0 + w] = sample.pixels.to(alpha.device)
    # Two windows of SSIM reach this far from a pixel that differs.
    rows, columns = _box((alpha.detach() > 0) | (planes[3] > 0) | (planes[4] > 0), _WINDOW - 1)
    planes, colour, alpha = planes[:, rows, columns], colour[:, rows, columns], alpha[rows, columns]
    behind = background[:, None, None]
    truth = planes[:3] + (1.0 - planes[3]) * behind
    image = torch.lerp(colour + (1.0 - alpha) * behind, truth, planes[4])
    return Pair(image, truth, planes[3], height * width)


def dssim(pair: Pair) -> Tensor:
    """1 - SSIM over the whole picture, as the Gaussian splatting codes compute it.

    Wang et al. 2004 with an 11 x 11 Gaussian window of 1.5 px, zeros beyond the picture, mean over channels. (The
    metric that avatars are judged by, `nbavatar.metrics.ssim`, counts complete windows only.)
    """
    stacked = torch.stack((pair.image, pair.truth))
    moments = torch.cat((stacked, stacked.square(), (pair.image * pair.truth)[None]))
    mean_x, mean_y, square_x, square_y, product = _blur(moments.flatten(0, 1)[:, None]).view(5, 3, *pair.alpha.shape)
    covariance = product - mean_x * mean_y
    variances = (square_x - mean_x.square()) + (square_y - mean_y.square())
    ssim = (2 * mean_x * mean_y + _C1) * (2 * covariance + _C2)
    ssim = ssim / ((mean_x.square() + mean_y.square() + _C1) * (variances + _C2))
    return (1.0 - ssim).sum() / (3 * pair.pixels)


def _box(content: Tensor, margin: int) -> tuple[slice, slice]:
    """Rows and columns of the smallest rectangle around true pixels, widened; one pixel where there are none."""
    slices = []
    for axis in (1, 0):
        where = content.any(axis).nonzero()
        size = content.shape[1 - axis]
        if len(where) == 0:
            slices.append(slice(0, 1))
        else:
            slices.append(slice(max(0, int(where[0]) - margin), min(size, int(where[-1]) + 1 + margin)))
    return slices[0], slices[1]


def _blur(planes: Tensor) -> Tensor:
    """Gaussian window over planes (B, 1, h, w), zeros beyond."""
    # One group a plane: torch has a fast kernel for that, and none for one channel in a batch.
    count, taps = len(planes), _taps(planes.dtype, planes.device).expand(len(planes), 1, _WINDOW)
    rows = F.conv2d(planes.transpose(0, 1), taps[..., None], padding=(_WINDOW // 2, 0), groups=count)
    return F.conv2d(rows, taps[:, :, None], padding=(0, _WINDOW // 2), groups=count).transpose(0, 1)


@functools.cache
def _taps(dtype: torch.dtype, device: torch.device) -> Tensor:
    offsets = torch.arange(_WINDOW, dtype=torch.float64) - _WINDOW // 2
    taps = torch.exp(-offsets.square() / (2 * _SIGMA**2))
    return (taps / taps.sum()).to(dtype=dtype, device=device).view(1, 1, _WINDOW)
