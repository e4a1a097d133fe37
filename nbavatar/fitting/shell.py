"""What the head's mesh lacks and the masks show, such as hair: a surface of its own that rides with the head.

The visual hull of the head (`nbavatar.fitting.hull`) is carved in its rest frame. Of it only what the mesh cannot
explain is kept: cells that lie farther from the mesh than `reach`, in views that show the head where nothing within
`reach` of the mesh projects to, and what lies between them and the mesh. A hull bulges where no camera looks (behind
the head, along the lines of sight); such bulges explain no pixel, and are not kept. Nothing is looked for where the
neck goes on below the largest border of the mesh: that does not move with the head, as hair beside it does. Where
nothing reaches out there is no surface.

The surface moves with the head as a whole; where the skin under it moves besides (jaw, contact), the mean motion of the
nearest skin is added, which fades in smoothly from vertex to vertex.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from nbavatar.config.geometry import ShellConfig
from nbavatar.data.sequences import Part
from nbavatar.fitting.hull import Counts, Grid, Silhouette, count_views, grid_over
from nbavatar.fitting.surface import decimated, face_areas, piece_surface, smoothed
from nbavatar.math.directions import axes_along
from nbavatar.mesh.bvh import DeformingMesh
from nbavatar.mesh.topology import boundary_loops

__all__ = ["Rest", "Shell", "carried", "carve_shell", "rest_of", "ride", "surface_radius"]

_BLOCK = 64  # frames aligned at once
_TYPICAL = 65  # frames, evenly spread, whose median is the mesh in its rest frame
_ROBUST = 0.02  # distance from the rigid motion at which a vertex counts a quarter [radius]
_COARSE = 3.0  # cells of the first look are so much larger
_SKIN = 64  # vertices of the mesh that tell how the skin under a vertex of the surface moves


class Rest(NamedTuple):
    """The head in the frame of its rest mesh.

    Attributes:
        rotation, shift: from rest to world, (N, 3, 3) and (N, 3) [m]; of frames without the head, NaN.
        verts: typical positions in the rest frame, (V, 3) [m].
        radius: root mean square distance of the surface from its middle [m].
    """

    rotation: np.ndarray
    shift: np.ndarray
    verts: np.ndarray
    radius: float

    def to_rest(self, row: int, points: np.ndarray) -> np.ndarray:
        """World points (P, 3) of a frame, in the rest frame, float64."""
        return (points.astype(np.float64) - self.shift[row]) @ self.rotation[row]


@dataclasses.dataclass(frozen=True)
class Shell:
    """The surface, in the rest frame.

    Attributes:
        verts: (W, 3) float64 [m]; faces: (G, 3), counter-clockwise seen from outside. Both empty where nothing reaches
            out.
        said: what was found, for the record.
    """

    verts: np.ndarray
    faces: np.ndarray
    said: dict[str, Any]


def rest_of(rest: np.ndarray, faces: np.ndarray, verts: np.ndarray, rows: Sequence[int]) -> Rest:
    """Rigid motion of the head in every frame, by the vertices that move with it (the skull's, not the jaw's).

    Args:
        rest: (V, 3) [m]; faces: (F, 3).
        verts: (N, V, 3) [m], world; NaN where the head is not in the frame.
        rows: frames whose median is the typical mesh.
    """
    import torch

    from nbavatar.fitting.rigid import align_points

    radius = surface_radius(rest, faces)
    source = torch.from_numpy(np.asarray(rest, np.float64))
    rotation, shift = np.full((len(verts), 3, 3), np.nan), np.full((len(verts), 3), np.nan)
    there = np.flatnonzero(np.isfinite(verts).all((1, 2)))
    for start in range(0, len(there), _BLOCK):
        block = there[start : start + _BLOCK]
        target = torch.from_numpy(verts[block].astype(np.float64))
        weight = torch.ones(target.shape[:2], dtype=torch.float64)
        turn, move, _ = align_points(source, target, weight, scale=_ROBUST * radius)
        rotation[block], shift[block] = turn.numpy(), move.numpy()
    found = Rest(rotation, shift, np.asarray(rest, np.float64), radius)
    typical = np.intersect1d(rows, there)
    if len(typical):
        typical = typical[np.unique(np.linspace(0, len(typical) - 1, min(_TYPICAL, len(typical))).round().astype(int))]
        found = found._replace(verts=np.median([found.to_rest(row, verts[row]) for row in typical], axis=0))
    return found


def surface_radius(verts: np.ndarray, faces: np.ndarray) -> float:
    """Root mean square distance of a surface's points from their mean, by area [m]."""
    corners = np.asarray(verts, np.float64)[faces]
    area = face_areas(verts, faces)
    area = area / area.sum()
    middle = area @ corners.mean(1)
    corners = corners - middle
    # Mean of |x|^2 over a triangle with corners a, b, c: (|a|^2 + |b|^2 + |c|^2 + |a + b + c|^2) / 12.
    square = ((corners**2).sum((1, 2)) + (corners.sum(1) ** 2).sum(1)) / 12.0
    return float(np.sqrt(area @ square))


def carve_shell(
    rest: Rest,
    faces: np.ndarray,
    rows: Sequence[int],
    view: Callable[[int], Silhouette],
    cfg: ShellConfig,
    *,
    above_neck: bool = False,
) -> Shell:
    """Finds what reaches beyond the mesh.

    Args:
        rest: of `rest_of`.
        faces: of the head's mesh, (F, 3).
        rows: frame of each view.
        view: makes the silhouette of a view (its position in `rows`).
        cfg: options.
        above_neck: leave out all that lies below the end of the mesh's neck, not only where the neck itself goes on.

    Returns:
        the surface; an empty one where nothing reaches out, where there are no views, or where they are too alike.
    """
    said: dict[str, Any] = {"radius_mm": round(1e3 * rest.radius, 2), "views": len(rows)}
    nothing = np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    spread = _spread([view(i).cam_from_rest for i in _sparse(len(rows))], rest.verts.mean(0))
    said["spread_deg"] = round(spread, 1)
    if spread < cfg.spread_deg:
        return Shell(*nothing, {**said, "absent": "the views are too alike to tell depth"})
    mesh = DeformingMesh(rest.verts, faces)
    margin = cfg.margin * rest.radius
    low, high = rest.verts.min(0) - margin, rest.verts.max(0) + margin
    for edge in (_COARSE * cfg.voxel, cfg.voxel):
        grid = grid_over(low, high, edge * rest.radius, cfg.cells)
        order = _interleaved(len(rows))
        counts = count_views(grid, (view(i) for i in order), len(rows), cfg.misses)
        found = _cells(grid, counts, mesh, rest, faces, len(rows), cfg, np.inf if above_neck else cfg.reach)
        if not found.kept.any():
            return Shell(*nothing, {**said, "absent": "nothing reaches beyond the mesh"})
        box = np.argwhere(found.kept)
        low, high = grid.low + (box.min(0) - 3) * grid.edge, grid.low + (box.max(0) + 4) * grid.edge
    gap, least = cfg.gap * rest.radius, (cfg.reach * rest.radius) ** 2
    verts, shell = piece_surface(grid, found.depth, found.kept, mesh, gap, least)
    if not len(shell):
        return Shell(*nothing, {**said, "absent": "what reaches beyond the mesh is smaller than a few cells"})
    verts = smoothed(verts, shell)
    verts, shell = decimated(verts, shell, _face_count(verts, shell, rest.verts, faces, cfg.faces))
    height, _, _ = mesh.closest(verts, np.inf)
    return Shell(
        verts,
        shell,
        {
            **said,
            "cells": grid.count,
            "cell_mm": round(1e3 * grid.edge, 2),
            "faces": len(shell),
            "height_mm": [round(1e3 * float(value), 1) for value in (height.mean(), height.max())],
        },
    )


def _face_count(verts: np.ndarray, shell: np.ndarray, rest: np.ndarray, faces: np.ndarray, most: int) -> int:
    """Faces as large as the mesh's median face, but not more than `most`."""
    typical = float(np.median(face_areas(rest, faces)))
    return max(8, min(most, int(face_areas(verts, shell).sum() / max(typical, 1e-12))))


class _Cells(NamedTuple):
    """What a grid shows: how far inside the hull each cell is, in [-1, 1], and which cells are kept."""

    depth: np.ndarray
    kept: np.ndarray


def _cells(
    grid: Grid, counts: Counts, mesh: DeformingMesh, rest: Rest, faces: np.ndarray, views: int, cfg: ShellConfig,
    around: float,
) -> _Cells:  # fmt: skip
    """Hull of the counts, and of it what reaches beyond the mesh; `around` the neck's end nothing is kept [radius]."""
    import scipy.ndimage

    seen = counts.seen.astype(np.float64)
    limit = max(cfg.misses, 1.0 / max(views, 1) ** 2)  # of a limit of zero too, the sign of the depth tells the side
    share = np.divide(counts.missed, seen, out=np.ones_like(seen), where=seen >= _LEAST * views)
    depth = np.clip(1.0 - share / limit, -1.0, 1.0)
    hull = np.flatnonzero((share <= cfg.misses).ravel())
    centres = grid.centres(hull)
    height, _, _ = mesh.signed(np.ascontiguousarray(centres), np.inf)
    beyond = np.zeros(grid.count, bool)
    core = np.zeros(grid.count, bool)
    above = ~_in_neck(centres, rest.verts, faces, rest.radius, around * rest.radius)
    beyond[hull] = (height > cfg.gap * rest.radius) & above
    explained = counts.unexplained.ravel()[hull] < np.maximum(cfg.support * seen.ravel()[hull], 1.0)
    core[hull] = (height > cfg.reach * rest.radius) & ~explained & above
    core, beyond = core.reshape(grid.shape), beyond.reshape(grid.shape)
    steps = max(1, round((cfg.reach - cfg.gap) * rest.radius / grid.edge)) + 1
    kept = (
        scipy.ndimage.binary_dilation(core, np.ones((3, 3, 3)), iterations=steps, mask=beyond) if core.any() else core
    )
    return _Cells(depth, kept)


_LEAST = 0.25  # share of the views that must see a cell


def _in_neck(points: np.ndarray, verts: np.ndarray, faces: np.ndarray, radius: float, around: float) -> np.ndarray:
    """Which points (P, 3) lie where the neck goes on: beyond the plane of the mesh's largest border, if that is as
    long as a neck's, and within its outline or no farther than `around` beside it.
    """
    largest, longest = None, 1.5 * radius
    for loop in boundary_loops(faces):
        ring = verts[loop]
        length = float(np.linalg.norm(np.roll(ring, -1, 0) - ring, axis=1).sum())
        if length > longest:
            largest, longest = ring, length
    if largest is None:
        return np.zeros(len(points), bool)
    centre = largest.mean(0)
    ring = largest - centre
    normal = np.cross(ring, np.roll(ring, -1, 0)).sum(0)
    if not normal.any():
        return np.zeros(len(points), bool)
    normal /= np.linalg.norm(normal)
    normal = normal if normal @ (verts.mean(0) - centre) < 0 else -normal
    inside = (points - centre) @ normal > 0
    axes = axes_along(normal[None])[0, :2].T
    # The outline in polar coordinates about its centre, from which all of a neck's can be seen.
    direction, distance = _polar(ring @ axes)
    towards, away = _polar((points[inside] - centre) @ axes)
    inside[inside] = away < np.interp(towards, direction, distance, period=2.0 * np.pi) + around
    return inside


def _polar(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Angles [radians] and distances of points (P, 2) from the origin."""
    return np.arctan2(points[:, 1], points[:, 0]), np.linalg.norm(points, axis=1)


def _sparse(count: int) -> np.ndarray:
    """Up to 64 positions, evenly."""
    return np.unique(np.linspace(0, count - 1, min(count, 64)).round().astype(int)) if count else np.zeros(0, int)


def _interleaved(count: int) -> np.ndarray:
    """All positions, so that the first few are spread over all: views that differ carve most."""
    order = np.argsort((np.arange(count) * 0.6180339887498949) % 1.0, kind="stable")
    return order


def _spread(poses: Sequence[np.ndarray], middle: np.ndarray) -> float:
    """How far apart are three directions from which cameras see the middle: the least of their angles [degrees].

    Two directions alone, however far apart, leave a wedge where their silhouettes cross, which no mask contradicts. The
    three are the two that are farthest apart and the one that is farthest from both; 0 where there are fewer views.
    """
    if len(poses) < 3:
        return 0.0
    centres = np.stack([-pose[:3, :3].T @ pose[:3, 3] for pose in poses]) - middle
    towards = centres / np.maximum(np.linalg.norm(centres, axis=1, keepdims=True), 1e-12)
    angles = np.degrees(np.arccos(np.clip(towards @ towards.T, -1.0, 1.0)))
    ends = np.unravel_index(angles.argmax(), angles.shape)
    return float(angles[list(ends)].min(0).max())


def carried(shell: Part, head: Part, verts: np.ndarray) -> Part:
    """A shell on other poses of its head, such as another subject's.

    Args:
        shell, head: of one sequence.
        verts: the head in the new poses, (N, V, 3) [m], world.
    """
    rest = rest_of(head.rest, head.faces, verts, [])
    surface = Shell(np.asarray(shell.rest, np.float64), np.asarray(shell.faces), {})
    return Part(shell.faces, shell.rest, ride(surface, rest, verts))


def ride(shell: Shell, rest: Rest, verts: np.ndarray) -> np.ndarray:
    """The surface in every frame.

    x(t) = R(t) (x + sum_k w_k d_k(t)) + s(t), where d_k is how far skin vertex k is from its typical place in the rest
    frame, and w_k >= 0 weighs the nearest vertices, falls to 0 at the farthest of them and sums to 1: an offset of the
    skin as a whole is passed on whole, noise of single vertices is not.

    Args:
        shell, rest: see there.
        verts: the head in every frame, (N, V, 3) [m], world.

    Returns:
        float32 (N, W, 3) [m]; NaN where the head is not in the frame.
    """
    from scipy.spatial import cKDTree

    count = min(_SKIN, len(rest.verts))
    distance, near = cKDTree(rest.verts).query(shell.verts, k=count)
    distance, near = distance.reshape(len(shell.verts), count), near.reshape(len(shell.verts), count)
    weight = (1.0 - distance / np.maximum(distance[:, -1:], 1e-12)) ** 2 + (1e-12 if count > 1 else 1.0)
    weight /= weight.sum(1, keepdims=True)
    result = np.full((len(verts), len(shell.verts), 3), np.nan, np.float32)
    for row in np.flatnonzero(np.isfinite(rest.shift).all(1)):
        apart = rest.to_rest(int(row), verts[row]) - rest.verts
        placed = shell.verts + np.einsum("wk,wkc->wc", weight, apart[near])
        result[row] = placed @ rest.rotation[row].T + rest.shift[row]
    return result
