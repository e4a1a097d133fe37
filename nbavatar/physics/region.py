"""Which part of the skin moves: what contact reaches along the surface, and the constraints that lie there."""

from typing import NamedTuple

import numpy as np
import scipy.sparse

from nbavatar.jit.cache import stored_njit
from nbavatar.mesh.drawing import vertex_normals
from nbavatar.physics.tissue import SoftSurface

__all__ = ["Region", "Skin"]


class Region(NamedTuple):
    """What is simulated in a step.

    Attributes:
        active: ids of the vertices that may move, (A,).
        moving: 1.0 for them, else 0.0, (V,).
        edges: edges with an end that may move, (E, 2); `lengths` without contact (E,) [m].
        faces: faces with all corners among them, (G, 3).
    """

    active: np.ndarray
    moving: np.ndarray
    edges: np.ndarray
    lengths: np.ndarray
    faces: np.ndarray


class Skin:
    """A head's surface as a net of edges."""

    def __init__(self, surface: SoftSurface, rest: np.ndarray, reach: float) -> None:
        """Takes the operators, the rest shape (V, 3) [m], and how far contact reaches along the surface [m]."""
        self._edges, self._faces, self._count, self._reach = surface.edges, surface.faces, len(rest), reach
        a, b = surface.edges.T
        length = np.maximum(np.linalg.norm(rest[a] - rest[b], axis=1), 1e-9)
        self._net = _symmetric(length, a, b, self._count)
        ring = _symmetric(np.ones(len(a)), a, b, self._count) + scipy.sparse.eye(self._count)
        share = scipy.sparse.diags(1.0 / np.asarray(ring.sum(axis=1)).ravel())
        self._smoother = scipy.sparse.csr_matrix(share @ ring)

    def outward(self, head: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """Outward unit normals (V, 3), smoothed so that nostrils and lips do not turn them.

        Args:
            head: positions without contact [m], (V, 3). faces: (F, 3), counter-clockwise seen from outside.
        """
        normals = vertex_normals(head, faces)
        for _ in range(4):
            normals = self._smoother @ normals
        return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)

    def spread(self, distance: np.ndarray, touched: np.ndarray) -> None:
        """Lowers, in place, distances (V,) along the surface [m] from touched vertices; inf stays beyond the reach."""
        _spread(distance, touched, self._net.indptr, self._net.indices, self._net.data, self._reach)

    def region(self, active: np.ndarray, head: np.ndarray) -> Region:
        """The constraints around active vertices (A,) of a head (V, 3) [m] without contact."""
        moving = np.zeros(self._count)
        moving[active] = 1.0
        return Region(active, moving, *_around(moving, head, self._edges, self._faces))


def _symmetric(values: np.ndarray, a: np.ndarray, b: np.ndarray, count: int) -> scipy.sparse.csr_matrix:
    matrix = scipy.sparse.coo_matrix((values, (a, b)), shape=(count, count))
    return (matrix + matrix.T).tocsr()


@stored_njit(error_model="numpy")
def _spread(distance, touched, start, near, length, limit):
    """Shortest ways from the touched vertices, by a ring of vertices whose neighbours are to be looked at again."""
    count = len(distance)
    queue, waiting = np.zeros(count, np.int64), np.zeros(count, np.bool_)
    first, size = 0, 0
    for v in touched:
        if distance[v] > 0.0:
            distance[v] = 0.0
            waiting[v] = True
            queue[size] = v
            size += 1
    while size > 0:
        i = queue[first]
        first = (first + 1) % count
        size -= 1
        waiting[i] = False
        for t in range(start[i], start[i + 1]):
            j, way = near[t], distance[i] + length[t]
            if way <= limit and way < distance[j]:
                distance[j] = way
                if not waiting[j]:
                    waiting[j] = True
                    queue[(first + size) % count] = j
                    size += 1


@stored_njit(error_model="numpy")
def _around(moving, head, edges, faces):
    """Edges with an end that moves, their lengths, and faces all of whose corners move."""
    pairs, lengths = np.zeros((len(edges), 2), np.int64), np.zeros(len(edges))
    found = 0
    for e in range(len(edges)):
        a, b = edges[e, 0], edges[e, 1]
        if moving[a] > 0.0 or moving[b] > 0.0:
            d0, d1, d2 = head[a, 0] - head[b, 0], head[a, 1] - head[b, 1], head[a, 2] - head[b, 2]
            pairs[found, 0], pairs[found, 1] = a, b
            lengths[found] = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
            found += 1
    inner, kept = np.zeros((len(faces), 3), np.int64), 0
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if moving[a] > 0.0 and moving[b] > 0.0 and moving[c] > 0.0:
            inner[kept, 0], inner[kept, 1], inner[kept, 2] = a, b, c
            kept += 1
    return pairs[:found], lengths[:found], inner[:kept]
