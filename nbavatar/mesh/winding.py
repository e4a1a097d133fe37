"""What is inside a closed surface: points, by signed crossings of a ray or the generalised winding number; edges.

For a surface without a border both are the same integer. A ray costs a few visits of the tree, so it is asked first;
where it runs along an edge or a corner, or the surface has a border, the winding number decides (Jacobson et al. 2013,
far clusters as dipoles: Barill et al. 2018, first order). Array names are those of `nbavatar.mesh.tree`.
"""

import math

import numpy as np

from nbavatar.jit.cache import stored_njit

__all__ = ["charge", "crossings", "inner_middles", "is_closed", "winding", "winding_plain"]

_STACK = 64
# A cluster farther than this many of its radii is taken as one dipole.
_FAR = 2.0
# A crossing nearer than this to an edge (in barycentric weights) is not trusted.
_EDGE = 1e-9


def is_closed(faces: np.ndarray, count: int) -> bool:
    """Whether every edge is run through equally often both ways: then winding numbers are integers.

    Args:
        faces: (F, 3) into `count` vertices.
    """
    ends = np.concatenate((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]])).astype(np.int64)
    low, high = ends.min(axis=1), ends.max(axis=1)
    _, edge = np.unique(low * count + high, return_inverse=True)
    return not np.bincount(edge.ravel(), np.where(ends[:, 0] < ends[:, 1], 1.0, -1.0)).any()


@stored_njit(error_model="numpy")
def _meets_box(bounds, k, p0, p1, p2, d0, d1, d2, far, margin, slack):
    """Whether p + t d for t from 0 to `far` comes into box k, grown by `margin` [m], or misses it by `slack` in t."""
    near = 0.0
    for c in range(3):
        p, d = (p0, p1, p2)[c], (d0, d1, d2)[c]
        low, high = bounds[k, c] - margin, bounds[k, 3 + c] + margin
        if d == 0.0:
            if p < low or p > high:
                return False
        else:
            a, b = (low - p) / d, (high - p) / d
            near, far = max(near, min(a, b)), min(far, max(a, b))
    return near <= far + slack


@stored_njit(error_model="numpy")
def _cross(verts, faces, f, p0, p1, p2, d0, d1, d2):
    """Where p + t d meets the plane of face f.

    Returns:
        d . n (n the face's normal times twice its area), t d . n, n . n, and the weights of the second and third corner
        (Moeller and Trumbore 1997), not finite where d . n is 0.
    """
    a, b, c = verts[faces[f, 0]], verts[faces[f, 1]], verts[faces[f, 2]]
    e0, e1, e2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    g0, g1, g2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    n0, n1, n2 = e1 * g2 - e2 * g1, e2 * g0 - e0 * g2, e0 * g1 - e1 * g0
    facing = d0 * n0 + d1 * n1 + d2 * n2
    s0, s1, s2 = a[0] - p0, a[1] - p1, a[2] - p2
    r0, r1, r2 = s1 * d2 - s2 * d1, s2 * d0 - s0 * d2, s0 * d1 - s1 * d0
    wb, wc = (g0 * r0 + g1 * r1 + g2 * r2) / facing, -(e0 * r0 + e1 * r1 + e2 * r2) / facing
    return facing, s0 * n0 + s1 * n1 + s2 * n2, n0 * n0 + n1 * n1 + n2 * n2, wb, wc


@stored_njit(error_model="numpy")
def crossings(points, verts, faces, nodes, bounds):
    """Signed number of faces that a ray from each point (P, 3) [m] leaves through, away from the middle of the mesh.

    Returns:
        (P,) float64: the winding number of a closed surface; NaN where the ray meets an edge or the point is on a face.
    """
    result = np.zeros(len(points))
    stack = np.zeros(_STACK, np.int64)
    size = max(bounds[0, 3] - bounds[0, 0], bounds[0, 4] - bounds[0, 1], bounds[0, 5] - bounds[0, 2])
    for i in range(len(points)):
        p0, p1, p2 = points[i, 0], points[i, 1], points[i, 2]
        # Away from the middle there is least to cross; a little askew, so that symmetric meshes give no edge hits.
        d0 = p0 - 0.5 * (bounds[0, 0] + bounds[0, 3]) + 0.0211 * size
        d1 = p1 - 0.5 * (bounds[0, 1] + bounds[0, 4]) + 0.0137 * size
        d2 = p2 - 0.5 * (bounds[0, 2] + bounds[0, 5]) - 0.0093 * size
        length = math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        if not length > 0.0:
            result[i] = np.nan
            continue
        d0, d1, d2 = d0 / length, d1 / length, d2 / length
        stack[0] = 0
        top = 1
        while top > 0:
            top -= 1
            k = stack[top]
            if not _meets_box(bounds, k, p0, p1, p2, d0, d1, d2, np.inf, 1e-9 * size, 0.0):
                continue
            if nodes[k, 2] >= 0:
                stack[top], stack[top + 1] = nodes[k, 2], nodes[k, 3]
                top += 2
                continue
            for f in range(nodes[k, 0], nodes[k, 0] + nodes[k, 1]):
                facing, height, square, wb, wc = _cross(verts, faces, f, p0, p1, p2, d0, d1, d2)
                area = math.sqrt(square)
                if abs(facing) <= _EDGE * area:
                    # Seen edge on: it counts for nothing unless the ray lies in its plane.
                    if area > 0.0 and abs(height) <= _EDGE * area * size:
                        result[i] = np.nan
                    continue
                wa = 1.0 - wb - wc
                t = height / facing
                least = min(wa, wb, wc)
                if least < -_EDGE or t < -_EDGE * size:
                    continue
                if least <= _EDGE or t <= _EDGE * size:
                    result[i] = np.nan
                else:
                    result[i] += 1.0 if facing > 0.0 else -1.0
    return result


@stored_njit(error_model="numpy")
def inner_middles(points, edges, verts, faces, nodes, bounds):
    """Where edges that end outside a surface dip into it.

    Args:
        points: positions [m], (V, 3); edges (E, 2) into them.

    Returns:
        (E,) float64 in (0, 1): the middle of the first stretch inside, as a share of the way to the second end; NaN
        where there is none, or an end lies inside.
    """
    result = np.full(len(edges), np.nan)
    stack = np.zeros(_STACK, np.int64)
    for i in range(len(edges)):
        p, q = points[edges[i, 0]], points[edges[i, 1]]
        d0, d1, d2 = q[0] - p[0], q[1] - p[1], q[2] - p[2]
        first, second, enters = np.inf, np.inf, False
        stack[0] = 0
        top = 1
        while top > 0:
            top -= 1
            k = stack[top]
            if not _meets_box(bounds, k, p[0], p[1], p[2], d0, d1, d2, 1.0, 0.0, _EDGE):
                continue
            if nodes[k, 2] >= 0:
                stack[top], stack[top + 1] = nodes[k, 2], nodes[k, 3]
                top += 2
                continue
            for f in range(nodes[k, 0], nodes[k, 0] + nodes[k, 1]):
                facing, height, _, wb, wc = _cross(verts, faces, f, p[0], p[1], p[2], d0, d1, d2)
                if facing == 0.0:
                    continue
                t = height / facing
                if min(1.0 - wb - wc, wb, wc) < -_EDGE or t < 0.0 or t > 1.0:
                    continue
                # A crossing on an edge of the surface is met once for each of its two faces.
                if t < first - _EDGE:
                    first, second, enters = t, first, facing < 0.0
                elif t > first + _EDGE:
                    second = min(second, t)
        if enters and second <= 1.0:
            result[i] = 0.5 * (first + second)
    return result


@stored_njit(error_model="numpy")
def charge(verts, faces, nodes, bounds, dipoles):
    """Dipoles (N, 7) of all nodes: centre (area weighted) [m], a radius that holds the box, sum of area vectors."""
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
            for f in range(nodes[k, 0], nodes[k, 0] + nodes[k, 1]):
                a, b, c = verts[faces[f, 0]], verts[faces[f, 1]], verts[faces[f, 2]]
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
                dipoles[k, i] = dipoles[k, i] / area[k] if area[k] > 0.0 else verts[faces[nodes[k, 0], 0], i]
        square = 0.0
        for i in range(3):
            square += max(dipoles[k, i] - bounds[k, i], bounds[k, 3 + i] - dipoles[k, i]) ** 2
        dipoles[k, 3] = math.sqrt(square)


@stored_njit(error_model="numpy")
def winding(points, verts, faces, nodes, dipoles):
    """Generalised winding number of each point (P, 3) [m] by the tree's dipoles, (P,)."""
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
                for f in range(nodes[k, 0], nodes[k, 0] + nodes[k, 1]):
                    total += _solid_angle(p0, p1, p2, verts[faces[f, 0]], verts[faces[f, 1]], verts[faces[f, 2]])
        result[i] = total / (4.0 * math.pi)
    return result


@stored_njit(error_model="numpy")
def winding_plain(points, verts, faces):
    """The same as the exact sum over all faces: cheaper for a few points."""
    result = np.zeros(len(points))
    for i in range(len(points)):
        for f in range(len(faces)):
            result[i] += _solid_angle(
                points[i, 0], points[i, 1], points[i, 2], verts[faces[f, 0]], verts[faces[f, 1]], verts[faces[f, 2]]
            )
    return result / (4.0 * math.pi)


@stored_njit(error_model="numpy")
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
