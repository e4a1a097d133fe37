"""Rotations in torch: axis-angle, matrices, quaternions (wxyz).

All functions take any batch shape and floating dtype, are differentiable, and are safe where the
textbook forms divide by zero: at the identity, and at half turns.

Source of the formulas: Sola, "Quaternion kinematics for the error-state Kalman filter" (2017), section 2-4;
the branch choice of `matrix_to_quaternion` is Shepperd's (1978).
"""

import torch
from torch import Tensor

__all__ = [
    "axis_angle_to_matrix",
    "axis_angle_to_quaternion",
    "matrix_to_axis_angle",
    "matrix_to_quaternion",
    "normalize_quaternion",
    "quaternion_multiply",
    "quaternion_to_matrix",
]


def axis_angle_to_quaternion(axis_angle: Tensor) -> Tensor:
    """Rotation vector `[..., 3]` [rad] to unit quaternion `[..., 4]`, wxyz."""
    squared = (axis_angle * axis_angle).sum(-1, keepdim=True)
    small = squared < 1e-8 if axis_angle.dtype == torch.float64 else squared < 1e-6
    angle = torch.where(small, torch.ones_like(squared), squared).sqrt()
    # sin(a/2)/a = 1/2 - a^2/48 + a^4/3840 near zero: the error is below half an ulp on the small branch.
    factor = torch.where(small, 0.5 - squared / 48 + squared * squared / 3840, torch.sin(angle / 2) / angle)
    real = torch.where(small, 1 - squared / 8 + squared * squared / 384, torch.cos(angle / 2))
    return torch.cat([real, axis_angle * factor], dim=-1)


def axis_angle_to_matrix(axis_angle: Tensor) -> Tensor:
    """Rotation vector `[..., 3]` [rad] to rotation matrix `[..., 3, 3]`."""
    return quaternion_to_matrix(axis_angle_to_quaternion(axis_angle))


def normalize_quaternion(quaternion: Tensor) -> Tensor:
    """Scales `[..., 4]` to unit length; the zero quaternion becomes the identity, with zero gradient."""
    largest = quaternion.abs().amax(-1, keepdim=True).detach()
    usable = largest > torch.finfo(quaternion.dtype).tiny
    # Dividing by the largest entry first keeps the squares away from overflow and underflow.
    scaled = quaternion / torch.where(usable, largest, torch.ones_like(largest))
    identity = torch.zeros_like(quaternion)
    identity[..., 0] = 1
    safe = torch.where(usable, scaled, identity)
    return safe / (safe * safe).sum(-1, keepdim=True).sqrt()


def quaternion_to_matrix(quaternion: Tensor) -> Tensor:
    """Unit quaternion `[..., 4]` (wxyz) to rotation matrix `[..., 3, 3]`. Does not normalise."""
    w, x, y, z = quaternion.unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(*quaternion.shape[:-1], 3, 3)


def matrix_to_quaternion(matrix: Tensor) -> Tensor:
    """Rotation matrix `[..., 3, 3]` to unit quaternion `[..., 4]`, wxyz, with the first nonzero entry positive."""
    m = matrix
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    squares = torch.stack([trace, m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]], dim=-1)
    best = squares.argmax(-1)
    a = m[..., 2, 1] - m[..., 1, 2]
    b = m[..., 0, 2] - m[..., 2, 0]
    c = m[..., 1, 0] - m[..., 0, 1]
    d = m[..., 0, 1] + m[..., 1, 0]
    e = m[..., 0, 2] + m[..., 2, 0]
    f = m[..., 1, 2] + m[..., 2, 1]
    big = 1 + torch.stack([trace, *(2 * m[..., i, i] - trace for i in range(3))], dim=-1)
    candidates = torch.stack(
        [
            torch.stack([big[..., 0], a, b, c], -1),
            torch.stack([a, big[..., 1], d, e], -1),
            torch.stack([b, d, big[..., 2], f], -1),
            torch.stack([c, e, f, big[..., 3]], -1),
        ],
        dim=-2,
    )
    index = best[..., None, None].expand(*best.shape, 1, 4)
    quaternion = normalize_quaternion(candidates.gather(-2, index).squeeze(-2))
    nonzero = quaternion.abs() > 4 * torch.finfo(matrix.dtype).eps
    first = quaternion.gather(-1, nonzero.to(torch.int8).argmax(-1, keepdim=True))
    return torch.where(first < 0, -quaternion, quaternion)


def matrix_to_axis_angle(matrix: Tensor) -> Tensor:
    """Rotation matrix `[..., 3, 3]` to rotation vector `[..., 3]` [rad], of length at most pi."""
    quaternion = matrix_to_quaternion(matrix)
    real, imaginary = quaternion[..., :1], quaternion[..., 1:]
    squared = (imaginary * imaginary).sum(-1, keepdim=True)
    small = squared < (1e-12 if matrix.dtype == torch.float64 else 1e-7)
    length = torch.where(small, torch.ones_like(squared), squared).sqrt()
    # 2 atan2(s, w) / s -> 2/w - 2 s^2 / (3 w^3) as s -> 0; w is 1 up to s^2/2 there.
    w = torch.where(small, real, torch.ones_like(real))
    factor = torch.where(small, 2 / w - 2 * squared / (3 * w**3), 2 * torch.atan2(length, real) / length)
    return imaginary * factor


def quaternion_multiply(left: Tensor, right: Tensor) -> Tensor:
    """Hamilton product of `[..., 4]` (wxyz): first rotates by `right`, then by `left`."""
    w1, x1, y1, z1 = left.unbind(-1)
    w2, x2, y2, z2 = right.unbind(-1)
    return torch.stack(
        [
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        ],
        dim=-1,
    )
