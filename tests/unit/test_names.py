"""One rule for names, wherever they come from."""

import json

import numpy as np
import pytest

from nbavatar.cli import main
from nbavatar.config.run import load_run
from nbavatar.config.sheets import capture_subjects
from nbavatar.config.tables import read_tables
from nbavatar.data.capture import open_capture, read_splits
from nbavatar.data.sequences import read_sequence
from nbavatar.errors import ConfigError, DataError
from nbavatar.io.framepack import FramePack, FramePackWriter
from nbavatar.names import LONGEST, is_name, name_like

NAMES = ["084", "cam-1", "f.003", "_x", "Zoë", "摄像机", "камера_1", "कैमरा", "مصور", "a" * LONGEST]
HOSTILE = [
    "", ".", "..", ".hidden", "../evil", "a/b", "/etc", "a\\b", "c0;touch pwned;", "$(touch pwned)", "`touch pwned`",
    "a b", "a\nb", "a\0b", "-x", "--out", "a'b", 'a"b', "a|b", "a&b", "a>b", "a*b", "{run}", "a,b", "~", "a\u202eb",
    "\u0301a", "\ud800", "<b>", "a" * (LONGEST + 1), "头" * LONGEST,
]  # fmt: skip


def test_the_rule():
    assert [name for name in NAMES if not is_name(name)] == []
    assert [name for name in HOSTILE if is_name(name)] == []


@pytest.mark.parametrize(
    ("folder", "name"),
    [
        ("a b", "a_b"),
        (".git", "_git"),
        ("-x", "_x"),
        ("Anna; rm *", "Anna__rm__"),
        ("头 像", "头_像"),
        ("Zoe\u0308", "Zoë"),
    ],
)
def test_a_folder_gives_a_name_like_its_own(folder, name):
    assert name_like(folder) == name
    assert is_name(name)


def _cameras(folder, *names):
    folder.mkdir(parents=True)
    entry = {"width": 8, "height": 8, "K": [[8, 0, 4], [0, 8, 4], [0, 0, 1]], "R": np.eye(3).tolist(), "t": [0, 0, 1]}
    (folder / "cameras.json").write_text(json.dumps({name: entry for name in names}))
    return folder


@pytest.mark.parametrize("name", HOSTILE)
def test_files_with_other_names_are_refused_in_one_line(tmp_path, name):
    folder = _cameras(tmp_path / "capture", "left", name)
    (folder / "splits.json").write_text(json.dumps({"frames": ["f0", name]}))
    for read in (lambda: open_capture(folder), lambda: read_splits(folder)):
        with pytest.raises(DataError, match="a name of letters") as caught:
            read()
        assert "\n" not in str(caught.value) and str(caught.value).isprintable()
    with pytest.raises(ConfigError, match=r"cameras\.json: camera: expected a name"):
        capture_subjects(str(folder), "")
    for key in ("variants", "crops", "protocols"):
        with pytest.raises(ConfigError, match=f"{key}: expected a name"):
            load_run({key: {name: {}}})
    with pytest.raises(ConfigError, match="run: expected a name"):
        load_run({"run": name})


def test_layouts_frame_packs_and_mesh_sequences_follow_the_same_rule(tmp_path):
    (tmp_path / "tables.yaml").write_text('"../t": {}\n')
    with pytest.raises(ConfigError, match=r"tables.yaml: table: expected a name .* '\.\./t'"):
        read_tables(tmp_path / "tables.yaml")
    manifest = {"stage": "crop", "subject": "s", "camera": "c", "width": 1, "height": 1, "frames": [], "layers": []}
    for key, value in (("subject", "../s"), ("camera", "c;x"), ("frames", ["../../f"])):
        with FramePackWriter(tmp_path / "p.zip", manifest | {"cam_from_world": None, key: value}):
            pass
        with pytest.raises(DataError, match=f"p.zip: {key}: expected a name"):
            FramePack(tmp_path / "p.zip")
    np.savez(tmp_path / "m.npz", frames=np.array(["a/b"]), record=np.array("{}"))
    arrays = {f"head.{key}": np.zeros((1, 3, 3) if key == "verts" else (3, 3), np.float32) for key in ("rest", "verts")}
    faces = np.array([[0, 1, 2]])
    np.savez(tmp_path / "m.npz", frames=np.array(["a/b"]), **{"head.faces": faces}, **arrays)
    with pytest.raises(DataError, match="frames: expected a name"):
        read_sequence(tmp_path / "m.npz")


def test_two_folders_of_one_name_are_an_error(tmp_path):
    for name in ("a b", "a_b"):
        _cameras(tmp_path / "two" / name, "left", "right")
    with pytest.raises(ConfigError, match=r"a_b: expected a subject of its own, found 'a_b', which .*/a b is called"):
        capture_subjects(str(tmp_path / "two"), "")
    for name in ("张三", "李四"):
        _cameras(tmp_path / "chinese" / name, "left", "right")
    assert list(capture_subjects(str(tmp_path / "chinese"), "")) == ["张三", "李四"]


def test_check_writes_nothing_outside_its_folder(tmp_path, capfd):
    folder = _cameras(tmp_path / "capture", "left", "../evil")
    assert main(["check", str(folder), "--out", str(tmp_path / "out")]) == 2
    assert "camera: expected a name of letters, digits" in capfd.readouterr().err
    assert not list(tmp_path.rglob("*evil*"))


def test_verbs_refuse_such_subjects(tmp_path, capfd):
    for words in (["ingest", "--camera", "left"], ["tracks"]):
        out = ["--subject", "../s", "--layout", "capture", "--root", str(tmp_path), "--out", str(tmp_path / "o")]
        assert main([*words, *out]) == 2
        assert "--subject: expected a name" in capfd.readouterr().err
