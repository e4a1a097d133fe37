"""Evaluation of stored renders, through the command, against figures computed anew from the arrays."""

import csv
import json
import math

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from nbavatar.cli import main
from nbavatar.evaluation.evaluate import composite, mean_images
from nbavatar.io.framepack import FramePack, FramePackWriter

SIZE = 40
FRAMES = ["0001", "0002", "0003"]
SPLIT = {"0001": "train", "0002": "train", "0003": "test"}


def image(seed: int, *, channels: bool = True) -> np.ndarray:
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (5, 5, 3) if channels else (5, 5))
    return np.kron(coarse, np.ones((8, 8, 1) if channels else (8, 8))).astype(np.uint8)


def alpha_of(seed: int) -> np.ndarray:
    alpha = np.zeros((SIZE, SIZE), np.uint8)
    alpha[8:32, 10 + seed % 3 : 30] = 255
    alpha[7, 10:30] = 100
    return alpha


def write_crop(path, camera, seed, unseen=None):
    """`unseen`: columns of which the camera's image says nothing."""
    manifest = {
        "stage": "crop", "subject": "S2", "camera": camera, "width": SIZE, "height": SIZE, "K": np.eye(3).tolist(),
        "cam_from_world": np.eye(4).tolist(), "distortion": None, "frames": FRAMES, "split": SPLIT,
        "segments": [[0, 2]], "layers": {"rgb": "", "alpha": ""}, "record": {},
    }  # fmt: skip
    if unseen is not None:
        manifest |= {"unseen": True, "layers": {"rgb": "", "alpha": "", "label": ""}}
    with FramePackWriter(path, manifest) as pack:
        for i, frame in enumerate(FRAMES):
            alpha = alpha_of(seed + i)
            if unseen is not None:
                alpha[:, unseen] = 0
                label = np.where(alpha > 0, np.uint8(1), np.uint8(0))
                label[:, unseen] = 255
                pack.add("label", frame, label)
            pack.add("rgb", frame, image(seed + i))
            pack.add("alpha", frame, alpha)


def write_render(path, images: dict[str, np.ndarray], record=None):
    manifest = {
        "stage": "render", "subject": "S2", "variant": "full", "camera": "102", "width": SIZE, "height": SIZE,
        "cam_from_world": np.eye(4).tolist(), "frames": list(images), "layers": {"rgb": ""}, "record": record or {},
    }  # fmt: skip
    with FramePackWriter(path, manifest) as pack:
        for name, picture in images.items():
            pack.add("rgb", name, picture)


@pytest.fixture
def files(tmp_path):
    for camera, seed in (("102", 10), ("108", 20), ("110", 30)):
        write_crop(tmp_path / f"{camera}.zip", camera, seed)
    return tmp_path


def run(files, render, *, frames=("102",), protocol="nv1024", train=("108", "110"), extra=()):
    return main(
        ["evaluate", "--render", str(render), "--frames", *(str(files / f"{c}.zip") for c in frames)]
        + (["--train-frames", *(str(files / f"{c}.zip") for c in train)] if train else [])
        + ["--protocol", protocol, "--out", str(files / "eval.json"), "--csv", str(files / "eval.csv"), *extra]
    )


FAST = ("--cfg", '{"nets": ["alex"], "device": "cpu"}')


def test_what_is_rendered_beyond_the_cameras_image_does_not_count(files):
    """A hand that leaves the picture goes on in the render: there is no truth to hold that against."""
    unseen = slice(24, SIZE)
    write_crop(files / "102.zip", "102", 10, unseen=unseen)
    results = []
    for seed in (1, 2):
        picture = image(7)
        picture[:, unseen] = image(seed)[:, unseen]
        write_render(files / "render.zip", {"102/0001": picture, "102/0002": picture})
        assert run(files, files / "render.zip", extra=FAST) == 0
        results.append(json.loads((files / "eval.json").read_text()))
    assert results[0]["per_image"] == results[1]["per_image"]
    blank = image(7)
    blank[:, unseen] = 255
    alpha = alpha_of(10)[..., None] / 255.0
    alpha[:, unseen] = 0
    error = (alpha * image(10) / 255.0 + 1 - alpha - blank / 255.0) ** 2
    assert results[0]["per_image"][0]["psnr"] == pytest.approx(-10 * math.log10(error.mean()), rel=1e-6)


def test_figures_equal_an_independent_computation(files):
    predictions = {"102/0001": image(1), "102/0002": image(2)}
    write_render(files / "render.zip", predictions)
    assert run(files, files / "render.zip", extra=FAST) == 0
    result = json.loads((files / "eval.json").read_text())
    expected = []
    for i, prediction in enumerate(predictions.values()):
        a = alpha_of(10 + i)[..., None] / 255.0
        truth = a * image(10 + i) / 255.0 + (1 - a)
        error = (truth - prediction / 255.0) ** 2
        inside = alpha_of(10 + i) >= 127.5
        similarity = structural_similarity(
            truth, prediction / 255.0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1.0,
            channel_axis=-1, full=True,
        )[1][5:-5, 5:-5].mean(-1)  # fmt: skip
        expected.append(
            (
                -10 * math.log10(error.mean()),
                -10 * math.log10(error[inside].mean()),
                similarity.mean(),
                similarity[inside[5:-5, 5:-5]].mean(),
            )
        )
    # float32 images against float64 ones.
    for row, values in zip(result["per_image"], expected, strict=True):
        found = [row[name] for name in ("psnr", "psnr_fg", "ssim", "ssim_fg")]
        np.testing.assert_allclose(found, values, rtol=1e-6)
        assert row["lpips_alex"] > 0
    means = np.mean(expected, axis=0)
    for name, value in zip(("psnr", "psnr_fg", "ssim", "ssim_fg"), means):
        assert result["metrics"][name] == pytest.approx(value, rel=1e-6)
    assert (result["subject"], result["variant"], result["protocol"]["name"]) == ("S2", "full", "nv1024")
    assert result["size"] == [SIZE, SIZE] and result["count"] == 2 and result["cameras"] == ["102"]
    assert result["train_cameras"] == ["108", "110"]
    assert set(result["record"]["inputs"]) == {"render", "frames.0", "train_frames.0", "train_frames.1"}
    with open(files / "eval.csv") as stream:
        rows = list(csv.DictReader(stream))
    assert [float(row["psnr"]) for row in rows] == [row["psnr"] for row in result["per_image"]]


def test_perfect_render_beats_everything_and_trivial_answers_are_what_they_say(files):
    # On a background of 0 and with coverage 0 or 255 the composite is exact in 8 bits, except the line of 100.
    truth = {}
    for i, frame in enumerate(FRAMES[:2]):
        alpha = alpha_of(10 + i)
        truth[f"102/{frame}"] = np.round(composite(image(10 + i), alpha, (0, 0, 0)) * 255).astype(np.uint8)
    write_render(files / "render.zip", truth)
    protocol = '{"name": "nv1024", "background": [0, 0, 0]}'
    assert run(files, files / "render.zip", protocol=protocol, extra=FAST) == 0
    result = json.loads((files / "eval.json").read_text())
    assert result["metrics"]["psnr"] > 50 and result["metrics"]["psnr_fg"] == 100
    assert result["metrics"]["ssim"] > 0.999 and result["metrics"]["lpips_alex"] < 1e-3
    black = [composite(image(10 + i), alpha_of(10 + i), (0, 0, 0)).astype(np.float64) for i in range(2)]
    expected = np.mean([-10 * math.log10((b**2).mean()) for b in black])
    assert result["trivial"]["background"]["psnr"] == pytest.approx(expected, rel=1e-6)
    train = [composite(image(s + i), alpha_of(s + i), (0, 0, 0)) for s in (20, 30) for i in range(2)]
    mean = np.mean(np.array(train, np.float64), axis=0)
    expected = np.mean([-10 * math.log10(((b - mean) ** 2).mean()) for b in black])
    assert result["trivial"]["mean_image"]["psnr"] == pytest.approx(expected, rel=1e-5)
    assert result["metrics"]["psnr"] > result["trivial"]["mean_image"]["psnr"]


def test_self_reenactment_uses_the_mean_image_of_the_same_camera(files):
    write_render(files / "render.zip", {"108/0003": image(1), "110/0003": image(2)})
    assert run(files, files / "render.zip", frames=("108", "110"), protocol="sr1024", extra=FAST) == 0
    result = json.loads((files / "eval.json").read_text())
    expected = []
    for seed in (20, 30):
        mean = np.mean([composite(image(seed + i), alpha_of(seed + i), (1, 1, 1)) for i in range(2)], axis=0)
        expected.append(
            -10 * math.log10(((composite(image(seed + 2), alpha_of(seed + 2), (1, 1, 1)) - mean) ** 2).mean())
        )
    assert result["trivial"]["mean_image"]["psnr"] == pytest.approx(np.mean(expected), rel=1e-5)


def test_same_files_give_the_same_bytes(files):
    write_render(files / "render.zip", {"102/0001": image(1), "102/0002": image(2)})
    run(files, files / "render.zip", extra=FAST)
    first = (files / "eval.json").read_bytes(), (files / "eval.csv").read_bytes()
    run(files, files / "render.zip", extra=FAST)
    assert ((files / "eval.json").read_bytes(), (files / "eval.csv").read_bytes()) == first


@pytest.mark.slow
def test_other_kernels_change_no_digit_that_a_table_shows(files):
    # Another machine takes other convolution kernels and sums in another order; this one too, without oneDNN.
    # Tables show 2 digits of PSNR, 3 of SSIM and LPIPS; the figures agree to 1e-6.
    write_render(files / "render.zip", {"102/0001": image(1), "102/0002": image(12)})
    extra = ("--cfg", '{"device": "cpu"}')
    results = []
    threads = torch.get_num_threads()
    for count, onednn in ((1, True), (2, False)):
        torch.set_num_threads(count)
        try:
            with torch.backends.mkldnn.flags(enabled=onednn):
                assert run(files, files / "render.zip", extra=extra) == 0
        finally:
            torch.set_num_threads(threads)
        results.append(json.loads((files / "eval.json").read_text())["metrics"])
    first, second = results
    assert set(first) == {"psnr", "psnr_fg", "ssim", "ssim_fg", "lpips_alex", "lpips_vgg"}
    for name, value in first.items():
        assert second[name] == pytest.approx(value, abs=1e-6), name
        digits = 2 if name.startswith("psnr") else 3
        assert f"{second[name]:.{digits}f}" == f"{value:.{digits}f}"


def test_features_are_computed_once_for_each_image(files, monkeypatch):
    # A VGG16 pyramid of 1024 px is half a gigabyte and seconds of work: each truth's serves the render and both trivial
    # answers, each trivial answer's serves every truth, and none is kept longer than it is needed.
    from nbavatar.metrics.lpips import LPIPS

    seen = []
    original = LPIPS.features
    monkeypatch.setattr(LPIPS, "features", lambda self, images: seen.append(self.net) or original(self, images))
    write_render(files / "render.zip", {"102/0001": image(1), "102/0002": image(2)})
    assert run(files, files / "render.zip", extra=("--cfg", '{"device": "cpu", "nets": ["alex", "vgg"]}')) == 0
    # Two truths and two renders by both nets; background and mean image by the first net only.
    assert seen.count("vgg") == 4 and seen.count("alex") == 4 + 2


def test_what_a_training_took_is_carried_over_from_the_render(files):
    training = {
        "config": {"method": "splatting_avatar", "splatting_avatar": {"mode": "released"}, "seed": 1}, "steps": 300,
        "seconds": 12.5, "primitives": 9000, "model_bytes": 123456, "last": {"loss": 1},
    }  # fmt: skip
    write_render(files / "render.zip", {"102/0001": image(1), "102/0002": image(2)}, record={"training": training})
    assert run(files, files / "render.zip", extra=("--cfg", '{"nets": [], "device": "cpu"}')) == 0
    assert json.loads((files / "eval.json").read_text())["training"] == {
        "method": "splatting_avatar", "mode": "released", "steps": 300, "train_seconds": 12.5, "primitives": 9000,
        "model_bytes": 123456,
    }  # fmt: skip


def test_digests_change_with_one_pixel(files):
    pictures = {"102/0001": image(1), "102/0002": image(2)}
    write_render(files / "render.zip", pictures)
    run(files, files / "render.zip", extra=("--cfg", '{"nets": []}'))
    before = json.loads((files / "eval.json").read_text())["digests"]
    pictures["102/0002"][3, 4, 1] ^= 1
    write_render(files / "render.zip", pictures)
    run(files, files / "render.zip", extra=("--cfg", '{"nets": []}'))
    after = json.loads((files / "eval.json").read_text())["digests"]
    assert before["truth"] == after["truth"] and before["prediction"] != after["prediction"]


@pytest.mark.parametrize(
    ("pictures", "protocol", "message"),
    [
        ({"102/0001": image(1)}, "nv1024", "expected 2 frames, found 1"),
        ({"102/0001": image(1), "102/0003": image(2)}, "nv1024", "a frame outside it"),
        ({"104/0001": image(1)}, "nv1024", "give the crops of every rendered camera"),
        ({"102/0001": image(1), "102/0002": image(2)[:, :32]}, "nv1024", "expected 40x40, as the truth, found 32x40"),
        ({"102/0001": image(1), "102/0002": image(2)}, '{"bakground": [1, 1, 1]}', "did you mean 'background'"),
        ({"102/0001": image(1), "102/0002": image(2)}, "nv2048", "expected JSON text or a file"),
    ],
)
def test_bad_input_is_one_line_exit_2_and_no_output(files, capsys, pictures, protocol, message):
    write_render(files / "render.zip", pictures)
    assert run(files, files / "render.zip", protocol=protocol, extra=("--cfg", '{"nets": []}')) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert message in error and error.startswith("nbavatar evaluate: error: ")
    assert not (files / "eval.json").exists() and not (files / "eval.csv").exists()


def test_mean_images_are_weighted_by_frames_not_by_cameras():
    ones, zeros = np.full((4, 4, 3), 255, np.uint8), np.zeros((4, 4, 3), np.uint8)
    full = np.full((4, 4), 255, np.uint8)
    means = mean_images([("a", ones, full, None), ("a", ones, full, None), ("b", zeros, full, None)], (0, 0, 0))
    assert means["a"].max() == 1 and means["b"].max() == 0
    np.testing.assert_allclose(means[""], 2 / 3, rtol=1e-6)
    assert mean_images([], (1, 1, 1)) == {}


def test_mean_images_are_of_what_is_known():
    ones, zeros = np.full((4, 4, 3), 255, np.uint8), np.zeros((4, 4, 3), np.uint8)
    full, left = np.full((4, 4), 255, np.uint8), np.tile(np.arange(4) < 2, (4, 1))
    corner = np.zeros((4, 4), bool)
    corner[0, 0] = True
    images = [("a", ones, full, left), ("a", zeros, full, corner)]
    (means,) = {mean_images(images, (0.5, 0.5, 0.5))[key].tobytes() for key in ("a", "")}
    found = np.frombuffer(means, np.float32).reshape(4, 4, 3)
    expected = np.where(left, 0.0, 0.5)
    expected[0, 0] = 0.5  # known in neither: the background
    np.testing.assert_array_equal(found, np.repeat(expected[..., None], 3, -1).astype(np.float32))


def test_the_mean_image_is_judged_where_the_truth_is_known(files):
    """A mean that is right where anything is known is as right as an answer can be."""
    for name in ("102", "train"):
        manifest = _manifest(files, name)
        with FramePackWriter(files / f"{name}.zip", manifest) as out:
            for n, frame in enumerate(manifest["frames"]):
                label, alpha = np.ones((SIZE, SIZE), np.uint8), alpha_of(3).copy()
                columns = slice(4 * n, 4 * n + 9)
                label[:, columns], alpha[:, columns] = 255, 0
                for layer, plane in (("rgb", image(3)), ("label", label), ("alpha", alpha)):
                    out.add(layer, frame, plane)
    write_render(files / "render.zip", {"102/0001": image(1), "102/0002": image(1)})
    extra = (*FAST, "--train-frames", str(files / "train.zip"))
    assert run(files, files / "render.zip", extra=extra) == 0
    assert json.loads((files / "eval.json").read_text())["trivial"]["mean_image"]["psnr"] > 60


def _manifest(files, name):
    """Of a crop with labels in which something says nothing."""
    write_crop(files / f"{name}.zip", name, 3, unseen=slice(0, 1))
    with FramePack(files / f"{name}.zip") as pack:
        return pack.manifest


def _without_anybody(path, frames):
    """The crop of a camera again, with nobody in some frames."""
    write_crop(path, "102", 10)
    with FramePack(path) as pack:
        kept = {(layer, frame): pack.read(layer, frame) for layer in pack.layers for frame in pack.frames}
        manifest = pack.manifest
    with FramePackWriter(path, manifest) as pack:
        for (layer, frame), picture in kept.items():
            pack.add(layer, frame, picture // 3 if layer == "alpha" and frame in frames else picture)


def test_frames_without_anybody_raise_no_mean(files):
    """A matte of 85 covers no pixel by half: background against background would count 100 dB."""
    _without_anybody(files / "102.zip", ["0002"])
    white = np.full((SIZE, SIZE, 3), 255, np.uint8)
    write_render(files / "render.zip", {"102/0001": image(1), "102/0002": white})
    assert run(files, files / "render.zip", extra=FAST) == 0
    result = json.loads((files / "eval.json").read_text())
    assert result["count"] == 2 and result["empty"] == 1
    assert {value for name, value in result["per_image"][1].items() if name not in ("camera", "frame")} == {None}
    assert result["metrics"]["psnr"] == result["per_image"][0]["psnr"] < 20
    assert result["trivial"]["background"]["psnr"] < 20


def test_an_empty_truth_stops_the_evaluation(files, capfd):
    _without_anybody(files / "102.zip", FRAMES)
    white = np.full((SIZE, SIZE, 3), 255, np.uint8)
    write_render(files / "render.zip", {"102/0001": white, "102/0002": white})
    assert run(files, files / "render.zip", extra=FAST) == 2
    assert "truth: alpha: expected someone in one of its images at least" in capfd.readouterr().err
    assert not (files / "eval.json").exists() and not (files / "eval.csv").exists()
