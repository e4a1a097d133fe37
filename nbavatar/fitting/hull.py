"""Visual hull of a rigidly moving part, in its rest frame, from silhouettes of many frames and cameras.

A point belongs to the hull if nearly all views that say anything about it show the part there (Laurentini 1994, with a
share of misses instead of none, because poses jitter and masks err):

    misses(x) / seen(x) <= limit,    seen: views in which x projects to a pixel with evidence

A pixel is evidence of background, of the part, or of nothing: what another part or anything else covers, or the camera
did not record, says nothing about what lies behind. Points that have missed too often for any outcome are dropped on
the way, which changes no result and leaves a few views' worth of work.
"""

import dataclasses
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

__all__ = ["BACKGROUND", "NOTHING", "PART", "UNEXPLAINED", "Counts", "Grid", "Silhouette", "count_views", "grid_over"]

NOTHING, BACKGROUND, PART, UNEXPLAINED = range(4)
"""What a pixel shows: no evidence, background, the part, the part where its mesh is out of reach."""

_CHUNK = 1 << 18  # points that are projected at once


class Silhouette(NamedTuple):
    """One view of the part.

    Attributes:
        evidence: what each pixel shows, uint8 (H, W).
        K: intrinsics of an ideal pinhole, (3, 3) [px].
        cam_from_rest: from the part's rest frame to the camera, (4, 4) [m].
    """

    evidence: np.ndarray
    K: np.ndarray
    cam_from_rest: np.ndarray


@dataclasses.dataclass(frozen=True)
class Grid:
    """Cubic cells: `low` is the outer corner of the first (3,) [m], `edge` their side [m], `shape` their number."""

    low: np.ndarray
    edge: float
    shape: tuple[int, int, int]

    def centres(self, cells: np.ndarray) -> np.ndarray:
        """Centres of cells given by their flat numbers, float64 (P, 3) [m]."""
        return self.low + (np.stack(np.unravel_index(cells, self.shape), axis=1) + 0.5) * self.edge

    @property
    def count(self) -> int:
        """Number of cells."""
        return int(np.prod(self.shape))


class Counts(NamedTuple):
    """How often each cell was seen, missed, and seen where the mesh is out of reach; uint16 of the grid's shape.

    A cell that was dropped keeps the counts of that moment; its misses are too many in any case.
    """

    seen: np.ndarray
    missed: np.ndarray
    unexplained: np.ndarray


def grid_over(low: np.ndarray, high: np.ndarray, edge: float, most: int) -> Grid:
    """Cells of side `edge` [m] over a box [m], larger where more than `most` would be needed."""
    size = np.maximum(np.asarray(high, np.float64) - low, edge)
    edge = max(edge, float(np.cbrt(np.prod(size) / most)))
    while True:
        shape = np.maximum(np.ceil(size / edge), 1).astype(int)
        if np.prod(shape) <= most or (shape == 1).all():
            return Grid(np.asarray(low, np.float64), edge, (int(shape[0]), int(shape[1]), int(shape[2])))
        edge *= 1.02


def count_views(grid: Grid, views: Iterable[Silhouette], total: int, limit: float) -> Counts:
    """Counts over all views.

    Args:
        grid: in the part's rest frame.
        views: silhouettes, made as they are needed.
        total: number of views, or more.
        limit: share of misses that a point of the hull may have; cells with more than `limit * total` are dropped.
    """
    seen, missed, unexplained = (np.zeros(grid.count, np.uint16) for _ in range(3))
    alive = np.arange(grid.count)
    for view in views:
        for start in range(0, len(alive), _CHUNK):
            cells = alive[start : start + _CHUNK]
            shown = _shown(grid.centres(cells), view)
            seen[cells] += shown != NOTHING
            missed[cells] += shown == BACKGROUND
            unexplained[cells] += shown == UNEXPLAINED
        alive = alive[missed[alive] <= limit * total]
    return Counts(*(values.reshape(grid.shape) for values in (seen, missed, unexplained)))


def _shown(points: np.ndarray, view: Silhouette) -> np.ndarray:
    """What a view shows at points (P, 3) [m]; nothing outside the picture and behind the camera. uint8 (P,)."""
    height, width = view.evidence.shape
    matrix = view.K @ view.cam_from_rest[:3]
    projected = points @ matrix[:, :3].T + matrix[:, 3]
    depth = projected[:, 2]
    front = depth > 0
    depth = np.where(front, depth, 1.0)
    x, y = np.floor(projected[:, 0] / depth), np.floor(projected[:, 1] / depth)
    inside = front & (x >= 0) & (y >= 0) & (x < width) & (y < height)
    x, y = np.where(inside, x, 0).astype(np.int64), np.where(inside, y, 0).astype(np.int64)
    return np.where(inside, view.evidence[y, x], NOTHING).astype(np.uint8)
