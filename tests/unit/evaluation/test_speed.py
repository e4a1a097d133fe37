"""Timing record of a toy avatar."""

import json

import pytest

from nbavatar.cli import main
from nbavatar.io.records import read_json
from tests.scenes.toy import SIZE, write_scene
from tests.scenes.training import train_options


@pytest.mark.parametrize("deferred", [True, False])
def test_speed_times_every_stage_of_the_papers_table(tmp_path, deferred: bool) -> None:
    scene = write_scene(tmp_path / "scene")
    cfg = {
        "steps": 1, "texels": 4, "deferred": deferred, "weight_lpips": 0.0, "previews": 0,
        "unet": {"width": 4, "depth": 3, "max_width": 8, "convs": 1},
    }  # fmt: skip
    common = ["--meshes", str(scene["meshes"]), "--device", "cpu"]
    frames = ["--frames", *(str(path) for path in scene["packs"][:1])]
    model, out = str(tmp_path / "model.pt"), str(tmp_path / "speed.json")
    train = ["train", *frames, *common, "--spectral", str(scene["spectral"]), "--out", model]
    train += ["--cfg", json.dumps(train_options(cfg))]
    assert main(train) == 0
    timing = json.dumps({"frames": 2, "repeats": 3, "warmup": 1})
    assert (
        main(["speed", "--model", model, *frames, *common, "--out", out, "--cfg", timing, "--engine", "onnxruntime"])
        == 0
    )
    record = read_json(out)
    speed = record["speed"]
    expected = {"pose", "raster", "raster_rgb", "compose", "total_fp32"}
    if deferred:
        expected |= {"renderer_fp32", "renderer_bf16", "total_bf16", "renderer_engine", "total_engine"}
    assert speed["engine"].startswith("onnxruntime " if deferred else "eager")
    assert set(speed["ms"]) == expected and all(value > 0 for value in speed["ms"].values())
    for name, fps in speed["fps"].items():
        assert fps == pytest.approx(1000 / speed["ms"][name], rel=0.01)
    assert speed["size"] == [SIZE, SIZE] and speed["billboards"] == 12 and speed["peak_memory_mb"] > 0
    assert (speed["renderer_gmac"] is not None) == deferred
    assert record["command"] == "speed" and record["device"]
