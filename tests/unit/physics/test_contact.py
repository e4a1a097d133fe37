"""Whole frames of contact: nothing left inside anything, at any depth, on any input."""

import dataclasses
import functools

import igl
import numpy as np
import pytest

from nbavatar.mesh.bvh import DeformingMesh
from nbavatar.physics.contact import ContactNumbers, ContactSolver, FrameResult
from nbavatar.physics.rigid import rigid_motion
from nbavatar.physics.sequence import enclosed_volume
from nbavatar.physics.shapes import capsule_hand, press, round_head
from nbavatar.physics.tissue import bed_stiffness, soft_surface, tissue_thickness

HEAD, FACES = round_head(1600)
HAND, HAND_FACES = capsule_hand(300, fingers=2)


@functools.cache
def _surface(modulus: float = 1e4):
    return soft_surface(HEAD, FACES, bed_stiffness(tissue_thickness(HEAD, FACES), modulus))


def _solver(modulus: float = 1e4, pinned: np.ndarray | None = None, **numbers) -> ContactSolver:
    chosen = dataclasses.replace(ContactNumbers(), **numbers)
    return ContactSolver(_surface(modulus), HEAD, [(HAND, HAND_FACES)], chosen, pinned)


def _depth_of(points: np.ndarray, verts: np.ndarray, faces: np.ndarray) -> float:
    """Deepest of points inside a mesh, by libigl [m]."""
    closed = DeformingMesh(verts, faces)
    inside = igl.winding_number(closed.verts, closed.closed_faces, points) > 0.5
    return float(np.sqrt(igl.point_mesh_squared_distance(points[inside], verts, faces)[0].max())) if inside.any() else 0


def _depth(head: np.ndarray, hand: np.ndarray) -> float:
    """Deepest vertex of either part inside the other [m]."""
    return max(_depth_of(hand, head, FACES), _depth_of(head, hand, HAND_FACES))


@pytest.mark.parametrize("depth", [0.001, 0.005, 0.012, 0.02])
def test_nothing_is_left_inside_anything(depth):
    hand = press(HAND, depth)
    assert _depth(HEAD, hand) > 0.5 * depth
    result = _solver().solve(HEAD, [hand])
    assert _depth(result.head, result.hands[0]) < 2e-4
    assert not result.exceeded or depth > 0.01
    volume = DeformingMesh(HEAD, FACES)
    assert abs(enclosed_volume(volume, result.head) / enclosed_volume(volume, HEAD) - 1) < 5e-3


def _deepest_of_surfaces(head: np.ndarray, hand: np.ndarray) -> float:
    """Like `_depth`, of 28 points on every face instead of the vertices."""
    share = np.array([(i, j, 6 - i - j) for i in range(7) for j in range(7 - i)]) / 6.0
    deepest = 0.0
    for verts, faces, other, other_faces in ((hand, HAND_FACES, head, FACES), (head, FACES, hand, HAND_FACES)):
        corners = verts[faces]
        near = (corners.max(1) > other.min(0)).all(1) & (corners.min(1) < other.max(0)).all(1)
        points = np.einsum("sc,fci->fsi", share, corners[near]).reshape(-1, 3)
        deepest = max(deepest, _depth_of(points, other, other_faces))
    return deepest


@pytest.mark.parametrize("depth", [0.003, 0.008, 0.014])
def test_faces_do_not_cut_through_each_other_between_their_vertices(depth):
    result = _solver().solve(HEAD, [press(HAND, depth)])
    assert _deepest_of_surfaces(result.head, result.hands[0]) < 2e-4


def test_an_edge_that_dips_in_between_two_outer_vertices_is_contact():
    """A needle laid flat into the cheek: all its vertices are outside, its long edges are 1 mm inside."""
    needle = np.array([[-0.09, 0.0, 0], [0.09, 0.0, 0], [0.0, 0.0, 0.006], [0.0, 0.003, 0.006], [0.0, -0.003, 0.006]])
    faces = np.array([[0, 2, 4], [0, 3, 2], [1, 4, 2], [1, 2, 3], [0, 4, 1], [0, 1, 3]])
    placed = press(needle[:, [1, 0, 2]], 0.001)
    assert _depth_of(placed, HEAD, FACES) == 0
    result = ContactSolver(_surface(), HEAD, [(needle, faces)], ContactNumbers()).solve(HEAD, [placed])
    assert result.depth[0] > 5e-4 and result.depth[1] < 2e-4 and result.active > 0


def test_the_dent_is_where_the_hand_is_and_fades_out():
    result = _solver(hand_shift=0.0, hand_turn=0.0).solve(HEAD, [press(HAND, 0.01)])
    moved = np.linalg.norm(result.head - HEAD, axis=1)
    distance = np.linalg.norm(HEAD[:, None] - result.hands[0][None], axis=2).min(axis=1)
    assert distance[moved.argmax()] < 0.015
    assert moved[distance > 0.06].max() == 0
    assert moved[(distance > 0.03)].max() < 0.25 * moved.max()
    assert 0.007 < moved.max() < 0.013
    # Neighbours of what moves move too: the dent is no spike.
    assert (moved > 1e-3).sum() > 15


@pytest.mark.parametrize("gap", [0.0005, 0.004, 0.3])
def test_free_frames_are_returned_as_they_are(gap):
    hand = press(HAND, -gap)
    result = _solver().solve(HEAD, [hand])
    assert result.active == 0 and not result.exceeded
    np.testing.assert_array_equal(result.head, HEAD)
    np.testing.assert_array_equal(result.hands[0], hand)
    assert result.head_contact.any() == (gap < 0.002)


def test_without_contact_only_everything_is_simulated():
    solver, everywhere = _solver(), _solver(contact_only=False)
    free = everywhere.solve(HEAD, [press(HAND, -0.3)])
    assert free.active == len(HEAD) and free.steps > 0
    np.testing.assert_allclose(free.head, HEAD, atol=1e-12)
    np.testing.assert_array_equal(free.hands[0], press(HAND, -0.3))
    near, whole = (one.solve(HEAD, [press(HAND, 0.006)]) for one in (solver, everywhere))
    assert near.active < len(HEAD) == whole.active
    assert _depth(whole.head, whole.hands[0]) < 2e-4
    # Beyond the reach of contact nothing moves much: the local answer stands for the whole one.
    np.testing.assert_allclose(near.head, whole.head, atol=1e-3)


def test_deterministic():
    first, second = (_solver().solve(HEAD, [press(HAND, 0.012)]) for _ in range(2))
    assert first.head.tobytes() == second.head.tobytes() and first.hands[0].tobytes() == second.hands[0].tobytes()


def test_a_fast_finger_does_not_tunnel():
    """Before: 6 cm away. Now: 15 mm deep. The skin is pushed ahead on the side that the finger came from."""
    solver = _solver()
    away, deep = press(HAND, -0.06), press(HAND, 0.015)
    before = solver.solve(HEAD, [away])
    result = solver.solve(HEAD, [deep], before, HEAD, [away])
    assert _depth(result.head, result.hands[0]) < 2e-4
    outward = press(np.zeros((1, 3)), -1.0)[0] - press(np.zeros((1, 3)), 0.0)[0]
    assert ((result.head - HEAD) @ outward).min() < -0.008


def test_equivariant_under_rigid_motion():
    rotation, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    rotation *= np.linalg.det(rotation)
    shift = np.array([0.4, -1.0, 2.0])
    hand = press(HAND, 0.006)
    here = _solver().solve(HEAD, [hand])
    there = _solver().solve(HEAD @ rotation.T + shift, [hand @ rotation.T + shift])
    np.testing.assert_allclose(there.head, here.head @ rotation.T + shift, atol=2e-4)


@pytest.mark.parametrize("modulus", [0.0, 1e-3, 1e4, 1e12])
def test_any_stiffness_resolves_contact(modulus):
    result = _solver(modulus).solve(HEAD, [press(HAND, 0.006)])
    assert np.isfinite(result.head).all() and _depth(result.head, result.hands[0]) < 2e-4


@pytest.mark.parametrize("time_step", [1e-6, 1e-3, 1.0])
def test_any_time_step_resolves_contact(time_step):
    result = _solver(time_step=time_step).solve(HEAD, [press(HAND, 0.006)])
    assert np.isfinite(result.head).all() and _depth(result.head, result.hands[0]) < 2e-4


@pytest.mark.parametrize("density", [0.0, 1e-12, 1e6])
def test_any_mass_resolves_contact(density):
    result = _solver(density=density).solve(HEAD, [press(HAND, 0.006)])
    assert np.isfinite(result.head).all() and _depth(result.head, result.hands[0]) < 2e-4


def test_pinned_vertices_stay_and_what_is_left_is_said():
    pinned = np.arange(len(HEAD))
    result = _solver(pinned=pinned, hand_shift=0.002).solve(HEAD, [press(HAND, 0.01)])
    np.testing.assert_array_equal(result.head, HEAD)
    assert result.exceeded and result.depth[1] > 0.005
    assert np.linalg.norm(result.pose[0, :3]) <= 0.002 + 1e-12


def test_stiff_bone_moves_the_hand_soft_tissue_does_not():
    bone = _solver(1e9).solve(HEAD, [press(HAND, 0.002)])
    flesh = _solver(1e3).solve(HEAD, [press(HAND, 0.002)])
    assert np.linalg.norm(bone.pose[0, :3]) > 2 * np.linalg.norm(flesh.pose[0, :3])


@pytest.mark.parametrize("depth", [0.06, 0.1, 0.14])
def test_a_hand_through_the_head_is_reported_not_a_crash(depth):
    result = _solver().solve(HEAD, [press(HAND, depth)])
    assert np.isfinite(result.head).all() and result.exceeded
    assert np.linalg.norm(result.head - HEAD, axis=1).max() <= ContactNumbers().max_dent + 1e-9


@pytest.mark.parametrize("defect", ["inside_out_hand", "inverted_face", "zero_area", "repeated_vertex", "unreferenced"])
def test_defective_meshes_are_worked_on(defect):
    head, faces, hand_faces = HEAD.copy(), FACES.copy(), HAND_FACES
    if defect == "inside_out_hand":
        hand_faces = HAND_FACES[:, ::-1]
    elif defect == "inverted_face":
        faces[700] = faces[700][::-1]
    elif defect == "zero_area":
        head[faces[700, 0]] = head[faces[700, 1]]
    elif defect == "repeated_vertex":
        faces[700] = faces[700, 0]
    else:
        head = np.concatenate((head, [[5.0, 5.0, 5.0]]))
    surface = soft_surface(head, faces, np.full(len(head), 1e6))
    result = ContactSolver(surface, head, [(HAND, hand_faces)], ContactNumbers()).solve(head, [press(HAND, 0.006)])
    assert np.isfinite(result.head).all()
    closed = DeformingMesh(result.head, FACES)
    inside = igl.winding_number(closed.verts, closed.closed_faces, result.hands[0]) > 0.5
    depth = np.sqrt(igl.point_mesh_squared_distance(result.hands[0], result.head, FACES)[0])
    assert depth[inside].max(initial=0) < 2e-4


def test_two_hands_are_corrected_on_their_own():
    other = HAND + [0.0, 0.0, 0.0]
    solver = ContactSolver(_surface(), HEAD, [(HAND, HAND_FACES), (other, HAND_FACES)], ContactNumbers())
    mirrored = press(HAND, 0.006) * [-1.0, 1.0, -1.0]  # turned half a round about y: the other side of the head
    result = solver.solve(HEAD, [press(HAND, 0.006), mirrored])
    assert all(_depth(result.head, hand) < 2e-4 for hand in result.hands)
    assert not np.allclose(result.pose[0], result.pose[1])


def test_rigid_motion_is_recovered():
    rotation, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
    rotation *= np.linalg.det(rotation)
    found, shift = rigid_motion(HEAD, HEAD @ rotation.T + [1.0, 2.0, 3.0])
    np.testing.assert_allclose(found, rotation, atol=1e-12)
    np.testing.assert_allclose(shift, [1.0, 2.0, 3.0], atol=1e-12)


def test_result_names_its_fields():
    assert FrameResult._fields[:3] == ("head", "hands", "pose")
