"""Numba kernels of the billboards' projection: forward, and the gradients backward.

The forward pass does the arithmetic of `projection.py` operation by operation and without contraction. Only the last
digit of a square root may differ from torch's, whose vector library does not always round it correctly.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from nbavatar.jit.compile import exact_inlined, exact_kernel
from nbavatar.rendering.billboards.projection import FADE_FLOOR

__all__ = ["Adjoints", "Billboards", "Camera", "Projected", "project", "project_back"]


class Billboards(NamedTuple):
    """Means (F, 3), quaternions (F, 4), half-extents (F, 2), float64; or the gradients by them."""

    means: Any
    quats: Any
    extents: Any


class Camera(NamedTuple):
    """`cam_from_world` (4, 4), intrinsics fx, skew, cx, fy, cy, float64; the others see `project_billboards`."""

    cam_from_world: Any
    intrinsics: Any
    near: Any
    low_pass: Any
    support: Any


class Projected(NamedTuple):
    """Arrays of `ProjectedPatches`."""

    plane: Any
    fade: Any
    depth: Any
    nearest: Any
    bounds: Any


class Adjoints(NamedTuple):
    """Of a projection's planes (F, 3, 3) and fades (F,)."""

    plane: Any
    fade: Any


@exact_inlined
def _to_camera(i, billboards, view, c, au, av, g):
    """Writes centre and axes in the camera's frame and the cross products; returns 1 / volume, 0 where seen edge-on."""
    means, quats, extents = billboards.means, billboards.quats, billboards.extents
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
def _low_pass_back(ux, vx, uy, vy, radius, dL_dxx, dL_dxy, dL_dyy, dL_dfade):
    """Gradients by the Jacobian from those by what `_low_pass` returns where it contracts."""
    det, total, gap = _spectrum(ux, vx, uy, vy)
    aa, ab, bb = ux * ux + vx * vx, ux * uy + vx * vy, uy * uy + vy * vy
    if 0.5 * (total + gap) < radius:
        scale = 1.0 / (radius * total)
        dL_ddet = (dL_dxx + dL_dyy) * scale + dL_dfade / (radius * radius)
        dL_dscale = dL_dxx * (aa + det) + dL_dxy * ab + dL_dyy * (bb + det)
        dL_dtotal, dL_dgap = -dL_dscale * scale / total, 0.0
    else:
        small = 2.0 * det / (total + gap)
        factor = small / radius
        scale = (1.0 - factor) / (total * gap)
        dL_dshift = dL_dxx + dL_dyy
        dL_dscale = dL_dxx * aa + dL_dxy * ab + dL_dyy * bb - dL_dshift * (small * small)
        dL_dfactor = dL_dfade + dL_dshift - dL_dscale / (total * gap)
        dL_dsmall = dL_dfactor / radius - 2.0 * dL_dshift * scale * small
        dL_ddet = 2.0 * dL_dsmall / (total + gap)
        dL_dtotal = -dL_dscale * scale / total - dL_dsmall * small / (total + gap)
        dL_dgap = -dL_dscale * scale / gap - dL_dsmall * small / (total + gap)
    dL_daa, dL_dab, dL_dbb = dL_dxx * scale, dL_dxy * scale, dL_dyy * scale
    turn = ux * vy - vx * uy  # a fourth of `plus - minus` in `_spectrum`
    longer, shorter = dL_dtotal / total, dL_dgap / gap if gap > 0.0 else 0.0
    plus = longer if turn > 0.0 else shorter if turn < 0.0 else 0.5 * (longer + shorter)
    minus = longer + shorter - plus
    dL_dturn = dL_ddet if turn > 0.0 else -dL_ddet if turn < 0.0 else 0.0
    return (
        2.0 * ux * dL_daa + uy * dL_dab + dL_dturn * vy + (ux + vy) * plus + (ux - vy) * minus,
        2.0 * vx * dL_daa + vy * dL_dab - dL_dturn * uy - (uy - vx) * plus + (uy + vx) * minus,
        2.0 * uy * dL_dbb + ux * dL_dab - dL_dturn * vx + (uy - vx) * plus + (uy + vx) * minus,
        2.0 * vy * dL_dbb + vx * dL_dab + dL_dturn * ux + (ux + vy) * plus - (ux - vy) * minus,
    )


@exact_inlined
def _axes_back(i, billboards, dL_du, dL_dv, gradients):
    """Gradients by quaternion and half-extents from those by the two half-axes in the world's frame."""
    quats, extents, grad_quats, grad_extents = (
        billboards.quats, billboards.extents, gradients.quats, gradients.extents,
    )  # fmt: skip
    w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
    s = 2.0 / (w * w + x * x + y * y + z * z)
    u_0, u_1, u_2 = y * y + z * z, x * y + w * z, x * z - w * y
    v_0, v_1, v_2 = x * y - w * z, x * x + z * z, y * z + w * x
    grad_extents[i, 0] = dL_du[0] * (1.0 - s * u_0) + dL_du[1] * (s * u_1) + dL_du[2] * (s * u_2)
    grad_extents[i, 1] = dL_dv[0] * (s * v_0) + dL_dv[1] * (1.0 - s * v_1) + dL_dv[2] * (s * v_2)
    a, b, c = dL_du[0] * extents[i, 0], dL_du[1] * extents[i, 0], dL_du[2] * extents[i, 0]
    d, e, f = dL_dv[0] * extents[i, 1], dL_dv[1] * extents[i, 1], dL_dv[2] * extents[i, 1]
    dL_ds = s * (b * u_1 + c * u_2 - a * u_0 + d * v_0 + f * v_2 - e * v_1)  # s = 2 / |q|^2: its slope is -s^2 q
    grad_quats[i, 0] = s * (b * z - c * y - d * z + f * x - dL_ds * w)
    grad_quats[i, 1] = s * (b * y + c * z + d * y - 2.0 * e * x + f * w - dL_ds * x)
    grad_quats[i, 2] = s * (b * x - 2.0 * a * y - c * w + d * x + f * z - dL_ds * y)
    grad_quats[i, 3] = s * (b * w - 2.0 * a * z + c * x - d * w - 2.0 * e * z + f * y - dL_ds * z)


@exact_kernel
def project(first, end, billboards, camera, projected):
    """Fills rows `first ... end` of the arrays of `ProjectedPatches`.

    Args:
        billboards, camera: see above.
        projected: results.
    """
    view, intrinsics, near, low_pass, support = (
        camera.cam_from_world, camera.intrinsics, camera.near, camera.low_pass, camera.support,
    )  # fmt: skip
    plane, fade, depth, nearest, bounds = (
        projected.plane, projected.fade, projected.depth, projected.nearest, projected.bounds,
    )  # fmt: skip
    fx, skew, cx, fy, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3], intrinsics[4]
    c, au, av, g, corners = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros((3, 3)), np.zeros((4, 3))
    for i in range(first, end):
        inverse = _to_camera(i, billboards, view, c, au, av, g)
        facing = inverse != 0.0
        for row in range(3):
            plane[i, row, 0], plane[i, row, 1], plane[i, row, 2] = _row(g, row, inverse, intrinsics)
        in_front = c[2] > near
        z = c[2] if in_front else 1.0
        x0, y0 = (fx * c[0] + skew * c[1]) / z + cx, fy * c[1] / z + cy
        fade[i] = 1.0
        contracted = False
        xx, xy, yy = 1.0, 0.0, 1.0
        if low_pass > 0.0 and in_front and facing:
            jacobian = _jacobian(au, av, x0 - cx, y0 - cy, z, intrinsics)
            xx, xy, yy, fade[i], contracted = _low_pass(*jacobian, low_pass)
        if contracted:
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
            if contracted:
                dx, dy = x - x0, y - y0
                x, y = x0 + (yy * dx - xy * dy) / det, y0 + (xx * dy - xy * dx) / det
            bounds[i, 0], bounds[i, 1] = min(bounds[i, 0], x), min(bounds[i, 1], y)
            bounds[i, 2], bounds[i, 3] = max(bounds[i, 2], x), max(bounds[i, 3], y)
        if not (facing and fade[i] > FADE_FLOOR and bounds[i, 0] <= bounds[i, 2]):
            bounds[i, 0], bounds[i, 1], bounds[i, 2], bounds[i, 3] = 1.0, 1.0, 0.0, 0.0


@exact_kernel
def project_back(first, end, billboards, camera, adjoints, gradients):
    """Fills rows `first ... end` of the gradients by means, quaternions and half-extents.

    The chain rule from the end of `project` to its beginning. As in `projection.py` the volume, by which all rows are
    divided, counts as constant: the ratios of the rows do not depend on it.

    Args:
        billboards, camera, adjoints: see above.
        gradients: results, like `billboards`.
    """
    view, intrinsics, near, low_pass = camera.cam_from_world, camera.intrinsics, camera.near, camera.low_pass
    grad_plane, grad_fade, grad_means = adjoints.plane, adjoints.fade, gradients.means
    fx, skew, cx, fy, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3], intrinsics[4]
    c, au, av, g = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros((3, 3))
    dL_dc, dL_dau, dL_dav, dL_dg, dL_du, dL_dv = (
        np.zeros(3), np.zeros(3), np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros(3),
    )  # fmt: skip
    for i in range(first, end):
        inverse = _to_camera(i, billboards, view, c, au, av, g)
        for j in range(3):
            dL_dc[j], dL_dau[j], dL_dav[j] = 0.0, 0.0, 0.0
        xx, xy, yy, dx, dy = 1.0, 0.0, 1.0, 0.0, 0.0
        contracted = False
        if low_pass > 0.0 and c[2] > near and inverse != 0.0:
            z = c[2]
            x0, y0 = (fx * c[0] + skew * c[1]) / z + cx, fy * c[1] / z + cy
            ux, vx, uy, vy = _jacobian(au, av, x0 - cx, y0 - cy, z, intrinsics)
            xx, xy, yy, _, contracted = _low_pass(ux, vx, uy, vy, low_pass)
        if contracted:
            dx, dy = x0 - (xx * x0 + xy * y0), y0 - (xy * x0 + yy * y0)
            dL_dxx, dL_dxy, dL_dyy, dL_ddx, dL_ddy = 0.0, 0.0, 0.0, 0.0, 0.0
            for row in range(3):
                a, b, _ = _row(g, row, inverse, intrinsics)
                p, q, r = grad_plane[i, row, 0], grad_plane[i, row, 1], grad_plane[i, row, 2]
                dL_dxx += p * a
                dL_dxy += p * b + q * a
                dL_dyy += q * b
                dL_ddx += r * a
                dL_ddy += r * b
            dL_dxx, dL_dxy, dL_dyy = dL_dxx - dL_ddx * x0, dL_dxy - dL_ddx * y0 - dL_ddy * x0, dL_dyy - dL_ddy * y0
            dL_dx0, dL_dy0 = dL_ddx * (1.0 - xx) - dL_ddy * xy, dL_ddy * (1.0 - yy) - dL_ddx * xy
            dL_dux, dL_dvx, dL_duy, dL_dvy = _low_pass_back(
                ux, vx, uy, vy, low_pass, dL_dxx, dL_dxy, dL_dyy, grad_fade[i]
            )
            dL_dx0 -= (dL_dux * au[2] + dL_dvx * av[2]) / z
            dL_dy0 -= (dL_duy * au[2] + dL_dvy * av[2]) / z
            ox, oy = x0 - cx, y0 - cy
            dL_dau[0], dL_dav[0] = dL_dux * fx / z, dL_dvx * fx / z
            dL_dau[1], dL_dav[1] = (dL_dux * skew + dL_duy * fy) / z, (dL_dvx * skew + dL_dvy * fy) / z
            dL_dau[2], dL_dav[2] = -(dL_dux * ox + dL_duy * oy) / z, -(dL_dvx * ox + dL_dvy * oy) / z
            dL_dc[0], dL_dc[1] = dL_dx0 * fx / z, (dL_dx0 * skew + dL_dy0 * fy) / z
            dL_dc[2] = -(dL_dx0 * ox + dL_dy0 * oy + dL_dux * ux + dL_dvx * vx + dL_duy * uy + dL_dvy * vy) / z
        for row in range(3):
            p, q, r = grad_plane[i, row, 0], grad_plane[i, row, 1], grad_plane[i, row, 2]
            x = (p * xx + q * xy + r * dx - r * cx) * inverse
            y = (p * xy + q * yy + r * dy - r * cy) * inverse
            dL_dg[row, 0], dL_dg[row, 1], dL_dg[row, 2] = (x - y * (skew / fy)) / fx, y / fy, r * inverse
        for j in range(3):  # of a x b, where h is the gradient: b x h by a and h x a by b
            n, m = (j + 1) % 3, (j + 2) % 3
            dL_dav[j] += c[n] * dL_dg[0, m] - c[m] * dL_dg[0, n] + dL_dg[2, n] * au[m] - dL_dg[2, m] * au[n]
            dL_dau[j] += dL_dg[1, n] * c[m] - dL_dg[1, m] * c[n] + av[n] * dL_dg[2, m] - av[m] * dL_dg[2, n]
            dL_dc[j] += dL_dg[0, n] * av[m] - dL_dg[0, m] * av[n] + au[n] * dL_dg[1, m] - au[m] * dL_dg[1, n]
        for j in range(3):
            a, b, d = view[0, j], view[1, j], view[2, j]
            grad_means[i, j] = a * dL_dc[0] + b * dL_dc[1] + d * dL_dc[2]
            dL_du[j] = a * dL_dau[0] + b * dL_dau[1] + d * dL_dau[2]
            dL_dv[j] = a * dL_dav[0] + b * dL_dav[1] + d * dL_dav[2]
        _axes_back(i, billboards, dL_du, dL_dv, gradients)
