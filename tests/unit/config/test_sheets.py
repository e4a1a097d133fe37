import json
import math
from pathlib import Path

import pytest

from nbavatar.config.sheets import Subject, capture_subjects, read_rows, read_subjects, refuse_namesakes
from nbavatar.errors import ConfigError

HEADER = "subject\ttrain_cameras\ttest_camera\n"


def _write(path, text):
    path.write_text(text)
    return path


def test_camera_ids_stay_text(tmp_path):
    path = _write(tmp_path / "s.tsv", HEADER + "S3\t121,010,084\t110\n")
    subject = read_subjects(path, "root")["S3"]
    assert subject.train_cameras == ("121", "010", "084")
    assert subject.cameras == ("010", "084", "110", "121")


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (HEADER + "S1\t110,102\t102\n", "without the test camera"),
        (HEADER + "S1\t\t102\n", "found none"),
        (HEADER + "S1\t102\t\n", "camera: expected a name"),
        (HEADER + "S1\t1\t2\nS1\t1\t2\n", "S1 again"),
        (HEADER + "S/1\t1\t2\n", "a name of letters"),
        (HEADER + "S1\t1\n", "3 columns"),
        ("subject\ttest_camera\n", "header"),
    ],
)
def test_wrong_subject_sheets_end_in_one_line(tmp_path, text, match):
    with pytest.raises(ConfigError, match=match) as caught:
        read_subjects(_write(tmp_path / "s.tsv", text), "root")
    assert "\n" not in str(caught.value)


def test_rows_star_means_every_subject_and_unknown_ones_are_named(tmp_path):
    path = _write(tmp_path / "r.tsv", "subject\tvariant\tprotocol\n*\tfull\tnv\nS2\tch03\tnv\n")
    rows = read_rows(path, ["S1", "S2"])
    assert [(r.subject, r.variant) for r in rows] == [("S1", "full"), ("S2", "full"), ("S2", "ch03")]
    with pytest.raises(ConfigError, match=r"line 3: unknown subject 'S2'; known: S1"):
        read_rows(path, ["S1"])


def _capture(folder, angles):
    folder.mkdir(parents=True)
    cameras = {}
    for name, angle in angles.items():
        c, s = math.cos(angle), math.sin(angle)
        K = [[2, 0, 0.5], [0, 2, 0.5], [0, 0, 1]]
        cameras[name] = {"R": [[c, 0, -s], [0, 1, 0], [s, 0, c]], "t": [0, 0, 1], "width": 1, "height": 1, "K": K}
    (folder / "cameras.json").write_text(json.dumps(cameras))


def test_capture_holds_out_the_best_surrounded_camera_unless_told(tmp_path):
    _capture(tmp_path / "demo", {"a": -0.6, "b": 0.12, "c": 0.5, "d": 0.0, "e": -0.15})
    assert capture_subjects(str(tmp_path / "demo"), "")["demo"].test_camera == "d"
    chosen = capture_subjects(str(tmp_path / "demo"), "a")["demo"]
    assert chosen.test_camera == "a"
    assert chosen.train_cameras == ("b", "c", "d", "e")
    with pytest.raises(ConfigError, match="unknown camera 'z'"):
        capture_subjects(str(tmp_path / "demo"), "z")


def test_nothing_is_held_out_of_a_single_camera(tmp_path):
    _capture(tmp_path / "demo", {"a": 0.0})
    subject = capture_subjects(str(tmp_path / "demo"), "")["demo"]
    assert (subject.cameras, subject.train_cameras, subject.test_camera) == (("a",), ("a",), "")
    with pytest.raises(ConfigError, match="test_camera: unknown camera 'z'"):
        capture_subjects(str(tmp_path / "demo"), "z")


def test_folder_of_captures_gives_one_subject_each(tmp_path):
    for name in ("one", "two"):
        _capture(tmp_path / name, {"a": 0.0, "b": 0.3})
    assert list(capture_subjects(str(tmp_path), "")) == ["one", "two"]
    with pytest.raises(ConfigError, match="data_root"):
        capture_subjects(str(tmp_path / "nothing"), "")


@pytest.mark.parametrize(
    ("wanted", "meant"), [("084", "084"), (84, "084"), (110, "110"), (8, "010"), (10, "010"), ("left", "left")]
)
def test_numbers_of_the_command_line_are_ids_of_cameras(tmp_path, wanted, meant):
    _capture(tmp_path / "demo", {"084": -0.6, "110": 0.12, "010": 0.5, "left": 0.0})
    assert capture_subjects(str(tmp_path / "demo"), wanted)["demo"].test_camera == meant


@pytest.mark.parametrize(("wanted", "found"), [(8, "'008' and '010'"), (9, "none; known: 008, 010")])
def test_a_number_that_means_no_camera_or_two_is_refused(tmp_path, wanted, found):
    _capture(tmp_path / "demo", {"008": -0.6, "010": 0.5})
    with pytest.raises(ConfigError, match=f"one camera that {wanted} can mean, found {found}.*in quotes"):
        capture_subjects(str(tmp_path / "demo"), wanted)


def test_sheets_and_cameras_may_begin_with_a_byte_order_mark(tmp_path):
    path = tmp_path / "s.tsv"
    path.write_bytes(b"\xef\xbb\xbf" + (HEADER + "S1\t1,2\t3\n").encode())
    assert read_subjects(path, "root")["S1"].test_camera == "3"
    _capture(tmp_path / "demo", {"a": -0.6, "b": 0.12})
    path = tmp_path / "demo/cameras.json"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert capture_subjects(str(tmp_path / "demo"), "a")["demo"].train_cameras == ("b",)


def test_results_of_another_capture_of_that_name_are_not_replaced(tmp_path):
    here, there = (Subject("demo", ("a",), "", str(tmp_path / day / "demo")) for day in ("monday", "tuesday"))
    record = tmp_path / "check" / "demo" / "record.json"
    for folder in (here.root, there.root, record.parent):
        Path(folder).mkdir(parents=True)
    record.write_text(json.dumps({"folder": here.root}))
    refuse_namesakes({"demo": here}, tmp_path / "check")
    with pytest.raises(ConfigError, match=r"'demo', of which there are results; they were made of .*monday/demo"):
        refuse_namesakes({"demo": there}, tmp_path / "check")
    Path(here.root).rmdir()  # moved
    refuse_namesakes({"demo": there}, tmp_path / "check")
