"""`masks: {keep: person}`: the matte as it is."""

import json

import cv2
import numpy as np
import pytest
from PIL import Image

from nbavatar.cli import main
from nbavatar.io.framepack import FramePack


@pytest.fixture
def person(capture, tmp_path):
    """Mattes that go down to the edge of the image below the parts, as shoulders do; and their parts."""
    for path in capture.glob("masks/*/*.png"):
        matte = np.where(np.array(Image.open(path)) > 0, 255, 0).astype(np.uint8)
        rows, columns = np.nonzero(matte)
        matte[rows.max() - 8 :, columns.min() : columns.max()] = 255
        Image.fromarray(matte).save(path)
    common = ["--layout", "capture", "--root", str(capture), "--subject", "me"]
    assert main(["ingest", *common, "--camera", "left", "--out", str(tmp_path / "left.zip")]) == 0
    assert main(["tracks", *common, "--out", str(tmp_path / "t.npz")]) == 0
    return tmp_path


def labels(folder, **cfg):
    words = ["--frames", str(folder / "left.zip"), "--meshes", str(folder / "t.npz"), "--out", str(folder / "m.zip")]
    assert main(["masks", *words, "--cfg", json.dumps({"forearm_length": 0.0, **cfg})]) == 0
    with FramePack(folder / "m.zip") as pack:
        assert pack.manifest["keep"] == cfg.get("keep", "parts")  # `shell` takes no shoulders for hair
        return {frame: pack.read("label", frame) for frame in pack.frames}


def test_hair_and_shoulders_stay_where_the_person_is_kept(person):
    cut, kept = labels(person), labels(person, keep="person")
    with FramePack(person / "left.zip") as pack:
        for frame, label in kept.items():
            matte = cv2.medianBlur(pack.read("person", frame), 3) > 127  # corners are rounded, as in every matte
            np.testing.assert_array_equal(label > 0, matte)
            assert (cut[frame] > 0).sum() < 0.9 * matte.sum(), "the test has shoulders to cut"
            hand = cut[frame] == 2
            assert hand.any() and (label[hand] == 2).all(), "hands are told apart as before"
            assert set(np.unique(label[matte & (cut[frame] == 0)])) <= {1}
