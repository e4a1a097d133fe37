"""Where hands and head touch or overlap, as contacts for the solver and as figures for the report."""

from typing import NamedTuple

import numba
import numpy as np

from nbavatar.mesh.bvh import DeformingMesh, surface_points
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


@numba.njit(cache=True)
def _longest(points, edges):
    """Length of the longest edge."""
    square = 0.0
    for e in range(len(edges)):
        a, b = edges[e, 0], edges[e, 1]
        d0, d1, d2 = points[a, 0] - points[b, 0], points[a, 1] - points[b, 1], points[a, 2] - points[b, 2]
        square = max(square, d0 * d0 + d1 * d1 + d2 * d2)
    return np.sqrt(square)


@numba.njit(cache=True)
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
            points = np.einsum("pc,pci->pi", weights, mesh.verts[ids])
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
        anchor, share = _samples(hand, np.arange(count), None if edges is None else edges[1][h], head)
        ours = _of_hand(head, hand, anchor, share, outward, radius, near)
        low, high = hand.box()
        boxed = movable[in_box(head.verts[movable], low - near, high + near)]
        ids, weights = _samples(head, boxed, None if edges is None else edges[0], hand)
        theirs = _of_head(head, hand, ids, weights, outward, radius, near)
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


def _of_hand(
    head: DeformingMesh, hand: DeformingMesh, anchor: np.ndarray, share: np.ndarray, outward: np.ndarray,
    radius: float, near: float,
) -> tuple[np.ndarray, ...]:  # fmt: skip
    """Contacts of points of the hand with faces of the head, as in `Contacts` but without `hand`."""
    points = np.einsum("pc,pci->pi", share, hand.verts[anchor])
    distance, face, weight = head.signed(points, radius)
    found = np.flatnonzero((face >= 0) & (distance < near))
    depth = -distance[found]
    inside, distance = depth > 0.0, np.abs(depth)
    face, weight, p = face[found], weight[found], points[found]
    q = surface_points(head.verts, head.faces, face, weight)
    ids = head.faces[face]
    away = _unit(np.einsum("pc,pci->pi", weight, outward[ids]))
    normal = _direction(p, q, distance, inside, away)
    wrong = (normal * away).sum(1) < 0.2
    normal[wrong] = away[wrong]
    return p, normal, ids, weight, depth, anchor[found], share[found]


def _of_head(
    head: DeformingMesh, hand: DeformingMesh, ids: np.ndarray, weights: np.ndarray, outward: np.ndarray,
    radius: float, near: float,
) -> tuple[np.ndarray, ...]:  # fmt: skip
    """Contacts of points of the head with faces of the hand, as in `Contacts` but without `hand`."""
    points = np.einsum("pc,pci->pi", weights, head.verts[ids])
    distance, face, weight = hand.signed(points, radius)
    found = np.flatnonzero((face >= 0) & (distance < near))
    depth = -distance[found]
    inside, distance = depth > 0.0, np.abs(depth)
    ids, weights, x = ids[found], weights[found], points[found]
    face, weight = face[found], weight[found]
    away = _unit(np.einsum("pc,pci->pi", weights, outward[ids]))
    q = surface_points(hand.verts, hand.faces, face, weight)
    # From hand to head is the direction out of the hand; the contact's normal is its opposite.
    normal = -_direction(x, q, distance, inside, -away)
    wrong = (normal * away).sum(1) < -0.2
    normal[wrong] = away[wrong]
    through = np.flatnonzero(wrong & inside)
    if len(through):
        paths = x[through, None] - _MARCH[:, None] * away[through, None]
        blocked = hand.inside(paths.reshape(-1, 3)).reshape(len(through), -1)
        first = np.where(blocked.all(axis=1), len(_MARCH) - 1, np.argmin(blocked, axis=1))
        q[through] = paths[np.arange(len(through)), first]
    keep = ~wrong | inside
    return q[keep], normal[keep], ids[keep], weights[keep], depth[keep], hand.faces[face[keep]], weight[keep]


def _direction(
    points: np.ndarray, nearest: np.ndarray, distance: np.ndarray, inside: np.ndarray, otherwise: np.ndarray
) -> np.ndarray:
    """Unit vectors out of a surface at `nearest`, from points on either side of it."""
    way = np.where(inside[:, None], nearest - points, points - nearest)
    return np.where((distance > 1e-6)[:, None], way / np.maximum(distance, 1e-12)[:, None], otherwise)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
