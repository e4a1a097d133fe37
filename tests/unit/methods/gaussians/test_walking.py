"""Straightest walks against constructions that know nothing of them: the plane, folded strips, cones."""

import numpy as np
import pytest

from nbavatar.methods.splatting_avatar.walking import make_surface, tangents, walk


def at(verts: np.ndarray, faces: np.ndarray, face: np.ndarray, bary: np.ndarray) -> np.ndarray:
    return np.einsum("nc,ncd->nd", bary, verts[faces[face]])


def square(side: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A triangulated unit square in the plane z = 0: inner vertices moved, diagonals and orientations at random."""
    random = np.random.default_rng(seed)
    y, x = np.mgrid[0 : side + 1, 0 : side + 1] / side
    points = np.stack((x, y, np.zeros_like(x)), -1)
    points[1:-1, 1:-1, :2] += random.uniform(-0.3, 0.3, (side - 1, side - 1, 2)) / side
    ids = np.arange((side + 1) ** 2).reshape(side + 1, side + 1)
    faces = []
    for i in range(side):
        for j in range(side):
            a, b, c, d = ids[i, j], ids[i, j + 1], ids[i + 1, j + 1], ids[i + 1, j]
            faces += [[a, b, c], [a, c, d]] if random.random() < 0.5 else [[a, b, d], [b, c, d]]
    faces = np.array([np.roll(face, random.integers(3)) for face in faces])
    flipped = random.random(len(faces)) < 0.3
    faces[flipped] = faces[flipped][:, ::-1]
    return points.reshape(-1, 3), faces


def starts(faces: np.ndarray, count: int, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    return random.integers(len(faces), size=count), random.dirichlet([1, 1, 1], count)


def test_in_the_plane_a_walk_is_a_sum_and_stops_at_the_rim() -> None:
    verts, faces = square(7, 0)
    random = np.random.default_rng(1)
    face, bary = starts(faces, 4000, random)
    begin = at(verts, faces, face, bary)
    step = np.concatenate((random.normal(size=(4000, 2)) * 0.4, random.normal(size=(4000, 1))), 1)
    end = at(verts, faces, *walk(make_surface(verts, faces), face, bary, step))
    flat = step * [1, 1, 0]
    with np.errstate(divide="ignore"):
        limit = np.where(flat[:, :2] > 0, (1 - begin[:, :2]) / flat[:, :2], -begin[:, :2] / flat[:, :2])
    share = np.clip(np.where(flat[:, :2] == 0, np.inf, limit).min(1), 0, 1)
    assert (share < 1).mean() > 0.2 and (share == 1).mean() > 0.2
    np.testing.assert_allclose(end, begin + share[:, None] * flat, atol=1e-12)


def folded_strip(count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A flat strip of triangles (V, 2), folded in space along each inner edge by a random angle (V, 3), faces."""
    random = np.random.default_rng(seed)
    flat = np.stack((np.arange(count + 2) * 0.5, (np.arange(count + 2) % 2).astype(float)), 1)
    flat += random.uniform(-0.15, 0.15, flat.shape)
    faces = np.array([[i, i + 1, i + 2] if i % 2 == 0 else [i + 1, i, i + 2] for i in range(count)])
    folded = np.concatenate((flat, np.zeros((len(flat), 1))), 1)
    for i in range(1, count):  # everything from vertex i + 2 on turns about the edge (i, i + 1)
        axis = folded[i + 1] - folded[i]
        axis /= np.linalg.norm(axis)
        angle = random.uniform(-1.2, 1.2)
        arm = folded[i + 2 :] - folded[i]
        turned = np.cos(angle) * arm + np.sin(angle) * np.cross(axis, arm)
        turned += (1 - np.cos(angle)) * (arm @ axis)[:, None] * axis
        folded[i + 2 :] = folded[i] + turned
    return flat, folded, faces


@pytest.mark.parametrize("seed", range(5))
def test_over_folds_a_walk_is_straight_in_the_unfolded_strip(seed: int) -> None:
    flat, folded, faces = folded_strip(12, seed)
    random = np.random.default_rng(seed + 100)
    face = np.zeros(200, np.int64)
    bary = random.dirichlet([1, 1, 1], 200)
    begin = np.einsum("nc,ncd->nd", bary, flat[faces[face]])
    last = np.full(200, len(faces) - 1)
    goal_bary = random.dirichlet([1, 1, 1], 200)
    goal = np.einsum("nc,ncd->nd", goal_bary, flat[faces[last]])
    # The same vector, in the first triangle's plane in space: by its two edges.
    edges_flat = np.stack((flat[1] - flat[0], flat[2] - flat[0]), 1)
    weights = np.linalg.solve(edges_flat, (goal - begin).T).T
    step = weights @ np.stack((folded[1] - folded[0], folded[2] - folded[0]))
    new_face, new_bary = walk(make_surface(folded, faces), face, bary, step)
    # Lines that stay in the strip arrive; the others end on its rim, on the line.
    end = np.einsum("nc,ncd->nd", new_bary, flat[faces[new_face]])
    whole = np.linalg.norm(end - goal, axis=1) < 1e-10
    assert whole.sum() > 20 and (new_face[whole] == len(faces) - 1).all()
    np.testing.assert_allclose(new_bary[whole], goal_bary[whole], atol=1e-9)
    ahead, side = goal - begin, end - begin
    off_line = np.abs(ahead[:, 0] * side[:, 1] - ahead[:, 1] * side[:, 0]) / np.linalg.norm(ahead, axis=1)
    assert off_line.max() < 1e-10
    assert (new_bary[~whole].min(1) == 0).all()


def cone(angles: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Triangles around an apex (vertex 0) with given angles at it, long legs, closed up in space by any means.

    Only the lengths of the edges matter to a walk, so the cone stands on a circle whose vertices lie at the distance
    1 from the apex and at the chords of the angles from each other; angles sum to less than 2 pi.
    """
    chords = 2 * np.sin(angles / 2)
    # Radius of the circle on which the chords close (bisection on the sum of central angles).
    low, high = chords.max() / 2, 1.0
    for _ in range(200):
        middle = 0.5 * (low + high)
        total = 2 * np.arcsin(np.minimum(1.0, chords / (2 * middle))).sum()
        low, high = (middle, high) if total > 2 * np.pi else (low, middle)
    radius = 0.5 * (low + high)
    turn = np.concatenate(([0.0], np.cumsum(2 * np.arcsin(chords / (2 * radius)))))[:-1]
    rim = np.stack((radius * np.cos(turn), radius * np.sin(turn), np.zeros_like(turn)), 1)
    verts = np.concatenate(([[0.0, 0.0, np.sqrt(1 - radius**2)]], rim))
    number = len(angles)
    faces = np.array([[0, 1 + i, 1 + (i + 1) % number] for i in range(number)])
    return verts, faces


def polar(verts: np.ndarray, faces: np.ndarray, angles: np.ndarray, face: int, bary: np.ndarray) -> tuple[float, float]:
    """Distance from the apex and angle around it in the unfolded cone."""
    point, legs = bary @ verts[faces[face]] - verts[0], verts[faces[face]][1:] - verts[0]
    corner = int((faces[face] == 0).argmax())
    legs = np.delete(verts[faces[face]], corner, 0) - verts[0]
    first = legs[0] / np.linalg.norm(legs[0])
    across = legs[1] - (legs[1] @ first) * first
    own = np.arctan2(point @ across / np.linalg.norm(across), point @ first)
    return float(np.linalg.norm(point)), float(angles[:face].sum() + own)


@pytest.mark.parametrize("through", [True, False])
def test_around_and_through_a_vertex(through: bool) -> None:
    random = np.random.default_rng(3)
    for trial in range(30):
        angles = random.uniform(0.5, 1.1, 5)
        verts, faces = cone(angles, trial)
        surface = make_surface(verts, faces)
        face, bary = int(random.integers(5)), random.dirichlet([2, 1, 1])
        bary = 0.4 * bary + 0.6 * np.eye(3)[0]  # well inside the legs
        start = bary @ verts[faces[face]]
        r, phi = polar(verts, faces, angles, face, bary)
        legs = verts[faces[face]][1:] - verts[0]
        inward = (verts[0] - start) / r
        sideways = legs[1] - legs[0]
        sideways -= (sideways @ inward) * inward  # counter-clockwise seen from the apex
        sideways /= np.linalg.norm(sideways)
        aside = 0.0 if through else random.choice([-1, 1]) * random.uniform(0.05, 0.6)
        length = r + 0.5
        heading = np.cos(aside) * inward + np.sin(aside) * sideways
        new_face, new_bary = walk(surface, np.array([face]), bary[None], length * heading[None])
        found_r, found_phi = polar(verts, faces, angles, int(new_face[0]), new_bary[0])
        if through:
            expected_r, expected_phi = 0.5, phi + angles.sum() / 2
        else:  # a straight line in the plane, in polar coordinates about the apex
            x, y = r - length * np.cos(aside), length * np.sin(aside)
            expected_r, expected_phi = np.hypot(x, y), phi + np.arctan2(y, x)
        assert found_r == pytest.approx(expected_r, abs=1e-9)
        turn = angles.sum()
        off = (found_phi - expected_phi + turn / 2) % turn - turn / 2
        assert off == pytest.approx(0, abs=1e-7)


def test_a_vertex_on_the_border_ends_the_walk() -> None:
    verts = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]])
    faces = np.array([[0, 1, 2]])
    face, bary = walk(make_surface(verts, faces), [0], [[0.2, 0.4, 0.4]], [[-1.0, -1.0, 0]])
    np.testing.assert_allclose(at(verts, faces, face, bary), [[0, 0, 0]], atol=1e-12)


def test_slivers_and_faces_without_area_are_crossed_in_line() -> None:
    # Two halves of a square with a zipper of triangles without area between them: vertices 4 and 5 lie on the diagonal.
    verts = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.3, 0.3, 0], [0.7, 0.7, 0]], float)
    faces = np.array([[0, 1, 2], [0, 2, 4], [4, 2, 5], [0, 4, 3], [4, 5, 3], [5, 2, 3]])
    surface = make_surface(verts, faces)
    random = np.random.default_rng(0)
    target = random.uniform(0.05, 0.95, (500, 2))
    begin = np.array([0.6, 0.35, 0.0])
    bary = np.tile([1 - 0.6, 0.6 - 0.35, 0.35], (500, 1))
    step = np.concatenate((target, np.zeros((500, 1))), 1) - begin
    face, bary = walk(surface, np.zeros(500, int), bary, step)
    np.testing.assert_allclose(at(verts, faces, face, bary)[:, :2], target, atol=1e-9)
    # A point on a face without any extent stays where it is.
    dot = make_surface(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    face, bary = walk(dot, [0], [[0.5, 0.25, 0.25]], [[1.0, 2.0, 3.0]])
    assert np.isfinite(bary).all() and bary.sum() == pytest.approx(1)


def test_from_a_vertex_or_an_edge_any_direction_works() -> None:
    verts, faces = square(5, 4)
    surface = make_surface(verts, faces)
    inner = np.flatnonzero((verts[:, :2] > 0.15).all(1) & (verts[:, :2] < 0.85).all(1))
    rows = [(f, c) for f in range(len(faces)) for c in range(3) if faces[f, c] in inner]
    face, corner = np.array(rows).T
    turn = np.linspace(0, 2 * np.pi, len(face))
    step = 0.14 * np.stack((np.cos(turn), np.sin(turn), 0 * turn), 1)
    for bary in (np.eye(3)[corner], 0.5 * np.eye(3)[corner] + 0.5 * np.eye(3)[(corner + 1) % 3]):
        begin = at(verts, faces, face, bary)
        inside = ((begin + step)[:, :2] > 0).all(1) & ((begin + step)[:, :2] < 1).all(1)
        end = at(verts, faces, *walk(surface, face, bary, step))
        np.testing.assert_allclose(end[inside], (begin + step)[inside], atol=1e-9)


def bumpy_dome(side: int) -> tuple[np.ndarray, np.ndarray]:
    verts, faces = square(side, 9)
    verts = verts.copy()
    verts[:, 2] = 0.2 * np.sin(5 * verts[:, 0]) * np.cos(4 * verts[:, 1]) + 0.02 * np.sin(40 * verts[:, 0])
    return verts, faces


@pytest.mark.parametrize("rounds", [2, pytest.param(50, marks=pytest.mark.slow)])
def test_a_million_random_steps_stay_on_the_surface(rounds: int) -> None:
    verts, faces = bumpy_dome(25)
    surface = make_surface(verts, faces)
    random = np.random.default_rng(5)
    face, bary = starts(faces, 20_000, random)
    for _ in range(rounds):
        step = random.normal(size=(20_000, 3)) * 0.02
        before = at(verts, faces, face, bary)
        face, bary = walk(surface, face, bary, step)
        assert face.min() >= 0 and face.max() < len(faces)
        assert bary.min() >= 0 and np.abs(bary.sum(1) - 1).max() < 1e-12
        # A path on the surface is never shorter than the chord.
        moved = np.linalg.norm(at(verts, faces, face, bary) - before, axis=1)
        assert (moved <= np.linalg.norm(step, axis=1) + 1e-12).all()


def test_tangents_change_the_coordinates_they_say() -> None:
    verts, faces = bumpy_dome(6)
    surface = make_surface(verts, faces)
    random = np.random.default_rng(6)
    face = random.integers(len(faces), size=100)
    bary = 0.1 * random.dirichlet([1, 1, 1], 100) + 0.9 / 3
    change = 0.2 * (random.dirichlet([1, 1, 1], 100) - 1 / 3)
    new_face, new_bary = walk(surface, face, bary, tangents(surface, face, change))
    assert (new_face == face).all()
    np.testing.assert_allclose(new_bary, bary + change, atol=1e-12)
