"""Cells of the rotations, float32 against 50 digits: at the identity, at half turns, at extreme norms."""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nbavatar.math.rotations import (
    axis_angle_to_matrix,
    axis_angle_to_quaternion,
    matrix_to_axis_angle,
    matrix_to_quaternion,
    normalize_quaternion,
    quaternion_multiply,
)
from nbavatar.studies.extremes.cells import Level, Limit, Refusal, Sample, cell
from nbavatar.studies.extremes.compare import derivative, gradient_error, gradients, precise, relative

__all__: list[str] = []

_AXIS = np.array([0.31, -0.47, 0.83]) / np.linalg.norm([0.31, -0.47, 0.83])
_ANGLES = (1.0, 1e-2, 1.001e-3, 9.99e-4, 1e-5, 1e-10, 1e-20, 1e-30, 0.0, 3.0, math.pi - 1e-3, math.pi - 1e-6, math.pi)
_QUICK = (1.0, 9.99e-4, 0.0, math.pi)
_LARGE = (4.0, 2 * math.pi, 10.0, 1e2, 1e4, 1e6)


def _quaternion(vector: np.ndarray) -> np.ndarray:
    """Quaternion of a rotation vector, mpmath."""
    from mpmath import cos, mpf, sin, sqrt

    angle = sqrt(sum(v * v for v in vector))
    if angle == 0:
        return np.array([mpf(1), *(v / 2 for v in vector)])
    return np.array([cos(angle / 2), *(v * sin(angle / 2) / angle for v in vector)])


def _matrix(q: np.ndarray) -> np.ndarray:
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _vector_cell(kernel: str, condition: str, levels: tuple[float, ...], quick: tuple[float, ...], **more: Any):
    return cell("rotations", kernel, condition, "angle [rad]", levels, quick=quick, oracle="50 digits (mpmath)", **more)


def _from_vector(function, truth, angle: float) -> Sample:
    """A function of a rotation vector against its mpmath form, with its gradient."""
    import mpmath

    vector = torch.tensor(_AXIS * angle, dtype=torch.float32)
    probe = torch.randn(16, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    values: list[Tensor] = []

    def loss(v: Tensor) -> Tensor:
        values.append(function(v))
        flat = values[-1].reshape(-1)
        return (flat * probe[: len(flat)].float()).sum()

    found = gradients(loss, [vector])[1]
    with mpmath.workdps(60):
        at = precise(vector.numpy())
        true = truth(at).astype(np.float64)
        weights = precise(probe[: true.size].float().numpy())
        slope = derivative(lambda moved: (truth(moved).ravel() * weights).sum(), at)
    return Sample(relative(values[0], true), gradient_error(found, [slope]))


_GROWS = tuple(
    Limit(lambda angle, most=most: angle == most, 1e-7 * most, 1e-6 * most, "24 bits of the angle, less its turns")
    for most in (1e2, 1e4, 1e6)
)


@_vector_cell("axis_angle_to_matrix", "identity to half turn", _ANGLES, _QUICK)
def _to_matrix(angle: float) -> Sample:
    return _from_vector(axis_angle_to_matrix, lambda v: _matrix(_quaternion(v)), angle)


@_vector_cell("axis_angle_to_matrix", "many turns", _LARGE, (4.0, 1e6), limits=_GROWS)
def _to_matrix_large(angle: float) -> Sample:
    return _from_vector(axis_angle_to_matrix, lambda v: _matrix(_quaternion(v)), angle)


@_vector_cell("axis_angle_to_quaternion", "identity to half turn", _ANGLES, _QUICK)
def _to_quaternion(angle: float) -> Sample:
    return _from_vector(axis_angle_to_quaternion, _quaternion, angle)


def _rotation(angle: float, axis: np.ndarray = _AXIS) -> tuple[Tensor, np.ndarray]:
    """A rotation by `angle` as a float32 matrix, and its exact rotation vector, of length at most pi."""
    import mpmath

    with mpmath.workdps(50):
        unit = precise(axis)
        unit = unit / mpmath.sqrt((unit * unit).sum())
        exact = unit * mpmath.mpf(angle)
        matrix = torch.tensor(_matrix(_quaternion(exact)).astype(np.float64), dtype=torch.float32)
    return matrix, exact


def _turned(matrix: Tensor, turn: Tensor) -> Tensor:
    """R exp([turn]) to first order, which is all that a gradient at turn = 0 needs."""
    zero = torch.zeros_like(turn[0])
    cross = torch.stack((zero, -turn[2], turn[1], turn[2], zero, -turn[0], -turn[1], turn[0], zero)).reshape(3, 3)
    return matrix @ (torch.eye(3, dtype=turn.dtype) + cross)


@_vector_cell("matrix_to_quaternion", "identity to half turn", _ANGLES, _QUICK)
def _quaternion_of(angle: float) -> Sample:
    matrix, exact = _rotation(angle)
    return _quaternion_sample(matrix, exact)


@cell(
    "rotations",
    "matrix_to_quaternion",
    "half turns about special axes",
    "axis",
    ("x", "y", "z", "xy", "yz", "zx", "xyz"),
    quick=("x", "xy"),
    oracle="50 digits (mpmath)",
)
def _half_turns(axis: str) -> Sample:
    matrix, exact = _rotation(math.pi, np.array([float(name in axis) for name in "xyz"]))
    return _quaternion_sample(matrix, exact)


def _quaternion_sample(matrix: Tensor, exact: np.ndarray) -> Sample:
    import mpmath

    probe = torch.tensor([0.3, -1.1, 0.7, 0.4], dtype=torch.float32)
    values: list[Tensor] = []

    def loss(turn: Tensor) -> Tensor:
        values.append(matrix_to_quaternion(_turned(matrix, turn)))
        return (values[-1] * probe).sum()

    found = gradients(loss, [torch.zeros(3)])[1]
    with mpmath.workdps(50):
        q = _quaternion(exact)
        sign = 1 if float((q * precise(values[0].detach().numpy())).sum()) >= 0 else -1
        w, x, y, z = sign * q
        # dq = q (0, turn) / 2 (Sola 2017, eq. 200)
        jacobian = np.array([[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]]) / 2
        slope = (precise(probe.numpy()) @ jacobian).astype(np.float64)
        true = (sign * q).astype(np.float64)
    return Sample(relative(values[0], true), gradient_error(found, [slope]))


@_vector_cell(
    "matrix_to_axis_angle",
    "identity to half turn",
    _ANGLES,
    _QUICK,
    limits=(Limit(lambda angle: 0 < float(angle) < 1e-9, 1.0, 1e-4, "entries under 6e-8 may round away"),),
)
def _vector_of(angle: float) -> Sample:
    import mpmath

    matrix, exact = _rotation(angle)
    probe = torch.tensor([0.3, -1.1, 0.7], dtype=torch.float32)
    values: list[Tensor] = []

    def loss(turn: Tensor) -> Tensor:
        values.append(matrix_to_axis_angle(_turned(matrix, turn)))
        return (values[-1] * probe).sum()

    found = gradients(loss, [torch.zeros(3)])[1]
    with mpmath.workdps(50):
        # At the half turn both signs are right; the kernel says which one the rounded matrix is nearer to.
        vector = exact if float((exact * precise(values[0].detach().numpy())).sum()) >= 0 else -exact
        slope = (precise(probe.numpy()) @ _inverse_jacobian(vector)).astype(np.float64)
        true = vector.astype(np.float64)
    return Sample(relative(values[0], true), gradient_error(found, [slope]))


def _inverse_jacobian(vector: np.ndarray) -> np.ndarray:
    """Derivative of log(exp(v) exp(t)) by t at 0: 1 + [v]/2 + (1/a^2 - cot(a/2)/(2a)) [v]^2 (Sola 2017, eq. 144)."""
    from mpmath import cot, mpf, sqrt

    x, y, z = vector
    cross = np.array([[0 * x, -z, y], [z, 0 * x, -x], [-y, x, 0 * x]])
    angle = sqrt((vector * vector).sum())
    factor = 1 / angle**2 - cot(angle / 2) / (2 * angle) if angle > mpf(10) ** -8 else mpf(1) / 12
    return np.eye(3) + cross / 2 + factor * (cross @ cross)


@cell(
    "rotations",
    "matrix_to_quaternion",
    "matrix far from a rotation",
    "scale of the matrix [1]",
    (1.0, 1.001, 1.1, 0.9),
    oracle="the rotation itself",
    limits=(Limit(lambda scale: scale != 1.0, 0.2, 1.0, "not a rotation: the nearest is not looked for"),),
)
def _scaled(scale: float) -> Sample:
    import mpmath

    matrix, exact = _rotation(1.0)
    found = matrix_to_quaternion(matrix * scale)
    with mpmath.workdps(50):
        return Sample(relative(found, _quaternion(exact).astype(np.float64)))


@cell(
    "rotations",
    "normalize_quaternion",
    "norm",
    "norm [1]",
    (1.0, 1e-3, 1e-10, 1e-20, 1e-30, 1e-37, 1e-39, 1e-44, 0.0, 1e10, 1e20, 1e30, 3e38),
    quick=(1.0, 1e-37, 0.0, 3e38),
    oracle="50 digits (mpmath)",
    limits=(Limit(lambda norm: 0 < float(norm) < 1.2e-38, 2.0, 1.001, "subnormal: taken for zero, the identity"),),
)
def _normalise(norm: float) -> Sample:
    import mpmath

    unit = np.array([0.5, -0.1, 0.7, -0.5])
    q = torch.tensor(unit / np.linalg.norm(unit) * norm, dtype=torch.float32)
    probe = torch.tensor([0.3, -1.1, 0.7, 0.4], dtype=torch.float32)
    values: list[Tensor] = []

    def loss(quat: Tensor) -> Tensor:
        values.append(normalize_quaternion(quat))
        return (values[-1] * probe).sum()

    found = gradients(loss, [q])[1]
    if norm == 0.0:  # defined: the identity, gradient zero
        return Sample(relative(values[0], [1.0, 0, 0, 0]), gradient_error(found, [np.zeros(4)]))
    with mpmath.workdps(60):
        at = precise(q.numpy())
        length = mpmath.sqrt((at * at).sum())
        true = at / length
        weights = precise(probe.numpy())
        slope = (weights - true * (weights * true).sum()) / length
        return Sample(
            relative(values[0], true.astype(np.float64)), gradient_error(found, [slope.astype(np.float64)], least=1e-12)
        )


@cell(
    "rotations",
    "quaternion_multiply",
    "length of a product of many",
    "factors [1]",
    (1.0, 10.0, 1e3, 1e5),
    oracle="50 digits (mpmath)",
    limits=(Limit(lambda count: float(count) >= 1e3, 1e-2, 1e-4, "rounding adds up; normalise now and then"),),
)
def _product(count: float) -> Sample:
    """The rotation by `count` small turns about one axis."""
    import mpmath

    step = axis_angle_to_quaternion(torch.tensor(_AXIS * 1e-3, dtype=torch.float32))
    found = torch.tensor([1.0, 0.0, 0.0, 0.0])
    power, left = step, int(count)
    while left:  # by squaring, as rounding would otherwise be all that is seen of 1e5 products
        found = quaternion_multiply(found, power) if left & 1 else found
        power, left = quaternion_multiply(power, power), left >> 1
    with mpmath.workdps(50):
        w, *xyz = precise(step.numpy())
        length = mpmath.sqrt(sum(v * v for v in xyz))
        angle = mpmath.atan2(length, w) * int(count)
        true = np.array([mpmath.cos(angle), *(v / length * mpmath.sin(angle) for v in xyz)])
        return Sample(relative(found, true.astype(np.float64)))


@cell(
    "rotations",
    "matrix_to_axis_angle",
    "not a number",
    "case",
    ("NaN", "zero matrix"),
    oracle="nothing finite",
    refuses=lambda case: case == "NaN",
    limits=(Limit(lambda case: True, 10.0, 1.0, "no rotation: any rotation"),),
)
def _nonsense(case: Level) -> Sample | Refusal:
    matrix = torch.full((3, 3), math.nan) if case == "NaN" else torch.zeros(3, 3)
    found = matrix_to_axis_angle(matrix)
    if bool(torch.isnan(found).any()) and case == "NaN":
        return Refusal("NaN stays NaN: readers of parameters refuse it before")
    return Sample(relative(found, torch.zeros(3)))
