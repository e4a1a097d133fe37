"""Connectivity against trimesh, Euler's formula and hand-made meshes."""

import numpy as np
import pytest
import trimesh

from nbavatar.errors import DataError
from nbavatar.mesh.topology import (
    boundary_edges,
    boundary_loops,
    edges,
    mesh_defects,
    unreferenced_vertices,
    validate_mesh,
    vertex_adjacency,
    vertex_components,
)


@pytest.fixture
def two_balls() -> tuple[np.ndarray, np.ndarray]:
    """An icosphere (42 vertices), then an unreferenced vertex, then a cylinder without caps."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    tube = trimesh.creation.cylinder(radius=1, height=2, sections=9)
    side = tube.faces[np.abs(tube.face_normals[:, 2]) < 0.5]
    verts = np.concatenate((ball.vertices, [[9.0, 9, 9]], tube.vertices + [5, 0, 0]))
    return verts, np.concatenate((ball.faces, side + 43)).astype(np.int64)


def test_edges_equal_trimesh_and_euler(two_balls):
    verts, faces = two_balls
    mesh = trimesh.Trimesh(verts, faces, process=False)
    np.testing.assert_array_equal(edges(faces), np.unique(np.sort(mesh.edges_unique, axis=1), axis=0))
    ball = faces[(faces < 42).all(1)]
    assert 42 - len(edges(ball)) + len(ball) == 2


def test_components_are_numbered_by_first_vertex_and_skip_unreferenced(two_balls):
    verts, faces = two_balls
    component = vertex_components(faces, len(verts))
    assert (component[:42] == 0).all() and component[42] == -1
    used = np.unique(faces[faces > 42])
    assert (component[used] == 1).all()
    np.testing.assert_array_equal(unreferenced_vertices(faces, len(verts)), np.setdiff1d(np.arange(len(verts)), faces))
    # Renumbering moves the labels with the vertices.
    order = np.random.default_rng(0).permutation(len(verts))
    back = np.argsort(order)
    renumbered = vertex_components(back[faces], len(verts))[back]
    np.testing.assert_array_equal(renumbered == renumbered[0], component == component[0])


def test_boundary_loops_of_an_open_cylinder(two_balls):
    verts, faces = two_balls
    loops = boundary_loops(faces)
    assert [len(loop) for loop in loops] == [9, 9]
    assert len(boundary_edges(faces)) == 18
    for loop in loops:
        assert np.ptp(verts[loop, 2]) < 1e-12
        # Consecutive vertices are border edges, in the direction of their face.
        pairs = {tuple(pair) for pair in boundary_edges(faces).tolist()}
        assert {(a, b) for a, b in zip(loop.tolist(), np.roll(loop, -1).tolist(), strict=True)} <= pairs


def test_two_holes_that_touch_in_a_vertex_use_every_border_edge_once():
    faces = np.array([[0, 1, 2], [0, 3, 4]])
    loops = boundary_loops(faces)
    assert sum(map(len, loops)) == 6 and len(loops) == 2


def test_many_holes_that_touch_use_every_border_edge_once():
    faces = np.asarray(trimesh.creation.icosphere(subdivisions=3).faces, np.int64)
    faces = faces[np.random.default_rng(0).permutation(len(faces))[:900]]
    loops = boundary_loops(faces)
    found = [pair for loop in loops for pair in zip(loop.tolist(), np.roll(loop, -1).tolist(), strict=True)]
    assert sorted(found) == sorted(map(tuple, boundary_edges(faces).tolist()))


def test_borders_adjacency_and_components_of_any_faces():
    # Faces drawn at random: non-manifold edges, holes that touch, vertices without a face, none at all.
    rng = np.random.default_rng(3)
    for count in (0, 1, 7, 60, 300):
        faces = np.array([rng.permutation(40)[:3] for _ in range(count)], np.int64).reshape(-1, 3)
        directed = [(f[i], f[(i + 1) % 3]) for f in faces.tolist() for i in range(3)]
        uses = {}
        for a, b in directed:
            uses.setdefault((min(a, b), max(a, b)), []).append((a, b))
        expected = sorted(found[0] for found in uses.values() if len(found) == 1)
        assert sorted(map(tuple, boundary_edges(faces).tolist())) == expected
        matrix = vertex_adjacency(faces, 45)
        assert matrix.shape == (45, 45) and matrix.nnz == 2 * len(uses) and (matrix.data == 1.0).all()
        assert all(matrix[a, b] == matrix[b, a] == 1.0 for a, b in uses)
        # Components by spreading the smallest id along edges until nothing changes.
        label = np.arange(45)
        for _ in range(45):
            for a, b in uses:
                label[[a, b]] = min(label[a], label[b])
        used = np.unique(faces)
        component = vertex_components(faces, 45)
        np.testing.assert_array_equal(component[used], np.unique(label[used], return_inverse=True)[1])
        assert (np.delete(component, used) == -1).all()


def test_adjacency_equals_trimesh(two_balls):
    verts, faces = two_balls
    mesh = trimesh.Trimesh(verts, faces, process=False)
    matrix = vertex_adjacency(faces, len(verts))
    assert (matrix != matrix.T).nnz == 0
    for v in (0, 17, 50):
        assert matrix.indices[matrix.indptr[v] : matrix.indptr[v + 1]].tolist() == sorted(mesh.vertex_neighbors[v])


def test_defects_are_found_and_only_they():
    verts = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0.5, 0, 0], [0, 0, 1], [7, 7, 7.0]])
    faces = np.array([[0, 1, 2], [1, 3, 2], [2, 0, 1], [0, 4, 1], [5, 5, 0], [0, 1, 5]])
    defects = mesh_defects(verts, faces)
    assert defects.unreferenced.tolist() == [6]
    assert defects.repeated_vertex.tolist() == [4]
    assert defects.duplicate.tolist() == [2]
    assert defects.zero_area.tolist() == [3, 4]
    assert [0, 1] in defects.non_manifold.tolist()
    clean = mesh_defects(*(np.asarray(x) for x in (lambda m: (m.vertices, m.faces))(trimesh.creation.icosphere())))
    assert all(len(field) == 0 for field in clean)


def test_inconsistent_orientation_is_named():
    verts = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.0]])
    assert mesh_defects(verts, np.array([[0, 1, 2], [1, 2, 3]])).inconsistent.tolist() == [[1, 2]]
    assert len(mesh_defects(verts, np.array([[0, 1, 2], [2, 1, 3]])).inconsistent) == 0


@pytest.mark.parametrize(
    ("verts", "faces", "words"),
    [
        (np.zeros((4, 2)), np.array([[0, 1, 2]]), ("verts", "(4, 2)")),
        (np.zeros((4, 3)), np.array([[0, 1, 4]]), ("faces", "0 to 3", "count from 1")),
        (np.zeros((4, 3)), np.array([[0.0, 1, 2]]), ("faces", "float64")),
        (np.full((2, 4, 3), [[[0.0]], [[np.nan]]]), np.array([[0, 1, 2]]), ("frame 1", "vertex 0")),
    ],
)
def test_bad_arrays_are_refused_in_one_line(verts, faces, words):
    with pytest.raises(DataError) as error:
        validate_mesh(verts, faces, "head of a.npz")
    line = str(error.value)
    assert "\n" not in line and line.startswith("head of a.npz") and all(word in line for word in words)


def test_good_arrays_pass(two_balls):
    validate_mesh(*two_balls, "mesh")
