"""Cells of walking on triangles, float64: the straight line on flat patches, the unfolded one over ridges."""

import math
from typing import Any

import numpy as np

from nbavatar.methods.splatting_avatar.walking import make_surface, walk
from nbavatar.studies.extremes.cells import Level, Limit, Sample, Tolerance, cell

__all__: list[str] = []

_LINE = "the straight line in the unfolded plane"
_EXACT = Tolerance(1e-9, 1.0)


def _grid(cells: int, *, squeeze: float = 1.0, ridge: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A square of side 1, flat or folded along x = 1/2 by an angle; positions, faces, positions in the plane.

    `squeeze` presses the inner lines of vertices towards y = 1/2.
    """
    ticks = np.linspace(0, 1, cells + 1)
    x, y = np.meshgrid(ticks, ticks, indexing="ij")
    inner = (y > 0) & (y < 1)
    y = np.where(inner, 0.5 + (y - 0.5) * squeeze, y)
    plane = np.stack((x, y), -1).reshape(-1, 2)
    over = np.maximum(plane[:, 0] - 0.5, 0.0)
    verts = np.stack((plane[:, 0] - over + over * math.cos(ridge), plane[:, 1], over * math.sin(ridge)), 1)
    n = cells + 1
    corner = (np.arange(cells)[:, None] * n + np.arange(cells)).ravel()
    first = np.stack((corner, corner + n, corner + 1), 1)
    second = np.stack((corner + 1, corner + n, corner + n + 1), 1)
    return verts, np.concatenate((first, second)), plane


def _walk(
    cells: int,
    length: float,
    *,
    size: float = 1.0,
    offset: float = 0.0,
    squeeze: float = 1.0,
    ridge: float = 0.0,
    angles: np.ndarray | None = None,
) -> Sample:
    """Paths from the middles of some faces to points of the plane; error of the ends, in units of the side."""
    verts, faces, plane = _grid(cells, squeeze=squeeze, ridge=ridge)
    surface = make_surface(verts * size + offset * np.array([1.0, -0.7, 0.4]), faces)
    random = np.random.default_rng(3)
    middle = plane[faces].mean(1)
    start = np.flatnonzero(np.abs(middle[:, 0] - 0.25) < 0.2)
    start = start[random.permutation(len(start))[:12]]
    angle = random.uniform(-0.4, 0.4, len(start)) if angles is None else np.resize(angles, len(start))
    way = length * np.stack((np.cos(angle), np.sin(angle)), 1)
    goal = middle[start] + way
    keep = ((goal > 0.01) & (goal < 0.99)).all(1)
    start, way, goal = start[keep], way[keep], goal[keep]
    step = np.concatenate((way, np.zeros((len(way), 1))), 1) * size
    face, bary = walk(surface, start, np.full((len(start), 3), 1 / 3), step)
    if not (np.isfinite(bary).all() and (bary >= 0).all() and np.allclose(bary.sum(1), 1) and len(start)):
        return Sample(math.nan)
    ends = np.einsum("nc,nci->ni", bary, plane[faces[face]])
    return Sample(float(np.linalg.norm(ends - goal, axis=1).max()))


def _cell(condition: str, axis: str, levels: tuple[Level, ...], **more: Any):
    more.setdefault("oracle", _LINE)
    more.setdefault("exact", _EXACT)
    return cell("walking", "walk", condition, axis, levels, unit="of the side", **more)


@_cell("triangles crossed", "cells a side [1]", (4.0, 1.0, 16.0, 64.0, 200.0), quick=(4.0, 16.0))
def _crossed(cells: float) -> Sample:
    return _walk(int(cells), 0.5, angles=None) if cells > 1 else _walk(2, 0.2)


@_cell("length of the step", "length / side [1]", (0.3, 1e-3, 1e-9, 1e-15, 0.0))
def _length(length: float) -> Sample:
    return _walk(4, length)


@_cell("size of the mesh", "side [m]", (1.0, 1e-6, 1e-20, 1e6, 1e20))
def _size(size: float) -> Sample:
    return _walk(4, 0.3, size=size)


@_cell(
    "mesh far from the origin",
    "offset / side [1]",
    (0.0, 1e2, 1e4, 1e6),
    limits=(Limit(lambda offset: float(offset) >= 1e6, 1e-8, 1.0, "the positions themselves are rounded"),),
)
def _offset(offset: float) -> Sample:
    return _walk(7, 0.3, offset=offset)


@_cell("fold", "angle of the fold [deg]", (10.0, 45.0, 90.0, 150.0, 179.0, 179.999), quick=(10.0, 150.0))
def _fold(angle: float) -> Sample:
    return _walk(4, 0.45, ridge=math.radians(angle))


@_cell(
    "slivers in the way",
    "height / width [1]",
    (1.0, 1e-2, 1e-4, 1e-8, 1e-11),
    limits=(Limit(lambda height: float(height) <= 1e-8, 1e-3, 1.0, "angles of a needle have few digits"),),
)
def _slivers(height: float) -> Sample:
    return _walk(4, 0.3, squeeze=height, angles=np.array([0.7, -0.9, 1.2]))


@_cell("through vertices", "angle off the vertex [rad]", (0.1, 1e-6, 1e-9, 1e-12, 1e-15, 0.0))
def _vertex(off: float) -> Sample:
    """From the middle of an edge along a line of edges, through a vertex of six faces."""
    verts, faces, plane = _grid(4)
    surface = make_surface(verts, faces)
    face = int(np.flatnonzero((faces == np.array([6, 11, 7])).all(1))[0])
    start = plane[faces[face]].mean(0)
    target = plane[12]
    way = (target - start) * 1.8
    turn = np.array([[math.cos(off), -math.sin(off)], [math.sin(off), math.cos(off)]])
    way = turn @ way
    found, bary = walk(surface, np.array([face]), np.full((1, 3), 1 / 3), np.array([[*way, 0.0]]))
    end = bary[0] @ plane[faces[found[0]]]
    return Sample(float(np.linalg.norm(end - start - way)))


@_cell("border", "step beyond the border [side]", (1.0, 1e3, 1e12), oracle="stops on the border; never leaves the mesh")
def _border(length: float) -> Sample:
    verts, faces, plane = _grid(4)
    surface = make_surface(verts, faces)
    found, bary = walk(surface, np.arange(8), np.full((8, 3), 1 / 3), np.tile([[length, 0.3 * length, 0]], (8, 1)))
    if not np.isfinite(bary).all():
        return Sample(math.nan)
    ends = np.einsum("nc,nci->ni", bary, plane[faces[found]])
    return Sample(float(np.abs(1 - ends.max(1)).max()))


@_cell(
    "degenerate mesh",
    "case",
    ("a face of no area beside", "a face in one point", "book of three pages", "one face"),
    oracle="finite; on the mesh; as long as the way is",
)
def _degenerate(case: str) -> Sample:
    verts, faces, _ = _grid(2)
    if case == "a face of no area beside":
        verts = np.concatenate((verts, 0.5 * (verts[:1] + verts[1:2])))
        faces = np.concatenate((faces, [[1, 0, 9]]))
    elif case == "a face in one point":
        verts = np.concatenate((verts, verts[:1], verts[:1]))
        faces = np.concatenate((faces, [[0, 9, 10]]))
    elif case == "book of three pages":
        verts = np.concatenate((verts, verts[6:] + [0, 0, 1.0]))
        faces = np.concatenate((faces, [[3, 9, 4], [4, 9, 10]]))
    else:
        faces = faces[:1]
    surface = make_surface(verts, faces)
    count = len(faces)
    step = np.random.default_rng(5).normal(size=(count, 3)) * [0.3, 0.3, 0.0]
    found, bary = walk(surface, np.arange(count), np.full((count, 3), 1 / 3), step)
    good = np.isfinite(bary).all() and (bary >= 0).all() and np.allclose(bary.sum(1), 1)
    good = good and ((found >= 0) & (found < count)).all()
    return Sample(0.0 if good else math.nan)
