"""Numba kernels of the billboards' projection: forward, and the gradients backward.

The forward pass does the arithmetic of `projection.py` operation by operation and without contraction. Only the last
digit of a square root may differ from torch's, whose vector library does not always round it correctly.
"""

import math

import numpy as np

from nbavatar.jit.compile import exact_inlined, exact_kernel
from nbavatar.rendering.billboards.projection import FADE_FLOOR

__all__ = ["project", "project_back"]


@exact_inlined
def _place(i, means, quats, extents, view, c, au, av, g):
    """Writes centre and axes in the camera's frame and the cross products; returns 1 / volume, 0 where seen edge-on."""
    w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
    s = 2.0 / (w * w + x * x + y * y + z * z)
    u_0, u_1, u_2 = 1.0 - s * (y * y + z * z), s * (x * y + w * z), s * (x * z - w * y)
    v_0, v_1, v_2 = s * (x * y - w * z), 1.0 - s * (x * x + z * z), s * (y * z + w * x)
    for j in range(3):
        a, b, d = view[j, 0], view[j, 1], view[j, 2]
        c[j] = a * means[i, 0] + b * means[i, 1] + d * means[i, 2] + view[j, 3]
        au[j] = (a * u_0 + b * u_1 + d * u_2) * extents[i, 0]
        av[j] = (a * v_0 + b * v_1 + d * v_2) * extents[i, 1]
    for j in range(3):
        n, m = (j + 1) % 3, (j + 2) % 3
        g[0, j] = av[n] * c[m] - av[m] * c[n]
        g[1, j] = c[n] * au[m] - c[m] * au[n]
        g[2, j] = au[n] * av[m] - au[m] * av[n]
    volume = c[0] * g[2, 0] + c[1] * g[2, 1] + c[2] * g[2, 2]
    return 1.0 / volume if volume != 0.0 else 0.0


@exact_inlined
def _row(g, row, inverse, intrinsics):
    """Row of the plane's matrix P, before the low-pass."""
    fx, skew, cx, fy, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3], intrinsics[4]
    x, y = g[row, 0] / fx, (g[row, 1] - g[row, 0] * (skew / fx)) / fy
    return x * inverse, y * inverse, (g[row, 2] - x * cx - y * cy) * inverse


@exact_inlined
def _jacobian(au, av, dx, dy, z, intrinsics):
    """Derivative of the pixel by (u, v) at the centre, `(dx, dy)` from the principal point: ux, vx, uy, vy."""
    fx, skew, fy = intrinsics[0], intrinsics[1], intrinsics[3]
    ux, vx = (fx * au[0] + skew * au[1] - dx * au[2]) / z, (fx * av[0] + skew * av[1] - dx * av[2]) / z
    return ux, vx, (fy * au[1] - dy * au[2]) / z, (fy * av[1] - dy * av[2]) / z


@exact_inlined
def _spectrum(ux, vx, uy, vy):
    """|det|, sum and difference of the singular values: s1 s2, s1 + s2, s1 - s2."""
    plus = (ux + vy) * (ux + vy) + (uy - vx) * (uy - vx)
    minus = (ux - vy) * (ux - vy) + (uy + vx) * (uy + vx)
    return abs(ux * vy - vx * uy), math.sqrt(max(plus, minus)), math.sqrt(min(plus, minus))


@exact_inlined
def _low_pass(ux, vx, uy, vy, radius):
    """Contraction of screen offsets xx, xy, yy, the fade, and whether there is any; see `projection._low_pass`."""
    det, total, gap = _spectrum(ux, vx, uy, vy)
    large = 0.5 * (total + gap)
    if 0.0 < large < radius:
        scale = 1.0 / (radius * total)
        xx, xy = (ux * ux + vx * vx + det) * scale, (ux * uy + vx * vy) * scale
        return xx, xy, (uy * uy + vy * vy + det) * scale, det / (radius * radius), True
    if large > 0.0 and det / large < radius:
        small = 2.0 * det / (total + gap)
        factor = small / radius
        slope = (1.0 - factor) / (total * gap)
        shift = factor - slope * (small * small)
        xx, xy = slope * (ux * ux + vx * vx) + shift, slope * (ux * uy + vx * vy)
        return xx, xy, slope * (uy * uy + vy * vy) + shift, factor, True
    return 1.0, 0.0, 1.0, 1.0, False


@exact_inlined
def _low_pass_back(ux, vx, uy, vy, radius, by_xx, by_xy, by_yy, by_fade):
    """Gradients by the Jacobian from those by what `_low_pass` returns where it contracts."""
    det, total, gap = _spectrum(ux, vx, uy, vy)
    aa, ab, bb = ux * ux + vx * vx, ux * uy + vx * vy, uy * uy + vy * vy
    if 0.5 * (total + gap) < radius:
        scale = 1.0 / (radius * total)
        by_det = (by_xx + by_yy) * scale + by_fade / (radius * radius)
        by_scale = by_xx * (aa + det) + by_xy * ab + by_yy * (bb + det)
        by_total, by_gap = -by_scale * scale / total, 0.0
    else:
        small = 2.0 * det / (total + gap)
        factor = small / radius
        scale = (1.0 - factor) / (total * gap)
        by_shift = by_xx + by_yy
        by_scale = by_xx * aa + by_xy * ab + by_yy * bb - by_shift * (small * small)
        by_factor = by_fade + by_shift - by_scale / (total * gap)
        by_small = by_factor / radius - 2.0 * by_shift * scale * small
        by_det = 2.0 * by_small / (total + gap)
        by_total = -by_scale * scale / total - by_small * small / (total + gap)
        by_gap = -by_scale * scale / gap - by_small * small / (total + gap)
    by_aa, by_ab, by_bb = by_xx * scale, by_xy * scale, by_yy * scale
    turn = ux * vy - vx * uy  # a fourth of `plus - minus` in `_spectrum`
    longer, shorter = by_total / total, by_gap / gap if gap > 0.0 else 0.0
    plus = longer if turn > 0.0 else shorter if turn < 0.0 else 0.5 * (longer + shorter)
    minus = longer + shorter - plus
    by_turn = by_det if turn > 0.0 else -by_det if turn < 0.0 else 0.0
    return (
        2.0 * ux * by_aa + uy * by_ab + by_turn * vy + (ux + vy) * plus + (ux - vy) * minus,
        2.0 * vx * by_aa + vy * by_ab - by_turn * uy - (uy - vx) * plus + (uy + vx) * minus,
        2.0 * uy * by_bb + ux * by_ab - by_turn * vx + (uy - vx) * plus + (uy + vx) * minus,
        2.0 * vy * by_bb + vx * by_ab + by_turn * ux + (ux + vy) * plus - (ux - vy) * minus,
    )


@exact_inlined
def _axes_back(i, quats, extents, by_u, by_v, grad_quats, grad_extents):
    """Gradients by quaternion and half-extents from those by the two half-axes in the world's frame."""
    w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
    s = 2.0 / (w * w + x * x + y * y + z * z)
    u_0, u_1, u_2 = y * y + z * z, x * y + w * z, x * z - w * y
    v_0, v_1, v_2 = x * y - w * z, x * x + z * z, y * z + w * x
    grad_extents[i, 0] = by_u[0] * (1.0 - s * u_0) + by_u[1] * (s * u_1) + by_u[2] * (s * u_2)
    grad_extents[i, 1] = by_v[0] * (s * v_0) + by_v[1] * (1.0 - s * v_1) + by_v[2] * (s * v_2)
    a, b, c = by_u[0] * extents[i, 0], by_u[1] * extents[i, 0], by_u[2] * extents[i, 0]
    d, e, f = by_v[0] * extents[i, 1], by_v[1] * extents[i, 1], by_v[2] * extents[i, 1]
    by_s = s * (b * u_1 + c * u_2 - a * u_0 + d * v_0 + f * v_2 - e * v_1)  # s = 2 / |q|^2: its slope is -s^2 q
    grad_quats[i, 0] = s * (b * z - c * y - d * z + f * x - by_s * w)
    grad_quats[i, 1] = s * (b * y + c * z + d * y - 2.0 * e * x + f * w - by_s * x)
    grad_quats[i, 2] = s * (b * x - 2.0 * a * y - c * w + d * x + f * z - by_s * y)
    grad_quats[i, 3] = s * (b * w - 2.0 * a * z + c * x - d * w - 2.0 * e * z + f * y - by_s * z)


@exact_kernel
def project(first, end, means, quats, extents, view, intrinsics, near, low_pass, support, plane, fade, depth, nearest,
            bounds):  # fmt: skip
    """Fills rows `first ... end` of a Projection's arrays.

    Args:
        means, quats, extents: (F, 3), (F, 4), (F, 2) float64.
        view: (4, 4); intrinsics: fx, skew, cx, fy, cy.
        near, low_pass, support: see `project_billboards`.
        plane, fade, depth, nearest, bounds: see Projection.
    """
    fx, skew, cx, fy, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3], intrinsics[4]
    c, au, av, g, corners = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros((3, 3)), np.zeros((4, 3))
    for i in range(first, end):
        inverse = _place(i, means, quats, extents, view, c, au, av, g)
        facing = inverse != 0.0
        for row in range(3):
            plane[i, row, 0], plane[i, row, 1], plane[i, row, 2] = _row(g, row, inverse, intrinsics)
        in_front = c[2] > near
        z = c[2] if in_front else 1.0
        x0, y0 = (fx * c[0] + skew * c[1]) / z + cx, fy * c[1] / z + cy
        fade[i] = 1.0
        squeezed = False
        xx, xy, yy = 1.0, 0.0, 1.0
        if low_pass > 0.0 and in_front and facing:
            jacobian = _jacobian(au, av, x0 - cx, y0 - cy, z, intrinsics)
            xx, xy, yy, fade[i], squeezed = _low_pass(*jacobian, low_pass)
        if squeezed:
            dx, dy = x0 - (xx * x0 + xy * y0), y0 - (xy * x0 + yy * y0)
            for row in range(3):
                a, b = plane[i, row, 0], plane[i, row, 1]
                plane[i, row, 0], plane[i, row, 1] = a * xx + b * xy, a * xy + b * yy
                plane[i, row, 2] = a * dx + b * dy + plane[i, row, 2]
        depth[i] = c[2]
        for j in range(3):
            corners[0, j] = c[j] + support * (-au[j] - av[j])
            corners[1, j] = c[j] + support * (au[j] - av[j])
            corners[2, j] = c[j] + support * (au[j] + av[j])
            corners[3, j] = c[j] + support * (-au[j] + av[j])
        nearest[i] = max(min(corners[0, 2], corners[1, 2], corners[2, 2], corners[3, 2]), near)
        for j in range(4):
            bounds[i, j] = math.inf if j < 2 else -math.inf
        det = xx * yy - xy * xy
        det = det if det > 0.0 else 1.0
        for j in range(8):  # the corners, and where the edges cross the near plane
            n, m = j // 2, (j // 2 + 1) % 4
            x, y, z, far = corners[n, 0], corners[n, 1], corners[n, 2], corners[m, 2]
            if j % 2 == 0:
                if z < near:
                    continue
            else:
                if (z >= near) == (far >= near):
                    continue
                t = (near - z) / (far - z)
                x, y, z = x + t * (corners[m, 0] - x), y + t * (corners[m, 1] - y), near
            x, y = (fx * x + skew * y) / z + cx, fy * y / z + cy
            if squeezed:
                dx, dy = x - x0, y - y0
                x, y = x0 + (yy * dx - xy * dy) / det, y0 + (xx * dy - xy * dx) / det
            bounds[i, 0], bounds[i, 1] = min(bounds[i, 0], x), min(bounds[i, 1], y)
            bounds[i, 2], bounds[i, 3] = max(bounds[i, 2], x), max(bounds[i, 3], y)
        if not (facing and fade[i] > FADE_FLOOR and bounds[i, 0] <= bounds[i, 2]):
            bounds[i, 0], bounds[i, 1], bounds[i, 2], bounds[i, 3] = 1.0, 1.0, 0.0, 0.0


@exact_kernel
def project_back(first, end, means, quats, extents, view, intrinsics, near, low_pass, grad_plane, grad_fade, grad_means,
              grad_quats, grad_extents):  # fmt: skip
    """Fills rows `first ... end` of the gradients by means, quaternions and half-extents.

    The chain rule from the end of `project` to its beginning. As in `projection.py` the volume, by which all rows are
    divided, counts as constant: the ratios of the rows do not depend on it.

    Args:
        grad_plane, grad_fade: (F, 3, 3), (F,); grad_means, grad_quats, grad_extents: (F, 3), (F, 4), (F, 2) results.
        All others: see `project`.
    """
    fx, skew, cx, fy, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3], intrinsics[4]
    c, au, av, g = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros((3, 3))
    by_c, by_au, by_av, by_g, by_u, by_v = (
        np.zeros(3), np.zeros(3), np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros(3),
    )  # fmt: skip
    for i in range(first, end):
        inverse = _place(i, means, quats, extents, view, c, au, av, g)
        for j in range(3):
            by_c[j], by_au[j], by_av[j] = 0.0, 0.0, 0.0
        xx, xy, yy, dx, dy = 1.0, 0.0, 1.0, 0.0, 0.0
        squeezed = False
        if low_pass > 0.0 and c[2] > near and inverse != 0.0:
            z = c[2]
            x0, y0 = (fx * c[0] + skew * c[1]) / z + cx, fy * c[1] / z + cy
            ux, vx, uy, vy = _jacobian(au, av, x0 - cx, y0 - cy, z, intrinsics)
            xx, xy, yy, _, squeezed = _low_pass(ux, vx, uy, vy, low_pass)
        if squeezed:
            dx, dy = x0 - (xx * x0 + xy * y0), y0 - (xy * x0 + yy * y0)
            by_xx, by_xy, by_yy, by_dx, by_dy = 0.0, 0.0, 0.0, 0.0, 0.0
            for row in range(3):
                a, b, _ = _row(g, row, inverse, intrinsics)
                p, q, r = grad_plane[i, row, 0], grad_plane[i, row, 1], grad_plane[i, row, 2]
                by_xx += p * a
                by_xy += p * b + q * a
                by_yy += q * b
                by_dx += r * a
                by_dy += r * b
            by_xx, by_xy, by_yy = by_xx - by_dx * x0, by_xy - by_dx * y0 - by_dy * x0, by_yy - by_dy * y0
            by_x0, by_y0 = by_dx * (1.0 - xx) - by_dy * xy, by_dy * (1.0 - yy) - by_dx * xy
            by_ux, by_vx, by_uy, by_vy = _low_pass_back(ux, vx, uy, vy, low_pass, by_xx, by_xy, by_yy, grad_fade[i])
            by_x0 -= (by_ux * au[2] + by_vx * av[2]) / z
            by_y0 -= (by_uy * au[2] + by_vy * av[2]) / z
            ox, oy = x0 - cx, y0 - cy
            by_au[0], by_av[0] = by_ux * fx / z, by_vx * fx / z
            by_au[1], by_av[1] = (by_ux * skew + by_uy * fy) / z, (by_vx * skew + by_vy * fy) / z
            by_au[2], by_av[2] = -(by_ux * ox + by_uy * oy) / z, -(by_vx * ox + by_vy * oy) / z
            by_c[0], by_c[1] = by_x0 * fx / z, (by_x0 * skew + by_y0 * fy) / z
            by_c[2] = -(by_x0 * ox + by_y0 * oy + by_ux * ux + by_vx * vx + by_uy * uy + by_vy * vy) / z
        for row in range(3):
            p, q, r = grad_plane[i, row, 0], grad_plane[i, row, 1], grad_plane[i, row, 2]
            x = (p * xx + q * xy + r * dx - r * cx) * inverse
            y = (p * xy + q * yy + r * dy - r * cy) * inverse
            by_g[row, 0], by_g[row, 1], by_g[row, 2] = (x - y * (skew / fy)) / fx, y / fy, r * inverse
        for j in range(3):  # of a x b, where h is the gradient: b x h by a and h x a by b
            n, m = (j + 1) % 3, (j + 2) % 3
            by_av[j] += c[n] * by_g[0, m] - c[m] * by_g[0, n] + by_g[2, n] * au[m] - by_g[2, m] * au[n]
            by_au[j] += by_g[1, n] * c[m] - by_g[1, m] * c[n] + av[n] * by_g[2, m] - av[m] * by_g[2, n]
            by_c[j] += by_g[0, n] * av[m] - by_g[0, m] * av[n] + au[n] * by_g[1, m] - au[m] * by_g[1, n]
        for j in range(3):
            a, b, d = view[0, j], view[1, j], view[2, j]
            grad_means[i, j] = a * by_c[0] + b * by_c[1] + d * by_c[2]
            by_u[j] = a * by_au[0] + b * by_au[1] + d * by_au[2]
            by_v[j] = a * by_av[0] + b * by_av[1] + d * by_av[2]
        _axes_back(i, quats, extents, by_u, by_v, grad_quats, grad_extents)
