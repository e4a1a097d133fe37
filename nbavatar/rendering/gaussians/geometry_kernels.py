"""Numba kernels of the projection and the harmonics: one Gaussian after the other, in float64."""

import math

import numpy as np

from nbavatar.jit.compile import inlined, kernel
from nbavatar.rendering.gaussians.projection import MARGIN, SIGMAS
from nbavatar.rendering.gaussians.spherical_harmonics import L0, L1, L2, L3

__all__ = ["project", "project_back", "shade", "shade_back"]

_L20, _L21, _L22 = L2
_L30, _L31, _L32, _L33, _L34 = L3


@inlined
def _turn(camera, x, y, z):
    """From world to camera axes."""
    return (
        camera[0] * x + camera[1] * y + camera[2] * z,
        camera[4] * x + camera[5] * y + camera[6] * z,
        camera[8] * x + camera[9] * y + camera[10] * z,
    )


@inlined
def _turn_back(camera, x, y, z):
    """From camera to world axes."""
    return (
        camera[0] * x + camera[4] * y + camera[8] * z,
        camera[1] * x + camera[5] * y + camera[9] * z,
        camera[2] * x + camera[6] * y + camera[10] * z,
    )


@inlined
def _direction(camera, x, y, z):
    """Direction at which the Jacobian is taken, times the focal lengths, and which parts are clamped."""
    fx, skew, cx, fy, cy, width, height = (
        camera[12], camera[13], camera[14], camera[15], camera[16], camera[17], camera[18],
    )  # fmt: skip
    ty = y / z
    clamped = min(max(ty, (-MARGIN * height - cy) / fy), ((1.0 + MARGIN) * height - cy) / fy)
    side = fx * (x / z) + skew * clamped
    inside = min(max(side, -MARGIN * width - cx), (1.0 + MARGIN) * width - cx)
    return inside, fy * clamped, side == inside, ty == clamped


@inlined
def _axis(quats, i, j):
    """Column j of the rotation matrix of quaternion i."""
    w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
    s = 2.0 / (w * w + x * x + y * y + z * z)
    if j == 0:
        return 1.0 - s * (y * y + z * z), s * (x * y + w * z), s * (x * z - w * y)
    if j == 1:
        return s * (x * y - w * z), 1.0 - s * (x * x + z * z), s * (y * z + w * x)
    return s * (x * z + w * y), s * (y * z - w * x), 1.0 - s * (x * x + y * y)


@kernel
def project(means, quats, scales, offsets, camera, form, variances, depth, visible, radii):
    """Fills the fields of a Projection; see `project_gaussians`.

    Args:
        means, quats, scales, offsets: (N, 3), (N, 4), (N, 3), (N, 2) float64.
        camera: (21,) rows of `cam_from_world`, fx, skew, cx, fy, cy, width, height, near, low-pass.
        form, variances, depth, visible, radii: results.
    """
    fx, skew, cx, fy, cy = camera[12], camera[13], camera[14], camera[15], camera[16]
    width, height, near, low_pass = camera[17], camera[18], camera[19], camera[20]
    rows = np.zeros((2, 3))
    for i in range(len(means)):
        x, y, z = _turn(camera, means[i, 0], means[i, 1], means[i, 2])
        x, y, z = x + camera[3], y + camera[7], z + camera[11]
        depth[i] = z
        seen = z >= near
        if not seen:
            z = 1.0
        side_x, side_y, _, _ = _direction(camera, x, y, z)
        for j in range(3):
            ex, ey, ez = _axis(quats, i, j)
            ax, ay, az = _turn(camera, ex, ey, ez)
            rows[0, j] = scales[i, j] * (fx * ax + skew * ay - side_x * az) / z
            rows[1, j] = scales[i, j] * (fy * ay - side_y * az) / z
        a = rows[0, 0] * rows[0, 0] + rows[0, 1] * rows[0, 1] + rows[0, 2] * rows[0, 2]
        b = rows[0, 0] * rows[1, 0] + rows[0, 1] * rows[1, 1] + rows[0, 2] * rows[1, 2]
        c = rows[1, 0] * rows[1, 0] + rows[1, 1] * rows[1, 1] + rows[1, 2] * rows[1, 2]
        m0 = rows[0, 1] * rows[1, 2] - rows[0, 2] * rows[1, 1]
        m1 = rows[0, 2] * rows[1, 0] - rows[0, 0] * rows[1, 2]
        m2 = rows[0, 0] * rows[1, 1] - rows[0, 1] * rows[1, 0]
        det = m0 * m0 + m1 * m1 + m2 * m2 + low_pass * (a + c) + low_pass * low_pass
        a, c = a + low_pass, c + low_pass
        if not (seen and det > 0.0 and det < np.inf):
            seen, a, b, c, det = False, 1.0, 0.0, 1.0, 1.0
        px = fx * (x / z) + skew * (y / z) + cx + offsets[i, 0]
        py = fy * (y / z) + cy + offsets[i, 1]
        p = math.sqrt(c / det)
        form[i, 0], form[i, 1], form[i, 2], form[i, 3], form[i, 4] = p, -p * b / c, 1.0 / math.sqrt(c), px, py
        variances[i, 0], variances[i, 1] = a, c
        visible[i] = seen
        radius = SIGMAS * math.sqrt(0.5 * (a + c) + math.sqrt(0.25 * (a - c) * (a - c) + b * b))
        on_image = px + radius > 0 and px - radius < width and py + radius > 0 and py - radius < height
        radii[i] = radius if seen and on_image else 0.0


@kernel
def project_back(means, quats, scales, form, visible, camera, grad, dL_dmeans, dL_dquats, dL_dscales):
    """Gradients of `project` by means, quaternions and scales, from those by `form` (N, 5).

    With Sigma' = [[a, b], [b, c]] and det = a c - b^2, d p = p / 2 (dc / c - d det / det),
    d s = -(b dp + p db) / c + p b / c^2 dc and d k = -k / (2 c) dc; the terms of dc that come through p
    are joined, for their difference would cancel where a Gaussian is long and thin.
    """
    fx, skew, fy, low_pass = camera[12], camera[13], camera[15], camera[20]
    axes, moved, rows, turned = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((2, 3)), np.zeros((3, 3))
    for i in range(len(means)):
        for j in range(3):
            dL_dmeans[i, j] = 0.0
            dL_dscales[i, j] = 0.0
        for j in range(4):
            dL_dquats[i, j] = 0.0
        if not visible[i]:
            continue
        x, y, z = _turn(camera, means[i, 0], means[i, 1], means[i, 2])
        x, y, z = x + camera[3], y + camera[7], z + camera[11]
        side_x, side_y, free_x, free_y = _direction(camera, x, y, z)
        a, b, c = low_pass, 0.0, low_pass
        for j in range(3):
            ex, ey, ez = _axis(quats, i, j)
            axes[j, 0], axes[j, 1], axes[j, 2] = _turn(camera, ex, ey, ez)
            for k in range(3):
                moved[j, k] = scales[i, j] * axes[j, k]
            rows[0, j] = (fx * moved[j, 0] + skew * moved[j, 1] - side_x * moved[j, 2]) / z
            rows[1, j] = (fy * moved[j, 1] - side_y * moved[j, 2]) / z
            a += rows[0, j] * rows[0, j]
            b += rows[0, j] * rows[1, j]
            c += rows[1, j] * rows[1, j]
        p, k_ = form[i, 0], form[i, 2]
        det = c / (p * p)
        dL_dp = grad[i, 0] - b / c * grad[i, 1]
        dL_ddet = -0.5 * dL_dp * p / det
        dL_da = c * dL_ddet
        dL_db = -grad[i, 1] * p / c - 2.0 * b * dL_ddet
        dL_dc = dL_ddet * (b * b / c) + grad[i, 1] * p * b / (c * c) - 0.5 * grad[i, 2] * k_ / c
        dL_dz, dL_dside_x, dL_dside_y = 0.0, 0.0, 0.0
        for j in range(3):
            dL_dx = 2.0 * dL_da * rows[0, j] + dL_db * rows[1, j]
            dL_dy = 2.0 * dL_dc * rows[1, j] + dL_db * rows[0, j]
            dL_dz -= dL_dx * rows[0, j] + dL_dy * rows[1, j]
            dL_dside_x -= dL_dx * moved[j, 2] / z
            dL_dside_y -= dL_dy * moved[j, 2] / z
            u = fx * dL_dx / z
            v = (skew * dL_dx + fy * dL_dy) / z
            w = -(side_x * dL_dx + side_y * dL_dy) / z
            dL_dscales[i, j] = axes[j, 0] * u + axes[j, 1] * v + axes[j, 2] * w
            turned[0, j], turned[1, j], turned[2, j] = _turn_back(
                camera, scales[i, j] * u, scales[i, j] * v, scales[i, j] * w
            )
        dL_dtx, dL_dty = fx * grad[i, 3], skew * grad[i, 3] + fy * grad[i, 4]
        dL_dclamped = fy * dL_dside_y
        if free_x:
            dL_dtx += fx * dL_dside_x
            dL_dclamped += skew * dL_dside_x
        if free_y:
            dL_dty += dL_dclamped
        dL_dz = (dL_dz - (dL_dtx * x + dL_dty * y) / z) / z
        dL_dmeans[i, 0], dL_dmeans[i, 1], dL_dmeans[i, 2] = _turn_back(camera, dL_dtx / z, dL_dty / z, dL_dz)
        _quaternion_back(quats, i, turned, dL_dquats)


@inlined
def _quaternion_back(quats, i, dL_dmatrix, dL_dquats):
    """Gradient by a quaternion of any norm, from that by its rotation matrix."""
    w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
    m = dL_dmatrix
    s = 2.0 / (w * w + x * x + y * y + z * z)
    dL_ds = m[1, 0] * (x * y + w * z) + m[0, 1] * (x * y - w * z) - m[0, 0] * (y * y + z * z)
    dL_ds += m[2, 0] * (x * z - w * y) + m[0, 2] * (x * z + w * y) - m[1, 1] * (x * x + z * z)
    dL_ds += m[2, 1] * (y * z + w * x) + m[1, 2] * (y * z - w * x) - m[2, 2] * (x * x + y * y)
    xy, xz, yz = m[1, 0] + m[0, 1], m[2, 0] + m[0, 2], m[2, 1] + m[1, 2]
    wx, wy, wz = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    t = s * dL_ds  # the norm's share: ds / dq = -s^2 q
    dL_dquats[i, 0] = s * (x * wx + y * wy + z * wz - t * w)
    dL_dquats[i, 1] = s * (y * xy + z * xz + w * wx - 2.0 * x * (m[1, 1] + m[2, 2]) - t * x)
    dL_dquats[i, 2] = s * (x * xy + z * yz + w * wy - 2.0 * y * (m[0, 0] + m[2, 2]) - t * y)
    dL_dquats[i, 3] = s * (x * xz + y * yz + w * wz - 2.0 * z * (m[0, 0] + m[1, 1]) - t * z)


@inlined
def _unit(offsets, i):
    """Direction of an offset, z where it is zero, and its length, 1 there."""
    x, y, z = offsets[i, 0], offsets[i, 1], offsets[i, 2]
    squared = x * x + y * y + z * z
    if squared == 0.0:
        return 0.0, 0.0, 1.0, 1.0
    length = math.sqrt(squared)
    return x / length, y / length, z / length, length


@inlined
def _fill_basis(values, count, x, y, z):
    """Basis functions, as `spherical_harmonics.basis`."""
    values[0] = L0
    if count > 1:
        values[1], values[2], values[3] = -L1 * y, L1 * z, -L1 * x
    if count > 4:
        values[4], values[5], values[6] = _L20 * (x * y), -_L20 * (y * z), _L21 * (3.0 * z * z - 1.0)
        values[7], values[8] = -_L20 * (x * z), _L22 * (x * x - y * y)
    if count > 9:
        values[9], values[10] = -_L30 * y * (3.0 * x * x - y * y), _L31 * (x * y) * z
        values[11], values[12] = -_L32 * y * (5.0 * z * z - 1.0), _L33 * z * (5.0 * z * z - 3.0)
        values[13], values[14] = -_L32 * x * (5.0 * z * z - 1.0), _L34 * z * (x * x - y * y)
        values[15] = -_L30 * x * (x * x - 3.0 * y * y)


@kernel
def shade(coefficients, offsets, count, colours):
    """Colours (N, 3) from the first `count` of the coefficients (N, K, 3) and offsets (N, 3)."""
    values = np.zeros(16)
    for i in range(len(offsets)):
        x, y, z, _ = _unit(offsets, i)
        _fill_basis(values, count, x, y, z)
        r, g, b = 0.5, 0.5, 0.5
        for k in range(count):
            r += values[k] * coefficients[i, k, 0]
            g += values[k] * coefficients[i, k, 1]
            b += values[k] * coefficients[i, k, 2]
        colours[i, 0], colours[i, 1], colours[i, 2] = max(r, 0.0), max(g, 0.0), max(b, 0.0)


@kernel
def shade_back(coefficients, offsets, count, colours, grad, dL_dcoefficients, dL_doffsets):
    """Gradients of `shade` by coefficients and offsets, from those by the colours."""
    values, g = np.zeros(16), np.zeros(16)
    for i in range(len(offsets)):
        x, y, z, length = _unit(offsets, i)
        _fill_basis(values, count, x, y, z)
        dL_dr = grad[i, 0] if colours[i, 0] > 0.0 else 0.0
        dL_dg = grad[i, 1] if colours[i, 1] > 0.0 else 0.0
        dL_db = grad[i, 2] if colours[i, 2] > 0.0 else 0.0
        for k in range(count):
            g[k] = dL_dr * coefficients[i, k, 0] + dL_dg * coefficients[i, k, 1] + dL_db * coefficients[i, k, 2]
            dL_dcoefficients[i, k, 0] = values[k] * dL_dr
            dL_dcoefficients[i, k, 1] = values[k] * dL_dg
            dL_dcoefficients[i, k, 2] = values[k] * dL_db
        for k in range(count, coefficients.shape[1]):
            for j in range(3):
                dL_dcoefficients[i, k, j] = 0.0
        dx, dy, dz = 0.0, 0.0, 0.0
        if count > 1:
            dx, dy, dz = -L1 * g[3], -L1 * g[1], L1 * g[2]
        if count > 4:
            dx += _L20 * (y * g[4] - z * g[7]) + 2.0 * _L22 * x * g[8]
            dy += _L20 * (x * g[4] - z * g[5]) - 2.0 * _L22 * y * g[8]
            dz += 6.0 * _L21 * z * g[6] - _L20 * (y * g[5] + x * g[7])
        if count > 9:
            low, saddle = 5.0 * z * z - 1.0, 3.0 * (x * x - y * y)
            dx += _L31 * y * z * g[10] - _L32 * low * g[13] + 2.0 * _L34 * x * z * g[14]
            dx -= _L30 * (6.0 * x * y * g[9] + saddle * g[15])
            dy += _L31 * x * z * g[10] - _L32 * low * g[11] - 2.0 * _L34 * y * z * g[14]
            dy -= _L30 * (saddle * g[9] - 6.0 * x * y * g[15])
            dz += _L31 * x * y * g[10] - 10.0 * _L32 * z * (y * g[11] + x * g[13])
            dz += _L33 * (15.0 * z * z - 3.0) * g[12] + _L34 * (x * x - y * y) * g[14]
        along = x * dx + y * dy + z * dz
        dL_doffsets[i, 0] = (dx - along * x) / length
        dL_doffsets[i, 1] = (dy - along * y) / length
        dL_doffsets[i, 2] = (dz - along * z) / length
