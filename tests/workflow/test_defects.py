"""Captures that go wrong, through the workflow with its real commands: each is stopped by its check, in one line."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.scenes.solid import write_solid

ROOT = Path(__file__).parents[2]

# One run over a folder of captures; nothing of them is trained.
pytestmark = pytest.mark.slow


def _cameras(change):
    def edit(capture):
        path = capture / "cameras.json"
        rig = json.loads(path.read_text())
        change(rig)
        path.write_text(json.dumps(rig))

    return edit


def _poses(change):
    def edit(rig):
        for entry in rig.values():
            R, t = change(np.array(entry["R"]), np.array(entry["t"]))
            entry |= {"R": R.tolist(), "t": t.tolist()}

    return _cameras(edit)


def _exchange(rig):
    rig["low"], rig["high"] = rig["high"], rig["low"]


def _nobody(capture):
    for path in capture.glob("masks/side/*.png"):
        Image.fromarray(np.zeros_like(np.array(Image.open(path)))).save(path)


def _other_meshes(capture):
    for path in capture.glob("meshes/f*.npz"):
        arrays = dict(np.load(path))
        np.savez(path, **arrays | {"head": arrays["head"] + np.float32([0.5, 0, 0])})


FLIP = np.diag([1.0, -1.0, -1.0])
DEFECTS = {
    "camera_to_world": (_poses(lambda R, t: (R.T, -R.T @ t)), "R, t are camera to world"),
    "opengl": (_poses(lambda R, t: (FLIP @ R, FLIP @ t)), "y and z look flipped"),
    "millimetres": (_poses(lambda R, t: (R, 1000 * t)), "t is in millimetres"),
    "position": (_poses(lambda R, t: (R, -R.T @ t)), "t is the camera's position: store -R t"),
    "exchanged": (_cameras(_exchange), "cameras low and high are exchanged"),
    "nobody": (_nobody, "masks/side: expected labelled pixels in a frame at least"),
    "elsewhere": (_other_meshes, "expected meshes that project onto the masks"),
    "image_gone": (lambda capture: (capture / "images/near/f2.png").unlink(), "images/near/f2"),
    "mesh_cut_short": (lambda capture: (capture / "meshes/f1.npz").write_bytes(b"PK"), "meshes/f1.npz: expected"),
}


def test_every_defect_stops_its_capture_before_anything_is_made_of_it(tmp_path):
    for name, (damage, _) in {"sound": (lambda capture: None, ""), **DEFECTS}.items():
        damage(write_solid(tmp_path / "captures" / name, size=48))
    project = tmp_path / "project"
    project.mkdir()
    for name in ("Snakefile", "workflow", "config", "nbavatar"):
        (project / name).symlink_to(ROOT / name)
    environment = {**os.environ, "PYTHONPATH": str(project), "OMP_NUM_THREADS": "1"}
    environment["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{environment['PATH']}"
    command = [
        sys.executable, "-m", "snakemake", "stage_ingest", "--keep-going", "--cores", "2",
        "--configfile", "config/capture.yaml", "--config", f"data_root={tmp_path / 'captures'}",
    ]  # fmt: skip
    done = subprocess.run(command, cwd=project, env=environment, capture_output=True, text=True, timeout=900)
    assert done.returncode != 0
    results = project / "results/capture"
    for name, (_, words) in DEFECTS.items():
        lines = (project / f"logs/capture/check/{name}.log").read_text().splitlines()
        defects = [line for line in lines if "error:" in line]
        assert len(defects) == 1 and words in defects[0], (name, lines)
        assert not any(results.glob(f"*/{name}*")) or not any((results / "check" / name).iterdir()), name
    # The sound one went on.
    assert sorted(path.stem for path in (results / "ingest").glob("*/*")) == ["high", "low", "near", "side"]
    assert [path.name for path in (results / "ingest").iterdir()] == ["sound"]
    assert json.loads((results / "check/sound/record.json").read_text())["defects"] == []
    assert np.array(Image.open(results / "check/sound/overview.png")).std() > 10
