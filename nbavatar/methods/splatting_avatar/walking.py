"""Walking on triangles: points on a mesh moved along straightest geodesics.

A step is a tangent vector in the plane of the point's triangle. Within a triangle the path is a straight line; over an
edge it goes on straight in the neighbour unfolded into the same plane; through a vertex it leaves equal angles on both
sides (Polthier and Schmies 1998, 'straightest geodesics'); at a border it stops, and what is left of the step is lost.
Nothing is approximated: the result is exact up to rounding (float64).

Every triangle has its own plane (first corner at the origin, second on the x axis, third above it), so errors do not
pile up over the triangles of a path.
"""

from typing import NamedTuple

import numpy as np

__all__ = ["Surface", "make_surface", "tangents", "walk"]

_AT_VERTEX = 1e-10  # a path that leaves an edge within this share of an end goes through the vertex
_PARALLEL = 1e-13  # an edge is never met at a smaller angle [rad]
_MOST_CROSSINGS = 10_000


class Surface(NamedTuple):
    """A triangle mesh prepared for walking.

    Attributes:
        faces: vertex ids (F, 3) int64.
        corners: corners in the plane of each face [m], (F, 3, 2).
        axes: directions x and y of that plane in space, (F, 2, 3); zero for a face without one.
        across: face beyond the edge opposite each corner, (F, 3) int64; -1 at a border, and where more than two faces
            meet.
        verts: positions [m], (V, 3).
    """

    faces: np.ndarray
    corners: np.ndarray
    axes: np.ndarray
    across: np.ndarray
    verts: np.ndarray


def make_surface(verts: np.ndarray, faces: np.ndarray) -> Surface:
    """Lay out the triangles of a mesh.

    Args:
        verts: positions [m], float (V, 3), finite.
        faces: vertex ids, int (F, 3); neighbours need not have the same orientation.
    """
    verts, faces = np.asarray(verts, np.float64), np.asarray(faces, np.int64)
    first, second, third = (verts[faces[:, i]] for i in range(3))
    x = _unit(second - first)
    side = third - first
    along = (side * x).sum(1)
    up = side - along[:, None] * x
    # A height that is rounding error is none: its direction would be noise.
    longest = np.maximum(np.linalg.norm(second - first, axis=1), np.linalg.norm(side, axis=1))
    noise = 1e-12 * longest + 4e-16 * np.abs(verts).max(initial=0.0)
    up = np.where(np.linalg.norm(up, axis=1, keepdims=True) > noise[:, None], _unit(up), 0.0)
    y = _unit(up - (up * x).sum(1, keepdims=True) * x)
    corners = np.zeros((len(faces), 3, 2))
    corners[:, 1, 0] = np.linalg.norm(second - first, axis=1)
    corners[:, 2, 0], corners[:, 2, 1] = along, (side * y).sum(1)
    return Surface(faces, corners, np.stack((x, y), axis=1), _across(faces), verts)


def tangents(surface: Surface, face: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Steps in space that change barycentric coordinates by given amounts.

    Args:
        surface: the mesh.
        face: of every point, int (N,).
        change: of its barycentric coordinates, float (N, 3), each row with sum 0.

    Returns:
        float64 (N, 3) [m].
    """
    return np.einsum("nc,ncd->nd", np.asarray(change, np.float64), surface.verts[surface.faces[face]])


def walk(surface: Surface, face: np.ndarray, bary: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Move points on a surface.

    Args:
        surface: the mesh.
        face: of every point, int (N,).
        bary: barycentric coordinates in it, float (N, 3); clipped to the triangle first.
        step: vectors in space [m], float (N, 3); their part along the normal is dropped.

    Returns:
        face int64 (N,) and bary float64 (N, 3): at least 0, rows with sum 1 up to rounding.
    """
    face = np.array(face, np.int64)
    bary = _clipped(np.array(bary, np.float64))
    flat = np.einsum("nad,nd->na", surface.axes[face], np.asarray(step, np.float64))
    left = np.linalg.norm(flat, axis=1)
    active = np.flatnonzero(left > 0)
    left, heading = left[active], flat[active] / left[active, None]
    place = np.einsum("nc,nca->na", bary[active], surface.corners[face[active]])
    barred = np.zeros((len(active), 3), bool)  # edges that the path cannot leave by
    moved = np.zeros(len(active), bool)
    for _ in range(_MOST_CROSSINGS):
        if len(active) == 0:
            break
        here = face[active]
        corners = surface.corners[here]
        edge, reach, share = _exit(corners, place, heading, barred)
        rows = np.arange(len(active))
        inside = (left <= reach) | (edge < 0)
        if inside.any():
            ends = place[inside] + heading[inside] * np.where(edge[inside] < 0, 0.0, left[inside])[:, None]
            bary[active[inside]] = _barycentric(corners[inside], ends)
        beyond = surface.across[here, np.maximum(edge, 0)]
        at_border = ~inside & (beyond < 0)
        on_edge = ~inside
        if on_edge.any():  # also where a path ends if it cannot go on
            bary[active[on_edge]] = _on_edge(edge[on_edge], share[on_edge])
        moved |= reach > 1e-12 * corners[:, 1, 0]
        at_vertex = on_edge & moved & ((share <= _AT_VERTEX) | (share >= 1.0 - _AT_VERTEX))
        left = left - reach
        crossing = on_edge & ~at_border & ~at_vertex
        kept = crossing.copy()
        if crossing.any():
            c = rows[crossing]
            moved_to = _cross(surface, here[c], edge[c], beyond[c], share[c], heading[c])
            face[active[c]] = beyond[c]
            place[c], heading[c], barred[c] = moved_to
            bary[active[c]] = _barycentric(surface.corners[beyond[c]], place[c])
        for row in rows[at_vertex]:
            corner = (edge[row] + (1 if share[row] < 0.5 else 2)) % 3
            bary[active[row]] = np.eye(3)[corner]
            found = _through_vertex(surface, int(here[row]), int(corner), heading[row])
            if found is not None:
                new_face, new_corner, heading[row] = found
                face[active[row]] = new_face
                place[row] = surface.corners[new_face, new_corner]
                bary[active[row]] = np.eye(3)[new_corner]
                barred[row] = np.arange(3) != new_corner  # out of a corner the way is through the opposite edge
                kept[row] = True
        active, left, place = active[kept], left[kept], place[kept]
        heading, barred, moved = heading[kept], barred[kept], moved[kept]
    return face, bary


def _exit(
    corners: np.ndarray, place: np.ndarray, heading: np.ndarray, barred: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edge by which a line leaves its triangle (-1: none), the distance to it, and where along it, in [0, 1]."""
    start, end = corners[:, [1, 2, 0]], corners[:, [2, 0, 1]]
    along = end - start
    length = np.linalg.norm(along, axis=2)
    safe = np.where(length > 0, length, 1.0)
    outward = np.stack((along[..., 1], -along[..., 0]), axis=2) / safe[..., None]
    speed = np.einsum("nea,na->ne", outward, heading)
    met = (speed > _PARALLEL) & (length > 0) & ~barred
    distance = np.maximum(np.einsum("nea,nea->ne", outward, start - place[:, None]), 0.0)
    reach = np.where(met, distance / np.where(met, speed, 1.0), np.inf)
    hit = place[:, None] + np.where(met, reach, 0.0)[..., None] * heading[:, None]
    share = np.einsum("nea,nea->ne", hit - start, along) / safe**2
    # In a sliver two edges are met at once: the one whose ends enclose the point is left by; at a corner, the one that
    # is met more squarely, which is the nearer one to turn about the corner.
    nearest = reach.min(1)
    size = length.max(1)
    with np.errstate(invalid="ignore"):
        tied = met & (reach <= (nearest + 1e-12 * size)[:, None])
    outside = np.maximum(np.maximum(-share, share - 1.0), 0.0)
    score = np.where(tied, 1e6 * np.where(outside < 1e-9, 0.0, outside) - speed, np.inf)
    edge = np.where(tied.any(1), score.argmin(1), -1)
    rows = np.arange(len(edge))
    chosen = np.maximum(edge, 0)
    return edge, np.where(edge < 0, 0.0, reach[rows, chosen]), np.clip(share[rows, chosen], 0.0, 1.0)


def _cross(
    surface: Surface, face: np.ndarray, edge: np.ndarray, beyond: np.ndarray, share: np.ndarray, heading: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Point, direction and barred edges in the plane of the next triangle, unfolded over the shared edge."""
    own = surface.faces[face]
    rows = np.arange(len(face))
    a, b = (edge + 1) % 3, (edge + 2) % 3
    along = _unit(surface.corners[face, b] - surface.corners[face, a])
    outward = np.stack((along[:, 1], -along[:, 0]), axis=1)
    forward, sideways = (heading * outward).sum(1), (heading * along).sum(1)
    # The same edge in the neighbour, with its ends in the same order.
    theirs = surface.faces[beyond]
    first = (theirs == own[rows, a][:, None]).argmax(1)
    second = (theirs == own[rows, b][:, None]).argmax(1)
    begin, end = surface.corners[beyond, first], surface.corners[beyond, second]
    there = _unit(end - begin)
    left_of = np.stack((-there[:, 1], there[:, 0]), axis=1)
    # Corners run counter-clockwise, so a face lies left of its edges in their own order.
    inward = np.where((second == (first + 1) % 3)[:, None], left_of, -left_of)
    place = begin + share[:, None] * (end - begin)
    direction = _unit(forward[:, None] * inward + sideways[:, None] * there)
    barred = np.zeros((len(face), 3), bool)
    barred[rows, 3 - first - second] = True
    return place, direction, barred


def _through_vertex(
    surface: Surface, face: int, corner: int, heading: np.ndarray
) -> tuple[int, int, np.ndarray] | None:
    """Face, corner and direction in which a straightest path leaves a vertex; None at a border."""
    toward, other = (corner + 1) % 3, (corner + 2) % 3
    before = _angle(-heading, surface.corners[face, toward] - surface.corners[face, corner])
    # Around the vertex, starting over the edge to `toward`: face, its corner, the corner we come in by, its angle.
    fan: list[tuple[int, int, int, float]] = []
    vertex, pivot = surface.faces[face, corner], surface.faces[face, toward]
    here, leave = face, other  # the edge opposite corner `leave` holds vertex and pivot
    while True:
        here = int(surface.across[here, leave])
        if here < 0:
            return None
        own = surface.faces[here]
        at, entry = int((own == vertex).argmax()), int((own == pivot).argmax())
        leave = entry
        far = 3 - at - entry
        corners = surface.corners[here]
        angle = _angle(corners[entry] - corners[at], corners[far] - corners[at])
        fan.append((here, at, entry, angle))
        if here == face:
            break
        pivot = own[far]
        if len(fan) > len(surface.faces):
            return None
    half = 0.5 * sum(angle for *_, angle in fan)
    if half <= before:  # back into the same face, on the near side
        return face, corner, _turned(surface, face, corner, toward, before - half)
    turned = before
    for here, at, entry, angle in fan:
        if half <= turned + angle or here == face:
            return here, at, _turned(surface, here, at, entry, min(half - turned, angle))
        turned += angle
    return None


def _turned(surface: Surface, face: int, corner: int, toward: int, angle: float) -> np.ndarray:
    """Unit direction out of a corner, at an angle from the edge to another corner, into the face."""
    base = _unit((surface.corners[face, toward] - surface.corners[face, corner])[None])[0]
    sign = 1.0 if toward == (corner + 1) % 3 else -1.0
    cosine, sine = np.cos(angle), sign * np.sin(angle)
    return np.array([cosine * base[0] - sine * base[1], sine * base[0] + cosine * base[1]])


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.arctan2(abs(a[0] * b[1] - a[1] * b[0]), a[0] * b[0] + a[1] * b[1]))


def _across(faces: np.ndarray) -> np.ndarray:
    """Face beyond the edge opposite each corner, (F, 3); -1 unless exactly two faces share it."""
    edges = np.sort(np.stack((faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]), axis=1).reshape(-1, 2), axis=1)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    ordered = edges[order]
    starts = np.flatnonzero(np.r_[True, (ordered[1:] != ordered[:-1]).any(1)])
    counts = np.diff(np.r_[starts, len(ordered)])
    pairs = starts[(counts == 2) & (ordered[starts, 0] != ordered[starts, 1])]
    one, two = order[pairs], order[pairs + 1]
    across = np.full(len(edges), -1, np.int64)
    different = one // 3 != two // 3
    one, two = one[different], two[different]
    across[one], across[two] = two // 3, one // 3
    return across.reshape(-1, 3)


def _barycentric(corners: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Coordinates of points in the planes of their triangles (N, 3, 2), (N, 2) -> (N, 3), made valid."""
    base, height = corners[:, 1, 0], corners[:, 2, 1]
    flat = (base <= 0) | (height <= 0)
    third = np.where(flat, 0.0, place[:, 1] / np.where(flat, 1.0, height))
    second = (place[:, 0] - third * corners[:, 2, 0]) / np.where(base > 0, base, 1.0)
    values = np.stack((1.0 - second - third, second, third), axis=1)
    if flat.any():  # a triangle without area: by the longest of its edges
        values[flat] = [_on_sliver(c, p) for c, p in zip(corners[flat], place[flat], strict=True)]
    return _clipped(values)


def _on_sliver(corners: np.ndarray, place: np.ndarray) -> np.ndarray:
    spans = [np.linalg.norm(corners[(i + 2) % 3] - corners[(i + 1) % 3]) for i in range(3)]
    edge = int(np.argmax(spans))
    a, b = (edge + 1) % 3, (edge + 2) % 3
    share = float((place - corners[a]) @ (corners[b] - corners[a])) / spans[edge] ** 2 if spans[edge] > 0 else 0.0
    values = np.zeros(3)
    values[a], values[b] = 1.0 - share, share
    return values


def _on_edge(edge: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Coordinates of points on edges, `share` of the way along."""
    rows = np.arange(len(edge))
    values = np.zeros((len(edge), 3))
    values[rows, (edge + 1) % 3], values[rows, (edge + 2) % 3] = 1.0 - share, share
    return values


def _clipped(bary: np.ndarray) -> np.ndarray:
    """At least 0, with sum 1."""
    bary = np.maximum(bary, 0.0)
    total = bary.sum(1, keepdims=True)
    return np.where(total > 0, bary / np.where(total > 0, total, 1.0), 1.0 / 3.0)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Unit vectors; zero stays zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 0, vectors / np.where(length > 0, length, 1.0), 0.0)
