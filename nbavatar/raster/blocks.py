"""Blocks of pixels in which the plain torch references work through an image, so that their memory stays bounded."""

from collections.abc import Iterator

import torch
from torch import Tensor

__all__ = ["pixel_blocks"]

_BLOCK = 32  # pixels a side of a block
_BUDGET = 4_000_000  # largest number of float64 values in one intermediate of a block


def pixel_blocks(
    bounds: Tensor, rank: Tensor, width: int, height: int, values: int
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Yields (members, x, y): primitives in rank order that may touch a block, and pixels of it.

    Args:
        bounds: (N, 4) x0, y0, x1, y1 of each primitive on the image [px].
        rank: (N,) ids in blending order.
        width, height: of the image [px].
        values: numbers that one primitive takes at one pixel.
    """
    x0, y0, x1, y1 = bounds[rank].unbind(-1)
    for top in range(0, height, _BLOCK):
        bottom = min(top + _BLOCK, height)
        in_rows = (y0 <= bottom) & (y1 >= top) & (x0 <= x1)
        for left in range(0, width, _BLOCK):
            right = min(left + _BLOCK, width)
            members = rank[in_rows & (x0 <= right) & (x1 >= left)]
            if len(members) == 0:
                continue
            y, x = torch.meshgrid(
                torch.arange(top, bottom, device=bounds.device),
                torch.arange(left, right, device=bounds.device),
                indexing="ij",
            )
            step = max(1, _BUDGET // (len(members) * values))
            yield from ((members, px, py) for px, py in zip(x.ravel().split(step), y.ravel().split(step), strict=True))
