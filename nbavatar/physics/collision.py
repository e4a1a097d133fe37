"""Where hands and head touch or overlap, as contacts for the solver and as figures for the report."""

import math
from typing import NamedTuple

import numpy as np

from nbavatar.jit.cache import stored_njit
from nbavatar.mesh.bvh import DeformingMesh
from nbavatar.mesh.tree import in_box

__all__ = ["Contacts", "Overlap", "deepest_edge", "estimate_overlap", "find_contacts", "measure_overlap"]

# Steps by which the way out of a hand is searched along the inward normal [m].
_MARCH = np.arange(1, 17) * 0.002


class Contacts(NamedTuple):
    """C points of hands against points of the head's surface.

    Attributes:
        points: hand points [m], (C, 3).
        normals: unit vectors from the head to the hand, (C, 3).
        ids: head vertices, (C, 3); `weights` their barycentric weights (C, 3).
        hand: index of the hand, (C,).
        depth: how far each is inside the other part [m], (C,), negative outside.
        anchor: hand vertices that the point is made of, (C, 3); `anchor_weights` (C, 3).
    """

    points: np.ndarray
    normals: np.ndarray
    ids: np.ndarray
    weights: np.ndarray
    hand: np.ndarray
    depth: np.ndarray
    anchor: np.ndarray
    anchor_weights: np.ndarray


class Overlap(NamedTuple):
    """How far two meshes are inside each other.

    Attributes:
        hand_depth: depth of hand vertices inside the head [m], (Vh,), 0 outside.
        head_depth: depth of head vertices inside the hand [m], (V,), 0 outside.
        hand_distance: unsigned distance of hand vertices to the head [m], (Vh,), inf beyond the search radius.
        head_distance: the same of head vertices to the hand, (V,).
    """

    hand_depth: np.ndarray
    head_depth: np.ndarray
    hand_distance: np.ndarray
    head_distance: np.ndarray

    @property
    def deepest(self) -> float:
        """Greatest depth of any vertex [m]."""
        return float(max(self.hand_depth.max(initial=0.0), self.head_depth.max(initial=0.0)))


def measure_overlap(head: DeformingMesh, hand: DeformingMesh, count: tuple[int, int], radius: float) -> Overlap:
    """Distances within a radius, and depths at any depth, inside by winding number.

    Args:
        head: the head; `hand`: one hand.
        count: numbers of vertices of head and hand (the meshes also hold the hubs of closed holes).
        radius: how far outside distances are wanted [m].
    """
    return _overlap(head, hand, count, radius, None)


def estimate_overlap(
    head: DeformingMesh,
    hand: DeformingMesh,
    edges: tuple[np.ndarray, np.ndarray],
    count: tuple[int, int],
    radius: float,
) -> Overlap:
    """`measure_overlap`, several times faster.

    Near the surface the side is told by pseudonormals. Vertices farther away than half the longest edge are on the same
    side as their neighbours that are far too, as no edge between them can cross the surface: one winding number for
    each connected group.

    Args:
        edges: edges of head and hand, (E, 2) and (Eh, 2) int64; the rest as in `measure_overlap`.
    """
    return _overlap(head, hand, count, radius, edges)


def _overlap(
    head: DeformingMesh,
    hand: DeformingMesh,
    count: tuple[int, int],
    radius: float,
    edges: tuple[np.ndarray, np.ndarray] | None,
) -> Overlap:
    points = hand.verts[: count[1]]
    hand_depth, hand_distance = (
        _depths(head, points, radius) if edges is None else _quick(head, points, edges[1], radius)
    )
    head_depth, head_distance = np.zeros(count[0]), np.full(count[0], np.inf)
    low, high = hand.box()
    points = head.verts[: count[0]]
    boxed = in_box(points, low - radius, high + radius)
    near = np.flatnonzero(boxed)
    if len(near):
        points = np.ascontiguousarray(points[near])
        if edges is None:
            head_depth[near], head_distance[near] = _depths(hand, points, radius)
        else:
            local = np.cumsum(boxed) - 1
            within = edges[0][boxed[edges[0][:, 0]] & boxed[edges[0][:, 1]]]
            head_depth[near], head_distance[near] = _quick(hand, points, local[within], radius)
    return Overlap(hand_depth, head_depth, hand_distance, head_distance)


def _quick(mesh: DeformingMesh, points: np.ndarray, edges: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    longest = _longest(points, edges)
    distance, face, _ = mesh.signed(points, max(radius, 0.51 * longest))
    depth = np.maximum(-distance, 0.0)
    low, high = mesh.box()
    far = (face < 0) & in_box(points, low, high)
    depth[face < 0] = 0.0
    if far.any():
        group = _groups(far, edges)
        ids = np.flatnonzero(far)
        _, first, inverse = np.unique(group[ids], return_index=True, return_inverse=True)
        inside = mesh.inside(np.ascontiguousarray(points[ids[first]]))[inverse]
        if inside.any():
            deep = ids[inside]
            depth[deep] = mesh.closest(np.ascontiguousarray(points[deep]), np.inf)[0]
    distance = np.abs(distance)
    distance[distance > radius] = np.inf
    return depth, distance


def _depths(mesh: DeformingMesh, points: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    distance, face, _ = mesh.closest(points, radius)
    inside = mesh.inside(points)
    deep = np.flatnonzero(inside & (face < 0))
    if len(deep):
        distance[deep] = mesh.closest(np.ascontiguousarray(points[deep]), np.inf)[0]
    return np.where(inside, distance, 0.0), distance


@stored_njit()
def _longest(points, edges):
    """Length of the longest edge."""
    square = 0.0
    for e in range(len(edges)):
        a, b = edges[e, 0], edges[e, 1]
        d0, d1, d2 = points[a, 0] - points[b, 0], points[a, 1] - points[b, 1], points[a, 2] - points[b, 2]
        square = max(square, d0 * d0 + d1 * d1 + d2 * d2)
    return np.sqrt(square)


@stored_njit()
def _groups(member, edges):
    """A label for each vertex: equal for members joined by edges between members (union-find)."""
    parent = np.arange(len(member))
    for e in range(len(edges)):
        a, b = edges[e, 0], edges[e, 1]
        if member[a] and member[b]:
            while parent[a] != a:
                parent[a] = parent[parent[a]]
                a = parent[a]
            while parent[b] != b:
                parent[b] = parent[parent[b]]
                b = parent[b]
            parent[max(a, b)] = min(a, b)
    for v in range(len(member)):
        parent[v] = parent[parent[v]]
    return parent


def deepest_edge(head: DeformingMesh, hand: DeformingMesh, edges: tuple[np.ndarray, np.ndarray]) -> float:
    """How deep edges lie inside the other part whose ends are outside it [m].

    Args:
        edges: edges of head and hand to look at, (E, 2) and (Eh, 2) int64.
    """
    deepest = 0.0
    for mesh, other, pairs in ((head, hand, edges[0]), (hand, head, edges[1])):
        ids, weights = _dips(mesh, other, pairs)
        if len(ids):
            points = _surface_points(mesh.verts, ids, weights)
            deepest = max(deepest, float(other.closest(points, np.inf)[0].max()))
    return deepest


def find_contacts(
    head: DeformingMesh,
    hands: list[DeformingMesh],
    hand_counts: list[int],
    outward: np.ndarray,
    movable: np.ndarray,
    radius: float,
    near: float,
    edges: tuple[np.ndarray, list[np.ndarray]] | None = None,
) -> Contacts:
    """Contacts of all hands with the head, both ways: vertices (and edges) of either against the faces of the other.

    The normal is the direction of the shortest way apart. Where that way would pull the skin outwards (a fingertip
    that came out on the far side, a vertex behind the finger) it is the head's smoothed outward normal instead.

    Args:
        head: deformed head; `hands`: one mesh each, `hand_counts` their vertex numbers.
        outward: smoothed unit normals of the head's rest shape, (V, 3).
        movable: head vertices that may be in a contact of the second kind, (A,).
        radius: how deep a contact is looked for [m].
        near: points outside by less than this are contacts too, so that they do not enter later [m].
        edges: edges of the head (E, 2) and of each hand that are contacts where they dip into the other part between
            two vertices that do not: in the middle of the stretch inside.
    """
    parts: list[tuple[np.ndarray, ...]] = []
    for h, (hand, count) in enumerate(zip(hands, hand_counts, strict=True)):
        ids, weights = _samples(hand, np.arange(count), None if edges is None else edges[1][h], head)
        m = _meet(hand, ids, weights, head, outward, False, radius, near)
        ours = m.points, m.normals, m.other_ids, m.other_weights, m.depth, m.ids, m.weights
        low, high = hand.box()
        boxed = movable[in_box(head.verts[movable], low - near, high + near)]
        ids, weights = _samples(head, boxed, None if edges is None else edges[0], hand)
        m = _way_out(_meet(head, ids, weights, hand, outward, True, radius, near), hand)
        theirs = m.nearest, m.normals, m.ids, m.weights, m.depth, m.other_ids, m.other_weights
        parts += [(*part[:4], np.full(len(part[0]), h), *part[4:]) for part in (ours, theirs)]
    return Contacts(*(np.ascontiguousarray(np.concatenate(column)) for column in zip(*parts, strict=True)))


def _samples(
    mesh: DeformingMesh, vertices: np.ndarray, edges: np.ndarray | None, other: DeformingMesh
) -> tuple[np.ndarray, np.ndarray]:
    """Points of a mesh that may touch: vertex ids (P, 3) and weights (P, 3). A vertex is named three times."""
    ids, weights = np.repeat(vertices[:, None], 3, axis=1), np.zeros((len(vertices), 3))
    weights[:, 0] = 1.0
    if edges is not None:
        more, shares = _dips(mesh, other, edges)
        ids, weights = np.concatenate((ids, more)), np.concatenate((weights, shares))
    return ids, weights


def _dips(mesh: DeformingMesh, other: DeformingMesh, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points of a mesh's edges inside another between outer ends, as vertex ids (P, 3) and weights (P, 3)."""
    way = other.dips(mesh.verts, edges)
    found = np.flatnonzero(np.isfinite(way))
    way = way[found]
    return edges[found][:, [0, 1, 1]], np.stack((1.0 - way, way, np.zeros(len(way))), axis=1)


class _Meeting(NamedTuple):
    """Points of one mesh near another: where they are made of, what they are nearest to, the normal head to hand.

    `turned`: the normal is the head's own, as the shortest way apart would pull the skin outwards.
    """

    points: np.ndarray
    ids: np.ndarray
    weights: np.ndarray
    nearest: np.ndarray
    other_ids: np.ndarray
    other_weights: np.ndarray
    depth: np.ndarray
    normals: np.ndarray
    turned: np.ndarray


def _meet(
    own: DeformingMesh, ids: np.ndarray, weights: np.ndarray, other: DeformingMesh, outward: np.ndarray,
    skin: bool, radius: float, near: float,
) -> _Meeting:  # fmt: skip
    """Points of a mesh inside another, or nearer than `near`; `skin` if they are the head's, not the hand's."""
    points = _surface_points(own.verts, ids, weights)
    distance, face, share = other.signed(points, radius)
    found = np.flatnonzero((face >= 0) & (distance < near))
    points, ids, weights, share, depth = points[found], ids[found], weights[found], share[found], -distance[found]
    corners = other.faces[face[found]]
    nearest = _surface_points(other.verts, corners, share)
    away = _surface_points(outward, ids, weights) if skin else _surface_points(outward, corners, share)
    normals, turned = _normals(points, nearest, depth, away, skin)
    return _Meeting(points, ids, weights, nearest, corners, share, depth, normals, turned)


def _way_out(found: _Meeting, hand: DeformingMesh) -> _Meeting:
    """Head points in a hand, those whose normal was turned with the place where the inward normal leaves the hand."""
    through = np.flatnonzero(found.turned & (found.depth > 0.0))
    if len(through):
        paths = found.points[through, None] - _MARCH[:, None] * found.normals[through, None]
        blocked = hand.inside(paths.reshape(-1, 3)).reshape(len(through), -1)
        first = np.where(blocked.all(axis=1), len(_MARCH) - 1, np.argmin(blocked, axis=1))
        found.nearest[through] = paths[np.arange(len(through)), first]
    keep = ~found.turned | (found.depth > 0.0)
    return found if keep.all() else _Meeting(*(column[keep] for column in found))


@stored_njit(error_model="numpy")
def _surface_points(values, ids, weights):
    """Weighted sums (P, 3) of rows of `values` (V, 3): ids (P, 3), weights (P, 3)."""
    result = np.zeros((len(ids), 3))
    for p in range(len(ids)):
        a, b, c = ids[p, 0], ids[p, 1], ids[p, 2]
        u, v, w = weights[p, 0], weights[p, 1], weights[p, 2]
        for i in range(3):
            result[p, i] = u * values[a, i] + v * values[b, i] + w * values[c, i]
    return result


@stored_njit(error_model="numpy")
def _normals(points, nearest, depth, away, skin):
    """Unit normals from head to hand (P, 3), and which were turned; `away` (P, 3) is out of the head, any length."""
    normals, turned = np.zeros((len(points), 3)), np.zeros(len(points), np.bool_)
    sign = -1.0 if skin else 1.0
    for p in range(len(points)):
        a0, a1, a2 = away[p, 0], away[p, 1], away[p, 2]
        length = max(math.sqrt(a0 * a0 + a1 * a1 + a2 * a2), 1e-12)
        a0, a1, a2 = a0 / length, a1 / length, a2 / length
        normals[p, 0], normals[p, 1], normals[p, 2] = a0, a1, a2
        distance = abs(depth[p])
        if distance > 1e-6:
            # Out of the surface at `nearest`, from either side of it; from a hand to its outside is towards the head.
            scale = distance * (sign if depth[p] > 0.0 else -sign)
            n0 = (nearest[p, 0] - points[p, 0]) / scale
            n1 = (nearest[p, 1] - points[p, 1]) / scale
            n2 = (nearest[p, 2] - points[p, 2]) / scale
            turned[p] = n0 * a0 + n1 * a1 + n2 * a2 < 0.2 * sign
            if not turned[p]:
                normals[p, 0], normals[p, 1], normals[p, 2] = n0, n1, n2
    return normals, turned
