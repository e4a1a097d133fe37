import pickle

import numpy as np
import pytest

from nbavatar.data.decaf import (
    check_counts,
    frame_counts,
    read_boxes,
    read_camera,
    read_cuts,
    read_frame_array,
    read_keypoints,
    read_parameters,
)
from nbavatar.data.decaf_files import find_subject
from nbavatar.errors import DataError
from nbavatar.io.pickles import read_pickle

PARAMS = "train/params/S2/params_smoothed.pkl"
CAMERA_FILE = "train/cameras/S2/cameras.pkl"


def edit(path, change):
    content = read_pickle(path)
    path.write_bytes(pickle.dumps(change(content) or content, protocol=2))


def test_subject_is_found_in_either_folder(decaf, tiny):
    tiny.write_decaf(decaf, "S1", "test")
    assert find_subject(decaf, "S2").folder == "train"
    assert find_subject(decaf, "S1").folder == "test"
    assert find_subject(decaf, "S1").cameras == ["084", "100"]


def test_unknown_subject_lists_those_there_are(decaf):
    with pytest.raises(DataError, match=r"unknown subject 'S9'; known: S2"):
        find_subject(decaf, "S9")


def test_a_subject_in_both_folders_is_refused(decaf, tiny):
    tiny.write_decaf(decaf, "S2", "test")
    with pytest.raises(DataError, match="both folders"):
        find_subject(decaf, "S2")


def test_a_root_that_is_no_dataset(tmp_path):
    with pytest.raises(DataError, match="neither"):
        find_subject(tmp_path, "S2")
    with pytest.raises(DataError, match="no such folder"):
        find_subject(tmp_path / "nowhere", "S2")


def test_a_camera_without_video_is_named(decaf):
    """As camera 111 of subject S5 in the release: calibrated, but without any video."""
    subject = find_subject(decaf, "S2")
    subject.video("100").unlink()
    assert subject.cameras == ["084"]
    with pytest.raises(DataError, match=r"subject S2 has no video 100"):
        read_camera(subject, "100")
    with pytest.raises(DataError, match="no camera '999'"):
        read_camera(subject, "999")


@pytest.mark.parametrize("key", ["distortion", "dist", "dist_coeffs", "distCoeffs", "D", "lens_distortion_5"])
def test_distortion_is_found_under_any_name_and_reported(decaf, key):
    def rename(cameras):
        cameras["100"][key] = cameras["100"].pop("dist_coeffs")

    edit(decaf / CAMERA_FILE, rename)
    camera, report = read_camera(find_subject(decaf, "S2"), "100")
    assert report["distortion_key"] == key
    np.testing.assert_array_equal(camera.distortion[:5], [0.1, -0.05, 0.001, 0.002, 0.0])
    plain, report = read_camera(find_subject(decaf, "S2"), "084")
    assert plain.distortion is None and report["distortion_key"] is None
    assert report["keys"] == ["extrinsic", "intrinsic"]


def test_camera_ids_may_be_numbers_and_pixel_centres_at_zero(decaf):
    edit(decaf / CAMERA_FILE, lambda cameras: {int(name): entry for name, entry in cameras.items()})
    camera, _ = read_camera(find_subject(decaf, "S2"), "084", pixel_center=0.0)
    np.testing.assert_array_equal(camera.K, [[60, 0, 31.5], [0, 60, 25.5], [0, 0, 1]])
    assert (camera.width, camera.height, camera.name) == (64, 48, "084")


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda c: c["084"].pop("intrinsic"), "intrinsic: expected a 3 x 3 matrix"),
        (lambda c: c["084"].update(intrinsic=np.eye(4)), "expected a finite 3 x 3 matrix, found \\[4, 4\\]"),
        (lambda c: c["084"].update(extrinsic=np.eye(4) * np.nan), "NaN"),
        (lambda c: c["084"].update(extrinsic=np.diag([1, 1, -1, 1.0])), "expected a rotation"),
        (lambda c: c["084"].update(intrinsic=[[60, 0, 900], [0, 60, 20], [0, 0, 1]]), "principal point inside"),
        (lambda c: c["084"].update(dist=[1, 2, 3]), "4, 5, 8 or 12 distortion coefficients, found 3"),
    ],
)
def test_a_calibration_that_cannot_be_is_one_line(decaf, change, line):
    def apply(cameras):
        change(cameras)

    edit(decaf / CAMERA_FILE, apply)
    with pytest.raises(DataError, match=line) as error:
        read_camera(find_subject(decaf, "S2"), "084")
    assert "\n" not in str(error.value) and "084" in str(error.value)


def test_frame_keys_are_sorted_as_numbers(tmp_path, tiny):
    by_int = read_parameters(find_subject(tiny.write_decaf(tmp_path / "a"), "S2"))
    by_str = read_parameters(find_subject(tiny.write_decaf(tmp_path / "b", keys="str"), "S2"))
    for part in by_int:
        for name in by_int[part]:
            np.testing.assert_array_equal(by_int[part][name], by_str[part][name])
            assert by_int[part][name].dtype == np.float32


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (
            lambda p: p[7]["right_hand"]["hand_pose"].__setitem__(3, np.nan),
            "frame 7: right_hand.hand_pose: .*found NaN",
        ),
        (lambda p: p[2]["head"].pop("transl"), "frame 2: head.transl: expected a vector, found none"),
        (lambda p: p[2]["head"].update(transl=np.zeros(4)), "frame 2: head.transl: expected 3 values, found 4"),
        (lambda p: p[5]["head"].update(shape_params=np.zeros(99)), "frame 5: head.shape_params: expected 100 values"),
        (lambda p: p.update(intro=p.pop(0)), "frame key: expected a frame number, found 'intro'"),
        (lambda p: p.update({"3": p[3]}), "frame 3: expected each frame once"),
        (lambda p: p.update({4: "x"}), "frame 4: head.transl"),
    ],
)
def test_bad_parameters_name_frame_and_field(decaf, change, line):
    def apply(parameters):
        change(parameters)

    edit(decaf / PARAMS, apply)
    with pytest.raises(DataError, match=line):
        read_parameters(find_subject(decaf, "S2"))


def test_boxes_that_are_missing_or_leave_the_frame_are_invalid(decaf):
    boxes = read_boxes(find_subject(decaf, "S2"), "head", "084", 64, 48)
    assert np.isnan(boxes[[3, 4]]).all()
    np.testing.assert_array_equal(np.delete(boxes, [3, 4], 0), np.tile([5, 6, 40, 41], (10, 1)))


def test_undetected_keypoints_have_no_confidence(decaf):
    path = decaf / "train/head_keys/S2/084.npy"
    points = np.load(path)
    points[2] = -1
    points[3, 5] = np.nan
    np.save(path, points)
    read = read_keypoints(find_subject(decaf, "S2"), "head", "084")
    assert not read[2].any() and not read[3, 5].any() and np.isfinite(read).all()
    np.testing.assert_array_equal(read[3, 6], points[3, 6].astype(np.float32))


def test_counts_agree_and_the_file_that_does_not_is_named(decaf):
    subject = find_subject(decaf, "S2")
    counts = frame_counts(subject, subject.cameras)
    assert check_counts(counts) == 12 and len(counts) == 16
    for name in ("train/contacts/S2/contacts_rh.npy", "train/head_bbs/S2/100.npy"):
        path = decaf / name
        whole = np.load(path)
        np.save(path, whole[:-1])
        with pytest.raises(DataError) as error:
            check_counts(frame_counts(subject, subject.cameras))
        assert str(path) in str(error.value) and "found 11" in str(error.value) and "expected 12" in str(error.value)
        np.save(path, whole)


def test_no_cuts_and_cuts(decaf, tiny):
    subject = find_subject(decaf, "S2")
    assert read_cuts(subject) == [(4, 5)]
    tiny.save(subject.cut_file, [])
    assert read_cuts(subject) == []
    tiny.save(subject.cut_file, np.array([[3, 4], [8, 9]]))
    assert read_cuts(subject) == [(3, 4), (8, 9)]
    tiny.save(subject.cut_file, [3, 4])
    with pytest.raises(DataError, match="pairs"):
        read_cuts(subject)


def test_frame_arrays_of_other_shapes_are_refused(decaf):
    path = decaf / "train/head_keys/S2/084.npy"
    with pytest.raises(DataError, match=r"expected \[frames, 21, 3\], found \[12, 68, 3\]"):
        read_frame_array(path, (21, 3))


def test_a_pickle_that_runs_code_is_refused(decaf, tmp_path):
    class Evil:
        def __reduce__(self):
            import os

            return os.system, (f"touch {tmp_path}/owned",)

    (decaf / PARAMS).write_bytes(pickle.dumps({0: Evil()}))
    with pytest.raises(DataError, match=r"params_smoothed\.pkl.*system"):
        read_parameters(find_subject(decaf, "S2"))
    assert not (tmp_path / "owned").exists()
