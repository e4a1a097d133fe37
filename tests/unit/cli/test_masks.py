import json

import cv2
import numpy as np
import pytest
from PIL import Image

from nbavatar.cli import main
from nbavatar.io.framepack import FramePack


@pytest.fixture
def prepared(capture, tmp_path):
    """The capture with person mattes in place of labels, ingested, and its tracks."""
    for path in capture.glob("masks/*/*.png"):
        label = np.array(Image.open(path))
        Image.fromarray(np.where(label > 0, 255, 0).astype(np.uint8)).save(path)
    common = ["--layout", "capture", "--root", str(capture), "--subject", "me"]
    assert main(["ingest", *common, "--camera", "left", "--out", str(tmp_path / "left.zip")]) == 0
    assert main(["tracks", *common, "--out", str(tmp_path / "t.npz")]) == 0
    return tmp_path


def masks(folder, *more, **cfg):
    words = ["masks", "--frames", str(folder / "left.zip"), "--meshes", str(folder / "t.npz")]
    return main([*words, "--out", str(folder / "m.zip"), *more, "--cfg", json.dumps(cfg)])


def test_a_matte_is_cut_into_the_labels_it_was_made_from(prepared, capture_master):
    assert masks(prepared, forearm_length=0.0) == 0  # there is no forearm, and one sees into the open wrist
    with FramePack(prepared / "m.zip") as pack:
        assert pack.layers == ["alpha", "label"] and pack.manifest["stage"] == "masks"
        for frame in pack.frames:
            truth = np.array(Image.open(capture_master / "masks/left" / f"{frame}.png"))
            label = pack.read("label", frame)
            for part in (1, 2):
                both = ((label == part) & (truth == part)).sum()
                assert (
                    both / ((label == part) | (truth == part)).sum() > 0.97
                )  # the open ball's inside counts as forearm
            np.testing.assert_array_equal(pack.read("alpha", frame), np.where(label > 0, 255, 0))
        assert pack.manifest["record"]["pixels"]["labelled"] > 0


@pytest.mark.parametrize("covered", ["background", "unknown"])
def test_what_hides_a_mesh_is_background_or_unknown(prepared, covered):
    """The hand's open wrist shows its inside, which counts as forearm: with a sleeve it hides the hand's mesh."""
    assert masks(prepared, covered=covered) == 0
    with FramePack(prepared / "m.zip") as pack:
        unseen = sum(int((pack.read("label", frame) == 255).sum()) for frame in pack.frames)
        assert pack.manifest["record"]["pixels"]["unseen"] == unseen
        assert pack.manifest["unseen"] == (unseen > 0) == (covered == "unknown")


def test_labels_that_say_nothing_go_through_ingest_and_masks(capture, tmp_path):
    for path in capture.glob("masks/*/*.png"):
        label = np.array(Image.open(path))
        label[40:44, 40:48] = 255
        Image.fromarray(label).save(path)
    common = ["--layout", "capture", "--root", str(capture), "--subject", "me"]
    assert main(["ingest", *common, "--camera", "left", "--out", str(tmp_path / "left.zip")]) == 0
    assert main(["tracks", *common, "--out", str(tmp_path / "t.npz")]) == 0
    assert masks(tmp_path) == 0
    for name in ("left.zip", "m.zip"):
        with FramePack(tmp_path / name) as pack:
            for frame in pack.frames:
                assert (pack.unseen(frame)[40:44, 40:48]).all() and pack.unseen(frame).sum() == 32
                assert not pack.read("alpha", frame)[40:44, 40:48].any()


@pytest.mark.parametrize("layout", ["me/left/{}.png", "left/{}.png"])
def test_masks_of_one_s_own_by_image(prepared, capture_master, layout):
    for i in range(5):
        path = prepared / "own" / layout.format(f"t{i}")
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.open(capture_master / "masks/left" / f"t{i}.png").save(path)
    assert masks(prepared, "--supplied", str(prepared / "own")) == 0
    with FramePack(prepared / "m.zip") as pack:
        for frame in pack.frames:
            truth = np.array(Image.open(capture_master / "masks/left" / f"{frame}.png"))
            np.testing.assert_array_equal(pack.read("label", frame), truth)
        assert pack.manifest["record"]["supplied"] is True


def test_masks_of_one_s_own_by_video(decaf, tiny, tmp_path):
    common = ["--layout", "decaf", "--root", str(decaf), "--subject", "S2", "--cfg", '{"every": 3}']
    assert main(["ingest", *common, "--camera", "084", "--out", str(tmp_path / "left.zip")]) == 0
    assert main(["tracks", *common, "--out", str(tmp_path / "t.npz")]) == 0
    own = [np.zeros((48, 64), np.uint8) for _ in range(12)]
    for i, mask in enumerate(own):
        mask[10:30, 10 + i : 30 + i] = 255
    tiny.write_video(tmp_path / "own" / "084.mp4", own)
    assert masks(tmp_path, supplied=str(tmp_path / "own"), temporal=False) == 0
    tiny.write_video(tmp_path / "short" / "084.mp4", own[:5])
    assert masks(tmp_path, supplied=str(tmp_path / "short")) == 2


def test_labels_in_lossy_files_are_refused(decaf, tiny, tmp_path, capfd):
    common = ["--layout", "decaf", "--root", str(decaf), "--subject", "S2", "--cfg", '{"every": 3}']
    assert main(["ingest", *common, "--camera", "084", "--out", str(tmp_path / "left.zip")]) == 0
    assert main(["tracks", *common, "--out", str(tmp_path / "t.npz")]) == 0
    label = np.zeros((48, 64), np.uint8)
    label[10:30, 10:30], label[20:40, 35:50] = 1, 2
    for step in (1, 85):
        tiny.write_video(tmp_path / f"own{step}" / "084.mp4", [label * step] * 12)
        assert masks(tmp_path, supplied=str(tmp_path / f"own{step}")) == 2
        assert "084.mp4: values: expected labels 0..3" in capfd.readouterr().err
    writer = cv2.VideoWriter(str(tmp_path / "084.mkv"), cv2.VideoWriter_fourcc(*"FFV1"), 25, (64, 48))
    for _ in range(12):
        writer.write(cv2.cvtColor(label, cv2.COLOR_GRAY2BGR))
    writer.release()
    assert masks(tmp_path, supplied=str(tmp_path), temporal=False) == 0
    with FramePack(tmp_path / "m.zip") as pack:
        np.testing.assert_array_equal(pack.read("label", pack.frames[0]), label)
    (tmp_path / "jpg/084").mkdir(parents=True)
    for i in range(12):
        Image.fromarray(label).save(tmp_path / f"jpg/084/{i}.jpg")
    assert masks(tmp_path, supplied=str(tmp_path / "jpg")) == 2
    assert "084: values: expected labels 0..3" in capfd.readouterr().err


def test_a_person_of_0_and_1_is_cut_by_the_meshes_as_one_of_0_and_255_is(prepared, capture_master):
    assert masks(prepared) == 0
    with FramePack(prepared / "m.zip") as pack:
        expected = {frame: pack.read("label", frame) for frame in pack.frames}
    for camera in ("left", "right"):
        for i in range(5):
            path = prepared / "own" / camera / f"t{i}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            label = np.array(Image.open(capture_master / "masks" / camera / f"t{i}.png"))
            Image.fromarray(np.minimum(label, 1)).save(path)
    assert masks(prepared, "--supplied", str(prepared / "own")) == 0
    with FramePack(prepared / "m.zip") as pack:
        for frame in pack.frames:
            np.testing.assert_array_equal(pack.read("label", frame), expected[frame])
    # A hand that another camera's labels show makes labels of this camera's ones, too.
    Image.open(capture_master / "masks/right/t0.png").save(prepared / "own/right/t0.png")
    assert masks(prepared, "--supplied", str(prepared / "own")) == 0
    with FramePack(prepared / "m.zip") as pack:
        assert set(np.unique(pack.read("label", "t3"))) == {0, 1}


def test_alpha_beside_a_matte_is_its_coverage(capture, tmp_path):
    rng = np.random.default_rng(0)
    for path in capture.glob("masks/*/*.png"):
        matte = np.where(np.array(Image.open(path)) > 0, 255, 0).astype(np.uint8)
        Image.fromarray(matte).save(path)
        target = capture / "alpha" / path.parent.name / path.name
        target.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.where(matte > 0, rng.integers(200, 256, matte.shape), 0).astype(np.uint8)).save(target)
    common = ["--layout", "capture", "--root", str(capture), "--subject", "me"]
    assert main(["tracks", *common, "--out", str(tmp_path / "t.npz")]) == 0
    for more in ([], ["--images-only"]):
        assert main(["ingest", *common, "--camera", "left", "--out", str(tmp_path / "left.zip"), *more]) == 0
        assert masks(tmp_path, *(["--capture", str(capture)] if more else []), temporal=False) == 0
        with FramePack(tmp_path / "m.zip") as pack:
            for frame in pack.frames:
                given = np.array(Image.open(capture / f"alpha/left/{frame}.png"))
                label, alpha = pack.read("label", frame), pack.read("alpha", frame)
                assert (label > 0).sum() > 500 and (label[given == 0] == 0).all()
                np.testing.assert_array_equal(alpha, np.where(label > 0, given, 0))


def test_bad_masks_of_one_s_own(prepared, capfd):
    own = prepared / "own" / "left"
    own.mkdir(parents=True)
    Image.fromarray(np.zeros((10, 10), np.uint8)).save(own / "t0.png")
    assert masks(prepared, "--supplied", str(prepared / "own")) == 2
    assert "t0.png: size: expected 96 x 80 as its camera says, found 10 x 10" in capfd.readouterr().err
    cv2.imwrite(str(own / "t0.png"), np.zeros((80, 96), np.uint8))
    assert masks(prepared, "--supplied", str(prepared / "own")) == 2
    assert "frame t1: expected a mask such as t1.png, found none" in capfd.readouterr().err
    assert masks(prepared, "--supplied", str(prepared)) == 2
    assert "found none of them" in capfd.readouterr().err
    assert not (prepared / "m.zip").exists()


def test_a_camera_without_a_labelled_pixel_stops(prepared, capture_master, capfd):
    for i in range(5):
        path = prepared / "own/left" / f"t{i}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.zeros((80, 96), np.uint8)).save(path)
    assert masks(prepared, "--supplied", str(prepared / "own")) == 2
    assert "camera left: expected pixels of a head or a hand in a frame at least, found none" in capfd.readouterr().err
    assert not (prepared / "m.zip").exists()
