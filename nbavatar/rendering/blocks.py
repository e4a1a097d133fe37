"""Blocks of pixels in which the plain torch references work through an image, so that their memory stays bounded."""

from collections.abc import Iterator

import torch
from torch import Tensor

__all__ = ["pixel_blocks"]

_BLOCK = 32  # pixels a side of a block, unless too many primitives touch it
_BUDGET = 4_000_000  # largest number of float64 values in one intermediate of a block


def pixel_blocks(
    bounds: Tensor, rank: Tensor, width: int, height: int, values: int
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Yields (members, x, y): primitives in rank order that may touch a block, and pixels of it.

    A block whose intermediates would be too large is halved, down to single pixels: its parts are touched by
    fewer primitives, so the work stays in proportion to what there is to blend.

    Args:
        bounds: (N, 4) x0, y0, x1, y1 of each primitive on the image [px].
        rank: (N,) ids in blending order.
        width, height: of the image [px].
        values: numbers that one primitive takes at one pixel.
    """
    x0, y0, x1, y1 = bounds.unbind(-1)

    def touching(members: Tensor, left: int, top: int, right: int, bottom: int) -> Tensor:
        a, b, c, d = (edge[members] for edge in (x0, y0, x1, y1))
        return members[(a <= c) & (a <= right) & (c >= left) & (b <= bottom) & (d >= top)]

    for first in range(0, height, _BLOCK):
        last = min(first + _BLOCK, height)
        in_rows = touching(rank, 0, first, width, last)
        blocks = [(in_rows, left, first, min(left + _BLOCK, width), last) for left in range(0, width, _BLOCK)]
        while blocks:
            outer, left, top, right, bottom = blocks.pop()
            members = touching(outer, left, top, right, bottom)
            if len(members) == 0:
                continue
            across, down = right - left, bottom - top
            if len(members) * values * across * down > _BUDGET and across * down > 1:
                x, y = (left + across // 2, bottom) if across >= down else (right, top + down // 2)
                rest = (x, top, right, bottom) if across >= down else (left, y, right, bottom)
                blocks += [(members, left, top, x, y), (members, *rest)]
                continue
            y, x = torch.meshgrid(
                torch.arange(top, bottom, device=bounds.device),
                torch.arange(left, right, device=bounds.device),
                indexing="ij",
            )
            yield members, x.ravel(), y.ravel()
