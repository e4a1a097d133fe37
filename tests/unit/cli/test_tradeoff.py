"""`nbavatar tradeoff` on a toy scene, and what render, speed and train make of its presets."""

import csv
import json
from pathlib import Path

import pytest
import torch

from nbavatar.cli import main as cli
from nbavatar.cli import tradeoff
from nbavatar.config.core import merge
from nbavatar.io.framepack import FramePack
from nbavatar.io.records import read_json
from tests.scenes.toy import SIZE, rewritten, write_scene
from tests.scenes.training import train_config, train_options

SHEET = {
    "exact": {"roi": False},
    "knobs": {"roi": [True], "order": ["center"], "decode": [0.5], "billboards": [0.5]},
    "presets": {"balanced": {"psnr": 0.1, "lpips": 0.002}, "fast": {"psnr": 60.0, "lpips": 9.0}},
    "images": 2,
    "repeats": 2,
    "warmup": 0,
    "importance_views": 2,
}


def sweep(*words: str) -> int:
    """`nbavatar tradeoff`, whatever the table of verbs says."""
    import argparse

    parser = argparse.ArgumentParser()
    tradeoff.add_arguments(parser)
    return tradeoff.main(parser.parse_args(list(words)))


@pytest.fixture(scope="module")
def measured(tmp_path_factory) -> dict:
    """A toy avatar and its sweep."""
    folder = tmp_path_factory.mktemp("tradeoff")
    scene = write_scene(folder / "scene", size=64)
    cfg = {
        "steps": 2, "texels": 4, "weight_lpips": 0.0, "previews": 0,
        "unet": {"width": 4, "depth": 2, "max_width": 8, "convs": 1},
    }  # fmt: skip
    model, packs = str(folder / "full" / "model.pt"), [str(path) for path in scene["packs"]]
    common = ["--meshes", str(scene["meshes"]), "--device", "cpu"]
    train = ["train", "--frames", *packs[:2], *common, "--spectral", str(scene["spectral"]), "--out", model]
    assert cli([*train, "--cfg", json.dumps(train_options(cfg))]) == 0
    words = ["--model", model, *common, "--frames", packs[2], "--train-frames", *packs[:2]]
    words += ["--sheet", json.dumps(SHEET), "--out", str(folder / "out")]
    assert sweep(*words) == 0
    return {"folder": folder, "model": model, "packs": packs, "common": common, "words": words, "scene": scene}


def test_a_sweep_writes_a_row_a_point_and_all_its_files(measured, capsys) -> None:
    out = measured["folder"] / "out"
    rows = list(csv.DictReader((out / "points.csv").open()))
    assert {"exact", "roi=on", "order=center", "decode=0.5", "billboards=0.5"} <= {row["label"] for row in rows}
    exact = rows[0]
    assert exact["label"] == "exact" and float(exact["speedup"]) == 1 and float(exact["diff_max"]) == 0
    for row in rows:
        assert float(row["total_ms"]) > 0 and float(row["peak_memory_mb"]) > 0 and 0 <= float(row["diff_share"]) <= 1
        assert float(row["psnr_lost"]) == pytest.approx(float(exact["psnr"]) - float(row["psnr"]), abs=1e-9)
    half = next(row for row in rows if row["label"] == "decode=0.5")
    assert float(half["decoded_pixels"]) == float(exact["decoded_pixels"]) / 4
    assert float(next(r for r in rows if r["label"] == "billboards=0.5")["posed"]) == 6
    for name in ("front_ms", "front_memory", "front_bytes"):
        assert (out / f"{name}.png").stat().st_size > 5000 and (out / f"{name}.pdf").read_bytes()[:4] == b"%PDF"
    assert "`order`" in (out / "knobs.md").read_text() and read_json(out / "tradeoff.json")["complete"] is True
    before = (out / "points.jsonl").read_text()
    assert sweep(*measured["words"]) == 0
    assert "0 points measured" in capsys.readouterr().out and (out / "points.jsonl").read_text() == before


def test_render_and_speed_take_presets_and_budgets(measured, tmp_path, capsys) -> None:
    model, out = measured["model"], str(tmp_path / "r.zip")
    render = ["render", "--model", model, "--frames", measured["packs"][2], *measured["common"], "--out", out]
    protocol = json.dumps({"name": "nv", "split": "novel_view", "roi": False})
    pictures = {}
    for words in (["--preset", "accurate"], [], ["--preset", "fast"], ["--max-ms", "1e9"], ["--min-psnr", "0"]):
        assert cli([*render, "--protocol", protocol, *words]) == 0
        with FramePack(out) as pack:
            pictures[" ".join(words)] = pack.read("rgb", pack.frames[0]).tobytes()
            assert ("tuned" in pack.manifest["record"]) == bool(words)
    assert pictures["--preset accurate"] == pictures[""]
    by_protocol = json.dumps({"name": "nv", "split": "novel_view", "preset": "fast"})
    assert cli([*render, "--protocol", by_protocol]) == 0
    with FramePack(out) as pack:
        assert pack.read("rgb", pack.frames[0]).tobytes() == pictures["--preset fast"]
    judge = ["evaluate", "--render", out, "--frames", measured["packs"][2], "--out", str(tmp_path / "e.json")]
    judge += ["--cfg", json.dumps({"nets": [], "trivial": False})]
    assert cli([*judge, "--protocol", by_protocol]) == 0
    assert cli([*judge, "--protocol", protocol]) == 2
    assert "preset: expected none, as the protocol says, found fast" in capsys.readouterr().err
    assert cli([*render, "--max-ms", "1e-6"]) == 2
    assert "--max-ms: expected a measured setting" in capsys.readouterr().err
    assert cli([*render, "--preset", "fats"]) == 2
    assert "did you mean 'fast'" in capsys.readouterr().err
    small = write_scene(tmp_path / "small", size=SIZE)
    other = ["render", "--model", model, "--frames", str(small["packs"][2]), *measured["common"], "--out", out]
    assert cli([*other, "--max-ms", "100"]) == 2
    assert "run `nbavatar tradeoff`" in capsys.readouterr().err
    timing = ["speed", "--model", model, "--frames", measured["packs"][2], *measured["common"]]
    timing += ["--out", str(tmp_path / "speed.json"), "--cfg", json.dumps({"frames": 1, "repeats": 2, "warmup": 0})]
    assert cli([*timing, "--preset", "fast"]) == 0
    record = read_json(tmp_path / "speed.json")["speed"]
    assert record["tuned"]["preset"] == "fast" and {"pose", "raster", "compose"} < set(record["ms"])


def test_presets_of_another_training_are_refused(measured, tmp_path, capsys) -> None:
    moved = tmp_path / "model.pt"
    moved.write_bytes(Path(measured["model"]).read_bytes() + b"\0")
    (tmp_path / "presets.json").write_bytes(Path(measured["model"]).with_name("presets.json").read_bytes())
    words = ["render", "--model", str(moved), "--frames", measured["packs"][2], *measured["common"]]
    assert cli([*words, "--out", str(tmp_path / "r.zip"), "--preset", "fast"]) == 2
    assert "run `nbavatar tradeoff` again" in capsys.readouterr().err


def test_training_takes_order_and_window_from_a_preset(tmp_path) -> None:
    from nbavatar.cli.train import _with_preset

    setting = {"order": "center", "roi": False, "precision": "bf16", "texels": 2}
    entry = {
        "device": "x",
        "size": [1, 1],
        "presets": {"fast": {"setting": setting, "label": "", "why": ""}},
        "points": [],
    }
    content = {"kind": "nbavatar presets", "format": 1, "model": "m", "measured": [entry | {"importance": None}]}
    (tmp_path / "presets.json").write_text(json.dumps(content))
    config = _with_preset("fast", str(tmp_path / "presets.json"), train_config(texels=8))
    assert (config.own.order, config.own.roi, config.own.precision) == ("center", False, "bf16")
    assert config.own.texels == 8 and config.own.roi_margin == train_config().own.roi_margin


def test_a_training_keeps_textures_by_their_footprint(measured) -> None:
    from nbavatar.methods.storage import load_avatar

    scene, out = measured["scene"], str(measured["folder"] / "sized" / "model.pt")
    words = ["train", "--frames", *measured["packs"][:2], *measured["common"], "--spectral", str(scene["spectral"])]
    options = load_avatar(measured["model"]).record["config"]
    options = merge(options, {"billboards": {"texture_density": 0.1}})
    assert cli([*words, "--out", out, "--cfg", json.dumps(options)]) == 0
    sized, whole = load_avatar(out), load_avatar(measured["model"])
    # An octahedron's face is some 30 px wide here, a tetrahedron's a third of that: 0.1 texels a pixel make 4 and 2.
    assert sized.billboards.sizes.tolist()[:8] == [4] * 8
    assert sized.textures()[1].shape == whole.textures()[1].shape
    assert torch.equal(sized.textures()[0][:8], whole.textures()[0][:8])


def test_savings_are_measured_on_and_off(measured) -> None:
    once = json.dumps({**SHEET, "images": 1, "repeats": 1})
    assert sweep(*measured["words"], "--sheet", once, "--savings") == 0
    rows = read_json(measured["folder"] / "out" / "savings.json")["rows"]
    by_name = {(row["saving"], row["scene"]): row for row in rows}
    window = by_name["region of interest", "avatar 8x smaller"]
    assert window["on_decoded_pixels"] < window["off_decoded_pixels"] == 64 * 64
    empty = by_name["empty pictures skipped", "avatar behind the camera"]
    assert empty["on_raster_calls"] == empty["on_decoder_calls"] == 0 < empty["off_decoder_calls"]
    head = by_name["absent parts left out", "head only"]
    assert (head["on_posed"], head["off_posed"]) == (8, 12) and head["diff_share"] == 0
    sized = by_name["textures by footprint (1 texels a pixel)", "held-out pictures"]
    assert sized["on_mb"] <= sized["off_mb"] + 1e-4 and sized["psnr_change"] is not None
    names = {name for name, _ in by_name}
    for name in ("billboards pruned", "billboards that training", "early ray stop", "level of detail"):
        assert any(saving.startswith(name) for saving in names)
    text = (measured["folder"] / "out" / "savings.md").read_text()
    assert "None" not in text and text.count("\n") == len(rows) + 2
    assert all(row["on_ms"] > 0 and row["off_ms"] > 0 for row in rows)


def test_pictures_that_show_nobody_are_not_judged(measured, tmp_path, capsys) -> None:
    sheet = json.dumps({**SHEET, "knobs": {}, "images": 3, "repeats": 1})

    def points(name: str, frames: list[str], hide: list[str]) -> int:
        truth = rewritten(measured["packs"][2], tmp_path / f"{name}.zip", frames, hide=hide)
        words = ["--model", measured["model"], *measured["common"], "--frames", truth, "--sheet", sheet, "--no-store"]
        return cli(["tradeoff", *words, "--train-frames", *measured["packs"][:2], "--out", str(tmp_path / name)])

    assert points("with", ["f0", "f1", "f2"], ["f1"]) == points("without", ["f0", "f2"], []) == 0
    found = [read_json(tmp_path / name / "tradeoff.json") for name in ("with", "without")]
    assert [one["images"] for one in found] == [2, 2]
    judged = ("psnr", "psnr_fg", "ssim", "lpips", "psnr_apart")
    assert [found[0]["points"][0][key] for key in judged] == [found[1]["points"][0][key] for key in judged]
    assert points("nobody", ["f0", "f1"], ["f0", "f1"]) == 2
    assert "expected someone in one of its images at least, found 2 images" in capsys.readouterr().err
