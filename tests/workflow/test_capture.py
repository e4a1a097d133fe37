"""A capture of one's own through the whole workflow: folder in, avatar, metrics, tables, figures and report out."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from nbavatar.data.sequences import read_sequence
from nbavatar.io.framepack import FramePack
from nbavatar.provenance import file_digest
from tests.scenes.solid import write_solid

ROOT = Path(__file__).parents[2]
# Sizes and steps of a toy; every other setting is the one that users get.
TINY = {
    "crops": {"full": {"size": 32}},
    "stages": {
        "train": {
            "steps": 12,
            "lpips_crop": 32,
            "previews": 1,
            "billboards": {"texels": 4, "unet": {"width": 4, "max_width": 8}},
        },
        "speed": {"repeats": 1, "warmup": 0},
        "video": {"seconds": 0.1, "max_frames": 2},
    },
}

pytestmark = pytest.mark.slow


def test_a_capture_ends_in_tables_and_a_report(tmp_path: Path) -> None:
    project = tmp_path / "project"
    project.mkdir()
    for name in ("Snakefile", "workflow", "config", "nbavatar"):
        (project / name).symlink_to(ROOT / name)
    (tmp_path / "tiny.json").write_text(json.dumps(TINY))
    environment = {**os.environ, "PYTHONPATH": str(project), "OMP_NUM_THREADS": "1"}
    environment["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{environment['PATH']}"
    command = [
        sys.executable, "-m", "nbavatar", "warm", "--", "snakemake", "--cores", "2",
        "--configfile", "config/capture.yaml", str(tmp_path / "tiny.json"),
        "--config", f"data_root={write_solid(tmp_path / 'toy')}",
    ]  # fmt: skip
    done = subprocess.run(command, cwd=project, env=environment, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]
    results = project / "results/capture"
    scores = [json.loads((results / f"eval/toy/full/{name}.json").read_text()) for name in ("nv", "sr")]
    assert all(np.isfinite(list(score["metrics"].values())).all() for score in scores)
    # Meshes are aligned to what the training cameras saw, and to nothing else.
    _, record = read_sequence(results / "align/toy.npz")
    cameras = {file_digest(path): path.stem for path in (results / "ingest/toy").glob("*.zip")}
    looked_at = {cameras[digest] for name, digest in record["inputs"].items() if name.startswith("frames.")}
    held_out = {name.partition("/")[0] for name in FramePack(results / "render/toy/full/nv.zip").frames}
    assert len(held_out) == 1 and looked_at == set(cameras.values()) - held_out
    for table in ("novel_view", "self_reenactment", "speed"):
        assert "toy" in (results / f"tables/{table}.csv").read_text() or table == "speed"
    assert "toy" in (results / "report/index.html").read_text()
