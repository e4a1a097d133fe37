"""Points, parts and the solver against the body models, autograd and dense algebra."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from nbavatar.bodymodels.mano import shorten_tips
from nbavatar.fitting.parts import HandPart, HeadPart, State, retract, right_jacobian
from nbavatar.fitting.points import skew, skinned_points
from nbavatar.fitting.refine import Observations, Prior, _linearise
from nbavatar.fitting.system import NormalEquations, acceleration_bands, solve
from nbavatar.math.rotations import axis_angle_to_matrix

from .scenes import bodies

N = 3
EXACT = {"rtol": 1e-10, "atol": 1e-12}


def _random(*size, scale=0.5, seed=0):
    return scale * torch.randn(*size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.fixture(scope="module")
def head():
    flame = bodies("tiny").flame
    return HeadPart(flame, flame.landmarks)


@pytest.fixture(scope="module")
def hand():
    return HandPart(bodies("tiny").mano)


def _state(part):
    if isinstance(part, HeadPart):
        return part.state(
            _random(100), _random(N, 50, seed=1), _random(N, 3, seed=2), _random(N, 3, seed=3), _random(N, 3)
        )
    return part.state(_random(10), _random(N, 45, seed=1), _random(N, 3, seed=2), _random(N, 3, seed=3))


def test_points_equal_the_mesh_and_autograd(hand):
    mesh = hand.mano.mesh
    vertices = torch.tensor([[1, 5, 9], [2, 2, 7]])
    weights = torch.tensor([[0.2, 0.3, 0.5], [0.5, 0.5, 0.0]], dtype=torch.float64)
    active = (0, 2, 5, 6)
    points = skinned_points(mesh, vertices, weights, active, (3, 7))
    shape, angles = _random(N, 10), _random(N, 4, 3, seed=4)

    def direct(shape, step):
        local = torch.zeros(N, 16, 3, dtype=torch.float64)
        local[:, list(active)] = angles
        turns = axis_angle_to_matrix(local)
        moved = turns[:, list(active)] @ axis_angle_to_matrix(step.reshape(N, 4, 3))
        turns = turns.index_copy(1, torch.tensor(active), moved)
        verts, joints = mesh.pose(shape, turns)
        return torch.cat([torch.einsum("nlkc,lk->nlc", verts[:, vertices], weights), joints[:, [3, 7]]], 1)

    zero = torch.zeros(N, 12, dtype=torch.float64)
    found = points.pose(shape, axis_angle_to_matrix(angles))
    torch.testing.assert_close(found.points, direct(shape, zero), **EXACT)
    by_shape = torch.autograd.functional.jacobian(lambda x: direct(x, zero).sum(0), shape)
    by_turn = torch.autograd.functional.jacobian(lambda x: direct(shape, x).sum(0), zero)
    torch.testing.assert_close(found.by_shape, by_shape.permute(2, 0, 1, 3), **EXACT)
    torch.testing.assert_close(found.by_turn, by_turn.permute(2, 0, 1, 3), **EXACT)


@pytest.mark.parametrize("name", ["head", "hand"])
def test_keypoints_and_derivatives_of_a_part(name, request):
    part = request.getfixturevalue(name)
    state = _state(part)
    found = part.keypoints(state)
    if name == "head":
        expected = part.flame.landmarks(part.vertices(state))
    else:
        p = part.parameters(state)
        expected = shorten_tips(part.mano.forward(p["betas"], p["hand_pose"], p["global_orient"], p["transl"]).joints)
    torch.testing.assert_close(found.points, expected, **EXACT)
    frame, shape = torch.zeros(N, 6 + part.local_count, dtype=torch.float64), torch.zeros_like(state.shape)

    def moved(frame, shape):
        return part.keypoints(retract(state, frame, shape)).points.flatten(1)

    by_frame = torch.autograd.functional.jacobian(lambda x: moved(x, shape).sum(0), frame)
    by_shape = torch.autograd.functional.jacobian(lambda x: moved(frame, x), shape)
    torch.testing.assert_close(found.by_frame, by_frame.permute(1, 0, 2), **EXACT)
    torch.testing.assert_close(found.by_shape, by_shape, **EXACT)


def test_parameters_reproduce_the_state(head, hand):
    for part in (head, hand):
        state = _state(part)
        p = part.parameters(state)
        order = (
            ("expression", "jaw", "global_orient", "transl")
            if part is head
            else ("hand_pose", "global_orient", "transl")
        )
        again = part.state(state.shape, *(p[name] for name in order))
        torch.testing.assert_close(part.vertices(again), part.vertices(state), **EXACT)


@pytest.mark.parametrize("size", [0.0, 1e-6, 1e-3, 1.0, 3.1, 5.0])
def test_right_jacobian_against_scipy_differences(size):
    axis = np.array([0.3, -0.8, 0.5])
    angle = size * axis / np.linalg.norm(axis)
    found = right_jacobian(torch.tensor(angle)[None])[0].numpy()
    step = 1e-5
    for k in range(3):
        ahead, behind = (Rotation.from_rotvec(angle + s * step * np.eye(3)[k]) for s in (1, -1))
        difference = (behind.inv() * ahead).as_rotvec() / (2 * step)
        np.testing.assert_allclose(found[:, k], difference, atol=1e-9)


def test_skew_is_the_cross_product():
    a, b = _random(5, 3), _random(5, 3, seed=1)
    torch.testing.assert_close((skew(a) @ b[..., None])[..., 0], torch.linalg.cross(a, b))


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7])
def test_acceleration_bands_are_the_normal_matrix(count):
    rows = (
        np.array([np.convolve(np.eye(count)[i], [1, -2, 1], "valid") for i in range(count)]).T
        if count >= 3
        else np.zeros((0, count))
    )
    normal = rows.T @ rows
    for k, band in enumerate(acceleration_bands(count)):
        np.testing.assert_allclose(band.numpy(), np.diagonal(normal, k) if k < count else [])


@pytest.mark.parametrize(
    "segments", [[(0, 10)], [(0, 6), (7, 8), (9, 10)], [(0, 0), (1, 10)], [(n, n) for n in range(11)]]
)
@pytest.mark.parametrize("smooth", [0.0, 3.0])
def test_solve_equals_dense_algebra(segments, smooth):
    count, size, shapes = 11, 5, 4
    a, b = _random(count, size, 12), _random(count, shapes, 12, seed=1)
    system = NormalEquations(
        a @ a.mT,
        _random(count, size, seed=2),
        a @ b.mT,
        (b @ b.mT).sum(0) + torch.eye(shapes),
        _random(shapes, seed=3),
        0.0,
    )
    smoothness = smooth * torch.rand(size, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    total = count * size
    dense = torch.zeros(total + shapes, total + shapes, dtype=torch.float64)
    for n in range(count):
        rows = slice(n * size, (n + 1) * size)
        dense[rows, rows] = system.blocks[n]
        dense[rows, total:], dense[total:, rows] = system.cross[n], system.cross[n].mT
    dense[total:, total:] = system.shape_block
    for first, last in segments:
        for n in range(first, last - 1):
            row = torch.zeros(size, total + shapes, dtype=torch.float64)
            for offset, factor in ((0, 1.0), (1, -2.0), (2, 1.0)):
                row[:, (n + offset) * size : (n + offset + 1) * size] = factor * torch.eye(size, dtype=torch.float64)
            dense += row.mT @ (smoothness[:, None] * row)
    dense += 0.1 * torch.diag(torch.diagonal(dense))
    expected = torch.linalg.solve(dense, -torch.cat([system.gradient.flatten(), system.shape_gradient]))
    steps, shape_step = solve(system, smoothness, segments, 0.1)
    torch.testing.assert_close(torch.cat([steps.flatten(), shape_step]), expected, rtol=1e-9, atol=1e-11)


def test_solve_reports_an_indefinite_system():
    system = NormalEquations(
        -torch.eye(2).double()[None],
        torch.ones(1, 2).double(),
        torch.zeros(1, 2, 1).double(),
        torch.eye(1).double(),
        torch.zeros(1).double(),
        0.0,
    )
    with pytest.raises(np.linalg.LinAlgError):
        solve(system, torch.zeros(2).double(), [(0, 0)], 0.0)


def test_gradient_of_the_whole_cost(hand):
    """The gradient in the normal equations is that of the cost they report, by central differences."""
    count = 5
    state = State(
        axis_angle_to_matrix(_random(count, 3, scale=0.02, seed=3)),
        _random(count, 3, scale=0.02) + torch.tensor([0, 0, 2.0]),
        _random(count, 45, scale=0.1, seed=5), _random(10, seed=6),
    )  # fmt: skip
    K = torch.tensor([[[500.0, 0, 320], [0, 510, 240], [0, 0, 1]]], dtype=torch.float64).expand(2, 3, 3)
    pose = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    pose[1, 0, 3] = 0.3
    seen = Observations(
        torch.tensor([320.0, 240.0]).double() + _random(2, count, 21, 2, scale=30), torch.rand(2, count, 21).double(),
        torch.ones(2, count, 21, dtype=torch.bool), K, pose,
    )  # fmt: skip
    prior = Prior(
        _random(count, 45, seed=8), _random(20, 45, seed=9), _random(10, seed=10), 0.7,
        torch.rand(51).double(), [(0, 3), (4, 4)],
    )  # fmt: skip

    def cost(frame, shape):
        return _linearise(hand, retract(state, frame, shape), prior, seen, 2.0, 25.0).cost

    system = _linearise(hand, state, prior, seen, 2.0, 25.0)
    zero, none = torch.zeros(count, 51, dtype=torch.float64), torch.zeros(10, dtype=torch.float64)
    for column in (0, 4, 7, 50):
        step = zero.clone()
        step[2, column] = 1e-6
        slope = (cost(step, none) - cost(-step, none)) / 2e-6
        # The rotation's acceleration is differentiated to first order in the turn between frames (0.1 rad here).
        assert abs(slope - system.gradient[2, column]) < (2e-2 if column < 3 else 1e-5) * system.gradient[2].abs().max()
    step = none.clone()
    step[3] = 1e-6
    slope = (cost(zero, step) - cost(zero, -step)) / 2e-6
    assert abs(slope - system.shape_gradient[3]) < 1e-5 * system.shape_gradient.abs().max()
