import numpy as np
import pytest

from nbavatar.camera.distortion import undistort_pixels
from nbavatar.camera.pinhole import Camera, project
from nbavatar.data.sequences import MeshSequence, Part
from nbavatar.errors import DataError
from nbavatar.preprocess.cropping import crop_extent, frame_boxes, plan_crop

CAMERA = Camera("084", 320, 180, np.array([[300.0, 0, 158.5], [0, 300.0, 92.2], [0, 0, 1]]), np.eye(4))
FRAMES = ["000000", "000001", "000002", "000003"]
OPTIONS = {"size": 64, "pad": 0.1, "per_frame": False, "multiple": 32}


def sequence(**extras):
    verts = np.array([[0.0, 0, 1], [0.1, 0, 1], [0, 0.1, 1]], np.float32)
    faces = np.array([[0, 1, 2]])
    moving = np.stack([verts + [0.02 * i, 0, 0] for i in range(4)]).astype(np.float32)
    return MeshSequence(FRAMES, {"head": Part(faces, verts, moving), "right_hand": Part(faces, verts, moving)}, extras)


def test_boxes_of_the_parts_are_joined_and_lost_ones_reported():
    head = np.array([[10, 10, 40, 40]] * 4, float)
    hand = np.array([[30, 30, 60, 70], [np.nan] * 4, [50, 30, 80, 70], [np.nan] * 4])
    tracked = sequence(**{"boxes.head.084": head, "boxes.right_hand.084": hand})
    boxes, source, missing = frame_boxes(tracked, CAMERA, FRAMES)
    assert source == "tracked boxes" and missing == ["000001", "000003"]
    np.testing.assert_array_equal(boxes, [[10, 10, 60, 70], [10, 10, 40, 40], [10, 10, 80, 70], [10, 10, 40, 40]])
    filled, _, _ = frame_boxes(tracked, CAMERA, FRAMES, fill=True)
    np.testing.assert_array_equal(filled[:, 2], [60, 70, 80, 80])


def test_without_tracked_boxes_the_meshes_are_projected():
    boxes, source, missing = frame_boxes(sequence(), CAMERA, FRAMES)
    assert source == "projected meshes" and missing == []
    pixels, _ = project(sequence().parts["head"].verts[2].astype(float), CAMERA.K, CAMERA.cam_from_world)
    np.testing.assert_allclose(boxes[2], [*pixels.min(0), *pixels.max(0)])


def test_boxes_are_found_in_the_undistorted_image():
    lens = np.array([-0.3, 0.1, 0.0, 0.0, 0.0])
    bent = Camera("084", 320, 180, CAMERA.K, CAMERA.cam_from_world, lens)
    box = np.array([[20.0, 20, 120, 150]] * 4)
    tracked = sequence(**{"boxes.head.084": box, "boxes.right_hand.084": box})
    boxes, _, _ = frame_boxes(tracked, bent, FRAMES)
    edge = np.stack([np.full(50, 20.0), np.linspace(20, 150, 50)], 1)
    ideal = undistort_pixels(edge, CAMERA.K, lens)
    assert boxes[0, 0] == pytest.approx(ideal[:, 0].min(), abs=0.05) and boxes[0, 0] < 20


def test_union_holds_all_frames_and_moving_windows_have_one_size():
    boxes = np.array([[10, 10, 60, 70], [20, 15, 90, 75], [np.nan] * 4, [40, 10, 70, 60]])
    plan = plan_crop(CAMERA, FRAMES, kind="box", boxes=boxes, **OPTIONS)
    assert not plan.moving and len(set(plan.windows.values())) == 1
    x0, y0, side = plan.windows["000000"]
    assert side == 96 and x0 <= 10 and y0 <= 10 and x0 + side >= 90 and y0 + side >= 75
    moving = plan_crop(CAMERA, FRAMES, kind="box", boxes=boxes, **{**OPTIONS, "per_frame": True})
    assert moving.moving and {side for _, _, side in moving.windows.values()} == {84}
    for frame, box in zip(FRAMES, boxes):
        x0, y0, side = moving.windows[frame]
        if np.isfinite(box).all():
            assert x0 <= box[0] and x0 + side >= box[2] and y0 <= box[1] and y0 + side >= box[3]
        expected = np.array([[300, 0, 158.5 - x0], [0, 300, 92.2 - y0], [0, 0, side / 64]]) * 64 / side
        np.testing.assert_allclose(moving.K[frame], expected)


def test_no_box_at_all_is_one_line():
    with pytest.raises(DataError, match="camera 084: boxes: expected at least one valid box"):
        plan_crop(CAMERA, FRAMES, kind="box", boxes=np.full((4, 4), np.nan), **OPTIONS)


def test_native_scale_keeps_focal_lengths_and_a_multiple():
    plan = plan_crop(CAMERA, FRAMES, kind="full", **{**OPTIONS, "size": 0})
    assert plan.size == 320 and plan.K["000000"][0, 0] == 300 and plan.windows["000000"] == (0, -70, 320)
    assert crop_extent(plan, CAMERA)["max"] == pytest.approx(140 / 320)
    plan = plan_crop(CAMERA, FRAMES, kind="center", **{**OPTIONS, "size": 0})
    assert plan.size == 192 and plan.K["000000"][1, 1] == 300 and plan.windows["000000"] == (64, -6, 192)
