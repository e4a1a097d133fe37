"""Folders of other programs through the whole workflow: imported, checked, trained, judged under both protocols."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from nbavatar.cli import main
from nbavatar.io.framepack import FramePack
from tests.scenes import foreign
from tests.workflow.test_capture import ROOT, TINY

pytestmark = pytest.mark.slow


def import_all(folder: Path) -> Path:
    """One capture from each format."""
    captures, meshes = folder / "captures", foreign.write_meshes(folder / "meshes")
    flame = foreign.write_flame(folder / "generic_model.pkl")
    made = {
        "vhap": ["vhap", foreign.write_vhap(folder / "param"), "--flame", flame],
        "nerfstudio": ["nerfstudio", foreign.write_nerfstudio(folder / "ns", moved=True), "--meshes", meshes],
        "colmap": ["colmap", foreign.write_colmap(folder / "colmap", binary=True), "--meshes", meshes],
    }
    for name, (kind, source, *more) in made.items():
        assert main(["import", kind, str(source), str(captures / name), *map(str, more)]) == 0
    return captures


def test_imported_captures_train_and_are_judged(tmp_path: Path) -> None:
    captures = import_all(tmp_path)
    project = tmp_path / "project"
    project.mkdir()
    for name in ("Snakefile", "workflow", "config", "nbavatar"):
        (project / name).symlink_to(ROOT / name)
    masks = {"masks": {"keep": "person"}}
    options = {**TINY, "stages": {**TINY["stages"], **masks, "align": {"iterations": 0}}}
    (tmp_path / "tiny.json").write_text(json.dumps(options))
    environment = {**os.environ, "PYTHONPATH": str(project), "OMP_NUM_THREADS": "1"}
    environment["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{environment['PATH']}"
    judged = {"vhap": ("nv", "sr"), "nerfstudio": ("nv",), "colmap": ("nv",)}
    scores = [f"results/capture/eval/{name}/full/{kind}.json" for name, kinds in judged.items() for kind in kinds]
    command = [
        sys.executable, "-m", "nbavatar", "warm", "--", "snakemake", "--cores", "2", *scores,
        "--configfile", "config/capture.yaml", str(tmp_path / "tiny.json"), "--config", f"data_root={captures}",
    ]  # fmt: skip
    done = subprocess.run(command, cwd=project, env=environment, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]
    for score in scores:
        metrics = json.loads((project / score).read_text())["metrics"]
        assert np.isfinite(list(metrics.values())).all()
    # VHAP's own split is judged: its held-out camera in the training moments, its held-out moment in the others.
    shown = {name: FramePack(project / f"results/capture/render/vhap/full/{name}.zip").frames for name in ("nv", "sr")}
    assert shown["nv"] == [f"222200037/0000{time}" for time in range(4)]
    assert shown["sr"] == ["222200036/00004", "222200038/00004"]
