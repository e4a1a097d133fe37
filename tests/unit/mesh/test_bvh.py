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


def test_rays_and_winding_numbers_agree_also_where_rays_meet_edges():
    """Points along the axes of a symmetric mesh, and on its vertices, edges and faces."""
    verts, faces = round_head(400)
    mesh = DeformingMesh(verts, faces)
    line = np.linspace(-0.15, 0.15, 101)
    axes = np.concatenate([np.outer(line, axis) for axis in np.eye(3)])
    middles = mesh.verts[mesh.closed_faces].mean(axis=1)
    points = np.concatenate((axes, 0.999 * mesh.verts, 1.001 * mesh.verts, 0.99 * middles))
    exact = igl.winding_number(mesh.verts, mesh.closed_faces, points)
    clear = np.abs(exact - 0.5) > 1e-6
    np.testing.assert_array_equal(mesh.inside(points)[clear], (exact > 0.5)[clear])


def test_a_surface_that_fans_cannot_close_falls_back_to_winding_numbers():
    verts, faces = round_head(400)
    # Every face twice in one place: edges with four faces, and a hole beside them.
    bad = np.concatenate((faces[5:], faces[40:44], faces[40:44, ::-1], faces[60:62]))
    mesh = DeformingMesh(verts, bad)
    points = np.random.default_rng(0).normal(size=(300, 3)) * 0.06
    exact = igl.winding_number(mesh.verts, mesh.closed_faces, points)
    clear = np.abs(exact - 0.5) > 0.1
    np.testing.assert_array_equal(mesh.inside(points)[clear], (exact > 0.5)[clear])


def _dips_by_rays(mesh: DeformingMesh, points: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Every edge against every face."""
    corners = mesh.verts[mesh.closed_faces]
    result = np.full(len(edges), np.nan)
    for i, (a, b) in enumerate(edges):
        p, d = points[a], points[b] - points[a]
        e, g, s = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], p - corners[:, 0]
        det = np.einsum("fi,fi->f", e, np.cross(d, g))
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.einsum("fi,fi->f", s, np.cross(d, g)) / det
            v = np.cross(s, e) @ d / det
            t = np.einsum("fi,fi->f", g, np.cross(s, e)) / det
            hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0) & (t <= 1)
        order = np.flatnonzero(hit)[np.argsort(t[hit])]
        if len(order) >= 2 and det[order[0]] > 0:
            result[i] = t[order[:2]].mean()
    return result


def test_edges_that_dip_in_are_found(mesh):
    rng = np.random.default_rng(2)
    points = np.concatenate((_points(mesh)[:300], mesh.verts.mean(0) + 0.2 * rng.normal(size=(100, 3))))
    edges = rng.integers(0, len(points), (600, 2))
    found, expected = mesh.dips(points, edges), _dips_by_rays(mesh, points, edges)
    assert np.isfinite(expected).sum() > 30
    np.testing.assert_allclose(found, expected, atol=1e-9)
    inner = np.flatnonzero(np.isfinite(found))
    a, b = points[edges[inner]].transpose(1, 0, 2)
    assert mesh.inside(a + found[inner, None] * (b - a)).all()


@pytest.mark.parametrize("distance", [0.0, 0.002, 0.02])
def test_clear_means_nothing_near_and_nothing_inside(distance):
    """Never true where libigl finds a vertex inside or near; always true where the hand is well off."""
    verts, faces = round_head(900)
    hand, hand_faces = capsule_hand(300)
    rng = np.random.default_rng(1)
    head, other = DeformingMesh(verts, faces), DeformingMesh(hand, hand_faces)
    answers = []
    for _ in range(60):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        placed = hand @ turn.T + rng.normal(size=3) * 0.1
        other.move(placed)
        answers.append(head.clear_of(other, distance))
        nearest = np.sqrt(igl.point_mesh_squared_distance(placed, verts, faces)[0].min())
        inside = igl.winding_number(head.verts, head.closed_faces, placed).max() > 0.5
        inside |= igl.winding_number(other.verts, other.closed_faces, verts).max() > 0.5
        if answers[-1]:
            assert nearest > distance and not inside
        elif nearest > distance + 0.02:
            assert inside
    assert 5 < sum(answers) < 55


def test_a_small_mesh_inside_a_large_one_is_not_clear():
    verts, faces = round_head(400)
    large, small = DeformingMesh(verts, faces), DeformingMesh(0.2 * verts, faces)
    assert not large.clear_of(small, 0.001) and not small.clear_of(large, 0.001)
    small.move(0.2 * verts + [0.2, 0, 0])
    assert large.clear_of(small, 0.001)
