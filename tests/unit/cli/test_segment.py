"""Masks for captures without: what surrounds the networks with a stand-in, each network where it is there."""

import json
import os
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from nbavatar.cli import main
from nbavatar.data import detector_models
from nbavatar.io.images import decode_image
from nbavatar.preprocess.mask_values import ValueSurvey
from tests.scenes.tiny_sam3 import write_tiny_sam3

WHEEL = os.environ.get("NBAVATAR_DETECTOR_MODELS")
needs_wheel = pytest.mark.skipif(not WHEEL, reason="NBAVATAR_DETECTOR_MODELS does not name the wheel")


@pytest.fixture
def bare(capture):
    """The tiny capture without its masks."""
    for path in sorted((capture / "masks").rglob("*"), reverse=True):
        path.unlink() if path.is_file() else path.rmdir()
    (capture / "masks").rmdir()
    return capture


def error(capfd):
    lines = [line for line in capfd.readouterr().err.splitlines() if "error:" in line]
    assert len(lines) == 1, lines
    return lines[0]


@pytest.fixture(scope="module")
def tiny_sam3(tmp_path_factory):
    pytest.importorskip("transformers")
    return write_tiny_sam3(tmp_path_factory.mktemp("sam3"))


def segment(capture, *more, **cfg):
    return main(["segment", str(capture), *map(str, more), "--cfg", json.dumps(cfg)])


def test_sam3_labels_every_frame_and_draws_a_picture_a_camera(bare, tiny_sam3):
    prompts = {"head": "head", "right_hand": "hand"}
    assert segment(bare, "--method", "sam3", "--model", tiny_sam3, "--device", "cpu", prompts=prompts) == 0
    for camera in ("left", "right"):
        masks = [decode_image(bare / "masks" / camera / f"t{i}.png") for i in range(5)]
        assert all(mask.shape == (80, 96) and mask.dtype == np.uint8 and mask.max() <= 2 for mask in masks)
        assert any(mask.any() for mask in masks)
        sheet = decode_image(bare / "segment" / f"{camera}.png")
        assert (sheet == [255, 255, 0]).all(-1).sum() > 50
        assert json.loads((bare / "segment" / f"{camera}.json").read_text())["inputs"]["model"].startswith("sha256:")


def test_sam3_marks_what_hides_parts(tiny_sam3):
    from nbavatar.detection.sam3 import Sam3

    pictures = np.random.default_rng(0).integers(0, 255, (3, 40, 50, 3), dtype=np.uint8)
    found = {}
    for part in ("head", "covered"):
        found[part] = list(Sam3(tiny_sam3, {part: "clothes"}).run(iter(pictures)))
    assert any(label.any() for label in found["head"])
    for head, covered in zip(*found.values()):
        np.testing.assert_array_equal(covered, np.where(head == 1, 255, 0))


def test_sam3_forgets_frames_without_changing_what_it_finds(tiny_sam3, monkeypatch):
    from nbavatar.detection import sam3

    pictures = np.random.default_rng(0).integers(0, 255, (7, 40, 50, 3), dtype=np.uint8)
    model = sam3.Sam3(tiny_sam3, {"head": "head"})
    whole = list(model.run(iter(pictures)))
    sizes = []
    forget = sam3._forget

    def watched(session, before):
        forget(session, before)
        frames = sum(frame is not None for frame in session.processed_frames.values())
        sizes.append((frames, max(len(o["non_cond_frame_outputs"]) for o in session.output_dict_per_obj.values())))

    # The tiny model looks back on 2 frames.
    monkeypatch.setattr(sam3, "_KEPT", 3)
    monkeypatch.setattr(sam3, "_forget", watched)
    for ours, expected in zip(model.run(iter(pictures)), whole):
        np.testing.assert_array_equal(ours, expected)
    assert max(frames for frames, _ in sizes) <= 3 and max(outputs for _, outputs in sizes) <= 3


def test_masks_that_exist_are_never_touched(bare, tiny_sam3, capfd):
    (bare / "masks/right").mkdir(parents=True)
    (bare / "masks/right/t0.png").write_bytes(b"mine")
    words = ["--method", "sam3", "--model", tiny_sam3, "--device", "cpu"]
    assert segment(bare, *words) == 2
    assert "expected no masks yet, found masks, which stay as they are" in error(capfd)
    assert not (bare / "masks/left").exists() and (bare / "masks/right/t0.png").read_bytes() == b"mine"
    assert segment(bare, *words, "--cameras", "left") == 0
    assert segment(bare, *words, "--cameras", "left", "--out", bare / "other") == 2, "its picture is there"


def test_a_failure_leaves_no_half_camera(bare, tiny_sam3, capfd):
    (bare / "images/left/t3.png").write_bytes(b"\x89PNG")
    assert segment(bare, "--method", "sam3", "--model", tiny_sam3, "--device", "cpu") == 2
    assert "t3.png" in error(capfd)
    assert not any((bare / "masks").iterdir())


BAD_WORDS = ({"head": "face", "right_hand": "face"}, {"nose": "nose"}, {"head": ""})


@pytest.mark.parametrize("prompts", BAD_WORDS)
def test_prompts_that_cannot_be_told_apart_are_refused(bare, capfd, prompts):
    assert segment(bare, "--method", "sam3", "--model", "x", prompts=prompts) == 2
    assert "prompts: expected different words" in error(capfd)


def test_folders_that_are_no_model(bare, tmp_path, capfd):
    assert segment(bare, "--method", "sam3") == 2
    assert "--model: expected the folder of SAM 3's weights" in error(capfd)
    pytest.importorskip("transformers")
    assert segment(bare, "--method", "sam3", "--model", tmp_path) == 2
    assert "found no config.json; hf download" in error(capfd)
    (tmp_path / "config.json").write_text('{"model_type": "sam3_video"}')
    assert segment(bare, "--method", "sam3", "--model", tmp_path, "--device", "cpu") == 2
    assert "expected SAM 3's weights, found other files" in error(capfd)


def test_the_matting_network_is_checked_like_the_others(bare, tmp_path, capfd):
    wheel = tmp_path / "mediapipe.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr(f"mediapipe/modules/{detector_models._MATTING['person'][0]}", b"something else")
    assert segment(bare, "--method", "person", "--model", wheel) == 2
    assert "selfie_segmentation.tflite: expected SHA-256 9ee168ec" in error(capfd)


@needs_wheel
def test_a_person_is_told_from_the_background(bare):
    from skimage.data import astronaut

    from nbavatar.data.detector_models import read_matting_model
    from nbavatar.detection.matting import PersonMatting

    picture = astronaut()
    matte = PersonMatting(read_matting_model(WHEEL)).matte(picture)
    assert matte.shape == picture.shape[:2] and matte.dtype == np.uint8
    # Places that anybody can name: face, hair, both shoulders; flag, shuttle, wall.
    for x, y in ((225, 110), (190, 60), (130, 350), (340, 300)):
        assert matte[y, x] > 250, (x, y)
    for x, y in ((30, 200), (440, 60), (330, 30), (10, 10)):
        assert matte[y, x] < 5, (x, y)
    survey = ValueSurvey()
    survey.add(matte, False, "matte")
    assert survey.masks("masks", ["head", "right_hand"]).kind == "person", "what the other stages take for a matte"


def test_what_the_network_is_unsure_of_becomes_one_or_the_other():
    """A vague shoulder in a dark corner is no matte to the other stages: those are soft at their edges only."""
    from nbavatar.detection.matting import _decided

    y, x = np.mgrid[0:120, 0:160]
    sure = np.clip(1.2 - np.hypot(x - 60, y - 50) / 40, 0, 1).astype(np.float32)
    sure = np.maximum(sure, np.where((x > 90) & (y > 80), 0.4 + 0.15 * (x > 120), 0))
    matte = _decided(sure, 2)
    assert matte[110, 100] == 0 and matte[110, 150] == 255 and matte[50, 60] == 255
    survey = ValueSurvey()
    survey.add(matte, False, "matte")
    assert survey.masks("masks", ["head", "right_hand"]).kind == "person"
    person = (sure > 0.5).astype(np.uint8)
    away = np.maximum(*(cv2.distanceTransform(side, cv2.DIST_L2, 5) for side in (person, 1 - person)))
    soft = (matte > 0) & (matte < 255)
    assert soft.any() and away[soft].max() < 4


@needs_wheel
def test_person_mattes_are_written(bare):
    from skimage.data import astronaut

    for path in Path(bare / "images").rglob("*.png"):
        Image.fromarray(astronaut()).resize((96, 80)).save(path)
    assert segment(bare, "--method", "person", "--model", WHEEL) == 0
    mask = decode_image(bare / "masks/left/t0.png")
    assert mask.shape == (80, 96) and 0.25 < (mask > 127).mean() < 0.75 and mask.max() == 255
