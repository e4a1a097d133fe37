import json

import numpy as np
import pytest

from nbavatar.cli import main
from nbavatar.io.framepack import FramePack


def ingest(root, out, layout="decaf", camera="084", **cfg):
    words = ["ingest", "--layout", layout, "--root", str(root), "--subject", "S2", "--camera", camera]
    return main([*words, "--out", str(out), "--cfg", json.dumps(cfg)])


def test_decaf_becomes_a_frame_pack(decaf, tmp_path):
    assert ingest(decaf, tmp_path / "a.zip", test_fraction=0.25) == 0
    with FramePack(tmp_path / "a.zip") as pack:
        assert pack.frames == [f"{i:06d}" for i in range(12)] and set(pack.layers) == {"rgb", "person"}
        assert pack.manifest["segments"] == [[0, 4], [5, 11]] and pack.manifest["distortion"] is None
        assert pack.split("test") == ["000004", "000010", "000011"]
        for i in (0, 7, 11):
            assert abs(int(pack.read("rgb", f"{i:06d}")[30, 40, 0]) - (10 + 18 * i)) <= 3
        corner = pack.read("rgb", "000003")[3, 3]
        assert corner[2] > 180 and corner[0] < 80, "colours are RGB"
        person = pack.read("person", "000000")
        assert person.shape == (48, 64) and person[20, 30] > 240 and person[2, 2] < 15
        record = pack.manifest["record"]
        assert record["folder"] == "train" and record["distortion_key"] is None and len(record["inputs"]) == 4
        assert record["source_frames"] == 12


def test_distortion_and_pixel_centres_reach_the_manifest(decaf, tmp_path):
    assert ingest(decaf, tmp_path / "a.zip", camera="100", pixel_center=0.0) == 0
    with FramePack(tmp_path / "a.zip") as pack:
        assert pack.manifest["distortion"][:2] == [0.1, -0.05]
        assert pack.manifest["record"]["distortion_key"] == "dist_coeffs"
        np.testing.assert_array_equal(pack.intrinsics("000000")[:2, 2], [31.5, 25.5])


def test_a_choice_of_frames_is_exact(decaf, tmp_path):
    assert ingest(decaf, tmp_path / "a.zip", start=1, every=3, max_frames=3) == 0
    with FramePack(tmp_path / "a.zip") as pack:
        assert pack.frames == ["000001", "000004", "000005"] and pack.manifest["segments"] == [[0, 1], [2, 2]]
        for frame in pack.frames:
            assert abs(int(pack.read("rgb", frame)[30, 40, 1]) - (10 + 18 * int(frame))) <= 3


def test_same_input_gives_the_same_bytes(decaf, tmp_path):
    for name in ("a.zip", "b.zip"):
        assert ingest(decaf, tmp_path / name, max_frames=4) == 0
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes()


@pytest.mark.parametrize("camera", ["left", "right"])
def test_capture_becomes_a_frame_pack(capture, tmp_path, camera):
    assert ingest(capture, tmp_path / "a.zip", layout="capture", camera=camera) == 0
    with FramePack(tmp_path / "a.zip") as pack:
        assert pack.frames == [f"t{i}" for i in range(5)] and pack.split("test") == ["t4"]
        label, alpha = pack.read("label", "t2"), pack.read("alpha", "t2")
        assert set(np.unique(label)) == {0, 1, 2} and ((alpha == 255) == (label > 0)).all()
