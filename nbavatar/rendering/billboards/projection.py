"""Billboards seen from one camera, as small per-billboard records.

A billboard is the plane patch `mean + R(q) (u su, v sv, 0)`. For a pinhole camera the
texture coordinates at pixel `(x, y)` are ratios of functions affine in the pixel,

    (p_u, p_v, p_w) = P (x, y, 1),    u = p_u / p_w,    v = p_v / p_w,    z = 1 / p_w,

by Cramer's rule on `z d = u a_u + v a_v + c` (the homogeneous plane of 2D Gaussian
Splatting, Huang et al. 2024, written without its division): with the ray `d = K^-1 (x, y, 1)`,
axes `a_u, a_v` and centre `c` in camera axes, `p_u = d.(a_v x c)`, `p_v = d.(c x a_u)` and
`p_w = d.(a_u x a_v)`, all over `D = c.(a_u x a_v)`. Everything is float64: the subtraction in
the cross products would cost a billboard of 1 mm at 10 m four of float32's seven digits.

Only elementwise arithmetic is used, never a matrix product: the record of a billboard then
does not depend, not even in its last bit, on where it stands in the arrays.
"""

import torch
from torch import Tensor

from nbavatar.rendering.patches import ProjectedPatches

__all__ = ["FADE_FLOOR", "project_billboards", "texture_support"]

FADE_FLOOR = 1e-6  # a billboard that the low-pass dims below this is as good as edge-on


def texture_support(texels: int) -> float:
    """Half-width, in texture coordinates, of where a texture of `texels` a side is not zero.

    Sampling is bilinear with the outer texel centres at -1 and 1 and zeros beyond them, so
    the border fades over one texel. A single texel is a tent that ends at -1 and 1.
    """
    return 1.0 if texels == 1 else 1.0 + 2.0 / (texels - 1)


def _cross(a: tuple[Tensor, ...], b: tuple[Tensor, ...]) -> tuple[Tensor, Tensor, Tensor]:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _axes(quats: Tensor) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """First two columns of the rotation matrices of unnormalised wxyz quaternions."""
    w, x, y, z = quats.unbind(-1)
    s = 2.0 / (w * w + x * x + y * y + z * z)
    first = (1.0 - s * (y * y + z * z), s * (x * y + w * z), s * (x * z - w * y))
    second = (s * (x * y - w * z), 1.0 - s * (x * x + z * z), s * (y * z + w * x))
    return first, second


def project_billboards(
    means: Tensor,
    quats: Tensor,
    half_extents: Tensor,
    viewmat: Tensor,
    K: Tensor,
    *,
    near: float,
    low_pass: float,
    support: float,
) -> ProjectedPatches:
    """Projects billboards into one camera.

    The low-pass keeps the half-extents of the projected patch, the singular values s1 >= s2 of
    its Jacobian at the centre, from falling under `low_pass` pixels: where they would, the patch
    is stretched about its projected centre to `low_pass` and its alpha is multiplied by
    `s / low_pass`, which preserves the sum of alpha over the image. A patch seen edge-on fades to
    nothing instead of flickering, and the arithmetic stays well conditioned up to that limit.
    Billboards whose centre is not in front of the near plane are not filtered.

    Args:
        means: (F, 3) centres, world [m].
        quats: (F, 4) rotations, wxyz, of any norm but zero.
        half_extents: (F, 2) distances from the centre to u = 1 and v = 1 [m].
        viewmat: (4, 4) `cam_from_world`.
        K: (3, 3) intrinsics [px], upper triangular; skew is honoured.
        near: depth at which hits are clipped [m].
        low_pass: least half-extent on screen [px]; 0 turns the filter off.
        support: `texture_support` of the textures.

    Returns:
        `ProjectedPatches`; `plane` and `fade` carry gradients to the first three arguments.
    """
    m, view, intr = means.double(), viewmat.detach().double(), K.detach().double()
    fx, skew, cx, fy, cy = intr[0, 0], intr[0, 1], intr[0, 2], intr[1, 1], intr[1, 2]
    extents = half_extents.double()

    def rotate(vector: tuple[Tensor, ...]) -> list[Tensor]:
        return [view[i, 0] * vector[0] + view[i, 1] * vector[1] + view[i, 2] * vector[2] for i in range(3)]

    c = tuple(value + view[i, 3] for i, value in enumerate(rotate(m.unbind(-1))))
    first, second = _axes(quats.double())
    au = tuple(value * extents[:, 0] for value in rotate(first))
    av = tuple(value * extents[:, 1] for value in rotate(second))

    normal = _cross(au, av)
    volume = (c[0] * normal[0] + c[1] * normal[1] + c[2] * normal[2]).detach()
    facing = volume != 0  # else the camera lies in the plane: no hit
    inverse = torch.where(facing, 1.0 / torch.where(facing, volume, 1.0), 0.0)
    rows = []
    for g in (_cross(av, c), _cross(c, au), normal):
        x, y = g[0] / fx, (g[1] - g[0] * (skew / fx)) / fy
        rows.append([x * inverse, y * inverse, (g[2] - x * cx - y * cy) * inverse])

    in_front = c[2].detach() > near
    depth = torch.where(in_front, c[2], 1.0)
    x0, y0 = (fx * c[0] + skew * c[1]) / depth + cx, fy * c[1] / depth + cy
    jacobian = _jacobian((x0 - cx, y0 - cy), au, av, depth, fx, skew, fy)
    fade = torch.ones_like(depth)
    squeeze = None
    if low_pass > 0:
        squeeze, fade = _low_pass(jacobian, in_front & facing, low_pass)
    if squeeze is not None:
        xx, xy, yy = squeeze
        dx, dy = x0 - (xx * x0 + xy * y0), y0 - (xy * x0 + yy * y0)
        rows = [[a * xx + b * xy, a * xy + b * yy, a * dx + b * dy + k] for a, b, k in rows]
    plane = torch.stack([torch.stack(row, -1) for row in rows], -2)

    with torch.no_grad():
        visible = facing & (fade > FADE_FLOOR)
        bounds, nearest = _bounds(c, au, av, near, support, (fx, skew, cx, fy, cy))
        if squeeze is not None:
            bounds = _stretch(bounds, (x0, y0), squeeze)
        corners_x, corners_y, seen = bounds
        infinity = torch.inf
        box = torch.stack(
            [
                torch.where(seen, corners_x, infinity).amin(0),
                torch.where(seen, corners_y, infinity).amin(0),
                torch.where(seen, corners_x, -infinity).amax(0),
                torch.where(seen, corners_y, -infinity).amax(0),
            ],
            -1,
        )
        hidden = torch.tensor([1.0, 1.0, 0.0, 0.0], dtype=box.dtype, device=box.device)
        box = torch.where((visible & seen.any(0))[:, None], box, hidden)
    return ProjectedPatches(plane, fade, c[2].detach(), nearest, box)


def _jacobian(
    offset: tuple[Tensor, Tensor],
    au: tuple[Tensor, ...],
    av: tuple[Tensor, ...],
    depth: Tensor,
    fx: Tensor,
    skew: Tensor,
    fy: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Derivative of the pixel by (u, v) at the centre, as xx, xy (by v), yx, yy."""
    entries = []
    for axis in (0, 1):
        for a in (au, av):
            moved = fx * a[0] + skew * a[1] if axis == 0 else fy * a[1]
            entries.append((moved - offset[axis] * a[2]) / depth)
    return entries[0], entries[1], entries[2], entries[3]


def _low_pass(
    jacobian: tuple[Tensor, Tensor, Tensor, Tensor], valid: Tensor, radius: float
) -> tuple[tuple[Tensor, Tensor, Tensor] | None, Tensor]:
    """Symmetric contraction of screen offsets (xx, xy, yy), or None for no change, and the fade.

    With J J^T = U diag(s1^2, s2^2) U^T the contraction is U diag(min(1, s / radius)) U^T. It is
    written as a polynomial in J J^T, so equal singular values need no eigenvectors.
    """
    ux, vx, uy, vy = jacobian

    def spectrum(ux: Tensor, vx: Tensor, uy: Tensor, vy: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        plus = (ux + vy).square() + (uy - vx).square()
        minus = (ux - vy).square() + (uy + vx).square()
        return (ux * vy - vx * uy).abs(), torch.maximum(plus, minus), torch.minimum(plus, minus)

    with torch.no_grad():
        det, total2, gap2 = spectrum(ux, vx, uy, vy)
        large = 0.5 * (total2.sqrt() + gap2.sqrt())
        small = det / torch.where(large > 0, large, 1.0)
        both = valid & (large < radius) & (large > 0)
        one = valid & (small < radius) & ~both & (large > 0)
    if jacobian[0].device.type == "cpu" and not bool((both | one).any()):
        return None, torch.ones_like(ux)

    # Branches not taken get a harmless matrix: their square roots must not see zero, whose
    # infinite slope would turn into NaN under the mask.
    def chosen(mask: Tensor, one_value: float, other_value: float) -> tuple[Tensor, ...]:
        return (
            torch.where(mask, ux, one_value),
            torch.where(mask, vx, 0.0),
            torch.where(mask, uy, 0.0),
            torch.where(mask, vy, other_value),
        )

    a, b, c, d = chosen(both, 1.0, 1.0)
    det, total2, _ = spectrum(a, b, c, d)
    scale = 1.0 / (radius * total2.sqrt())
    xx, xy, yy = (a * a + b * b + det) * scale, (a * c + b * d) * scale, (c * c + d * d + det) * scale
    fade = torch.where(both, det / radius**2, 1.0)
    xx, xy, yy = torch.where(both, xx, 1.0), torch.where(both, xy, 0.0), torch.where(both, yy, 1.0)

    a, b, c, d = chosen(one, 2.0, 1.0)
    det, total2, gap2 = spectrum(a, b, c, d)
    total, gap = total2.sqrt(), gap2.sqrt()
    small = 2.0 * det / (total + gap)
    factor = small / radius
    # 1 - factor <= gap / radius here, so the quotient is bounded however close s1 and s2 are
    slope = (1.0 - factor) / (total * gap)
    shift = factor - slope * small.square()
    xx = torch.where(one, slope * (a * a + b * b) + shift, xx)
    xy = torch.where(one, slope * (a * c + b * d), xy)
    yy = torch.where(one, slope * (c * c + d * d) + shift, yy)
    fade = torch.where(one, factor, fade)
    return (xx, xy, yy), fade


def _bounds(
    c: tuple[Tensor, ...],
    au: tuple[Tensor, ...],
    av: tuple[Tensor, ...],
    near: float,
    support: float,
    intrinsics: tuple[Tensor, Tensor, Tensor, Tensor, Tensor],
) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor]:
    """Projected polygon of the support clipped at the near plane: x, y, used (8, F), and its least depth."""
    fx, skew, cx, fy, cy = intrinsics
    corners = [
        tuple(c[i] + support * (su * au[i] + sv * av[i]) for i in range(3))
        for su, sv in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]
    xs, ys, used = [], [], []
    for index, here in enumerate(corners):
        there = corners[(index + 1) % 4]
        inside, next_inside = here[2] >= near, there[2] >= near
        z = torch.where(inside, here[2], 1.0)
        xs.append((fx * here[0] + skew * here[1]) / z + cx)
        ys.append(fy * here[1] / z + cy)
        used.append(inside)
        crosses = inside != next_inside
        t = (near - here[2]) / torch.where(crosses, there[2] - here[2], 1.0)
        x, y = here[0] + t * (there[0] - here[0]), here[1] + t * (there[1] - here[1])
        xs.append((fx * x + skew * y) / near + cx)
        ys.append(fy * y / near + cy)
        used.append(crosses)
    nearest = torch.stack([corner[2] for corner in corners]).amin(0).clamp_min(near)
    return (torch.stack(xs), torch.stack(ys), torch.stack(used)), nearest


def _stretch(
    points: tuple[Tensor, Tensor, Tensor], centre: tuple[Tensor, Tensor], squeeze: tuple[Tensor, Tensor, Tensor]
) -> tuple[Tensor, Tensor, Tensor]:
    """Moves screen points away from the centre by the inverse of the low-pass contraction."""
    xx, xy, yy = squeeze
    det = xx * yy - xy * xy
    det = torch.where(det > 0, det, 1.0)
    dx, dy = points[0] - centre[0], points[1] - centre[1]
    return centre[0] + (yy * dx - xy * dy) / det, centre[1] + (xx * dy - xy * dx) / det, points[2]
