"""Bounding volume hierarchy over triangles: built once, refitted when vertices move; closest points and separation.

Arrays shared by all kernels:

  faces    int64 (F, 3)  in the order of the leaves; `ids` (F,) are their numbers before that
  nodes    int64 (N, 4)  first face, number of faces, left child, right child (-1 in leaves); children after parents
  bounds   float64 (N, 6) [m] lower and upper corner of each node's box
"""

import math

import numpy as np

from nbavatar.jit.cache import stored_njit

__all__ = ["build_tree", "extent", "in_box", "nearest", "refit", "separated"]

_LEAF = 4
_STACK = 64
_PAIRS = 512


def build_tree(centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Median splits along the longest axis.

    Args:
        centres: centroids of the faces [m], (F, 3).

    Returns:
        The order of faces (F,) int64 and `nodes` (N, 4).
    """
    order = np.arange(len(centres))
    nodes: list[list[int]] = [[0, len(centres), -1, -1]]
    k = 0
    while k < len(nodes):
        first, count = nodes[k][:2]
        if count > _LEAF:
            ids = order[first : first + count]
            axis = int(np.argmax(np.ptp(centres[ids], axis=0)))
            order[first : first + count] = ids[np.argsort(centres[ids, axis], kind="stable")]
            half = count // 2
            nodes[k][2:] = [len(nodes), len(nodes) + 1]
            nodes += [[first, half, -1, -1], [first + half, count - half, -1, -1]]
        k += 1
    return order, np.array(nodes, np.int64).reshape(-1, 4)


@stored_njit(error_model="numpy")
def extent(verts, low, high):
    """Writes the box of points (V, 3) into `low` and `high` (3,)."""
    a0, a1, a2, b0, b1, b2 = np.inf, np.inf, np.inf, -np.inf, -np.inf, -np.inf
    for v in range(len(verts)):
        x, y, z = verts[v, 0], verts[v, 1], verts[v, 2]
        a0, a1, a2 = min(a0, x), min(a1, y), min(a2, z)
        b0, b1, b2 = max(b0, x), max(b1, y), max(b2, z)
    low[0], low[1], low[2], high[0], high[1], high[2] = a0, a1, a2, b0, b1, b2


@stored_njit(error_model="numpy")
def in_box(points, low, high):
    """Which points (P, 3) lie in the box between two corners (3,), (P,) bool."""
    result = np.zeros(len(points), np.bool_)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        result[i] = low[0] <= x and x <= high[0] and low[1] <= y and y <= high[1] and low[2] <= z and z <= high[2]
    return result


@stored_njit(error_model="numpy")
def refit(verts, faces, nodes, bounds):
    """Boxes of all nodes for vertices that moved."""
    for k in range(len(nodes) - 1, -1, -1):
        left, right = nodes[k, 2], nodes[k, 3]
        if left >= 0:
            for i in range(3):
                bounds[k, i] = min(bounds[left, i], bounds[right, i])
                bounds[k, 3 + i] = max(bounds[left, 3 + i], bounds[right, 3 + i])
        else:
            a0, a1, a2, b0, b1, b2 = np.inf, np.inf, np.inf, -np.inf, -np.inf, -np.inf
            for f in range(nodes[k, 0], nodes[k, 0] + nodes[k, 1]):
                for c in range(3):
                    v = faces[f, c]
                    x, y, z = verts[v, 0], verts[v, 1], verts[v, 2]
                    a0, a1, a2 = min(a0, x), min(a1, y), min(a2, z)
                    b0, b1, b2 = max(b0, x), max(b1, y), max(b2, z)
            bounds[k, 0], bounds[k, 1], bounds[k, 2] = a0, a1, a2
            bounds[k, 3], bounds[k, 4], bounds[k, 5] = b0, b1, b2


@stored_njit(error_model="numpy")
def _between(a, i, b, j):
    """Squared distance of box i of `a` from box j of `b`."""
    dx = max(a[i, 0] - b[j, 3], 0.0, b[j, 0] - a[i, 3])
    dy = max(a[i, 1] - b[j, 4], 0.0, b[j, 1] - a[i, 4])
    dz = max(a[i, 2] - b[j, 5], 0.0, b[j, 2] - a[i, 5])
    return dx * dx + dy * dy + dz * dz


@stored_njit(error_model="numpy")
def _box_of(verts, faces, f, box):
    a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
    for i in range(3):
        box[0, i] = min(verts[a, i], verts[b, i], verts[c, i])
        box[0, 3 + i] = max(verts[a, i], verts[b, i], verts[c, i])


@stored_njit(error_model="numpy")
def separated(verts, faces, nodes, bounds, other_verts, other_faces, other_nodes, other_bounds, distance):
    """True if the boxes of single faces already show that two meshes are everywhere farther apart than `distance` [m].

    Both trees are descended together; False says nothing: the faces may still be apart.
    """
    limit = distance * distance
    pairs = np.zeros((_PAIRS, 2), np.int64)
    one, two = np.zeros((1, 6)), np.zeros((1, 6))
    # A literal 0 as an argument would be compiled as a type of its own.
    only = np.int64(0)
    top = 1
    while top > 0:
        top -= 1
        i, j = pairs[top, 0], pairs[top, 1]
        if _between(bounds, i, other_bounds, j) > limit:
            continue
        if nodes[i, 2] < 0 and other_nodes[j, 2] < 0:
            for f in range(nodes[i, 0], nodes[i, 0] + nodes[i, 1]):
                _box_of(verts, faces, f, one)
                if _between(one, only, other_bounds, j) > limit:
                    continue
                for g in range(other_nodes[j, 0], other_nodes[j, 0] + other_nodes[j, 1]):
                    _box_of(other_verts, other_faces, g, two)
                    if _between(one, only, two, only) <= limit:
                        return False
        elif other_nodes[j, 2] < 0 or (nodes[i, 2] >= 0 and nodes[i, 1] >= other_nodes[j, 1]):
            pairs[top, 0], pairs[top, 1] = nodes[i, 2], j
            pairs[top + 1, 0], pairs[top + 1, 1] = nodes[i, 3], j
            top += 2
        else:
            pairs[top, 0], pairs[top, 1] = i, other_nodes[j, 2]
            pairs[top + 1, 0], pairs[top + 1, 1] = i, other_nodes[j, 3]
            top += 2
    return True


@stored_njit(error_model="numpy")
def _box_distance(bounds, k, x, y, z):
    dx = max(bounds[k, 0] - x, 0.0, x - bounds[k, 3])
    dy = max(bounds[k, 1] - y, 0.0, y - bounds[k, 4])
    dz = max(bounds[k, 2] - z, 0.0, z - bounds[k, 5])
    return dx * dx + dy * dy + dz * dz


@stored_njit(error_model="numpy")
def _closest_on_triangle(p, a, b, c, weight):
    """Squared distance from p to triangle abc; barycentric weights of the nearest point into `weight`.

    By the Voronoi regions of corners, edges and face (Ericson 2004, section 5.1.5).
    """
    ab0, ab1, ab2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    ac0, ac1, ac2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    ap0, ap1, ap2 = p[0] - a[0], p[1] - a[1], p[2] - a[2]
    d1 = ab0 * ap0 + ab1 * ap1 + ab2 * ap2
    d2 = ac0 * ap0 + ac1 * ap1 + ac2 * ap2
    bp0, bp1, bp2 = p[0] - b[0], p[1] - b[1], p[2] - b[2]
    d3 = ab0 * bp0 + ab1 * bp1 + ab2 * bp2
    d4 = ac0 * bp0 + ac1 * bp1 + ac2 * bp2
    cp0, cp1, cp2 = p[0] - c[0], p[1] - c[1], p[2] - c[2]
    d5 = ab0 * cp0 + ab1 * cp1 + ab2 * cp2
    d6 = ac0 * cp0 + ac1 * cp1 + ac2 * cp2
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    total = va + vb + vc
    u, v, w = 1.0, 0.0, 0.0
    if d1 <= 0.0 and d2 <= 0.0:
        pass
    elif d3 >= 0.0 and d4 <= d3:
        u, v, w = 0.0, 1.0, 0.0
    elif d6 >= 0.0 and d5 <= d6:
        u, v, w = 0.0, 0.0, 1.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0 and d1 - d3 > 0.0:
        v = d1 / (d1 - d3)
        u, w = 1.0 - v, 0.0
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0 and d2 - d6 > 0.0:
        w = d2 / (d2 - d6)
        u, v = 1.0 - w, 0.0
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0 and (d4 - d3) + (d5 - d6) > 0.0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        u, v = 0.0, 1.0 - w
    elif total > 0.0:
        u, v, w = va / total, vb / total, vc / total
    weight[0], weight[1], weight[2] = u, v, w
    q0 = u * a[0] + v * b[0] + w * c[0] - p[0]
    q1 = u * a[1] + v * b[1] + w * c[1] - p[1]
    q2 = u * a[2] + v * b[2] + w * c[2] - p[2]
    return q0 * q0 + q1 * q1 + q2 * q2


@stored_njit(error_model="numpy")
def nearest(points, verts, faces, ids, true_faces, nodes, bounds, radius):
    """Nearest face of each point within a radius.

    Args:
        points: (P, 3) [m].
        true_faces: faces whose id is not below this (fans over holes) are passed over.
        radius: how far to look [m].

    Returns:
        distance (P,) [m], inf where there is none; id (P,) int64, -1 there; barycentric weights (P, 3).
    """
    count = len(points)
    distance = np.full(count, np.inf)
    face = np.full(count, -1, np.int64)
    weights = np.zeros((count, 3))
    stack = np.zeros(_STACK, np.int64)
    reach = np.zeros(_STACK)
    weight = np.zeros(3)
    for i in range(count):
        p = points[i]
        best = radius * radius
        stack[0] = 0
        reach[0] = _box_distance(bounds, stack[0], p[0], p[1], p[2])
        top = 1
        while top > 0:
            top -= 1
            if reach[top] > best:
                continue
            k = stack[top]
            left, right = nodes[k, 2], nodes[k, 3]
            if left < 0:
                for f in range(nodes[k, 0], nodes[k, 0] + nodes[k, 1]):
                    if ids[f] < true_faces:
                        square = _closest_on_triangle(
                            p, verts[faces[f, 0]], verts[faces[f, 1]], verts[faces[f, 2]], weight
                        )
                        if square < best:
                            best = square
                            face[i] = ids[f]
                            weights[i, 0], weights[i, 1], weights[i, 2] = weight[0], weight[1], weight[2]
            else:
                dl = _box_distance(bounds, left, p[0], p[1], p[2])
                dr = _box_distance(bounds, right, p[0], p[1], p[2])
                # The nearer child goes on top.
                if dl < dr:
                    left, right, dl, dr = right, left, dr, dl
                if dl <= best:
                    stack[top], reach[top] = left, dl
                    top += 1
                if dr <= best:
                    stack[top], reach[top] = right, dr
                    top += 1
        if face[i] >= 0:
            distance[i] = math.sqrt(best)
    return distance, face, weights
