"""The pieces between networks and keypoints: no network is needed here."""

import numpy as np
import pytest

from nbavatar.bodymodels.mano import JOINT_NAMES
from nbavatar.config.detection import DetectConfig
from nbavatar.detection.anchors import Detections, anchor_centres, decode, joined, suppress
from nbavatar.detection.correspondence import (
    FACE_MIRROR,
    FACE_POINTS,
    FACE_TRUST,
    HAND_POINTS,
    face_landmarks,
    hand_joints,
)
from nbavatar.detection.hands import Hand, distinct, square_of_joints
from nbavatar.detection.squares import Square, cut_square, square_around, to_crop, to_image
from nbavatar.detection.stage import _lies_on, keep_parts
from nbavatar.detection.visibility import facing
from nbavatar.detection.windows import frame_windows, mask_window
from nbavatar.errors import DataError

STRIDES = (8, 16, 16, 16)


def test_anchors_are_as_many_as_the_networks_have_outputs():
    # 24 x 24 cells with 2 and 12 x 12 with 6; 16 x 16 with 2 and 8 x 8 with 6.
    assert len(anchor_centres(192, STRIDES)) == 2016
    assert len(anchor_centres(128, STRIDES)) == 896


def test_anchors_sit_in_the_middle_of_cells_row_by_row():
    centres = anchor_centres(192, STRIDES)
    np.testing.assert_allclose(centres[:2], [[4 / 192] * 2] * 2)
    np.testing.assert_allclose(centres[2], [12 / 192, 4 / 192])
    np.testing.assert_allclose(centres[1152], [8 / 192] * 2)
    np.testing.assert_allclose(centres.mean(0), 0.5)


def test_decoding_adds_the_anchor_and_drops_the_uncertain():
    anchors = np.array([[0.5, 0.25], [0.1, 0.1]])
    values = np.array([[2.0, -4.0, 10.0, 20.0, 3.0, 5.0], [0, 0, 1, 1, 0, 0]])
    found = decode(values, np.array([0.0, -9.0]), anchors, 100, 0.4)
    np.testing.assert_allclose(found.boxes, [[47, 11, 57, 31]])
    np.testing.assert_allclose(found.points, [[[53, 30]]])
    np.testing.assert_allclose(found.scores, [0.5])
    none = decode(values, np.array([-9.0, -1e4]), anchors, 100, 0.4)
    assert none.boxes.shape == (0, 4) and none.points.shape == (0, 1, 2)


def test_suppression_keeps_the_best_of_a_group():
    boxes = np.array([[0, 0, 10, 10], [1, 1, 11, 11], [50, 50, 60, 60]], dtype=float)
    groups = [Detections(boxes[i : i + 1], np.zeros((1, 1, 2)), np.array([s])) for i, s in enumerate((0.5, 0.9, 0.4))]
    kept = suppress(joined(groups), 0.3)
    np.testing.assert_array_equal(kept.boxes, boxes[[1, 2]])
    empty = Detections(np.zeros((0, 4)), np.zeros((0, 1, 2)), np.zeros(0))
    assert len(suppress(empty, 0.3).scores) == 0


@pytest.mark.parametrize("angle", [0.0, 0.3, -2.5, np.pi])
def test_crop_and_back_is_the_identity(angle):
    square, points = Square(123.4, -5.6, 78.9, angle), np.random.default_rng(0).uniform(-50, 300, (40, 2))
    np.testing.assert_allclose(to_image(to_crop(points, square, 192), square, 192), points, atol=1e-10)
    np.testing.assert_allclose(to_image(np.array([96.0, 96.0]), square, 192), [123.4, -5.6])


def test_an_upright_square_of_the_image_is_copied_and_a_quarter_turn_turned():
    image = np.random.default_rng(1).integers(0, 255, (40, 40, 3), dtype=np.uint8)
    square = Square(20.0, 18.0, 16.0)
    np.testing.assert_array_equal(cut_square(image, square, 16), image[10:26, 12:28])
    # The crop's x axis points down the image: its rows are the image's columns, from right to left.
    turned = cut_square(image, Square(20.0, 18.0, 16.0, np.pi / 2), 16)
    difference = np.abs(turned.astype(int) - np.rot90(image[10:26, 12:28], 1).astype(int))
    assert difference.max() <= 1  # fixed-point weights of the warp


def test_a_bright_spot_is_found_where_to_image_says():
    image = np.zeros((200, 300, 3), np.uint8)
    square = Square(140.0, 90.0, 150.0, 0.7)
    spot = to_image(np.array([70.0, 20.0]), square, 96)
    y, x = np.mgrid[:200, :300] + 0.5
    image[:] = (250 * np.exp(-((x - spot[0]) ** 2 + (y - spot[1]) ** 2) / 18))[..., None]
    crop = cut_square(image, square, 96)[..., 0].astype(float)
    rows, columns = np.mgrid[:96, :96] + 0.5
    centre = np.array([(columns * crop).sum(), (rows * crop).sum()]) / crop.sum()
    np.testing.assert_allclose(centre, [70, 20], atol=0.05)


def test_large_squares_do_not_alias():
    image = np.zeros((512, 512, 3), np.uint8)
    image[:, ::2] = 255
    crop = cut_square(image, Square(256, 256, 512), 64)
    assert np.ptp(crop) <= 2 and abs(float(crop.mean()) - 127.5) < 2


def test_square_around_holds_its_points_and_moves_along_its_own_axis():
    points = np.random.default_rng(2).normal(100, 20, (30, 2))
    inner = to_crop(points, square_around(points, 0.4, scale=1.0), 1)
    assert inner.min() > -1e-9 and inner.max() < 1 + 1e-9
    moved = square_around(np.array([[0.0, 0.0], [10.0, 10.0]]), 0.0, scale=2.0, shift=-0.1)
    assert (moved.x, moved.y, moved.side) == pytest.approx((5.0, 4.0, 20.0))


def test_hand_squares_turn_with_the_hand():
    # A hand that points up: the wrist at the bottom, knuckles above.
    joints = np.zeros((21, 3))
    joints[:, 0] = np.linspace(-20, 20, 21)
    joints[1:, 1] = -40
    joints[[5, 9, 13], 0] = [-5, 0, 5]
    joints[0, :2] = 0
    assert square_of_joints(joints).angle == pytest.approx(0.0)
    c, s = np.cos(1.1), np.sin(1.1)
    turned = joints.copy()
    turned[:, :2] = joints[:, :2] @ np.array([[c, s], [-s, c]])
    assert square_of_joints(turned).angle == pytest.approx(1.1)


def test_face_correspondences_are_68_different_places_and_mirror_symmetric():
    assert len(FACE_POINTS) == len(FACE_MIRROR) == len(FACE_TRUST) == 68
    assert len(set(FACE_POINTS)) == 68
    assert {i for ids in FACE_POINTS for i in ids} <= set(range(468))
    assert sorted(FACE_MIRROR) == list(range(68))
    assert [FACE_MIRROR[i] for i in FACE_MIRROR] == list(range(68))
    # A landmark of one vertex has a partner of one vertex, and those on the midline are their own partners.
    assert [len(FACE_POINTS[i]) for i in FACE_MIRROR] == [len(ids) for ids in FACE_POINTS]
    assert [i for i, j in enumerate(FACE_MIRROR) if i == j] == [8, 27, 28, 29, 30, 33, 51, 57, 62, 66]
    np.testing.assert_array_equal(FACE_TRUST[list(FACE_MIRROR)], FACE_TRUST)
    mesh = np.random.default_rng(3).normal(size=(468, 3))
    np.testing.assert_allclose(face_landmarks(mesh)[27], (mesh[168] + mesh[6]) / 2)


def test_hand_correspondence_names_the_same_joints():
    fingers = ("thumb", "index", "middle", "ring", "little")
    theirs = ["wrist"] + [f"{f}{i}" if i != 4 else f"{f}_tip" for f in fingers for i in (1, 2, 3, 4)]
    assert tuple(theirs[i] for i in HAND_POINTS) == JOINT_NAMES
    np.testing.assert_array_equal(hand_joints(np.arange(21)[:, None])[:, 0], HAND_POINTS)


def test_points_on_the_far_side_of_a_turned_face_are_hidden():
    # A half cylinder instead of a face; landmark vertices are spread over it, and turn out of sight with it.
    rng = np.random.default_rng(4)
    angle, height = rng.uniform(-1.4, 1.4, 468), rng.uniform(-1, 1, 468)
    for turn in (0.0, 1.0):
        mesh = np.stack([np.sin(angle + turn), height, -np.cos(angle + turn)], 1) * 100
        expected = np.cos(angle + turn)
        single = [row for row, ids in enumerate(FACE_POINTS) if len(ids) == 1]
        found = facing(mesh)[single]
        wanted = expected[[FACE_POINTS[row][0] for row in single]]
        assert np.median(np.abs(found - wanted)) < 0.1
        assert ((found > 0) == (wanted > 0))[np.abs(wanted) > 0.4].mean() > 0.95


def test_windows_cover_the_image_and_masks_narrow_them():
    for width, height in ((1920, 1080), (512, 512), (300, 900)):
        coarse, fine = frame_windows(width, height)
        assert len(coarse) == 1 and coarse[0].side == max(width, height)
        for x, y in np.random.default_rng(5).uniform(0, 1, (200, 2)) * [width, height]:
            assert any(abs(x - w.x) <= w.side / 2 and abs(y - w.y) <= w.side / 2 for w in fine)
    mask = np.zeros((100, 200), bool)
    assert mask_window(mask) == [] and mask_window(mask, coarse) == coarse
    mask[20:40, 50:90] = True
    window = mask_window(mask)[0]
    assert (window.x, window.y, window.side) == (70.0, 30.0, 50.0)


def test_doubles_of_a_hand_are_dropped():
    joints = np.random.default_rng(6).uniform(0, 100, (21, 3))
    first, double, other = Hand(joints, 0.9, 1.0), Hand(joints + 3, 0.95, 0.0), Hand(joints + 80, 0.6, 0.0)
    assert distinct([first, double, other]) == [first, other]


def test_a_hand_under_a_cover_lies_on_the_mask_as_far_as_it_is_known():
    joints = np.stack([np.arange(21) * 2.0 + 0.5, np.full(21, 5.5), np.zeros(21)], 1)
    hand, mask = Hand(joints, 0.9, 1.0), np.zeros((10, 60), np.uint8)
    mask[:, 30:] = 2
    assert not _lies_on(hand, mask, labels=True), "six of 21 joints on a hand"
    mask[:, :30] = 255
    assert _lies_on(hand, mask, labels=True), "six of the six that are known"
    assert not _lies_on(hand, np.full_like(mask, 255), labels=True)


def test_parts_that_no_two_cameras_see_are_left_out():
    shown, nothing = np.ones((10, 21, 3), np.float32), np.zeros((10, 21, 3), np.float32)
    once = nothing.copy()
    once[4] = 1
    keypoints = {"right_hand": {"a": shown, "b": once}, "left_hand": {"a": shown, "b": nothing}}
    kept, report = keep_parts(keypoints, 0.1)
    assert sorted(kept) == ["keypoints.right_hand.a", "keypoints.right_hand.b"]
    assert report["right_hand"]["frames_in_two_cameras"] == 1 and not report["left_hand"]["kept"]
    with pytest.raises(DataError, match="a part that two cameras see, found none"):
        keep_parts(keypoints, 0.2)


def test_defaults_are_in_range():
    assert DetectConfig().parts == ["head", "right_hand", "left_hand"]
