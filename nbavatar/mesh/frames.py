"""Triangle frames {T, R, k}: the local coordinate system that a billboard rides on.

The edge/normal frame follows the local triangle space of GaussianAvatars (Qian et al. 2024, section 3.2), with one change of
column order: a billboard spans its local x and y axes, so the surface normal is the **z** axis here.

    x = direction of the first edge v1 - v0
    z = surface normal (v1 - v0) x (v2 - v0), normalised
    y = z x x, in the plane of the triangle and pointing from the first edge to the third vertex

Where a triangle has no direction of its own (zero area, zero edge, all corners in one point) the missing axes are blended in,
continuously, from the triangles around it. The result is a rotation for every finite input, and its gradient is finite.
"""

from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["FaceFrames", "face_frames"]

# Blend thresholds, dimensionless. Above `_GOOD` a face uses only its own axes, below `_BAD` only its neighbours'. A height
# of 1e-3 edge lengths is where float32 coordinates a metre from the origin start to leave doubt about the normal.
_GOOD = 1e-3
_BAD = 1e-4
# Smallest k, in root-mean-square edge lengths of the mesh: a billboard never collapses to nothing.
_SCALE_FLOOR = 1e-4


class FaceFrames(NamedTuple):
    """Frames of F triangles; leading batch dimensions as in the vertices.

    Attributes:
        T: centroids [m], shape (..., F, 3).
        R: rotations, columns are the axes x (edge), y (in plane), z (normal), shape (..., F, 3, 3).
        k: face sizes, the mean of the first edge's length and the height over it [m], shape (..., F).
    """

    T: Tensor
    R: Tensor
    k: Tensor


def face_frames(verts: Tensor, faces: Tensor) -> FaceFrames:
    """Frame of every triangle: p_world = T + R (k p_local).

    Equivariant under rigid motion; differentiable; no NaN and no zero axis for any finite input. A well-shaped face depends
    on its own three vertices only. A face whose height, first edge or whole size is under 1e-3 (relative) takes the missing
    axes from the faces that share a vertex with it, and from 1e-4 down from them alone. Only if these have none
    either (an isolated sliver), an arbitrary but fixed perpendicular in world axes is used, which is not equivariant.

    Args:
        verts: vertex positions [m], shape (..., V, 3), float32 or float64.
        faces: vertex ids, shape (F, 3), int64.

    Returns:
        `FaceFrames` with T (..., F, 3) [m], R (..., F, 3, 3), k (..., F) [m], of the dtype and on the device of `verts`.
    """
    v0, v1, v2 = (verts.index_select(-2, faces[:, i]) for i in range(3))
    centroid = (v0 + v1 + v2) / 3.0
    edge, side = v1 - v0, v2 - v0
    # Work in units of the mesh, so that thresholds and squares mean the same for a head in metres or in microns.
    squares = _dot(edge, edge) + _dot(side, side) + _dot(v2 - v1, v2 - v1)
    unit = _safe_sqrt(squares.mean(-1, keepdim=True) / 3.0).clamp_min(torch.finfo(verts.dtype).tiny ** 0.5)
    edge, side, squares = edge / unit[..., None], side / unit[..., None], squares / unit**2

    cross = torch.linalg.cross(edge, side)
    around_normal, around_edge = _neighbourhood(cross, edge, faces, verts.shape[-2])

    # Squared quality in [0, 1]: 1 for an equilateral triangle, 0 for zero area.
    safe_squares = squares.clamp_min(_BAD**4)
    small = _fade(squares / 3.0)
    flat = torch.maximum(_fade(12.0 * _dot(cross, cross) / safe_squares**2), small)
    short = torch.maximum(_fade(_dot(edge, edge) / safe_squares), small)

    world_z = torch.zeros_like(cross)
    world_z[..., 2] = 1.0
    normal_there = _unit(around_normal, world_z)
    normal = _unit(torch.lerp(_unit(cross, normal_there), normal_there, flat[..., None]), normal_there)

    # With v0 = v1 the edge is the limit of an isosceles triangle over its height; with everything in one point it is the
    # mean edge of the neighbours.
    height = side - 0.5 * edge
    edge_there = torch.lerp(
        _unit(torch.linalg.cross(height, normal), around_edge), _unit(around_edge, world_z), small[..., None]
    )
    along = torch.lerp(_unit(edge, edge_there), edge_there, short[..., None])
    along = along - _dot(along, normal)[..., None] * normal
    x = _unit(along, _perpendicular(normal))
    y = torch.linalg.cross(normal, x)

    length = _safe_sqrt(_dot(edge, edge))
    k = 0.5 * (length + _dot(y, side).abs())
    k = k.clamp_min(_SCALE_FLOOR) * unit
    return FaceFrames(centroid, torch.stack((x, y, normal), dim=-1), k)


def _neighbourhood(cross: Tensor, edge: Tensor, faces: Tensor, n_verts: int) -> tuple[Tensor, Tensor]:
    """Area-weighted normal and edge of the faces that share a vertex with each face, both (..., F, 3)."""
    area = _safe_sqrt(_dot(cross, cross))[..., None]
    field = torch.cat((cross, edge * area), dim=-1)
    at_verts = field.new_zeros((*field.shape[:-2], n_verts, 6))
    for i in range(3):
        at_verts = at_verts.index_add(-2, faces[:, i], field)
    around = sum(at_verts.index_select(-2, faces[:, i]) for i in range(3))
    assert isinstance(around, Tensor)
    return around[..., :3], around[..., 3:]


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(-1)


def _safe_sqrt(x: Tensor) -> Tensor:
    """Square root with a zero, not infinite, gradient at 0."""
    positive = x > torch.finfo(x.dtype).tiny
    return torch.where(positive, torch.sqrt(torch.where(positive, x, torch.ones_like(x))), torch.zeros_like(x))


def _unit(x: Tensor, otherwise: Tensor) -> Tensor:
    """x / |x|, or `otherwise` normalised where x vanishes, or the world x axis where both do."""
    tiny = torch.finfo(x.dtype).tiny ** 0.5
    square, other_square = _dot(x, x)[..., None], _dot(otherwise, otherwise)[..., None]
    ok, other_ok = square > tiny, other_square > tiny
    world_x = torch.zeros_like(x)
    world_x[..., 0] = 1.0
    fallback = torch.where(
        other_ok, otherwise / torch.sqrt(torch.where(other_ok, other_square, torch.ones_like(square))), world_x
    )
    return torch.where(ok, x / torch.sqrt(torch.where(ok, square, torch.ones_like(square))), fallback)


def _perpendicular(normal: Tensor) -> Tensor:
    """The world axis least aligned with a unit normal, made perpendicular to it."""
    axis = torch.nn.functional.one_hot(normal.detach().abs().argmin(-1), 3).to(normal.dtype)
    return axis - _dot(axis, normal)[..., None] * normal


def _fade(square: Tensor) -> Tensor:
    """1 where the squared measure is below `_BAD`^2, 0 above `_GOOD`^2, a cubic between."""
    t = ((square - _BAD**2) / (_GOOD**2 - _BAD**2)).clamp(0.0, 1.0)
    return 1.0 - t * t * (3.0 - 2.0 * t)
