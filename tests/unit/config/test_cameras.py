import json

import pytest

from nbavatar.config.cameras import parse_camera, read_rig, stored_test_camera
from nbavatar.errors import DataError

GOOD = {
    "width": 20, "height": 10, "K": [[9.5, 0, 9], [0, 9, 5.5], [0, 0, 1]], "R": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
    "t": [0.1, 0, 0.6],
}  # fmt: skip


def parse(**change):
    return parse_camera("left", {**GOOD, **change}, "cameras.json")


def test_a_camera_is_read_as_written():
    camera = parse(distortion=[-0.1, 0.02, 0, 0])
    assert (camera.width, camera.height, camera.K, camera.R, camera.t, camera.distortion) == (
        20, 10, GOOD["K"], GOOD["R"], GOOD["t"], [-0.1, 0.02, 0, 0],
    )  # fmt: skip
    assert camera.centre == [0, 0.1, -0.6]  # -R^T t, by hand


@pytest.mark.parametrize("t", [[0.1, 0, 0.6], [[0.1], [0], [0.6]], [[0.1, 0, 0.6]]])
def test_t_may_be_a_list_a_column_or_a_row(t):
    assert parse(t=t).t == [0.1, 0, 0.6]
    assert parse(distortion=[[1, 2, 3, 4]]).distortion == parse(distortion=[[1], [2], [3], [4]]).distortion


@pytest.mark.parametrize(
    ("key", "hint"),
    [
        ("dist", "did you mean distortion"), ("distCoef", "did you mean distortion"), ("D", "did you mean distortion"),
        ("k1", "did you mean distortion"), ("p2", "did you mean distortion"), ("distortoin", "mean 'distortion'"),
        ("distortion_coefficients", "did you mean distortion"), ("distCoeffs", "did you mean distortion"),
        ("intrinsics", "did you mean K"), ("fx", "did you mean K"), ("camera_matrix", "did you mean K"),
        ("rotation", "did you mean R"), ("tvec", "did you mean t"), ("T", "did you mean t"),
        ("w", "did you mean width"),
        ("cam_from_world", "did you mean R and t"), ("c2w", "the inverse of camera to world"),
        ("position", "t = -R position"), ("is_fisheye", "did you mean camera_model"), ("zzz", "known: K, R"),
    ],
)  # fmt: skip
def test_keys_under_another_name_are_refused_with_a_hint(key, hint):
    with pytest.raises(DataError, match=f"camera left: unknown key '{key}'; .*{hint}"):
        parse(**{key: [0.1, 0, 0, 0]})


@pytest.mark.parametrize("model", ["PINHOLE", "opencv", "FULL_OPENCV", "SIMPLE_PINHOLE"])
def test_models_that_the_keys_describe(model):
    assert parse(camera_model=model).K == GOOD["K"]


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"camera_model": "OPENCV_FISHEYE"}, "camera_model: expected PINHOLE .* found 'OPENCV_FISHEYE'; other lenses"),
        ({"camera_model": "SIMPLE_RADIAL"}, "found 'SIMPLE_RADIAL'"),
        ({"camera_model": "PINHOLE", "distortion": [0.1, 0, 0, 0]}, "distortion: expected none for a camera_model"),
        ({"t": [0, 0, "1"]}, "t: expected 3 finite numbers"),
        ({"t": [[0, 0], [1, 1]]}, "t: expected 3 finite numbers"),
        ({"t": [0, 0, True]}, "t: expected 3 finite numbers"),
        ({"t": [0, 0, 10**400]}, "t: expected 3 finite numbers"),
        ({"R": [0, -1, 0, 1, 0, 0, 0, 0, 1]}, "R: expected 3 x 3 finite numbers"),
        ({"R": [[0, 1, 0], [1, 0, 0], [0, 0, 1]]}, "R: expected a rotation, found .* determinant -1"),
        ({"K": [[9, 0.1, 9], [0, 9, 5], [0, 0, 1]]}, "K: expected .*fx, 0, cx"),
        ({"distortion": "none"}, "distortion: expected finite numbers"),
        ({"distortion": [0.1, None, 0, 0]}, "distortion: expected finite numbers"),
    ],
)
def test_values_that_are_no_camera(change, line):
    with pytest.raises(DataError, match=line) as error:
        parse(**change)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("{}", "mapping from camera name"),
        ("[]", "mapping from camera name"),
        ("[[1]]", "found list"),
        ('{"a": {}, "a": {}}', "a: expected each key once, found it twice"),
        ('{"a": {"t": 1, "t": 2}}', "a: t: expected each key once"),
        ("{", "does not parse"),
        ("[" * 100_000, "does not parse"),
    ],
)
def test_files_that_are_no_rig(tmp_path, text, line):
    (tmp_path / "cameras.json").write_text(text)
    with pytest.raises(DataError, match=line):
        read_rig(tmp_path / "cameras.json")


def test_a_byte_order_mark_is_skipped(tmp_path):
    path = tmp_path / "cameras.json"
    path.write_bytes(b"\xef\xbb\xbf" + json.dumps({"left": GOOD}).encode())
    assert read_rig(path) == {"left": GOOD}


def test_a_capture_may_name_the_camera_that_is_held_out(tmp_path):
    names = ["a", "b"]
    assert stored_test_camera(tmp_path, names) == ""
    (tmp_path / "splits.json").write_text('\ufeff{"frames": [], "test_camera": "b"}', encoding="utf-8")
    assert stored_test_camera(tmp_path, names) == "b"
    for wrong in ('"c"', "1", "[]", "null", '["a"]', "{}"):
        (tmp_path / "splits.json").write_text(f'{{"test_camera": {wrong}}}')
        with pytest.raises(DataError, match=r"splits.json: test_camera: expected a camera of cameras.json"):
            stored_test_camera(tmp_path, names)
    (tmp_path / "splits.json").write_text("{")
    with pytest.raises(DataError, match="expected JSON"):
        stored_test_camera(tmp_path, names)
