"""The tidy table of all results, as a notebook opens it."""

import json
import math

import pandas as pd

from nbavatar.cli import main
from nbavatar.reporting.results import COLUMNS_OF_RESULTS


def test_a_notebook_finds_every_number_with_its_identity_unit_and_source(tmp_path):
    images = [
        {"camera": "084", "frame": "000007", "psnr": 20.1, "ssim": 0.1 + 0.2},
        {"camera": "NA", "frame": "000008", "psnr": None, "ssim": None},
    ]
    path = tmp_path / "eval" / "S2" / "full" / "nv1024.json"
    path.parent.mkdir(parents=True)
    protocol = {"name": "nv1024", "split": "all", "crop": "c", "background": [1, 1, 1], "precision": "fp32"}
    content = {
        "subject": "S2", "variant": "full", "protocol": protocol, "protocol_hash": "ab12", "size": [64, 32], "count": 2,
        "frames": "f", "metrics": {"psnr": 20.1, "ssim": 0.1 + 0.2}, "per_image": images,
        "trivial": {"background": {"psnr": 9.5}}, "training": {"model_bytes": 2_500_000, "train_seconds": 90},
    }  # fmt: skip
    path.write_text(json.dumps(content))
    speed = tmp_path / "speed" / "S2" / "full.json"
    speed.parent.mkdir(parents=True)
    speed.write_text(json.dumps({"speed": {"ms": {"raster": 1.25}, "size": [64, 32], "peak_memory_mb": 3.5}}))
    out = tmp_path / "results.csv"
    assert main(["collect", "--run", "r", "--evals", str(path), "--speeds", str(speed), "--out", str(out)]) == 0

    text = {name: str for name in ("subject", "view", "frame")}
    results = pd.read_csv(out, dtype=text, keep_default_na=False, float_precision="round_trip")
    assert tuple(results.columns) == COLUMNS_OF_RESULTS and set(results["run"]) == {"r"}
    keyed = results.set_index(["protocol", "view", "frame", "metric"])[["value", "unit"]].to_dict("index")
    assert keyed == {
        ("nv1024", "", "", "psnr"): {"value": 20.1, "unit": "dB"},
        ("nv1024", "", "", "ssim"): {"value": 0.1 + 0.2, "unit": "1"},
        ("nv1024", "", "", "background.psnr"): {"value": 9.5, "unit": "dB"},
        ("nv1024", "", "", "model_mb"): {"value": 2.5, "unit": "MB"},
        ("nv1024", "", "", "train_minutes"): {"value": 1.5, "unit": "min"},
        ("nv1024", "084", "000007", "psnr"): {"value": 20.1, "unit": "dB"},
        ("nv1024", "084", "000007", "ssim"): {"value": 0.1 + 0.2, "unit": "1"},
        ("", "", "", "ms.raster"): {"value": 1.25, "unit": "ms"},
        ("", "", "", "memory_mb"): {"value": 3.5, "unit": "MB"},
    }
    assert set(zip(results["source"], results["size"])) == {(str(path), "64x32"), (str(speed), "64x32")}
    whole = results[results["view"] == ""].pivot_table(index="variant", columns="metric", values="value")
    assert math.isclose(whole.loc["full", "psnr"], 20.1)


def test_a_number_that_is_none_is_one_line(tmp_path, capsys):
    protocol = {"name": "nv", "split": "all", "crop": "c", "background": [1, 1, 1], "precision": "fp32"}
    content = {
        "subject": "S2", "variant": "full", "protocol": protocol, "protocol_hash": "ab12", "size": [64, 32], "count": 2,
        "frames": "f", "metrics": {"psnr": 20.1}, "per_image": [{"camera": "1", "frame": "2", "psnr": "high"}],
    }  # fmt: skip
    path = tmp_path / "nv.json"
    path.write_text(json.dumps(content))
    assert main(["collect", "--evals", str(path), "--out", str(tmp_path / "results.csv")]) == 2
    error = capsys.readouterr().err
    assert "per_image[0].psnr: expected a finite number or null, found 'high'" in error and error.count("\n") == 1
    assert not (tmp_path / "results.csv").exists()
