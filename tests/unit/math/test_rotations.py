import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nbavatar.math import rotations as rot

VECTOR = st.lists(st.floats(-7, 7), min_size=3, max_size=3)


def _torch(values):
    return torch.tensor(values, dtype=torch.float64)


@given(VECTOR)
def test_axis_angle_to_matrix_agrees_with_scipy(vector):
    expected = Rotation.from_rotvec(vector).as_matrix()
    np.testing.assert_allclose(rot.axis_angle_to_matrix(_torch(vector)).numpy(), expected, atol=1e-13)


@given(VECTOR)
def test_matrix_to_quaternion_agrees_with_scipy_up_to_sign(vector):
    rotation = Rotation.from_rotvec(vector)
    got = rot.matrix_to_quaternion(_torch(rotation.as_matrix())).numpy()
    expected = rotation.as_quat()[[3, 0, 1, 2]]
    assert min(np.abs(got - expected).max(), np.abs(got + expected).max()) < 1e-12


@given(VECTOR)
def test_matrix_to_axis_angle_gives_the_same_rotation_within_half_a_turn(vector):
    matrix = rot.axis_angle_to_matrix(_torch(vector))
    back = rot.matrix_to_axis_angle(matrix)
    assert back.norm() <= math.pi + 1e-12
    np.testing.assert_allclose(rot.axis_angle_to_matrix(back).numpy(), matrix.numpy(), atol=1e-12)


@given(VECTOR, VECTOR)
def test_quaternion_multiply_composes(first, second):
    a, b = rot.axis_angle_to_quaternion(_torch(first)), rot.axis_angle_to_quaternion(_torch(second))
    product = rot.quaternion_to_matrix(rot.quaternion_multiply(a, b))
    np.testing.assert_allclose(
        product.numpy(), (rot.quaternion_to_matrix(a) @ rot.quaternion_to_matrix(b)).numpy(), atol=1e-12
    )


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, -1, 0], [1, 1, 1]])
def test_half_turns_survive(axis):
    vector = _torch(axis) / _torch(axis).norm() * math.pi
    matrix = rot.axis_angle_to_matrix(vector)
    back = rot.axis_angle_to_matrix(rot.matrix_to_axis_angle(matrix))
    np.testing.assert_allclose(back.numpy(), matrix.numpy(), atol=1e-12)


@pytest.mark.parametrize("scale", [0.0, 1e-12, 1e-6, 1e-3, 1.0, math.pi])
@pytest.mark.parametrize("function", [rot.axis_angle_to_matrix, rot.axis_angle_to_quaternion])
def test_gradients_are_right_from_zero_to_a_half_turn(scale, function):
    vector = (_torch([0.6, -0.48, 0.64]) * scale).requires_grad_()
    assert torch.autograd.gradcheck(function, (vector,), eps=1e-6, atol=1e-7)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_axis_angle_is_continuous_where_the_series_takes_over(dtype):
    border = 1e-3 if dtype == torch.float32 else 1e-4
    values = torch.tensor([[border * 0.999, 0, 0], [border * 1.001, 0, 0]], dtype=dtype)
    quaternion = rot.axis_angle_to_quaternion(values)
    expected = torch.cat([torch.cos(values.double() / 2)[:, :1], torch.sin(values.double() / 2)], -1)
    assert (quaternion.double() - expected).abs().max() < 4 * torch.finfo(dtype).eps


def test_normalize_quaternion_survives_zero_and_extreme_lengths():
    values = torch.tensor([[0.0, 0, 0, 0], [1e-30, 0, 0, 1e-30], [1e30, -1e30, 0, 0], [3, 0, 4, 0]], requires_grad=True)
    unit = rot.normalize_quaternion(values)
    h = math.sqrt(0.5)
    expected = torch.tensor([[1, 0, 0, 0], [h, 0, 0, h], [h, -h, 0, 0], [0.6, 0, 0.8, 0]])
    torch.testing.assert_close(unit, expected)
    unit.sum().backward()
    assert values.grad is not None
    assert values.grad[0].abs().max() == 0
    assert torch.isfinite(values.grad[3]).all()
