"""Edges over time, seams, inside and outside, on shapes whose truth is known."""

import numpy as np
import pytest

from nbavatar.mesh.consistency import (
    edge_lengths,
    edges_apart,
    reference_lengths,
    seam_welds,
    signed_volume,
    torn_edges,
)
from nbavatar.mesh.topology import boundary_loops, edges


def grid(columns, rows):
    """A rectangle of columns x rows squares, one unit each, in the plane z = 0."""
    x, y = np.meshgrid(np.arange(columns + 1.0), np.arange(rows + 1.0))
    verts = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    a = (np.arange(columns) + (columns + 1) * np.arange(rows)[:, None]).ravel()
    b, c = a + 1, a + columns + 1
    return verts, np.concatenate([np.stack([a, b, c], 1), np.stack([b, c + 1, c], 1)])


def tetrahedron():
    verts = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    return verts, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def test_volume_of_a_tetrahedron_is_a_sixth_and_changes_sign_with_the_winding():
    verts, faces = tetrahedron()
    assert signed_volume(verts, faces) == pytest.approx(1 / 6)
    assert signed_volume(verts, faces[:, ::-1]) == pytest.approx(-1 / 6)
    assert signed_volume(verts + [1e5, 0, 0], faces) == pytest.approx(1 / 6, rel=1e-9)
    assert signed_volume(verts * [-1, 1, 1], faces) == pytest.approx(-1 / 6), "mirrored"


def test_edges_of_another_order_are_apart_and_those_of_a_bent_sheet_are_not(rng):
    verts, faces = grid(12, 9)
    pairs = edges(faces)
    angle = verts[:, 0] / 12 * np.pi
    bent = np.stack([12 / np.pi * np.sin(angle), verts[:, 1], 12 / np.pi * np.cos(angle)], axis=1)
    reference = reference_lengths([verts, bent, verts], pairs)
    assert max(edges_apart(edge_lengths(bent, pairs), reference)) < 1.02
    assert edges_apart(edge_lengths(verts[rng.permutation(len(verts))], pairs), reference)[0] > 3
    for factor in (1000, 1.3, 1 / 1.3):
        apart = edges_apart(edge_lengths(verts * factor, pairs), reference)
        assert apart == pytest.approx((max(factor, 1 / factor),) * 2)
    # A sheet that is stretched one way and squeezed the other has as many edges that grow as edges that shrink.
    apart, grown = edges_apart(edge_lengths(verts * [1.3, 1 / 1.3, 1], pairs), reference)
    assert apart > 1.15 and grown < 1.1


def test_of_two_frames_the_shorter_edges_are_the_reference():
    verts, faces = grid(3, 3)
    pairs = edges(faces)
    np.testing.assert_array_equal(reference_lengths([verts * 50, verts], pairs), edge_lengths(verts, pairs))


def test_two_vertices_that_were_exchanged_tear_their_edges():
    verts, faces = grid(12, 9)
    pairs = edges(faces)
    reference = edge_lengths(verts, pairs)
    order = np.arange(len(verts))
    order[[3, 120]] = order[[120, 3]]
    torn = torn_edges(edge_lengths(verts[order], pairs), reference, 15.0)
    assert set(pairs[torn].ravel()) >= {3, 120} and all(3 in pair or 120 in pair for pair in pairs[torn].tolist())
    assert not len(torn_edges(reference * 1.5, reference, 15.0))


def test_a_mouth_that_opens_is_not_torn_and_a_block_of_vertices_in_another_order_is():
    verts, faces = grid(40, 30)
    pairs = edges(faces)
    reference = edge_lengths(verts, pairs)
    opened = reference.copy()
    opened[:20] *= 9  # 20 of 3,670 edges
    assert not len(torn_edges(opened, reference, 50.0))
    order = np.concatenate([np.random.default_rng(0).permutation(80), np.arange(80, len(verts))])
    torn = torn_edges(edge_lengths(verts[order], pairs), reference, 50.0)
    assert len(torn) > 50 and pairs[torn].min(axis=1).max() < 80


def split(verts, faces, column):
    """The grid with its vertices doubled along one column, as texture coordinates would."""
    seam = np.flatnonzero(verts[:, 0] == column)
    copies = {int(v): len(verts) + i for i, v in enumerate(seam)}
    right = verts[faces, 0].mean(1) > column
    faces = faces.copy()
    faces[right] = np.vectorize(lambda v: copies.get(v, v))(faces[right])
    return np.concatenate([verts, verts[seam]]), faces


def test_a_seam_is_no_border():
    verts, faces = grid(6, 4)
    apart, cut = split(verts, faces, 3)
    assert len(boundary_loops(cut)) == 2
    welded = seam_welds([apart, apart + 1e-7], cut)
    np.testing.assert_array_equal(welded[cut], faces)
    assert [len(loop) for loop in boundary_loops(welded[cut])] == [20]


def test_what_parts_in_some_frame_was_not_one():
    verts, faces = grid(6, 4)
    apart, cut = split(verts, faces, 3)
    later = apart.copy()
    later[np.unique(cut[faces[:, 0] != cut[:, 0]])] += [0.01, 0, 0]
    later[len(verts) :] += [0.01, 0, 0]
    np.testing.assert_array_equal(seam_welds([apart, later], cut), np.arange(len(apart)))


def test_corners_of_one_face_and_the_inside_of_a_surface_are_left_alone():
    verts, faces = grid(3, 1)
    verts[1] = verts[0]  # a face without area
    np.testing.assert_array_equal(seam_welds([verts], faces), np.arange(len(verts)))
    verts, faces = tetrahedron()
    np.testing.assert_array_equal(seam_welds([verts * 0], faces), np.arange(4))


def test_triangles_that_share_no_vertex_become_one_surface():
    verts, faces = grid(5, 5)
    soup, alone = verts[faces.ravel()], np.arange(faces.size).reshape(-1, 3)
    welded = seam_welds([soup], alone)[alone]
    assert len(np.unique(welded)) == len(verts)
    assert [len(loop) for loop in boundary_loops(welded)] == [20]
