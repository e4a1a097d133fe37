"""Closest points and inside tests against a deforming mesh, fast enough for every frame of a sequence.

A bounding volume hierarchy is built once for a mesh's connectivity and refitted when its vertices move. It answers
closest point queries within a radius, and inside tests by the generalised winding number (Jacobson et al. 2013), far
clusters as dipoles (Barill et al. 2018, first order). Holes (neck, wrist) are closed for the inside test by a fan
over each border loop; fans are never a closest face. libigl has the same queries but rebuilds its tree on every call
(about 30 ms for a head), which a sequence cannot afford; the tests hold the two against each other.
"""

import math

import numba
import numpy as np

from nbavatar.mesh.topology import boundary_loops

__all__ = ["DeformingMesh", "surface_points"]

_LEAF = 4
_STACK = 64
# A cluster farther than this many of its radii is taken as one dipole.
_FAR = 2.0
# For so few points the clusters do not pay: the sum is taken over all faces.
_FEW = 4


class DeformingMesh:
    """A mesh whose vertices move and whose faces stay.

    Attributes:
        faces: vertex ids, (F, 3) int64, counter-clockwise seen from outside. Faces that name a vertex twice are passed
            over in all queries.
        verts: current positions [m], (V + one per hole, 3) float64; the extra ones are the hubs of the fans.
    """

    def __init__(self, verts: np.ndarray, faces: np.ndarray) -> None:
        """Builds the hierarchy from positions (V, 3) [m] that are typical of the sequence, such as the rest pose."""
        faces = np.asarray(faces, np.int64)
        repeated = (faces[:, 0] == faces[:, 1]) | (faces[:, 1] == faces[:, 2]) | (faces[:, 2] == faces[:, 0])
        self._proper = np.flatnonzero(~repeated)
        self.faces = faces
        self._count = len(verts)
        loops = boundary_loops(faces[~repeated])
        self._rims = loops
        fans = [
            np.stack((np.roll(loop, -1), loop, np.full(len(loop), len(verts) + i)), axis=1)
            for i, loop in enumerate(loops)
        ]
        self._all_faces = np.ascontiguousarray(np.concatenate([faces[~repeated], *fans]))
        self._true_faces = len(self._proper)
        self.verts = np.zeros((len(verts) + len(loops), 3))
        self._place(np.asarray(verts, np.float64))
        corners = self.verts[self._all_faces]
        self._order, self._nodes = _build(corners.mean(axis=1))
        self._bounds = np.zeros((len(self._nodes), 6))
        self._dipoles = np.zeros((len(self._nodes), 7))
        self._across = _across(self._all_faces)
        # Corners (3 f + c) around each vertex.
        flat = self._all_faces.ravel()
        self._around = np.argsort(flat, kind="stable")
        self._around_start = np.concatenate(([0], np.cumsum(np.bincount(flat, minlength=len(self.verts)))))
        self._rim = np.zeros(len(verts), bool)
        for loop in loops:
            self._rim[loop] = True
        # Position of a face among the proper ones.
        self._place_of = np.zeros(len(faces), np.int64)
        self._place_of[self._proper] = np.arange(len(self._proper))
        self._fitted = self._charged = False

    def move(self, verts: np.ndarray) -> None:
        """Takes new positions (V, 3) [m]; the hierarchy follows at the next query."""
        self._place(verts)
        self._fitted = self._charged = False

    def closest(self, points: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Nearest surface point of each query.

        Args:
            points: (P, 3) float64 [m].
            radius: how far to look [m].

        Returns:
            distance (P,) [m], inf where nothing is within the radius; face id (P,) int64, -1 there; barycentric weights
            (P, 3). Of equally near faces the one met first in the hierarchy is returned, the same in every run.
        """
        self._fit()
        distance, face, weight = _closest(
            points, self.verts, self._all_faces, self._true_faces, self._order, self._nodes, self._bounds, radius
        )
        found = face >= 0
        face[found] = self._proper[face[found]]
        return distance, face, weight

    def signed(self, points: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`closest`, with the distance negative where a point lies behind the surface.

        The side is told by the angle-weighted pseudonormal of the nearest face, edge or corner (Baerentzen and Aanaes
        2005): exact for a closed, consistently oriented surface that does not cut itself, and much cheaper than
        `inside`.
        """
        distance, face, weight = self.closest(points, radius)
        _sign(
            points, self.verts, self._all_faces, self._across, self._around_start, self._around, self._place_of,
            distance, face, weight,
        )  # fmt: skip
        # Beside a hole the nearest surface would be the fan: only the winding number knows.
        beside = np.flatnonzero(_on_rim(face, weight, self.faces, self._rim))
        if len(beside):
            sign = np.where(self.inside(np.ascontiguousarray(points[beside])), -1.0, 1.0)
            distance[beside] = np.abs(distance[beside]) * sign
        return distance, face, weight

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Whether each point (P, 3) [m] is inside, i.e. has a winding number above one half; (P,) bool."""
        self._fit()
        low, high = self._bounds[0, :3], self._bounds[0, 3:]
        result = np.zeros(len(points), bool)
        boxed = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
        if len(boxed):
            result[boxed] = self.winding(points[boxed]) > 0.5
        return result

    def winding(self, points: np.ndarray) -> np.ndarray:
        """Generalised winding number of each point (P, 3) [m], with holes closed; (P,) float64."""
        if len(points) <= _FEW:
            return _winding_plain(np.ascontiguousarray(points), self.verts, self._all_faces)
        if not self._charged:
            self._fit()
            _charge(self.verts, self._all_faces, self._order, self._nodes, self._bounds, self._dipoles)
            self._charged = True
        return _winding(
            np.ascontiguousarray(points), self.verts, self._all_faces, self._order, self._nodes, self._dipoles
        )

    @property
    def closed_faces(self) -> np.ndarray:
        """Proper faces and the fans that close the holes, (G, 3) into `verts`."""
        return self._all_faces

    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of the bounding box [m]."""
        self._fit()
        return self._bounds[0, :3].copy(), self._bounds[0, 3:].copy()

    def _place(self, verts: np.ndarray) -> None:
        self.verts[: self._count] = verts
        for i, rim in enumerate(self._rims):
            self.verts[self._count + i] = self.verts[rim].mean(axis=0)

    def _fit(self) -> None:
        if not self._fitted:
            _refit(self.verts, self._all_faces, self._order, self._nodes, self._bounds)
            self._fitted = True


def surface_points(verts: np.ndarray, faces: np.ndarray, face: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Positions (P, 3) of barycentric points: face ids (P,), weights (P, 3)."""
    return np.einsum("pc,pci->pi", weight, verts[faces[face]])


def _build(centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Median splits along the longest axis.

    Returns the order of faces (F,) and nodes (N, 4) int64: first face in the order, number of faces, left child and
    right child (-1 in leaves). Children come after their parents.
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


@numba.njit(cache=True)
def _refit(verts, faces, order, nodes, bounds):
    for k in range(len(nodes) - 1, -1, -1):
        left, right = nodes[k, 2], nodes[k, 3]
        if left >= 0:
            for i in range(3):
                bounds[k, i] = min(bounds[left, i], bounds[right, i])
                bounds[k, 3 + i] = max(bounds[left, 3 + i], bounds[right, 3 + i])
        else:
            for i in range(3):
                low, high = np.inf, -np.inf
                for s in range(nodes[k, 0], nodes[k, 0] + nodes[k, 1]):
                    f = order[s]
                    for c in range(3):
                        value = verts[faces[f, c], i]
                        low, high = min(low, value), max(high, value)
                bounds[k, i], bounds[k, 3 + i] = low, high


@numba.njit(cache=True)
def _box_distance(bounds, k, x, y, z):
    dx = max(bounds[k, 0] - x, 0.0, x - bounds[k, 3])
    dy = max(bounds[k, 1] - y, 0.0, y - bounds[k, 4])
    dz = max(bounds[k, 2] - z, 0.0, z - bounds[k, 5])
    return dx * dx + dy * dy + dz * dz


@numba.njit(cache=True)
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


@numba.njit(cache=True)
def _closest(points, verts, faces, true_faces, order, nodes, bounds, radius):
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
        stack[0], reach[0] = 0, _box_distance(bounds, 0, p[0], p[1], p[2])
        top = 1
        while top > 0:
            top -= 1
            if reach[top] > best:
                continue
            k = stack[top]
            left, right = nodes[k, 2], nodes[k, 3]
            if left < 0:
                for s in range(nodes[k, 0], nodes[k, 0] + nodes[k, 1]):
                    f = order[s]
                    if f < true_faces:
                        square = _closest_on_triangle(
                            p, verts[faces[f, 0]], verts[faces[f, 1]], verts[faces[f, 2]], weight
                        )
                        if square < best:
                            best = square
                            face[i] = f
                            weights[i] = weight
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


def _on_rim(face: np.ndarray, weight: np.ndarray, faces: np.ndarray, rim: np.ndarray) -> np.ndarray:
    """Whether the nearest point lies on a border edge or border vertex: all its corners with weight are on the rim."""
    on = (rim[faces[np.maximum(face, 0)]] | (weight <= 1e-9)).all(axis=1)
    return on & (face >= 0)


def _across(faces: np.ndarray) -> np.ndarray:
    """The face on the other side of each face's edges (0-1, 1-2, 2-0), (G, 3); -1 where there is none or several."""
    directed = np.concatenate((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]))
    owner = np.tile(np.arange(len(faces)), 3)
    key = np.sort(directed, axis=1)
    _, edge, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    edge = edge.ravel()
    total = np.bincount(edge, owner)
    other = np.where(count[edge] == 2, total[edge] - owner, -1).astype(np.int64)
    return np.ascontiguousarray(other.reshape(3, -1).T)


@numba.njit(cache=True)
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


@numba.njit(cache=True)
def _sign(points, verts, faces, across, around_start, around, place_of, distance, face, weight):
    normal = np.zeros(3)
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
            _add_normal(verts, faces, f, -1, normal)
            if zeros == 1:
                edge = 0 if weight[i, 2] <= 1e-9 else (1 if weight[i, 0] <= 1e-9 else 2)
                if across[f, edge] >= 0:
                    _add_normal(verts, faces, across[f, edge], -1, normal)
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


@numba.njit(cache=True)
def _charge(verts, faces, order, nodes, bounds, dipoles):
    """Per node: centre (area weighted), a radius that holds its box, sum of area vectors."""
    area = np.zeros(len(nodes))
    for k in range(len(nodes) - 1, -1, -1):
        left, right = nodes[k, 2], nodes[k, 3]
        for i in range(7):
            dipoles[k, i] = 0.0
        area[k] = 0.0
        if left >= 0:
            area[k] = area[left] + area[right]
            for i in range(3):
                dipoles[k, 4 + i] = dipoles[left, 4 + i] + dipoles[right, 4 + i]
                if area[k] > 0.0:
                    dipoles[k, i] = (area[left] * dipoles[left, i] + area[right] * dipoles[right, i]) / area[k]
                else:
                    dipoles[k, i] = dipoles[left, i]
        else:
            for s in range(nodes[k, 0], nodes[k, 0] + nodes[k, 1]):
                a, b, c = verts[faces[order[s], 0]], verts[faces[order[s], 1]], verts[faces[order[s], 2]]
                n0 = 0.5 * ((b[1] - a[1]) * (c[2] - a[2]) - (b[2] - a[2]) * (c[1] - a[1]))
                n1 = 0.5 * ((b[2] - a[2]) * (c[0] - a[0]) - (b[0] - a[0]) * (c[2] - a[2]))
                n2 = 0.5 * ((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))
                size = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
                area[k] += size
                dipoles[k, 4] += n0
                dipoles[k, 5] += n1
                dipoles[k, 6] += n2
                for i in range(3):
                    dipoles[k, i] += size * (a[i] + b[i] + c[i]) / 3.0
            for i in range(3):
                dipoles[k, i] = dipoles[k, i] / area[k] if area[k] > 0.0 else verts[faces[order[nodes[k, 0]], 0], i]
        square = 0.0
        for i in range(3):
            square += max(dipoles[k, i] - bounds[k, i], bounds[k, 3 + i] - dipoles[k, i]) ** 2
        dipoles[k, 3] = math.sqrt(square)


@numba.njit(cache=True)
def _winding(points, verts, faces, order, nodes, dipoles):
    result = np.zeros(len(points))
    stack = np.zeros(_STACK, np.int64)
    for i in range(len(points)):
        p0, p1, p2 = points[i, 0], points[i, 1], points[i, 2]
        total = 0.0
        stack[0] = 0
        top = 1
        while top > 0:
            top -= 1
            k = stack[top]
            d0, d1, d2 = dipoles[k, 0] - p0, dipoles[k, 1] - p1, dipoles[k, 2] - p2
            square = d0 * d0 + d1 * d1 + d2 * d2
            if square > (_FAR * dipoles[k, 3]) ** 2:
                flux = dipoles[k, 4] * d0 + dipoles[k, 5] * d1 + dipoles[k, 6] * d2
                total += flux / (square * math.sqrt(square))
            elif nodes[k, 2] >= 0:
                stack[top], stack[top + 1] = nodes[k, 2], nodes[k, 3]
                top += 2
            else:
                for s in range(nodes[k, 0], nodes[k, 0] + nodes[k, 1]):
                    f = order[s]
                    total += _solid_angle(p0, p1, p2, verts[faces[f, 0]], verts[faces[f, 1]], verts[faces[f, 2]])
        result[i] = total / (4.0 * math.pi)
    return result


@numba.njit(cache=True)
def _winding_plain(points, verts, faces):
    result = np.zeros(len(points))
    for i in range(len(points)):
        for f in range(len(faces)):
            result[i] += _solid_angle(
                points[i, 0], points[i, 1], points[i, 2], verts[faces[f, 0]], verts[faces[f, 1]], verts[faces[f, 2]]
            )
    return result / (4.0 * math.pi)


@numba.njit(cache=True)
def _solid_angle(p0, p1, p2, a, b, c):
    """Signed solid angle of triangle abc seen from p (van Oosterom and Strackee 1983)."""
    a0, a1, a2 = a[0] - p0, a[1] - p1, a[2] - p2
    b0, b1, b2 = b[0] - p0, b[1] - p1, b[2] - p2
    c0, c1, c2 = c[0] - p0, c[1] - p1, c[2] - p2
    la = math.sqrt(a0 * a0 + a1 * a1 + a2 * a2)
    lb = math.sqrt(b0 * b0 + b1 * b1 + b2 * b2)
    lc = math.sqrt(c0 * c0 + c1 * c1 + c2 * c2)
    det = a0 * (b1 * c2 - b2 * c1) + a1 * (b2 * c0 - b0 * c2) + a2 * (b0 * c1 - b1 * c0)
    below = (
        la * lb * lc
        + (a0 * b0 + a1 * b1 + a2 * b2) * lc
        + (b0 * c0 + b1 * c1 + b2 * c2) * la
        + (c0 * a0 + c1 * a1 + c2 * a2) * lb
    )
    return 2.0 * math.atan2(det, below)
