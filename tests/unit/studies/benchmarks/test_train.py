"""`nbavatar bench train` on the trainings of the project: every part that a step has, and none that it has not."""

import json
from pathlib import Path

import pytest

from nbavatar.cli import main

CONFIG = Path(__file__).parents[4] / "config"
ALWAYS = {"data", "meshes", "raster", "unet", "lpips", "optimizer"}


@pytest.mark.slow
@pytest.mark.parametrize(("run", "own"), [("capture.yaml", {"colours"}), ("paper.yaml", {"regularisers"})])
def test_parts_of_a_step_are_those_of_the_run(capsys, run: str, own: set[str]) -> None:
    words = ["--json", "--size", "64", "--repeats", "1", "--device", "cpu"]
    assert main(["bench", "train", *words, "--config", str(CONFIG / run), "--against", "{normals: true}"]) == 0
    figures = json.loads(capsys.readouterr().out)
    parts = {name.removesuffix("_cpu_ms") for name in figures if name.endswith("_cpu_ms")}
    assert parts - {"step", "own", "against"} == ALWAYS | own
    assert all(figures[f"{name}_ms"] > 0 for name in parts - {"own", "against"})
