"""Reference dent of a soft head under a rigid hand: a thin-plate displacement field, pushed out of the hand until
nothing penetrates.

This is NOT the method of the pipeline's contact stage (a particle simulation): the displacement ``d`` minimises

    sum_i m_i |(L d)_i|^2 + a sum_i m_i |d_i|^2 + w sum_(i in A) |d_i - t_i|^2

with the cotangent Laplacian ``L`` and lumped masses ``m``, i.e. a bending plate on an elastic bed (biharmonic with
decay). The set ``A`` and its targets ``t`` start empty; every round the hand's surface points inside the deformed
head, and the head's vertices inside the hand, add what is needed to leave each other along the head's inward normals,
and the field is solved again. It ends when the deepest remaining point is below the tolerance.
"""

import dataclasses

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

__all__ = ["Dent", "Surface", "dent", "rim_fan", "signed_distance", "vertex_normals"]

_DEEPEST = 0.03
_FANS: dict[bytes, tuple[np.ndarray, list[np.ndarray]]] = {}


def signed_distance(
    points: np.ndarray, verts: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance to a surface, negative inside; holes (neck, wrist) count as closed by the fan over their rim.

    Inside is where the generalised winding number is above one half, so surfaces that cut themselves (lips) do no harm.

    Args:
        points: (P, 3) [m].
        verts: (V, 3) [m].
        faces: (F, 3) counter-clockwise seen from outside.

    Returns:
        distance (P,) [m], nearest face (P,) (of `faces`), nearest point (P, 3).
    """
    import igl

    points, verts = np.ascontiguousarray(points, np.float64), np.ascontiguousarray(verts, np.float64)
    faces = np.ascontiguousarray(faces, np.int64)
    squared, face, nearest = igl.point_mesh_squared_distance(points, verts, faces)
    distance = np.sqrt(squared)
    # Nothing is ever deeper: the winding number is not needed further off.
    candidates = np.flatnonzero(distance < _DEEPEST)
    if len(candidates):
        fan, hub = rim_fan(faces, len(verts))
        closed = np.concatenate([verts, *(verts[ring].mean(0, keepdims=True) for ring in hub)])
        winding = np.asarray(igl.winding_number(closed, np.concatenate([faces, fan]), points[candidates]))
        distance[candidates[winding > 0.5]] *= -1
    return distance, np.asarray(face), np.asarray(nearest)


def rim_fan(faces: np.ndarray, count: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """Triangles that close every hole of a surface.

    Args:
        faces: (F, 3) of an oriented manifold with boundary.
        count: number of vertices; hub `i` of the fans gets the id `count + i`.

    Returns:
        fan triangles (G, 3) and, for each hole, the vertices of its rim (their mean is the hub).
    """
    key = faces.tobytes()
    if key not in _FANS:
        edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        code, back = edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0]
        following = {int(a): int(b) for b, a in edges[~np.isin(code, back)]}
        fan, rims = [], []
        while following:
            start, at, rim = next(iter(following)), next(iter(following)), []
            while at in following:
                rim.append(at)
                nxt = following.pop(at)
                fan.append([at, nxt, count + len(rims)])
                at = nxt
            rims.append(np.array(rim if at == start else [*rim, at]))
        _FANS.clear() if len(_FANS) > 8 else None
        _FANS[key] = (np.array(fan, np.int64).reshape(-1, 3), rims)
    return _FANS[key]


@dataclasses.dataclass(frozen=True)
class Surface:
    """What the solver needs of the head, made once a subject.

    Attributes:
        faces: (F, 3) skin faces.
        movable: (V,) bool, skin that may move (no eyeballs, no neck).
        energy: (V, V) sparse matrix of the first two terms, scaled so that it does not depend on the mesh's density.
    """

    faces: np.ndarray
    movable: np.ndarray
    energy: sp.csc_matrix

    @classmethod
    def build(cls, verts: np.ndarray, faces: np.ndarray, movable: np.ndarray, reach: float = 0.018) -> "Surface":
        """Prepares the solver for a rest shape.

        Args:
            verts: (V, 3) [m].
            faces: (F, 3); faces with a vertex that is not movable on another component may be left out.
            movable: (V,) bool.
            reach: distance over which a dent fades [m].
        """
        n = len(verts)
        stiffness = sp.csc_matrix((n, n))
        mass = np.zeros(n)
        for i in range(3):
            a, b, c = (verts[faces[:, (i + k) % 3]] for k in range(3))
            area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
            cot = ((b - a) * (c - a)).sum(1) / np.maximum(2 * area, 1e-12)
            cot = np.clip(cot, 0.02, 20.0) / 2  # obtuse corners would give the plate negative springs
            j, k = faces[:, (i + 1) % 3], faces[:, (i + 2) % 3]
            stiffness += sp.coo_matrix((cot, (j, k)), (n, n)) + sp.coo_matrix((cot, (k, j)), (n, n))
            np.add.at(mass, faces[:, i], area / 3)
        mass = np.maximum(mass, 1e-9)
        laplacian = sp.diags(np.asarray(stiffness.sum(1)).ravel()) - stiffness
        # lengths in units of `reach`: bending and bed balance there
        energy = laplacian @ sp.diags(reach**4 / mass) @ laplacian + sp.diags(mass)
        return cls(faces, movable, sp.csc_matrix(energy / mass.mean()))


@dataclasses.dataclass(frozen=True)
class Dent:
    """A solved dent: `offset` (V, 3) [m] to be added, `rounds` taken, `residual` deepest penetration left [m]."""

    offset: np.ndarray
    rounds: int
    residual: float


def vertex_normals(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area-weighted unit normals (V, 3) of vertices (V, 3) and faces (F, 3); zero where no face is."""
    face_normal = np.cross(verts[faces[:, 1]] - verts[faces[:, 0]], verts[faces[:, 2]] - verts[faces[:, 0]])
    out = np.zeros_like(verts)
    for i in range(3):
        np.add.at(out, faces[:, i], face_normal)
    return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-12)


def dent(
    surface: Surface,
    head: np.ndarray,
    hand: np.ndarray,
    hand_faces: np.ndarray,
    *,
    tolerance: float = 2e-4,
    rounds: int = 40,
) -> Dent:
    """Pushes the head's surface out of the hand.

    Args:
        surface: the head's solver.
        head: (V, 3) undeformed posed vertices [m].
        hand: (P, 3) posed vertices [m], same axes.
        hand_faces: (F, 3).
        tolerance: penetration that is accepted [m].
        rounds: most rounds to take.

    Returns:
        The dent; its residual tells whether the tolerance was reached.
    """
    offset = np.zeros_like(head)
    samples = np.concatenate([hand, hand[hand_faces].mean(1)])
    near = np.linalg.norm(samples - head.mean(0), axis=1) < 0.25
    samples = samples[near]
    if not len(samples):
        return Dent(offset, 0, 0.0)
    inward = -vertex_normals(head, surface.faces)
    # the direction must not swirl at fine folds (lips, nostrils): average it over about a centimetre
    ends = surface.faces[:, [0, 1]]
    edge = float(np.median(np.linalg.norm(head[ends[:, 0]] - head[ends[:, 1]], axis=1)))
    ring = sp.coo_matrix(
        (np.ones(3 * len(surface.faces)), (surface.faces.ravel(), np.roll(surface.faces, 1, 1).ravel())),
        (len(head),) * 2,
    )
    ring = sp.csr_matrix(ring + ring.T + sp.eye(len(head)))
    for _ in range(int(np.clip((0.011 / edge) ** 2, 2, 30))):
        inward = ring @ inward
        inward /= np.maximum(np.linalg.norm(inward, axis=1, keepdims=True), 1e-12)
    target = np.zeros_like(head)
    held = np.zeros(len(head), bool)
    region = np.zeros(len(head), dtype=bool)
    residual = 0.0
    for step in range(rounds):
        verts = head + offset
        distance, face, nearest = signed_distance(samples, verts, surface.faces)
        # only skin that can give way is pushed
        deep = (distance < -tolerance / 4) & surface.movable[surface.faces[face]].any(1)
        push = np.zeros(len(head))
        corners = surface.faces[face[deep]]
        if len(corners):
            weight = _barycentric(nearest[deep], verts[corners]) * surface.movable[corners]
            weight /= np.maximum(weight.sum(1, keepdims=True), 0.2)
            need = -distance[deep] + tolerance / 4
            share = weight / np.maximum((weight**2).sum(1, keepdims=True), 0.05)
            np.maximum.at(
                push, corners.ravel(), (share * need[:, None]).clip(0, 0.02).ravel() * (weight.ravel() > 0.15)
            )
        close = np.flatnonzero(surface.movable & (np.linalg.norm(verts - hand.mean(0), axis=1) < 0.2))
        inside_depth = 0.0
        if len(close):
            d_hand, _, out = signed_distance(verts[close], hand, hand_faces)
            stuck = d_hand < -tolerance / 4
            if stuck.any():
                ids = close[stuck]
                along = ((out[stuck] - verts[ids]) * inward[ids]).sum(1)
                # the nearest way out may lead through the back of a finger; then go on inward by the depth
                push[ids] = np.maximum(push[ids], np.where(along > 0, along, -d_hand[stuck]) + tolerance / 4)
                inside_depth = float(-d_hand.min())
        push = np.minimum(push, 0.012) * surface.movable
        residual = max(float(-distance[deep].min()) if deep.any() else 0.0, inside_depth)
        if residual <= tolerance or not push.any():
            return Dent(offset, step, residual)
        moved = push > 0
        target[moved] = offset[moved] + push[moved, None] * inward[moved]
        held |= moved
        if not region[held].all():
            centre = head[held].mean(0)
            radius = np.linalg.norm(head[held] - centre, axis=1).max() + 0.07
            region = surface.movable & (np.linalg.norm(head - centre, axis=1) < radius)
        ids = np.flatnonzero(region)
        system = surface.energy[ids][:, ids] + sp.diags(held[ids] * 1e6)
        right = held[ids, None] * 1e6 * target[ids]
        offset = np.zeros_like(head)
        offset[ids] = splu(sp.csc_matrix(system)).solve(right)
    return Dent(offset, rounds, residual)


def _barycentric(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normal = np.cross(b - a, c - a)
    size = np.maximum((normal**2).sum(1), 1e-20)
    w0 = (np.cross(c - b, points - b) * normal).sum(1) / size
    w1 = (np.cross(a - c, points - c) * normal).sum(1) / size
    weight = np.clip(np.stack([w0, w1, 1 - w0 - w1], 1), 0, 1)
    return weight / weight.sum(1, keepdims=True)
