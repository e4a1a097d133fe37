"""Figures of the validation, on fields whose answer is known; and the stiffness heuristic's order of regions."""

import numpy as np
import pytest

from nbavatar.mesh.bvh import DeformingMesh
from nbavatar.physics.shapes import capsule_hand, press, round_head
from nbavatar.physics.tissue import bed_stiffness, tissue_thickness
from nbavatar.physics.validation import compare_deformation, compare_labels, head_distances, plausibility, vertex_areas


def test_comparison_of_known_fields():
    reference = np.zeros((1, 4, 3))
    reference[0, :, 2] = [-0.004, -0.002, 0.0, 0.0]
    ours = reference.copy()
    ours[0, 0] = [0.003, 0.0, -0.004]
    touching = np.array([[True, False, True, False]])
    labels = np.array([[True, True, False, False]])
    figures = compare_deformation(ours, reference, touching, labels)
    np.testing.assert_allclose(figures["mean_mm"], 1.5)
    np.testing.assert_allclose(figures["max_mm"], 3.0)
    np.testing.assert_allclose(figures["reference_mm"], 3.0)
    np.testing.assert_allclose(figures["cosine"], (0.8 + 1.0) / 2)
    np.testing.assert_allclose(figures["moved_cosine"], (0.8 + 1.0) / 2)
    assert (figures["contact_precision"], figures["contact_recall"], figures["contact_f1"]) == (0.5, 0.5, 0.5)


def test_comparison_with_itself_is_perfect_and_with_nothing_is_the_reference():
    field = np.random.default_rng(0).normal(size=(2, 30, 3)) * 0.003
    labels = np.ones((2, 30), bool)
    same = compare_deformation(field, field, labels, labels)
    assert same["mean_mm"] == 0 and same["contact_f1"] == 1
    np.testing.assert_allclose(same["cosine"], 1.0)
    nothing = compare_deformation(field * 0, field, ~labels, labels)
    np.testing.assert_allclose(nothing["mean_mm"], nothing["reference_mm"])
    assert nothing["contact_f1"] == 0


def test_directions_are_compared_on_contact_apart_from_the_rim():
    """One vertex under the hand agrees, one beside it bulges the other way."""
    reference, ours = np.zeros((1, 2, 3)), np.zeros((1, 2, 3))
    reference[0, :, 2], ours[0, :, 2] = -0.002, [-0.003, 0.001]
    figures = compare_deformation(ours, reference, np.ones((1, 2), bool), np.array([[True, False]]))
    assert figures["cosine"] == 1.0 and figures["moved_cosine"] == 0.0


def test_the_touch_distance_of_a_reference_is_found():
    distance = np.random.default_rng(0).uniform(0, 0.02, (3, 400))
    agreement = compare_labels(distance, distance < 0.004)
    assert agreement["best_touch_mm"] == 4.0 and agreement["f1"] == agreement["precision"] == agreement["recall"] == 1
    scores = agreement["f1_by_touch_mm"]
    assert isinstance(scores, dict) and scores["2"] < scores["3"] < scores["4"] > scores["5"] > scores["10"]


def test_distances_of_the_head_are_the_nearest_hands():
    import igl

    (head, faces), (hand, hand_faces) = round_head(900), capsule_hand(300)
    posed = [press(hand, -0.003), press(hand, 0.002) * [-1.0, 1.0, -1.0]]
    meshes = [DeformingMesh(hand, hand_faces) for _ in posed]
    found = head_distances(DeformingMesh(head, faces), meshes, head[None], [at[None] for at in posed])[0]
    squares = [igl.point_mesh_squared_distance(head, at, hand_faces)[0] for at in posed]
    outside = np.all([igl.winding_number(at, hand_faces, head) < 0.4 for at in posed], axis=0)
    expected = np.sqrt(np.minimum(*squares))
    np.testing.assert_allclose(found[outside], np.where(expected < 0.01, expected, np.inf)[outside], atol=1e-12)
    assert np.isfinite(found).sum() > 10


@pytest.mark.parametrize(("depth", "collides", "touches"), [(-0.02, 0, 0), (-0.003, 0, 1), (0.004, 1, 1)])
def test_plausibility_of_a_pressed_hand(depth, collides, touches):
    (head, faces), (hand, hand_faces) = round_head(900), capsule_hand(300)
    areas = (vertex_areas(head, faces), vertex_areas(hand, hand_faces))
    figures = plausibility(
        DeformingMesh(head, faces), DeformingMesh(hand, hand_faces), areas, head[None], press(hand, depth)[None]
    )
    assert figures["non_collision_ratio"] == 1 - collides and figures["touch_ratio"] == touches
    np.testing.assert_allclose(figures["max_depth_mm"], max(depth, 0) * 1e3, rtol=0.25, atol=1e-9)
    assert (figures["volume_mm3"] > 0) == bool(collides)


def test_areas_sum_to_the_surface():
    verts, faces = round_head(900)
    import trimesh

    np.testing.assert_allclose(vertex_areas(verts, faces).sum(), trimesh.Trimesh(verts, faces).area, rtol=1e-9)


def test_cheeks_are_softer_than_forehead_and_scale_does_not_leave_the_range():
    verts, faces = round_head(2000)
    thickness = tissue_thickness(verts, faces)
    assert thickness.min() >= 0.003 and thickness.max() <= 0.025
    forehead = (verts[:, 2] > 0.05) & (verts[:, 1] > 0.05)
    cheek = (np.abs(verts[:, 0]) > 0.05) & (verts[:, 2] > 0.03) & (np.abs(verts[:, 1] + 0.03) < 0.015)
    assert np.median(thickness[cheek]) > 1.5 * np.median(thickness[forehead])
    stiffness = bed_stiffness(thickness, 1e4)
    assert np.median(stiffness[cheek]) < 0.5 * np.median(stiffness[forehead])
