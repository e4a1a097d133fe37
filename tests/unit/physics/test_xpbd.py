"""The solver's constraints, one at a time, against closed forms."""

import numpy as np
import pytest

from nbavatar.physics.xpbd import relax


def _call(x, rest, mass, *, edges=(), support=0.0, stretch=0.0, shear=0.0, bend=0.0, ring=None, contacts=None, dt=0.1,
          iterations=200, friction=0.0, max_dent=np.inf, active=None, pose_mass=0.0, hold=0.0,
          bound=np.inf):  # fmt: skip
    n = len(x)
    edges = np.array(edges, np.int64).reshape(-1, 2)
    starts, ids, weights = ring or (np.zeros(n + 1, np.int64), np.zeros(0, np.int64), np.zeros(0))
    table, corner, weight = contacts or (np.zeros((0, 9)), np.zeros((0, 3), np.int64), np.zeros((0, 3)))
    pose = np.zeros((1, 6))
    pressed = relax(
        x, rest, np.asarray(mass, float), np.arange(n) if active is None else active, np.full(n, support), edges,
        np.linalg.norm(rest[edges[:, 0]] - rest[edges[:, 1]], axis=1), stretch, shear, starts, ids, weights,
        np.full(n, bend), np.zeros((0, 3), np.int64), np.zeros(n), 0.0, table, corner, weight,
        np.zeros(len(corner), np.int64), pose, np.array([[pose_mass, 0.0]]), np.array([hold, 0.0]),
        np.array([bound, bound]), np.zeros((1, 3)), dt, iterations, friction, max_dent,
    )  # fmt: skip
    return pressed, pose


def test_bed_is_one_implicit_step_of_a_spring():
    """m (x1 - x0) / h^2 = -k x1: the converged step has the closed form x1 = x0 / (1 + k h^2 / m)."""
    x, rest = np.array([[0.02, -0.01, 0.0]]), np.zeros((1, 3))
    start, k, m, h = x.copy(), 50.0, 2.0, 0.1
    _call(x, rest, [1 / m], support=k, dt=h)
    np.testing.assert_allclose(x, start / (1 + k * h * h / m), rtol=1e-12)


def test_shear_and_bed_reach_the_minimum_of_their_energy():
    """A chain with its end held: the converged step solves (M / h^2 + K) x = M / h^2 x0, a linear system."""
    n, k, t, m, h = 6, 30.0, 80.0, 0.5, 0.05
    rest = np.stack((np.arange(n), np.zeros(n), np.zeros(n)), 1) * 0.01
    x = rest.copy()
    x[0, 2] = 0.005
    start = x - rest
    mass = np.full(n, 1 / m)
    mass[0] = 0.0
    edges = [[i, i + 1] for i in range(n - 1)]
    _call(x, rest, mass, edges=edges, support=k, shear=t, dt=h, iterations=3000)
    matrix = np.diag(np.full(n, m / h**2 + k))
    for a, b in edges:
        matrix[[a, b], [a, b]] += t
        matrix[[a, b], [b, a]] -= t
    matrix[0], right = np.eye(n)[0], m / h**2 * start[:, 2]
    right[0] = start[0, 2]
    np.testing.assert_allclose((x - rest)[:, 2], np.linalg.solve(matrix, right), rtol=1e-6)


def test_bending_reaches_the_minimum_of_its_energy():
    n, k, b, m, h = 7, 5.0, 0.3, 0.5, 0.05
    rest = np.stack((np.arange(n), np.zeros(n), np.zeros(n)), 1)
    x = rest.copy()
    x[3, 1] = 0.2
    start = (x - rest)[:, 1].copy()
    mass = np.full(n, 1 / m)
    mass[3] = 0.0
    neighbours = [[j for j in (i - 1, i + 1) if 0 <= j < n] for i in range(n)]
    ring = (np.cumsum([0] + [len(a) for a in neighbours]), np.concatenate(neighbours), np.ones(2 * n - 2))
    _call(x, rest, mass, support=k, bend=b, ring=ring, dt=h, iterations=5000)
    laplacian = np.zeros((n, n))
    for i, around in enumerate(neighbours):
        laplacian[i, around] = 1
        laplacian[i, i] = -len(around)
    matrix = np.diag(np.full(n, m / h**2 + k)) + b * laplacian.T @ laplacian
    matrix[3], right = np.eye(n)[3], m / h**2 * start
    right[3] = start[3]
    np.testing.assert_allclose((x - rest)[:, 1], np.linalg.solve(matrix, right), rtol=1e-6, atol=1e-12)


def test_stretch_restores_length_and_keeps_the_centre_of_mass():
    rest = np.array([[0.0, 0, 0], [0.01, 0, 0]])
    x = rest * 3
    _call(x, rest, [1.0, 1.0], edges=[[0, 1]], stretch=1e12)
    np.testing.assert_allclose(x, [[0.01, 0, 0], [0.02, 0, 0]], atol=1e-9)


def _plane_contact(depth, previous=(0.0, 0.0, 0.0)):
    """One hand point above (in -z of) a triangle in z = 0 whose outside is +z."""
    point = np.array([0.0, 0.0, -depth])
    table = np.concatenate((point, point + previous, [0, 0, 1.0]))[None]
    return table, np.array([[0, 1, 2]]), np.full((1, 3), 1 / 3)


@pytest.mark.parametrize("stiffness", [0.0, 1.0, 1e12])
def test_contact_wins_over_any_stiffness(stiffness):
    rest = np.array([[0.01, 0, 0], [-0.01, 0.01, 0], [0, -0.01, 0.0]])
    x = rest.copy()
    _call(x, rest, [1.0, 1, 1], support=stiffness, contacts=_plane_contact(0.003), iterations=10)
    assert x[:, 2].mean() <= -0.003 + 1e-12 and np.isfinite(x).all()
    _call(x := rest.copy(), rest, [1.0, 1, 1], support=stiffness, contacts=_plane_contact(-0.003), iterations=10)
    np.testing.assert_allclose(x, rest, atol=1e-15)


def test_contact_force_balances_the_bed():
    rest = np.array([[0.01, 0, 0], [-0.01, 0.01, 0], [0, -0.01, 0.0]])
    x, h, k, m = rest.copy(), 0.1, 70.0, 1.0
    pressed, _ = _call(x, rest, [1 / m] * 3, support=k, contacts=_plane_contact(0.003), dt=h)
    np.testing.assert_allclose(pressed[0] / h**2, 3 * (k + m / h**2) * 0.003, rtol=1e-9)


@pytest.mark.parametrize(("friction", "moved"), [(0.0, 0.0), (0.1, None), (100.0, 0.002)])
def test_friction_drags_skin_up_to_coulombs_limit(friction, moved):
    rest = np.array([[0.01, 0, 0], [-0.01, 0.01, 0], [0, -0.01, 0.0]])
    x = rest.copy()
    contact = _plane_contact(0.003, previous=(-0.002, 0.0, 0.0))
    pressed, _ = _call(x, rest, [1.0, 1, 1], contacts=contact, friction=friction, iterations=50)
    slide = (x - rest)[:, 0].mean()
    if moved is None:
        # Impulse mu * N on three masses of 1 kg, a third of it on each.
        np.testing.assert_allclose(slide, friction * pressed[0] / 3, rtol=1e-6)
        assert 0 < slide < 0.002
    else:
        np.testing.assert_allclose(slide, moved, atol=1e-9)


def test_hand_yields_to_rigid_skin_but_not_beyond_its_bound():
    rest = np.array([[0.01, 0, 0], [-0.01, 0.01, 0], [0, -0.01, 0.0]])
    for bound, expected in ((0.01, 0.003), (0.001, 0.001)):
        x = rest.copy()
        _, pose = _call(x, rest, [0.0, 0, 0], contacts=_plane_contact(0.003), pose_mass=1.0, bound=bound)
        np.testing.assert_allclose(pose[0, 2], expected, rtol=1e-6)
        np.testing.assert_array_equal(x, rest)


@pytest.mark.parametrize("dt", [1e-6, 1e-3, 1.0])
@pytest.mark.parametrize("stiffness", [0.0, 1e-6, 1.0, 1e12])
@pytest.mark.parametrize("mass", [[1.0, 1, 1], [0.0, 1, 1], [0.0, 0, 0], [1e9, 1e-9, 1]])
def test_extreme_numbers_stay_finite(dt, stiffness, mass):
    rest = np.array([[0.01, 0, 0], [-0.01, 0.01, 0], [0, -0.01, 0.0]])
    x = rest + 1e-3
    ring = (np.array([0, 2, 4, 6]), np.array([1, 2, 0, 2, 0, 1]), np.full(6, 1e4))
    pinned = np.array(mass) == 0
    before = x.copy()
    _call(
        x, rest, mass, edges=[[0, 1], [1, 2], [2, 0]], support=stiffness, stretch=stiffness, shear=stiffness,
        bend=stiffness, ring=ring, contacts=_plane_contact(0.003), dt=dt, iterations=20, max_dent=0.035, friction=0.5,
    )  # fmt: skip
    assert np.isfinite(x).all()
    np.testing.assert_array_equal(x[pinned], before[pinned])
    assert np.linalg.norm(x - rest, axis=1)[~pinned].max(initial=0) <= 0.035 + 1e-12
