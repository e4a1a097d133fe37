"""The window of the image that an avatar can touch.

Decoding costs as much for empty pixels as for skin, so features are rasterized and decoded in a box around the
projected billboards only. Its sides are multiples of 2^depth of the U-Net; it may reach over the image border, where
billboards are drawn as everywhere else (the camera is shifted, nothing is padded).
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from nbavatar.methods.billboards.billboards import Posed

__all__ = ["Region", "full_region", "paste", "region_of", "shift_camera", "visible_box"]


class Region(NamedTuple):
    """A window: left column, top row, width, height [px], in the frame of the whole image; may exceed it."""

    x0: int
    y0: int
    width: int
    height: int

    def overlap(self, width: int, height: int) -> tuple[slice, slice, slice, slice]:
        """Rows and columns of an image of this size that lie in the window, then the same in the window's own
        pixels.
        """
        x1, y1 = min(self.x0 + self.width, width), min(self.y0 + self.height, height)
        x0, y0 = max(self.x0, 0), max(self.y0, 0)
        x1, y1 = max(x1, x0), max(y1, y0)
        return (
            slice(y0, y1),
            slice(x0, x1),
            slice(y0 - self.y0, y1 - self.y0),
            slice(x0 - self.x0, x1 - self.x0),
        )


def full_region(width: int, height: int, multiple: int) -> Region:
    """The whole image, extended to multiples of `multiple` to the right and below."""
    return Region(0, 0, -(-width // multiple) * multiple, -(-height // multiple) * multiple)


def region_of(
    posed: Posed,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    *,
    multiple: int,
    margin: float,
    near: float = 0.01,
) -> Region:
    """Smallest aligned window around the visible billboards (`visible_box`).

    Args:
        posed: billboards in world space.
        viewmat: world to camera, (4, 4).
        K: intrinsics [px], (3, 3).
        width, height: image size [px].
        multiple: alignment of both sides [px].
        margin: added on every side, as a share of the longer side of the box (what the mesh does not cover: hair).
        near: near plane [m].

    Returns:
        Region; one tile in the middle of the image when no billboard is visible.
    """
    box = visible_box(posed, viewmat, K, width, height, near=near)
    if box is None:
        return Region((width - multiple) // 2, (height - multiple) // 2, multiple, multiple)
    x0, y0, x1, y1 = box
    extra = margin * max(x1 - x0, y1 - y0)
    left, right = _align(x0 - extra, x1 + extra, width, multiple)
    top, bottom = _align(y0 - extra, y1 + extra, height, multiple)
    return Region(left, top, right - left, bottom - top)


def visible_box(
    posed: Posed, viewmat: Tensor, K: Tensor, width: int, height: int, *, near: float = 0.01
) -> tuple[float, float, float, float] | None:
    """Box x0, y0, x1, y1 [px] inside the image around the billboards that can be seen, or None where none can.

    Each billboard counts as a sphere of its half diagonal, so the box is conservative; the part of the avatar outside
    the image counts for nothing, and if a sphere crosses the near plane the box is the whole image.

    Args:
        posed: billboards in world space; there may be none.
        viewmat: world to camera, (4, 4).
        K: intrinsics [px], (3, 3).
        width, height: image size [px].
        near: near plane [m].
    """
    with torch.no_grad():
        camera = posed.means @ viewmat[:3, :3].T + viewmat[:3, 3]
        radius = posed.half_extents.norm(dim=1) * 1.2  # textures fade out a little beyond +-1
        depth = camera[:, 2]
        if bool(((depth + radius > near) & (depth - radius <= near)).any()):
            return 0.0, 0.0, float(width), float(height)
        front = depth > near
        safe = torch.where(front, depth, torch.ones_like(depth))
        low, high = [], []
        for axis, size in ((0, width), (1, height)):
            centre = camera[:, axis] / safe * K[axis, axis] + K[axis, 2]
            reach = radius / (safe - radius).clamp_min(near) * K[axis, axis].abs() * 1.5
            low.append(torch.where(front, centre - reach, centre.new_full((), float("inf"))))
            high.append(torch.where(front, centre + reach, centre.new_full((), -float("inf"))))
            front = front & (high[-1] > 0) & (low[-1] < size)
        if not bool(front.any()):
            return None
        box = torch.stack([low[0][front].amin(), low[1][front].amin(), high[0][front].amax(), high[1][front].amax()])
        x0, y0, x1, y1 = (float(v) for v in box)
    return max(x0, 0.0), max(y0, 0.0), min(x1, float(width)), min(y1, float(height))


def _align(low: float, high: float, size: int, multiple: int) -> tuple[int, int]:
    """Smallest interval of a multiple's length around [low, high], inside [0, size] where that is possible."""
    low, high = max(low, 0.0), min(high, float(size))
    first = int(low)
    length = max(1, math.ceil((math.ceil(high) - first) / multiple)) * multiple
    # Slide back into the image rather than decode pixels that do not exist.
    first = max(0, min(first, size - length))
    return first, first + length


def shift_camera(K: Tensor, region: Region) -> Tensor:
    """Intrinsics (3, 3) of the window."""
    shifted = K.clone()
    shifted[0, 2] -= region.x0
    shifted[1, 2] -= region.y0
    return shifted


def paste(window: Tensor, region: Region, width: int, height: int, fill: Tensor | float = 0.0) -> Tensor:
    """Put a window (..., h, w) into an image (..., height, width) filled with `fill` (broadcast to the channels)."""
    rows, columns, own_rows, own_columns = region.overlap(width, height)
    image = window.new_zeros((*window.shape[:-2], height, width)) + fill
    image[..., rows, columns] = window[..., own_rows, own_columns]
    return image
