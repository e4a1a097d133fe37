"""Distance and inside queries against libigl."""

import igl
import numpy as np
import pytest

from nbavatar.mesh.bvh import DeformingMesh, surface_points
from nbavatar.physics.shapes import capsule_hand, round_head


@pytest.fixture(params=["head", "hand"])
def mesh(request) -> DeformingMesh:
    verts, faces = round_head(900) if request.param == "head" else capsule_hand(400)
    bent = verts + 0.003 * np.sin(40 * verts[:, [1, 2, 0]])
    found = DeformingMesh(verts, faces)
    found.move(bent)
    return found


def _points(mesh: DeformingMesh) -> np.ndarray:
    rng = np.random.default_rng(0)
    near = mesh.verts[rng.integers(0, len(mesh.verts), 1500)] + 0.004 * rng.normal(size=(1500, 3))
    return np.concatenate((near, mesh.verts.mean(0) + 0.08 * rng.normal(size=(500, 3)), mesh.verts[:50]))


def test_closest_points_equal_libigl(mesh):
    points = _points(mesh)
    distance, face, weight = mesh.closest(points, np.inf)
    expected = igl.point_mesh_squared_distance(points, mesh.verts, mesh.faces)[0]
    np.testing.assert_allclose(distance, np.sqrt(expected), atol=1e-15)
    nearest = surface_points(mesh.verts, mesh.faces, face, weight)
    np.testing.assert_allclose(np.linalg.norm(nearest - points, axis=1), distance, atol=1e-12)
    np.testing.assert_allclose(weight.sum(1), 1, atol=1e-12)
    assert (weight >= 0).all()


def test_radius_only_leaves_out_what_is_farther(mesh):
    points = _points(mesh)
    everything, _, _ = mesh.closest(points, np.inf)
    distance, face, _ = mesh.closest(points, 0.005)
    np.testing.assert_array_equal(np.isfinite(distance), everything < 0.005)
    np.testing.assert_array_equal(distance[face >= 0], everything[face >= 0])


def test_winding_numbers_and_sides_equal_libigl(mesh):
    points = _points(mesh)[:2000]
    exact = igl.winding_number(mesh.verts, mesh.closed_faces, points)
    # The dipoles of far clusters cost up to some hundredths: nothing near one half is affected on a closed surface.
    np.testing.assert_allclose(mesh.winding(points), exact, atol=0.1)
    np.testing.assert_array_equal(mesh.inside(points), exact > 0.5)
    signed, _, _ = mesh.signed(points, np.inf)
    clear = np.abs(signed) > 1e-9
    np.testing.assert_array_equal((signed < 0)[clear], (exact > 0.5)[clear])


def test_two_shells_one_inside_the_other_are_inside():
    """An eyeball in a head: the winding number is 2 there, and still inside."""
    verts, faces = round_head(400)
    both = DeformingMesh(np.concatenate((verts, 0.3 * verts)), np.concatenate((faces, faces + len(verts))))
    inside = both.inside(np.array([[0.0, 0, 0], [0.0, 0.05, 0.0], [0.0, 0.2, 0.0]]))
    assert inside.tolist() == [True, True, False]


def test_faces_that_repeat_a_vertex_are_passed_over():
    verts, faces = capsule_hand(200, fingers=1)
    bad = np.concatenate((faces[:10], [[5, 5, 5], [7, 7, 8]], faces[10:]))
    points = np.random.default_rng(1).normal(size=(200, 3)) * 0.02
    clean, broken = DeformingMesh(verts, faces), DeformingMesh(verts, bad)
    np.testing.assert_array_equal(clean.closest(points, np.inf)[0], broken.closest(points, np.inf)[0])
    np.testing.assert_array_equal(clean.inside(points), broken.inside(points))
    face = broken.closest(points, np.inf)[1]
    assert not np.isin(face, [10, 11]).any()
