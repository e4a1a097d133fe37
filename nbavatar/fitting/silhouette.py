"""Silhouettes as a term of the refit: contours of the mesh against the border of a mask, by distance maps.

A mask becomes a signed distance map (negative inside), sampled bilinearly. Two kinds of mask are understood:

    matte   the whole person, hair and clothes included: sample points of the mesh may not lie outside
    labels  head and hands only: points on the mesh's rim (surface normal across the line of sight) that are near the
            border have to lie on it, from either side, unless the border is that of something in front of them; others
            may not lie outside

Keypoints say nothing of the back of a head; contours do. Masks are used at reduced size and in a few frames spread over
the sequence: what they add is mostly the shape, which all frames share.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from nbavatar.camera.distortion import distort_pixels

__all__ = [
    "FAR",
    "SilhouettePull",
    "Silhouettes",
    "choose_rim",
    "distance_map",
    "ideal_mask",
    "pull_to_silhouettes",
    "signed_distance_map",
]

FAR = 1e6
"""Distance to what is nowhere [px]."""
_RIM = 0.2
"""Largest cosine between surface normal and line of sight on the rim."""


@dataclasses.dataclass(frozen=True)
class Silhouettes:
    """Distance maps of some frames.

    Attributes:
        frames: positions in the sequence, int64 `[n]`, increasing.
        distance: `[M, n, h, w]`, float32 [px of the full, undistorted image]; 0 everywhere for a missing mask.
        scale: map pixels per image pixel `[M]`.
        border: whether rim points are drawn to the border (labels), or only kept from the outside (matte).
        band: how far from the border a rim point may be drawn [px].
        deviation: typical distance of a correct contour from the border [px].
        weight: weight of one point, against one keypoint of confidence 1.
        cover: distance to the nearest pixel that says nothing, likewise `[M, n, h, w]`; None where there is none.
        drawn: bool `[M, n, P]`, which points are drawn to the border; None before the choice (`choose_rim`).
    """

    frames: Tensor
    distance: Tensor
    scale: Tensor
    border: bool
    band: float
    deviation: float
    weight: float
    cover: Tensor | None = None
    drawn: Tensor | None = None


class SilhouettePull(NamedTuple):
    """Residuals of P points in M cameras: value [px] and gradient by the pixel position, and weights."""

    residual: Tensor
    gradient: Tensor
    weight: Tensor


def ideal_mask(mask: np.ndarray, K: np.ndarray, distortion: np.ndarray | None, lines: int) -> tuple[np.ndarray, float]:
    """Reduces a mask and removes lens distortion, by the nearest pixel.

    Args:
        mask: bool `[..., H, W]`, as recorded.
        K: camera matrix of it `[3, 3]` [px].
        distortion: its coefficients, or None.
        lines: height of the result; at most H.

    Returns:
        bool `[..., h, w]` and its pixels per pixel of the mask.
    """
    height, width = mask.shape[-2:]
    scale = min(lines, height) / height
    shape = (max(round(height * scale), 1), max(round(width * scale), 1))
    grid = np.stack(np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(shape[0]) + 0.5), axis=-1) / scale
    source = np.floor(distort_pixels(grid, K, distortion)).astype(int)
    inside = (source >= 0).all(-1) & (source[..., 0] < width) & (source[..., 1] < height)
    column, row = np.clip(source[..., 0], 0, width - 1), np.clip(source[..., 1], 0, height - 1)
    return mask[..., row, column] & inside, scale


def signed_distance_map(mask: np.ndarray, pixel: float) -> np.ndarray:
    """Signed distance to the border of a mask, negative inside.

    Args:
        mask: bool `[h, w]`.
        pixel: size of its pixels [px of the full image].

    Returns:
        float32 `[h, w]` [px of the full image]; 0 everywhere when the mask is empty or full.
    """
    from scipy.ndimage import distance_transform_edt

    if mask.all() or not mask.any():
        return np.zeros(mask.shape, dtype=np.float32)
    # Distances count from pixel centres: the border is half a pixel from either side.
    outside, inside = (np.asarray(distance_transform_edt(where)) for where in (~mask, mask))
    return (pixel * np.where(mask, 0.5 - inside, outside - 0.5)).astype(np.float32)


def distance_map(mask: np.ndarray, pixel: float) -> np.ndarray:
    """Distance to the nearest true pixel of a mask bool `[h, w]`, float32 [px of the full image]; else `FAR`."""
    from scipy.ndimage import distance_transform_edt

    if not mask.any():
        return np.full(mask.shape, FAR, np.float32)
    return (pixel * np.asarray(distance_transform_edt(~mask))).astype(np.float32)


def choose_rim(masks: Silhouettes, pixels: Tensor, camera: Tensor, normals: Tensor) -> Silhouettes:
    """Chooses the points that are drawn to the border; kept for many steps, so that the cost stays continuous.

    Args:
        masks: distance maps.
        pixels: ideal pixels of the points `[M, n, P, 2]` [px].
        camera: the points in camera axes `[M, n, P, 3]` [m].
        normals: unit normals in camera axes `[M, n, P, 3]`.
    """
    if not masks.border:
        return masks
    value, _ = _sample(masks.distance, masks, pixels)
    sight = camera / camera.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    rim = (normals * sight).sum(-1).abs() < _RIM
    rim &= value.abs() < masks.band
    if masks.cover is not None:  # the border nearest to a point is the cover's where no part of it is farther than that
        away, _ = _sample(masks.cover, masks, pixels)
        rim &= away > value.abs() + 1.0 / masks.scale[:, None, None]
    return dataclasses.replace(masks, drawn=rim)


def pull_to_silhouettes(masks: Silhouettes, pixels: Tensor, camera: Tensor) -> SilhouettePull:
    """Compares sample points `[M, n, P]` with the masks; arguments as in `choose_rim`."""
    value, gradient = _sample(masks.distance, masks, pixels)
    outside = value > 0
    used = (outside if masks.drawn is None else masks.drawn | outside) & (camera[..., 2] > 1e-3)
    squared = value**2
    # Geman-McClure of three deviations, as for keypoints: a mask may be wrong too.
    width = (3 * masks.deviation) ** 2
    robust = (width / (width + squared)) ** 2
    weight = torch.where(used, masks.weight * robust / masks.deviation**2, torch.zeros_like(value))
    return SilhouettePull(value, gradient, weight)


def _sample(maps: Tensor, masks: Silhouettes, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Bilinear value `[M, n, P]` and gradient `[M, n, P, 2]` of distance maps `[M, n, h, w]`; zero outside of them."""
    height, width = maps.shape[2:]
    place = pixels * masks.scale[:, None, None, None] - 0.5
    x, y = place[..., 0], place[..., 1]
    known = (x >= 0) & (y >= 0) & (x < width - 1) & (y < height - 1)
    x, y = x.clamp(0, width - 1.001), y.clamp(0, height - 1.001)
    column, row = x.floor().long(), y.floor().long()
    u, v = x - column, y - row
    flat = maps.flatten(2).double()
    index = (row * width + column).reshape(*pixels.shape[:3])
    a, b, c, d = (flat.gather(2, index + offset) for offset in (0, 1, width, width + 1))
    value = (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * d)
    slope = torch.stack([(1 - v) * (b - a) + v * (d - c), (1 - u) * (c - a) + u * (d - b)], -1)
    slope = slope * masks.scale[:, None, None, None]
    zero = torch.zeros_like(value)
    return torch.where(known, value, zero), torch.where(known[..., None], slope, torch.zeros_like(slope))
