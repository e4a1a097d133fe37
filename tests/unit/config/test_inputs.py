"""Digests of files that are not read."""

import json
import os

import pytest

from nbavatar.config.inputs import files_digest, mesh_digest, rig_digest, supplied_digest, supplied_place


@pytest.fixture
def root(tmp_path):
    (tmp_path / "splits.json").write_text(json.dumps({"frames": ["f0", "f1"]}))
    for folder in ("images/c", "masks/c", "meshes"):
        (tmp_path / folder).mkdir(parents=True)
        for name in ("f0", "f1"):
            (tmp_path / folder / f"{name}.png").write_bytes(b"1234")
            os.utime(tmp_path / folder / f"{name}.png", ns=(0, 10**18))
    return tmp_path


def _digest(root, kinds=("images", "masks")):
    for kept in ("_listing", "_folder", "_frames"):  # a plan asks once for each folder
        files_digest.__globals__[kept].cache_clear()
    return files_digest(str(root), "c", kinds)


def test_names_sizes_and_times_count_and_nothing_else(root):
    before = _digest(root)
    (root / "masks/c/f2.png").write_bytes(b"no frame")
    (root / "masks/c/.f0.png").write_bytes(b"hidden")
    (root / "masks/c/f0").mkdir()
    (root / "alpha/c").mkdir(parents=True)
    (root / "alpha/c/f0.png").write_bytes(b"another kind")
    assert _digest(root) == before
    for change in (
        lambda path: path.write_bytes(b"12345"),
        lambda path: os.utime(path, ns=(0, 10**18 + 1)),
        lambda path: path.unlink(),
        lambda path: (root / "masks/c/f1.jpg").write_bytes(b"1234"),
    ):
        change(root / "masks/c/f1.png")
        assert _digest(root) != before
        assert _digest(root, ["images"]) == _digest(root, ["images"])
        before = _digest(root)


def test_files_of_one_size_and_time_cannot_be_exchanged_unseen(root):
    before = _digest(root)
    folder = root / "masks/c"
    for old, new in (("f0.png", "x"), ("f1.png", "f0.png"), ("x", "f1.png")):
        (folder / old).rename(folder / new)
    assert _digest(root) != before


def test_what_a_link_points_to_counts(root):
    for name in ("f0", "f1"):
        (root / "images/c" / f"{name}.png").unlink()
        (root / "images/c" / f"{name}.png").symlink_to(root / "masks/c" / f"{name}.png")
    before = _digest(root)
    for name, other in (("f0", "f1"), ("f1", "f0")):
        (root / "images/c" / f"{name}.png").unlink()
        (root / "images/c" / f"{name}.png").symlink_to(root / "masks/c" / f"{other}.png")
    assert _digest(root) != before
    (root / "images/c/f0.png").unlink()
    (root / "images/c/f0.png").symlink_to("nowhere")
    assert _digest(root) == _digest(root)


def test_without_frames_every_file_counts(root):
    (root / "splits.json").write_text("{")
    before = _digest(root)
    (root / "masks/c/f2.png").write_bytes(b"maybe a frame")
    assert _digest(root) != before
    assert mesh_digest(str(root / "nowhere")) == mesh_digest(str(root / "nowhere either"))
    assert rig_digest(str(root)) != rig_digest(str(root / "nowhere"))


def test_supplied_masks_are_found_as_the_stage_finds_them(tmp_path):
    assert supplied_place(str(tmp_path), "s", "c") is None and supplied_digest(str(tmp_path), "s", "c") == ""
    (tmp_path / "c.mp4").write_bytes(b"film")
    assert supplied_place(str(tmp_path), "s", "c") == tmp_path / "c.mp4"
    film = supplied_digest(str(tmp_path), "s", "c")
    (tmp_path / "s/c").mkdir(parents=True)
    (tmp_path / "s/c/0001.png").write_bytes(b"mask")
    assert supplied_place(str(tmp_path), "s", "c") == tmp_path / "s/c"
    assert supplied_digest(str(tmp_path), "s", "c") not in ("", film)
