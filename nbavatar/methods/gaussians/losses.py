"""Pictures and losses of the Gaussian baselines, on whole pictures but computed only where something is.

Outside a box around render and truth both are plain background: L1 and squared error are 0 there and SSIM is 1. So a
sum over the box, divided by the pixels of the picture, is the mean over the picture.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from nbavatar.data.views import Sample
from nbavatar.methods.photometric import WINDOW, loss_dssim, loss_l1, loss_mse

__all__ = ["Pair", "compare"]


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
        return loss_l1(self.image, self.truth, pixels=self.pixels)

    def mse(self) -> Tensor:
        """Mean squared difference over the whole picture."""
        return loss_mse(self.image, self.truth, pixels=self.pixels)

    def dssim(self) -> Tensor:
        """1 - SSIM over the whole picture (`loss_dssim`)."""
        return loss_dssim(self.image, self.truth, pixels=self.pixels)


def compare(colour: Tensor, alpha: Tensor, sample: Sample, background: Tensor) -> Pair:
    """Put a render and its truth on a background.

    Args:
        colour: premultiplied, (3, H, W); alpha: (H, W).
        sample: the truth. Pixels that say nothing (of parts that are not in the model, covered, or outside the picture)
            are taken from it for both.
        background: RGB (3,).
    """
    height, width = alpha.shape
    planes = alpha.new_zeros((5, height, width))
    h, w = sample.pixels.shape[-2:]
    planes[:, sample.y0 : sample.y0 + h, sample.x0 : sample.x0 + w] = sample.pixels.to(alpha.device)
    # Two windows of SSIM reach this far from a pixel that differs.
    rows, columns = _box((alpha.detach() > 0) | (planes[3] > 0) | (planes[4] > 0), WINDOW - 1)
    planes, colour, alpha = planes[:, rows, columns], colour[:, rows, columns], alpha[rows, columns]
    behind = background[:, None, None]
    truth = planes[:3] + (1.0 - planes[3]) * behind
    image = torch.lerp(colour + (1.0 - alpha) * behind, truth, planes[4])
    return Pair(image, truth, planes[3], height * width)


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
