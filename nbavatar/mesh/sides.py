"""On which side of a surface a point lies, told from the nearest surface point alone.

The angle-weighted pseudonormal of the nearest face, edge or corner (Baerentzen and Aanaes 2005) is exact for a closed,
consistently oriented surface that does not cut itself.
"""

import math

import numpy as np

from nbavatar.jit.cache import stored_njit

__all__ = ["faces_across", "on_rim", "sign_distances"]


@stored_njit(error_model="numpy")
def on_rim(face, weight, faces, rim):
    """Whether the nearest point lies on a border edge or border vertex: all its corners with weight are on the rim."""
    result = np.zeros(len(face), np.bool_)
    for i in range(len(face)):
        if face[i] >= 0:
            on = True
            for c in range(3):
                on = on and (weight[i, c] <= 1e-9 or rim[faces[face[i], c]])
            result[i] = on
    return result


def faces_across(faces: np.ndarray) -> np.ndarray:
    """The face on the other side of each face's edges (0-1, 1-2, 2-0), (G, 3); -1 where there is none or several."""
    directed = np.concatenate((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]))
    owner = np.tile(np.arange(len(faces)), 3)
    key = np.sort(directed, axis=1)
    _, edge, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    edge = edge.ravel()
    total = np.bincount(edge, owner)
    other = np.where(count[edge] == 2, total[edge] - owner, -1).astype(np.int64)
    return np.ascontiguousarray(other.reshape(3, -1).T)


@stored_njit(error_model="numpy")
def _add_normal(verts, faces, f, corner, normal):
    """Adds a face's unit normal, times its angle at `corner` if that is not negative."""
    i = max(corner, 0)
    a, b, c = verts[faces[f, i]], verts[faces[f, (i + 1) % 3]], verts[faces[f, (i + 2) % 3]]
    b0, b1, b2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    c0, c1, c2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    n0, n1, n2 = b1 * c2 - b2 * c1, b2 * c0 - b0 * c2, b0 * c1 - b1 * c0
    area = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
    if area > 0.0:
        factor = 1.0 / area
        if corner >= 0:
            factor *= math.atan2(area, b0 * c0 + b1 * c1 + b2 * c2)
        normal[0] += factor * n0
        normal[1] += factor * n1
        normal[2] += factor * n2


@stored_njit(error_model="numpy")
def sign_distances(points, verts, faces, across, around_start, around, place_of, distance, face, weight):
    """Makes `distance` (P,) negative, in place, where a point (P, 3) lies behind its nearest surface point.

    Args:
        across: of `faces_across`.
        around_start, around: corners 3 f + c around each vertex v at around[around_start[v] : around_start[v + 1]].
        place_of: position in `faces` of each face id that `face` (P,) may name; `weight` (P, 3) barycentric.
    """
    normal = np.zeros(3)
    # A literal as an argument would be compiled as a type of its own.
    whole = np.int64(-1)
    for i in range(len(points)):
        if face[i] < 0:
            continue
        f = place_of[face[i]]
        zeros = 0
        for c in range(3):
            if weight[i, c] <= 1e-9:
                zeros += 1
        normal[:] = 0.0
        if zeros <= 1:
            _add_normal(verts, faces, f, whole, normal)
            if zeros == 1:
                edge = 0 if weight[i, 2] <= 1e-9 else (1 if weight[i, 0] <= 1e-9 else 2)
                if across[f, edge] >= 0:
                    _add_normal(verts, faces, across[f, edge], whole, normal)
        else:
            c = 0 if weight[i, 0] > 0.5 else (1 if weight[i, 1] > 0.5 else 2)
            v = faces[f, c]
            for s in range(around_start[v], around_start[v + 1]):
                _add_normal(verts, faces, around[s] // 3, around[s] % 3, normal)
        side = 0.0
        for k in range(3):
            q = 0.0
            for c in range(3):
                q += weight[i, c] * verts[faces[f, c], k]
            side += (points[i, k] - q) * normal[k]
        if side < 0.0:
            distance[i] = -distance[i]
