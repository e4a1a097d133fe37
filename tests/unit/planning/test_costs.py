"""What a run will cost: the line through measured jobs, and how many jobs of which size there are."""

import json
import math

import numpy as np
import pytest

from nbavatar.config.tradeoff import read_sheet
from nbavatar.data.sequences import MeshSequence, Part, write_sequence
from nbavatar.errors import DataError
from nbavatar.planning.costs import Work, cost_of, read_costs, sweep_pictures, workload
from tests.unit.planning.plans import ROOT, shipped
from tools.costs import record, rows_of

SHEET = read_sheet({"knobs": {"order": ["center"]}, "images": 2, "repeats": 3, "warmup": 1}, "sheet")


def _sheet(tmp_path, *rows):
    path = tmp_path / "costs.tsv"
    lines = ["rule", "of", "unit", "units", "cpu_s", "peak_mb", "out_mb"], *rows
    path.write_text("".join("\t".join(map(str, line)) + "\n" for line in lines))
    return path


def test_the_cost_of_another_size_lies_on_the_line_through_two_measured_ones(tmp_path):
    costs = read_costs(
        _sheet(tmp_path, ("ingest", "", "frames", 4, 3.0, 150, 8), ("ingest", "", "frames", 8, 5.0, 140, 16))
    )
    cost = costs["ingest", ""]
    assert (cost.seconds.at(4), cost.seconds.at(8), cost.seconds.at(104)) == (3.0, 5.0, 53.0)
    assert cost.disk.at(100) == pytest.approx(200.0)
    # Noise may make a larger job look smaller: it is never taken to shrink further.
    assert cost.memory.at(1000) == 150 and cost.sizes == (4.0, 8.0)


def test_one_measured_size_is_taken_in_proportion_and_a_job_as_it_is(tmp_path):
    rows = (
        ("render", "full", "images", 4, 8.0, 900, 2),
        ("table", "", "job", 1, 2.0, 100, 0.1),
        ("table", "", "job", 1, 4.0, 120, 0.1),
    )
    costs = read_costs(_sheet(tmp_path, *rows))
    assert costs["render", "full"].seconds.at(10) == 20.0 and costs["render", "full"].memory.at(10) == 900
    assert costs["table", ""].seconds.at(1) == 3.0 and costs["table", ""].memory.at(1) == 120
    assert cost_of(costs, Work("render", "new", "images", 1, 1)) is costs["render", "full"]
    assert cost_of(costs, Work("video", "", "frames", 1, 1)) is None


def test_another_sheet_is_refused_in_one_line(tmp_path):
    with pytest.raises(DataError, match="row 2: expected numbers"):
        read_costs(_sheet(tmp_path, ("ingest", "", "frames", 4, "long", 150, 8)))
    path = tmp_path / "other.tsv"
    path.write_text("a\tb\n1\t2\n")
    with pytest.raises(DataError, match="header: expected rule, of, unit"):
        read_costs(path)


def test_the_work_of_the_paper_is_that_of_its_sheets():
    plan = shipped("paper")
    works = workload(plan, 1630, SHEET)
    jobs = {}
    for work in works:
        jobs[work.rule] = jobs.get(work.rule, 0) + work.jobs
    assert jobs == {
        "ingest": 32, "masks": 32, "crop": 64, "tracks": 4, "fit": 4, "spectral": 4, "deform": 4, "reenact": 4,
        "reenact_contact": 4, "train": 36, "render": 64, "evaluate": 64, "speed": 8, "video": 8, "tradeoff": 1,
        "savings": 1, "offline": 1, "extremes": 1, "collect": 1, "report": 1, "table": 8, "figure": 10,
    }  # fmt: skip
    steps = {work.of: work.count for work in works if work.rule == "train"}
    assert steps["full"] == steps["no_dnr"] == 400_000
    assert (steps["gaussian_avatars"], steps["splatting_avatar"]) == (600_000, 30_000)
    assert steps["interact_avatar"] == steps["interact_avatar512"] == 600_000
    images = {work.count for work in works if work.rule == "render" and work.of == "full"}
    assert images == {1630 - 326, 326 * 7}  # novel views of training frames; held-out frames in seven cameras
    assert sweep_pictures(SHEET) == 2 * (2 + 2 * 4)


def test_memory_grows_only_where_it_was_seen_to_and_models_do_not_grow_with_steps(tmp_path):
    rows = [("fit", "", "views", 8, 3, 400, 1), ("fit", "", "views", 16, 4, 500, 2)]
    rows += [("masks", "", "frames", 4, 2, 383, 1), ("masks", "", "frames", 8, 4, 389, 2)]
    rows += [("train", "full", "steps", 1, 75, 8000, 795), ("evaluate", "a", "images", 3, 9, 300, 0)]
    rows += [("evaluate", "a", "images", 7, 20, 400, 0)]  # one by one: a larger heap, not a larger need
    costs = read_costs(_sheet(tmp_path, *rows))
    assert costs["fit", ""].memory.at(32) == 700 and costs["masks", ""].memory.at(1630) == 389
    assert costs["evaluate", "a"].memory.at(10_000) == 400
    assert costs["train", "full"].disk.at(400_000) == 795 and costs["train", "full"].seconds.at(10) == 750


def test_what_the_paper_spends_its_time_on_was_measured():
    costs = read_costs(ROOT / "config/costs.tsv")
    works = workload(shipped("paper"), 1630, SHEET)
    lacking = {work.rule for work in works if cost_of(costs, work) is None}
    assert not lacking & {
        "ingest",
        "masks",
        "crop",
        "tracks",
        "fit",
        "spectral",
        "deform",
        "train",
        "render",
        "evaluate",
    }
    for cost in costs.values():
        assert all(math.isfinite(line.at(1e6)) and line.slope >= 0 for line in (cost.seconds, cost.memory, cost.disk))


def _line(words: str, cpu_s: float, code: int = 0, peak_mb: int = 100) -> dict:
    return {"words": words.split(), "code": code, "cpu_s": cpu_s, "peak_mb": peak_mb, "out_mb": 1.0}


def test_the_jobs_of_a_run_become_rows(tmp_path, monkeypatch):
    """A sweep and its savings write into one folder; what failed, and what was done again, count once."""
    monkeypatch.chdir(tmp_path)
    for place in ("deform/S1.npz", "reenact/S1/S2.npz"):
        path = tmp_path / "results/run" / place
        path.parent.mkdir(parents=True)
        part = Part(np.array([[0, 1, 2]]), np.eye(3, dtype=np.float32), np.zeros((5, 3, 3), np.float32))
        write_sequence(path, MeshSequence([str(i) for i in range(5)], {"head": part}, {}), {})
    sheet = {"knobs": {}, "images": 1, "repeats": 1, "warmup": 0}
    train = """train --cfg {"steps":2} --out results/run/train/%s/full/model.pt"""
    lines = [
        _line("tradeoff --savings --out results/run/tradeoff/S1/full", 800.0),
        _line(f"tradeoff --sheet {json.dumps(sheet, separators=(',', ':'))} --out results/run/tradeoff/S1/full", 300.0),
        _line("tradeoff --offline --out results/run/tradeoff/S1/offline", 7.0),
        _line(train % "S1", 90.0, code=137),
        _line(train % "S1", 100.0, peak_mb=300),
        _line(train % "S2", 30.0, peak_mb=200),
        _line(train % "S2", 110.0, peak_mb=200),
        _line("table --out-stem results/run/tables/a", 0.5),
        _line("deform --out results/run/deform/S1.npz", 2.0),
        _line("deform --out results/run/reenact/S1/S2.npz", 3.0),
        _line("deform --out results/run/reenact/S1/S2.npz", 9.0, code=1),
        _line("extremes --out results/run/extremes", 9.0),
        _line("check --out somewhere", 1.0),
    ]
    assert rows_of(lines) == [
        ("deform", "", "frames", 5.0, 2.0, 100, 1.0),
        ("extremes", "", "job", 1.0, 9.0, 100, 1.0),
        ("offline", "", "job", 1.0, 7.0, 100, 1.0),
        ("reenact_contact", "", "frames", 5.0, 3.0, 100, 1.0),
        ("savings", "", "job", 1.0, 800.0, 100, 1.0),
        ("table", "", "job", 1.0, 0.5, 100, 1.0),
        ("tradeoff", "", "pictures", float(sweep_pictures(read_sheet(sheet, "sheet"))), 300.0, 100, 1.0),
        ("train", "full", "steps", 2.0, 105.0, 300, 1.0),
    ]


def test_a_run_that_leaves_no_note_says_so(tmp_path, capsys):
    """Another `nbavatar` may come first in PATH; hours later the sheet would be empty."""
    assert record(tmp_path / "usage.jsonl", ["sh", "-c", "exit 3"]) == 3
    assert "usage.jsonl: nothing noted" in capsys.readouterr().err
    assert record(tmp_path / "usage.jsonl", ["sh", "-c", "nbavatar schema --help"]) == 0
    assert capsys.readouterr().err == "" and '"code": 0' in (tmp_path / "usage.jsonl").read_text()
