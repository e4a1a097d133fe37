import json

import numpy as np
import pytest

from nbavatar.camera.pinhole import project
from nbavatar.cli import main
from nbavatar.data.sequences import read_sequence
from nbavatar.io.framepack import FramePack, FramePackWriter


@pytest.fixture(scope="module")
def prepared(capture_master, tmp_path_factory):
    folder = tmp_path_factory.mktemp("crop")
    common = ["--layout", "capture", "--root", str(capture_master), "--subject", "me"]
    assert main(["ingest", *common, "--camera", "left", "--out", str(folder / "left.zip")]) == 0
    assert main(["tracks", *common, "--out", str(folder / "t.npz")]) == 0
    return folder


def crop(folder, out, *more, **cfg):
    words = ["crop", "--frames", str(folder / "left.zip"), "--meshes", str(folder / "t.npz")]
    return main([*words, "--out", str(out), *more, "--cfg", json.dumps(cfg)])


@pytest.mark.parametrize(
    "cfg",
    [
        {"kind": "center", "size": 64},
        {"kind": "box", "size": 64},
        {"kind": "box", "size": 48, "pad": 0.3},
        {"kind": "box", "size": 64, "per_frame": True},
        {"kind": "full", "size": 0},
        {"kind": "full", "size": 64, "multiple": 16},
        {"kind": "center", "size": 160},
    ],
)
def test_labels_lie_where_the_meshes_project_with_the_new_camera(prepared, tmp_path, cfg):
    assert crop(prepared, tmp_path / "c.zip", **cfg) == 0
    sequence, _ = read_sequence(prepared / "t.npz")
    with FramePack(tmp_path / "c.zip") as pack:
        size = pack.manifest["width"]
        assert size == (cfg["size"] or 96) and pack.manifest["height"] == size
        assert pack.manifest["distortion"] is None and ("K_per_frame" in pack.manifest) == cfg.get("per_frame", False)
        for row, frame in enumerate(pack.frames):
            label, alpha, rgb = (pack.read(layer, frame) for layer in ("label", "alpha", "rgb"))
            assert label.shape == alpha.shape == rgb.shape[:2] == (size, size)
            assert (np.isin(label, [1, 2, 3]) == (alpha > 0)).all()
            pixels, _ = project(sequence.parts["right_hand"].verts[row], pack.intrinsics(frame), pack.cam_from_world)
            low, high = pixels.min(0), pixels.max(0)
            rows, columns = np.nonzero(label == 2)
            seen = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
            # The hand's own outline is in view; half a native pixel of rasterization plus one of ours.
            slack = 1.0 + size / 80
            inside = np.concatenate([np.clip(low, 0, size), np.clip(high, 0, size)])
            assert np.abs(seen - inside).max() < slack


def test_what_the_camera_did_not_see_is_marked(prepared, tmp_path):
    native = FramePack(prepared / "left.zip").manifest
    for cfg in ({"kind": "full", "size": 0}, {"kind": "center", "size": 64}):
        assert crop(prepared, tmp_path / f"{cfg['kind']}.zip", **cfg) == 0
        with FramePack(tmp_path / f"{cfg['kind']}.zip") as pack:
            x0, y0, side = pack.manifest["record"]["window"]
            y, x = np.mgrid[y0 : y0 + side, x0 : x0 + side]
            outside = (x < 0) | (y < 0) | (x >= native["width"]) | (y >= native["height"])
            assert pack.manifest["unseen"] == outside.any() == (cfg["kind"] == "full")
            for frame in pack.frames:
                if outside.any():
                    np.testing.assert_array_equal(pack.unseen(frame), outside)
                else:
                    assert pack.unseen(frame) is None and pack.read("label", frame).max() < 4


@pytest.mark.parametrize("size", [0, 48])
def test_what_says_nothing_in_the_masks_says_nothing_in_the_crop(prepared, tmp_path, size):
    with FramePack(prepared / "left.zip") as pack:
        layers = {name: pack.manifest["layers"][name] for name in ("label", "alpha")}
        with FramePackWriter(tmp_path / "masks.zip", {**pack.manifest, "layers": layers}) as out:
            for frame in pack.frames:
                label, alpha = pack.read("label", frame), pack.read("alpha", frame)
                label[41:47, 31:51], alpha[41:47, 31:51] = 255, 0
                out.add("label", frame, label)
                out.add("alpha", frame, alpha)
    assert crop(prepared, tmp_path / "c.zip", "--masks", str(tmp_path / "masks.zip"), kind="full", size=size) == 0
    with FramePack(tmp_path / "c.zip") as pack, FramePack(prepared / "left.zip") as native:
        assert pack.manifest["unseen"]
        x0, y0, side = pack.manifest["record"]["window"]
        scale = (size or side) / side
        y, x = np.mgrid[0 : size or side, 0 : size or side] / scale
        x, y = x + x0, y + y0
        # A pixel of the crop spans [x, x + 1 / scale) of the picture.
        touched = (x + 1 / scale > 31) & (x < 51) & (y + 1 / scale > 41) & (y < 47)
        outside = (x < 0) | (y < 0) | (x >= native.manifest["width"]) | (y >= native.manifest["height"])
        for frame in pack.frames:
            np.testing.assert_array_equal(pack.unseen(frame), touched | outside)
            assert not pack.read("alpha", frame)[touched].any()


def test_box_covers_head_and_hand_with_its_margin(prepared, tmp_path):
    assert crop(prepared, tmp_path / "c.zip", kind="box", size=64, pad=0.1) == 0
    with FramePack(tmp_path / "c.zip") as pack:
        assert pack.manifest["record"]["boxes"] == "projected meshes"
        native = FramePack(prepared / "left.zip")
        for frame in pack.frames:
            before, after = native.read("label", frame), pack.read("label", frame)
            x0, y0, side = pack.manifest["record"]["window"]
            assert 0.9 < (after > 0).sum() * (side / 64) ** 2 / (before > 0).sum() < 1.15
            assert not before[: max(y0, 0)].any() and not before[:, : max(x0, 0)].any()


def test_a_box_of_decaf_uses_tracked_boxes_and_drops_invalid_rows(decaf, tmp_path):
    common = ["--layout", "decaf", "--root", str(decaf), "--subject", "S2"]
    assert main(["ingest", *common, "--camera", "084", "--out", str(tmp_path / "left.zip")]) == 0
    assert main(["tracks", *common, "--out", str(tmp_path / "t.npz")]) == 0
    masks = ["masks", "--frames", str(tmp_path / "left.zip"), "--meshes", str(tmp_path / "t.npz")]
    assert main([*masks, "--out", str(tmp_path / "m.zip")]) == 0
    more = ["--masks", str(tmp_path / "m.zip")]
    assert crop(tmp_path, tmp_path / "c.zip", *more, kind="box", size=32, pad=0.0) == 0
    with FramePack(tmp_path / "c.zip") as pack:
        record = pack.manifest["record"]
        assert record["boxes"] == "tracked boxes" and record["missing_boxes"] == ["000003", "000004"]
        assert record["window"] == [5, 6, 35]
    (decaf / "train/head_bbs").rename(decaf / "gone")
    assert main(["tracks", *common, "--out", str(tmp_path / "t2.npz")]) == 2


def test_without_masks_one_line_says_what_to_do(decaf, tmp_path, capfd):
    common = ["--layout", "decaf", "--root", str(decaf), "--subject", "S2"]
    assert main(["ingest", *common, "--camera", "084", "--out", str(tmp_path / "left.zip")]) == 0
    capfd.readouterr()
    words = ["crop", "--frames", str(tmp_path / "left.zip"), "--out", str(tmp_path / "c.zip")]
    assert main(words) == 2
    error = capfd.readouterr().err.strip()
    assert "expected label, found person, rgb; run `nbavatar masks`" in error and "\n" not in error
    assert not (tmp_path / "c.zip").exists()


def test_masks_of_other_frames_are_refused(prepared, tmp_path, capture_master, capfd):
    words = ["--layout", "capture", "--root", str(capture_master), "--subject", "me", "--camera", "left"]
    assert main(["ingest", *words, "--out", str(tmp_path / "few.zip"), "--cfg", '{"max_frames": 3}']) == 0
    assert crop(prepared, tmp_path / "c.zip", "--masks", str(tmp_path / "few.zip"), kind="full") == 2
    assert "frames: expected 5 frames as in" in capfd.readouterr().err
