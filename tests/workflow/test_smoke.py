"""The smoke run as a user meets it: same command, same folder. After `make smoke` nothing is computed again."""

import csv
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "results/smoke"
TABLES = (
    "novel_view_1024", "self_reenactment_1024", "interactavatar_512", "ablation", "channels", "speed", "cameras",
)  # fmt: skip

pytestmark = pytest.mark.slow


def _snakemake(*words):
    command = [
        sys.executable,
        "-m",
        "snakemake",
        "--workflow-profile",
        "profiles/ci",
        "--configfile",
        "config/smoke.yaml",
    ]
    environment = dict(os.environ)
    environment["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{environment['PATH']}"
    return subprocess.run([*command, *words], cwd=ROOT, env=environment, capture_output=True, text=True)


@pytest.fixture(scope="module", autouse=True)
def smoke():
    done = _snakemake()
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]


def _evaluations():
    return {path: json.loads(path.read_text()) for path in sorted((RESULTS / "eval").glob("*/*/*.json"))}


def test_a_second_run_has_nothing_to_do():
    done = _snakemake("-n")
    assert "Nothing to be done" in done.stdout + done.stderr


def test_every_table_is_there_in_three_formats():
    for table in TABLES:
        for suffix in ("csv", "md", "tex"):
            path = RESULTS / f"tables/{table}.{suffix}"
            assert path.stat().st_size > 100, path


def test_every_metric_is_a_finite_number_and_carries_its_provenance():
    evaluations = _evaluations()
    assert len(evaluations) == len((ROOT / "config/smoke/runs.tsv").read_text().splitlines()) - 1  # one a row
    for path, value in evaluations.items():
        assert all(math.isfinite(number) for number in value["metrics"].values()), path
        assert set(value["record"]) >= {"code", "config", "inputs", "versions", "device", "seed"}, path


def test_the_avatar_beats_the_trivial_answers_by_three_decibels():
    value = json.loads((RESULTS / "eval/S2/full/nv1024.json").read_text())
    best = max(answer["psnr"] for answer in value["trivial"].values())
    assert value["metrics"]["psnr"] > best + 3


def test_training_loss_falls():
    events = [json.loads(line) for line in (RESULTS / "train/S2/full/history.jsonl").read_text().splitlines()]
    losses = [event["mse"] for event in events if "mse" in event]
    assert len(losses) > 4
    tenth = max(1, len(losses) // 10)
    assert sum(losses[-tenth:]) < 0.5 * sum(losses[:tenth])


def test_reproduced_cells_name_a_result_that_holds_their_value():
    found = 0
    for table in ("novel_view_1024", "ablation", "channels", "interactavatar_512", "self_reenactment_1024"):
        with open(RESULTS / f"tables/{table}.csv", newline="") as stream:
            for row in csv.DictReader(stream):
                # Other metrics and the trivial answers are in the csv too, but not in the printed table.
                if row["block"] != "reproduced" or row["shown"] != "yes" or not row["value"]:
                    continue
                assert row["comparable"] == "no", row
                for source in row["source"].split(";"):
                    assert (ROOT / source.strip()).is_file(), row
                metric = row["column"].rpartition(".")[2]
                if metric == "psnr" and ";" not in row["source"]:
                    value = json.loads((ROOT / row["source"]).read_text())["metrics"]["psnr"]
                    assert float(row["value"]) == pytest.approx(value, abs=1e-9)
                    found += 1
    assert found >= 10


def test_smoke_numbers_are_labelled_and_printed_ones_are_the_papers():
    text = (RESULTS / "tables/novel_view_1024.md").read_text()
    assert "smoke size" in text
    with open(RESULTS / "tables/novel_view_1024.csv", newline="") as stream:
        printed = {(r["row"], r["column"]): r["value"] for r in csv.DictReader(stream) if r["block"] == "printed"}
    assert float(printed["Ours", "mean.psnr"]) == 25.65
    assert float(printed["GA", "S2.lpips"]) == 0.053


def test_report_is_one_file_that_needs_no_network():
    page = (RESULTS / "report/index.html").read_text()
    for word in ('src="http', "src='http", 'href="http://', "@import", "fetch("):
        assert word not in page
    assert "<img" in page and "data:image/" in page
