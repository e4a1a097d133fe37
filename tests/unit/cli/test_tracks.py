import json

import numpy as np

from nbavatar.cli import main
from nbavatar.data.sequences import read_sequence
from nbavatar.io.framepack import FramePack


def test_decaf_tracks_have_the_frames_of_the_ingested_images(decaf, tmp_path):
    cfg = json.dumps({"every": 2, "test_fraction": 0.25})
    common = ["--layout", "decaf", "--root", str(decaf), "--subject", "S2", "--cfg", cfg]
    assert main(["tracks", *common, "--out", str(tmp_path / "t.npz")]) == 0
    assert main(["ingest", *common, "--camera", "084", "--out", str(tmp_path / "a.zip")]) == 0
    sequence, record = read_sequence(tmp_path / "t.npz")
    with FramePack(tmp_path / "a.zip") as pack:
        assert sequence.frames == pack.frames
        assert list(sequence.extras["split"]) == [pack.manifest["split"][frame] for frame in pack.frames]
        assert sequence.extras["segments"].tolist() == pack.manifest["segments"]
        assert record["split_digest"] == pack.manifest["split_digest"]
    assert record["cameras"]["100"]["distortion_key"] == "dist_coeffs" and record["absent"] == []
    assert record["head_pose_rotation_error"] < 1e-6


def test_capture_tracks(capture, tmp_path):
    words = ["tracks", "--layout", "capture", "--root", str(capture), "--subject", "me"]
    assert main([*words, "--out", str(tmp_path / "t.npz")]) == 0
    assert main([*words, "--out", str(tmp_path / "g.npz"), "--cfg", '{"contact": "given"}']) == 0
    rigid, _ = read_sequence(tmp_path / "t.npz")
    given, _ = read_sequence(tmp_path / "g.npz")
    assert list(rigid.parts) == ["head", "right_hand"]
    assert np.abs(rigid.parts["head"].verts - given.parts["head"].verts).max() > 5e-4
    np.testing.assert_array_equal(rigid.extras["head_final"], given.parts["head"].verts)
