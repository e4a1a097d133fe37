"""Triangle frames {T, R, k}: the local coordinate system that a billboard rides on.

The edge/normal frame follows the local triangle space of GaussianAvatars (Qian et al. 2024, section 3.2), with one
change of column order: a billboard spans its local x and y axes, so the surface normal is the **z** axis here.

    x = direction of the first edge v1 - v0
    z = surface normal (v1 - v0) x (v2 - v0), normalised
    y = z x x, in the plane of the triangle and pointing from the first edge to the third vertex

Where a triangle has no direction of its own (zero area, zero edge, all corners in one point) the missing axes are
blended in, continuously, from the triangles around it. The result is a rotation for every finite input, and its
gradient is finite.
"""

from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["FaceFrames", "face_frames"]

# Blend thresholds, dimensionless. Above `_GOOD` a face uses only its own axes, below `_BAD` only its neighbours'. At a
# height of 1e-3 edge lengths float32 coordinates a metre from the origin start to leave doubt about the normal.
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

    Equivariant under rigid motion; differentiable; no NaN and no zero axis for any finite input. A well-shaped face
    depends on its own three vertices only. A face whose height, first edge or whole size is under 1e-3 (relative) takes
    the missing axes from the faces that share a vertex with it, and from 1e-4 down from them alone. Only if these have
    none either (an isolated sliver), an arbitrary but fixed perpendicular in world axes is used: not equivariant.

    Args:
        verts: vertex positions [m], shape (..., V, 3), float32 or float64.
        faces: vertex ids, shape (F, 3), int64.

    Returns:
        `FaceFrames` with T (..., F, 3) [m], R (..., F, 3, 3), k (..., F) [m], dtype and device of `verts`.
    """
    # Components first inside, (3, ..., V): sums over three long rows are fast, over many short ones they are not.
    columns = verts.movedim(-1, 0)
    corners = faces.T.reshape(-1)
    v0, v1, v2 = columns[..., corners].chunk(3, dim=-1)
    centroid = (v0 + v1 + v2) / 3.0
    edge, side = v1 - v0, v2 - v0
    # Work in units of the mesh, so that thresholds and squares mean the same for a head in metres or in microns.
    squares = _dot(edge, edge) + _dot(side, side) + _dot(v2 - v1, v2 - v1)
    unit = _safe_sqrt(squares.mean(-1, keepdim=True) / 3.0).clamp_min(torch.finfo(verts.dtype).tiny ** 0.5)
    edge, side, squares = edge / unit, side / unit, squares / unit**2

    cross = _cross(edge, side)
    around_normal, around_edge = _neighbourhood(cross, edge, corners, verts.shape[-2])

    # Squared quality in [0, 1]: 1 for an equilateral triangle, 0 for zero area.
    safe_squares = squares.clamp_min(_BAD**4)
    edge_square = _dot(edge, edge)
    small = _fade(squares / 3.0)
    flat = torch.maximum(_fade(12.0 * _dot(cross, cross) / safe_squares**2), small)
    short = torch.maximum(_fade(edge_square / safe_squares), small)

    world_x, world_z = _world_axis(0, cross), _world_axis(2, cross)
    normal_there = _unit(around_normal, world_z)
    normal = _unit(torch.lerp(_unit(cross, normal_there), normal_there, flat.expand_as(cross)), normal_there)

    # With v0 = v1 the edge is the limit of an isosceles triangle over its height; with everything in one point it is
    # the mean edge of the neighbours.
    nearby = _unit(around_edge, world_x)
    edge_there = torch.lerp(_unit(_cross(side - 0.5 * edge, normal), nearby), nearby, small.expand_as(cross))
    along = torch.lerp(_unit(edge, edge_there), edge_there, short.expand_as(cross))
    x = _unit(along - _dot(along, normal) * normal, _perpendicular(normal))
    y = _cross(normal, x)

    k = 0.5 * (_safe_sqrt(edge_square) + _dot(y, side).abs())
    k = k.clamp_min(_SCALE_FLOOR) * unit
    rotation = torch.stack((x, y, normal), dim=-1).movedim(0, -2)
    return FaceFrames(centroid.movedim(0, -1), rotation, k)


def _neighbourhood(cross: Tensor, edge: Tensor, corners: Tensor, n_verts: int) -> tuple[Tensor, Tensor]:
    """Area-weighted normal and edge of the faces that share a vertex with each face, both (3, ..., F)."""
    field = torch.stack((cross, edge * _safe_sqrt(_dot(cross, cross))))
    at_verts = field.new_zeros((*field.shape[:-1], n_verts))
    at_verts = at_verts.index_add(-1, corners, torch.cat((field, field, field), dim=-1))
    first, second, third = at_verts[..., corners].chunk(3, dim=-1)
    around = first + second + third
    return around[0], around[1]


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return torch.stack((a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]))


def _world_axis(i: int, like: Tensor) -> Tensor:
    axis = torch.zeros_like(like)
    axis[i] = 1.0
    return axis


def _safe_sqrt(x: Tensor) -> Tensor:
    """Square root with a zero, not infinite, gradient at 0."""
    positive = x > torch.finfo(x.dtype).tiny
    return torch.where(positive, torch.sqrt(torch.where(positive, x, 1.0)), 0.0)


def _unit(x: Tensor, otherwise: Tensor) -> Tensor:
    """x / |x|, or the unit vector `otherwise` where x vanishes."""
    square = _dot(x, x)
    there = square > torch.finfo(x.dtype).tiny ** 0.5
    return torch.where(there, x / torch.sqrt(torch.where(there, square, 1.0)), otherwise)


def _perpendicular(normal: Tensor) -> Tensor:
    """A unit vector perpendicular to a unit normal, by the branchless construction of Duff et al. (2017)."""
    nx, ny, nz = normal[0], normal[1], normal[2]
    sign = torch.where(nz < 0.0, -1.0, 1.0).to(nz.dtype)
    a = -1.0 / (sign + nz)
    return torch.stack((1.0 + sign * nx * nx * a, sign * nx * ny * a, -sign * nx))


def _fade(square: Tensor) -> Tensor:
    """1 where the squared measure is below `_BAD`^2, 0 above `_GOOD`^2, a cubic between."""
    t = ((square - _BAD**2) / (_GOOD**2 - _BAD**2)).clamp(0.0, 1.0)
    return 1.0 - t * t * (3.0 - 2.0 * t)
