"""Projection of billboards on the CPU where no gradients are asked for, in one compiled pass.

The same arithmetic as in `projection.py`, which remains its definition, operation by operation and without
contraction. Only the last digit of a square root may differ from torch's, whose vector library does not always
round it correctly. Written as some three hundred torch operations the projection takes, on one thread, a fifteenth
of the time of a whole image.
"""

import math
from functools import cache

import numpy as np
import torch
from numba import types
from torch import Tensor

from nbavatar.raster.compile import exact_kernel, prepare, run_workers
from nbavatar.raster.projection import FADE_FLOOR, Projection

__all__ = ["project_billboards_cpu"]


def project_billboards_cpu(
    means: Tensor,
    quats: Tensor,
    half_extents: Tensor,
    viewmat: Tensor,
    K: Tensor,
    *,
    near: float,
    low_pass: float,
    support: float,
) -> Projection:
    """Projects billboards into one camera; arguments and result as `project_billboards`, without gradients."""
    _prepare()
    count = len(means)
    inputs = [tensor.detach().double().contiguous().numpy() for tensor in (means, quats, half_extents)]
    view = viewmat.detach().double().contiguous().numpy()
    intrinsics = K.detach().double().numpy()[[0, 0, 0, 1, 1], [0, 1, 2, 1, 2]]
    plane, fade, depth, nearest, bounds = (
        torch.empty(count, *shape, dtype=torch.float64) for shape in ((3, 3), (), (), (), (4,))
    )
    results = [tensor.numpy() for tensor in (plane, fade, depth, nearest, bounds)]
    share = -(-count // torch.get_num_threads())

    def work(worker: int) -> None:
        first, end = min(worker * share, count), min((worker + 1) * share, count)
        project(first, end, *inputs, view, intrinsics, near, low_pass, support, *results)

    run_workers(work)
    return Projection(plane, fade, depth, nearest, bounds)


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
        facing = volume != 0.0
        inverse = 1.0 / volume if facing else 0.0
        for row in range(3):
            x, y = g[row, 0] / fx, (g[row, 1] - g[row, 0] * (skew / fx)) / fy
            plane[i, row, 0], plane[i, row, 1] = x * inverse, y * inverse
            plane[i, row, 2] = (g[row, 2] - x * cx - y * cy) * inverse
        in_front = c[2] > near
        z = c[2] if in_front else 1.0
        x0, y0 = (fx * c[0] + skew * c[1]) / z + cx, fy * c[1] / z + cy
        fade[i] = 1.0
        squeezed = False
        xx, xy, yy = 1.0, 0.0, 1.0
        if low_pass > 0.0 and in_front and facing:
            dx, dy = x0 - cx, y0 - cy
            ux, vx = (fx * au[0] + skew * au[1] - dx * au[2]) / z, (fx * av[0] + skew * av[1] - dx * av[2]) / z
            uy, vy = (fy * au[1] - dy * au[2]) / z, (fy * av[1] - dy * av[2]) / z
            plus = (ux + vy) * (ux + vy) + (uy - vx) * (uy - vx)
            minus = (ux - vy) * (ux - vy) + (uy + vx) * (uy + vx)
            det, total, gap = abs(ux * vy - vx * uy), math.sqrt(max(plus, minus)), math.sqrt(min(plus, minus))
            large = 0.5 * (total + gap)
            if 0.0 < large < low_pass:
                squeezed = True
                scale = 1.0 / (low_pass * total)
                xx, xy = (ux * ux + vx * vx + det) * scale, (ux * uy + vx * vy) * scale
                yy = (uy * uy + vy * vy + det) * scale
                fade[i] = det / (low_pass * low_pass)
            elif large > 0.0 and det / large < low_pass:
                squeezed = True
                small = 2.0 * det / (total + gap)
                factor = small / low_pass
                slope = (1.0 - factor) / (total * gap)
                shift = factor - slope * (small * small)
                xx, xy = slope * (ux * ux + vx * vx) + shift, slope * (ux * uy + vx * vy)
                yy = slope * (uy * uy + vy * vy) + shift
                fade[i] = factor
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


@cache
def _prepare() -> None:
    def array(dimensions: int):
        return types.Array(types.float64, dimensions, "C")

    i64, f64 = types.int64, types.float64
    prepare(
        "projection",
        {
            project: (
                i64, i64, array(2), array(2), array(2), array(2), array(1), f64, f64, f64, array(3), array(1),
                array(1), array(1), array(2),
            ),
        },
    )  # fmt: skip
