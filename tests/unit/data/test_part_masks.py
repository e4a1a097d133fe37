"""Masks on a scene whose truth is known: balls with a torso, a forearm and hair that no mesh covers."""

import dataclasses

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nbavatar.camera.pinhole import Camera
from nbavatar.data.sequences import MeshSequence, Part
from nbavatar.mesh.zbuffer import rasterize_mesh
from nbavatar.preprocess.clothes import ClothesModel
from nbavatar.preprocess.masking import MaskNumbers, MaskStatistics, cut_masks
from nbavatar.preprocess.part_masks import Margins, PartCutter

WIDTH, HEIGHT = 200, 180
MARGINS = Margins(hair=0.04, neck=0.006, hand=0.006, sleeve=0.12)
NUMBERS = MaskNumbers(127, 0.01, 0.02, True, False)


def tube(start, end, radius, sectors=24):
    """A closed-enough tube, for torso and forearm."""
    axis = (end - start) / np.linalg.norm(end - start)
    R = Rotation.align_vectors([axis], [[0, 0, 1.0]])[0].as_matrix()
    angle = np.arange(sectors) * 2 * np.pi / sectors
    ring = radius * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(sectors)]) @ R.T
    verts = np.concatenate([ring + start, ring + end])
    a = np.arange(sectors)
    b = (a + 1) % sectors
    faces = np.concatenate([np.column_stack([a, b, b + sectors]), np.column_stack([a, b + sectors, a + sectors])])
    return verts, faces


def build(tiny, frames=5, distortion=None):
    """Mesh sequence, camera, and for each frame the matte and the true labels."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("y", 15, degrees=True).as_matrix()
    pose[2, 3] = 0.6
    K = np.array([[300.0, 0, 98.3], [0, 300.0, 85.1], [0, 0, 1]])
    camera = Camera("084", WIDTH, HEIGHT, K, pose, distortion)
    parts, truth, mattes = {}, [], []
    head, head_faces = tiny.open_sphere(0.08, np.zeros(3), np.array([0, -1.0, 0]))
    stack = {"head": [], "right_hand": []}
    for i in range(frames):
        hand, hand_faces = tiny.open_sphere(0.035, np.array([0.09 - 0.008 * i, 0.03, -0.1]), np.array([-1.0, -0.6, 0]))
        stack["head"].append(head)
        stack["right_hand"].append(hand)
        torso = tube(np.array([0, 0.057, 0.0]), np.array([0, 0.35, 0.0]), 0.058)
        shoulders = tube(np.array([-0.2, 0.19, 0]), np.array([0.2, 0.19, 0]), 0.06)
        wrist = hand[:24].mean(0).astype(float)
        axis = np.array([1.0, 0.6, 0]) / np.hypot(1, 0.6)
        forearm = tube(wrist, wrist + 0.3 * axis, 0.026)
        hair, hair_faces = tiny.open_sphere(0.1, np.zeros(3), np.array([0, -1.0, 0]), cut=0.1)
        layers = [(head, head_faces, 1), (hair, hair_faces, 1), (hand, hand_faces, 2)]
        layers += [(*mesh, 9) for mesh in (torso, shoulders, forearm)]
        verts = np.concatenate([mesh for mesh, _, _ in layers])
        offsets = np.cumsum([0] + [len(mesh) for mesh, _, _ in layers])
        faces = np.concatenate([f + o for (_, f, _), o in zip(layers, offsets)])
        owner = np.concatenate([np.full(len(f), value, np.uint8) for _, f, value in layers])
        face, _, _ = rasterize_mesh(verts, faces, K, WIDTH, HEIGHT, cam_from_world=pose)
        label = np.where(face >= 0, owner[face], np.uint8(0))
        mattes.append(np.where(label > 0, 255, 0).astype(np.uint8))
        truth.append(np.where(label == 9, 0, label).astype(np.uint8))
    parts["head"] = Part(head_faces, head, np.stack(stack["head"]))
    parts["right_hand"] = Part(hand_faces, stack["right_hand"][0], np.stack(stack["right_hand"]))
    return MeshSequence([f"{i:06d}" for i in range(frames)], parts), camera, mattes, truth


def iou(a, b):
    return (a & b).sum() / max((a | b).sum(), 1)


@pytest.fixture(scope="module")
def scene(tiny):
    return build(tiny)


def cut(scene, mattes, numbers=NUMBERS, runs=None, coverage=None, matte=True):
    sequence, camera, _, _ = scene
    statistics = MaskStatistics()
    source = ((f, m, coverage) for f, m in zip(sequence.frames, mattes))
    cutter = PartCutter(sequence, camera, MARGINS)
    return list(cut_masks(source, cutter, runs or [sequence.frames], numbers, statistics, matte=matte)), statistics


def test_torso_and_forearm_go_and_hair_stays(scene):
    result, statistics = cut(scene, scene[2])
    assert [frame for frame, _, _ in result] == scene[0].frames
    for (_, label, alpha), truth in zip(result, scene[3]):
        assert iou(label == 1, truth == 1) > 0.95 and iou(label == 2, truth == 2) > 0.93
        assert ((alpha == 255) == (label > 0)).all() and set(np.unique(alpha)) <= {0, 255}
    assert statistics.dropped > 0 and not statistics.empty_frames


def test_lossy_mattes_cost_little(scene):
    mattes = []
    for matte in scene[2]:
        _, coded = cv2.imencode(".jpg", matte, [cv2.IMWRITE_JPEG_QUALITY, 30])
        mattes.append(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE))
    for (_, label, _), truth in zip(cut(scene, mattes)[0], scene[3]):
        assert iou(label == 1, truth == 1) > 0.94 and iou(label == 2, truth == 2) > 0.91


def test_one_frame_s_fault_is_repaired_but_not_across_a_cut(scene):
    mattes = [matte.copy() for matte in scene[2]]
    mattes[2][60:90, 80:100] = 0
    frames = scene[0].frames
    healed, statistics = cut(scene, mattes)
    assert statistics.flicker > 0
    assert iou(healed[2][1] == 1, scene[3][2] == 1) > 0.95
    separate, statistics = cut(scene, mattes, runs=[frames[:3], frames[3:]])
    assert statistics.flicker == 0 and not separate[2][1][65:85, 85:95].any()


def test_labels_that_are_given_are_kept(scene):
    result, statistics = cut(scene, scene[3], matte=False)
    for (_, label, _), truth in zip(result, scene[3]):
        np.testing.assert_array_equal(label, truth)
    assert statistics.dropped == statistics.flicker == 0


def behind(sequence, camera, row, *parts):
    """Where the meshes of some parts are in a frame, whatever is in front of them."""
    shown = np.zeros((HEIGHT, WIDTH), bool)
    for part in (sequence.parts[name] for name in parts):
        pose = camera.cam_from_world
        face, _, _ = rasterize_mesh(part.verts[row], part.faces, camera.K, WIDTH, HEIGHT, cam_from_world=pose)
        shown |= face >= 0
    return shown


def test_what_hides_a_mesh_may_say_nothing(scene, rng):
    """Forearm and collar in front of the head: where they are is known from the true labels and the meshes alone."""
    sequence, camera, mattes, truth = scene
    truth = [label.copy() for label in truth]
    for label in truth:  # a collar, twelve rows high
        rows = np.flatnonzero((label == 1).any(1))
        label[rows.max() - 11 : rows.max() + 1][label[rows.max() - 11 : rows.max() + 1] == 1] = 0
    skin, cloth = np.array([200.0, 160, 130]), np.array([150.0, 40, 50])
    pictures = {
        frame: (np.where(label[..., None] > 0, skin, cloth) + rng.normal(0, 4, (HEIGHT, WIDTH, 3))).astype(np.uint8)
        for frame, label in zip(sequence.frames, truth)
    }
    statistics, numbers = MaskStatistics(), dataclasses.replace(NUMBERS, covered="unknown", temporal=False)
    source = ((frame, matte, None) for frame, matte in zip(sequence.frames, mattes))
    cutter = PartCutter(sequence, camera, MARGINS)
    result = list(
        cut_masks(
            source, cutter, [sequence.frames], numbers, statistics, matte=True, images=pictures.__getitem__,
            clothes=ClothesModel(1.0),
        )
    )  # fmt: skip
    scores, total, sleeve = [], 0, 0
    for row, (frame, label, alpha) in enumerate(result):
        wanted = behind(sequence, camera, row, "head", "right_hand") & (truth[row] == 0) & (mattes[row] > 0)
        unseen = label == 255
        scores.append(iou(unseen, wanted))
        total += int(unseen.sum())
        sleeve += int((unseen & (cutter.silhouettes(frame).support == 0)).sum())
        np.testing.assert_array_equal(alpha > 0, np.isin(label, (1, 2)))
    # The colours of cloth are averaged over three pixels, and the sleeve is a cone where the arm is a tube.
    assert min(scores) > 0.8, scores
    assert statistics.unseen == total and statistics.clothes > 200 and sleeve > 100, (total, statistics.clothes, sleeve)
    plain, _ = cut(scene, mattes)
    assert not any((label == 255).any() for _, label, _ in plain)


def test_labels_that_say_nothing_are_kept_and_take_half_covered_neighbours_with_them(scene):
    masks = [truth.copy() for truth in scene[3]]
    for mask in masks:
        mask[80:84, 90:94] = 255  # a microphone: small enough for a hole that would be filled
        assert (mask[78:86, 88:96] > 0).all()
    coverage = np.full((HEIGHT, WIDTH), 255, np.uint8)
    coverage[80:84, 89] = 120  # what the microphone half covers
    coverage[70:74, 89] = 120  # and another soft place, which nothing covers
    result, statistics = cut(scene, masks, coverage=coverage, matte=False)
    for (_, label, alpha), mask in zip(result, masks):
        np.testing.assert_array_equal(label[80:84, 89:94], 255)
        assert (label == 255).sum() == 20 and not alpha[label == 255].any()
        same = label != 255
        np.testing.assert_array_equal(label[same], mask[same])
        assert (alpha[70:74, 89] == 120).all()
    assert statistics.unseen == 20 * len(masks) and not statistics.empty_frames


def test_coverage_is_carried_and_soft_edges_are_an_option(scene):
    soft = np.full((HEIGHT, WIDTH), 90, np.uint8)
    for _, label, alpha in cut(scene, scene[3], coverage=soft, matte=False)[0]:
        np.testing.assert_array_equal(alpha, np.where(label > 0, 90, 0))
    blurred = [cv2.GaussianBlur(matte, (0, 0), 1.5) for matte in scene[2]]
    numbers = MaskNumbers(127, 0.01, 0.02, True, True)
    for _, label, alpha in cut(scene, blurred, numbers=numbers)[0]:
        assert len(np.unique(alpha)) > 20 and ((alpha > 0) == (label > 0)).all()


def test_a_person_out_of_view_gives_an_empty_mask(scene):
    mattes = [np.zeros_like(matte) for matte in scene[2]]
    result, statistics = cut(scene, mattes)
    assert statistics.empty_frames == scene[0].frames and not any(label.any() for _, label, _ in result)


def test_silhouettes_follow_lens_distortion(tiny, scene):
    sequence, camera, _, _ = scene
    lens = np.array([-0.35, 0.1, 0.004, -0.003, 0.0])
    bent = PartCutter(sequence, Camera("084", WIDTH, HEIGHT, camera.K, camera.cam_from_world, lens), MARGINS)
    straight = PartCutter(sequence, camera, MARGINS)
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    seen = bent.silhouettes("000001").support
    ideal = straight.silhouettes("000001").support
    maps = cv2.initUndistortRectifyMap(camera.K - half, lens, np.eye(3), camera.K - half, (WIDTH, HEIGHT), cv2.CV_32FC1)
    undone = cv2.remap(seen, *maps, cv2.INTER_NEAREST)
    assert iou(undone == 1, ideal == 1) > 0.97 and iou(undone == 2, ideal == 2) > 0.95
    assert iou(seen == 1, ideal == 1) < 0.995, "the lens must matter in this test"


def test_parts_that_are_absent_are_not_looked_for(scene):
    sequence, camera, _, _ = scene
    alone = MeshSequence(sequence.frames, {"head": sequence.parts["head"]})
    labels = PartCutter(alone, camera, MARGINS).silhouettes("000000")
    assert set(np.unique(labels.support)) == {0, 1}


def test_nothing_in_view_is_no_error(scene):
    sequence, camera, mattes, _ = scene
    away = Camera("x", WIDTH, HEIGHT, camera.K, np.diag([1.0, -1, -1, 1]) @ camera.cam_from_world)
    cutter = PartCutter(sequence, away, MARGINS)
    outline = cutter.silhouettes("000000")
    assert not outline.support.any() and not cutter.cut(mattes[0], outline, 127).any()
