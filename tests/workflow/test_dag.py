"""What the workflow plans, from nothing."""

import csv
import json
import re
import shlex
import subprocess
import sys

import pytest
import yaml

from tests.scenes.capture import write_capture
from tests.workflow.conftest import difference


def _sheet(project, name):
    with open(project.folder / name, newline="") as stream:
        return list(csv.DictReader(stream, delimiter="\t"))


def _counted(project, rows, subjects, crops):
    """Jobs of each unit of work, by the sheets alone."""
    rows, cameras = _sheet(project, rows), {s["subject"]: s["train_cameras"] for s in _sheet(project, subjects)}
    made = {row["subject"] for row in rows}
    views = sum(1 + len(cameras[name].split(",")) for name in made)
    trained = {(row["subject"], row["variant"]) for row in rows}
    return {
        **dict.fromkeys(("tracks", "fit", "spectral", "deform"), len(made)),
        **{"ingest": views, "masks": views, "crop": crops * views},
        **{"train": len(trained), "render": len(rows), "evaluate": len(rows)},
        **dict.fromkeys(("report", "collect", "extremes", "tradeoff"), 1),
    }


def _named(project, name):
    return yaml.safe_load((project.folder / name).read_text())


def test_default_target_is_everything_and_not_nothing(project):
    plan = project.plan()
    config = _named(project, "config/smoke.yaml")
    counted = _counted(project, config["runs"], config["subjects"], len(config["crops"]))
    counted |= {"synthesize": 1, "video": 2 * len(config["videos"]), "reenact": 1, "reenact_contact": 1}
    counted |= {"table": len(_named(project, "config/tables.yaml")), "figure": len(_named(project, config["figures"]))}
    assert 0 < plan.pop("speed") <= counted["train"]
    assert plan == counted


def test_a_variant_of_one_row_adds_one_training_one_render_one_evaluation(project):
    config, before = _named(project, "config/smoke.yaml"), project.plan()
    path = project.folder / config["runs"]
    sheet = path.read_text()
    (project.folder / "config/more.yaml").write_text(yaml.safe_dump({"variants": {"new": {"meshes": "fit"}}}))
    path.write_text(sheet + "S2\tnew\tsr1024\n")
    after = project.plan(config="config/smoke.yaml config/more.yaml")
    path.write_text(sheet)
    assert difference(before, after) == {"train": 1, "render": 1, "evaluate": 1}


def test_one_subject_one_table_one_stage_can_be_asked_for(project):
    subject, whole = project.plan("subject_S2"), project.plan()
    assert subject.pop("subject_S2") == 1
    shown = {"speed", "table", "collect", "report", "figure", "reenact", "reenact_contact", "video", "tradeoff"}
    assert subject == {name: count for name, count in whole.items() if name not in shown | {"extremes"}}
    table = project.plan("table_ablation")
    assert table["table"] == 1
    rows = _named(project, "config/tables.yaml")["ablation"]["rows"]
    assert table["train"] == len({row["variant"] for row in rows if row.get("variant")})
    assert "speed" not in table
    stage = project.plan("stage_masks")
    assert {"masks", "ingest", "tracks"} < set(stage)
    assert "crop" not in stage


def _decaf(project, subjects=("S1", "S2", "S3", "S4")):
    """Empty files in the places of a Decaf folder, as the release splits it."""
    base = project.folder / "resources/DecafDataset"
    names = ["assets/generic_model.pkl", "assets/landmark_embedding.npy", "assets/mano_v1_2/models/MANO_RIGHT.pkl"]
    for subject in subjects:
        split = "test" if subject in ("S1", "S3") else "train"
        for camera in ("084", "100", "102", "108", "110", "111", "121", "122"):
            names += [f"{split}/{kind}/{subject}/{camera}.mp4" for kind in ("videos", "segmentations")]
            keyed = ("head_keys", "right_hand_keys", "head_bbs", "right_hand_bbs")
            names += [f"{split}/{kind}/{subject}/{camera}.npy" for kind in keyed]
        names += [
            f"{split}/cameras/{subject}/cameras.pkl",
            f"{split}/params/{subject}/params_smoothed.pkl",
            f"{split}/cutIDs/{subject}.pkl",
            f"{split}/deformations/{subject}/deforms.npy",
            f"{split}/contacts/{subject}/contacts_head.npy",
            f"{split}/contacts/{subject}/contacts_rh.npy",
        ]
    for name in names:
        path = base / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("raw")


def test_the_whole_paper_is_planned(project):
    _decaf(project)
    plan = project.plan(config="config/paper.yaml")
    config = _named(project, "config/paper.yaml")
    counted = _counted(project, "config/runs.tsv", "config/subjects.tsv", crops=2)
    pairs, films = len(config["reenact"]), 2 * counted["fit"] * len(config["videos"])
    counted |= {"reenact": pairs, "reenact_contact": pairs, "video": films, "savings": 1, "offline": 1}
    counted |= {
        "table": len(_named(project, "config/tables.yaml")),
        "figure": len(_named(project, "config/figures.yaml")),
    }
    assert 0 < plan["speed"] <= counted["train"]
    assert {name: count for name, count in plan.items() if name != "speed"} == counted
    # Its rehearsal is the same with data of its own; the small one runs every rule, on fewer people and variants.
    rehearsal = project.plan(config="config/paper.yaml config/rehearsal.yaml")
    assert rehearsal == plan | {"synthesize": 1}
    small = project.plan(config="config/paper.yaml config/rehearsal.yaml config/rehearsal/small.yaml")
    assert set(small) == set(rehearsal) and sum(small.values()) < sum(rehearsal.values()) / 3


def test_subjects_are_found_in_both_split_folders(project):
    _decaf(project)
    reasons = project.snakemake("-n", "stage_tracks", config="config/paper.yaml").stdout
    for subject, split in (("S1", "test"), ("S2", "train"), ("S3", "test"), ("S4", "train")):
        assert f"DecafDataset/{split}/params/{subject}/params_smoothed.pkl" in reasons


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--config", "stages={train: {step: 3}}"), "unknown key 'step'; did you mean 'steps'"),
        (("--config", "run=a/b"), "config.run"),
        (("--config", "device=gpu"), "one of auto, cpu, cuda"),
        (("--config", "runs=config/none.tsv"), "config/none.tsv: expected a sheet"),
        # The outputs of a job are removed before it starts: a dataset of the user's would be gone.
        (("--config", "data_root=config"), "config: expected a folder without files, or a synthetic dataset"),
    ],
)
def test_configuration_errors_are_one_line_before_any_job(project, words, message):
    config = yaml.safe_load((project.folder / "config/smoke.yaml").read_text())
    assert config["run"] == "smoke"
    out = project.snakemake("-n", *words)
    assert out.returncode != 0
    text = out.stdout + out.stderr
    assert message in text
    assert "Traceback" not in text


def test_unknown_subject_is_named(project):
    sheet = project.folder / "config/bad.tsv"
    sheet.write_text("subject\tvariant\tprotocol\nS9\tfull\tnv1024\n")
    out = project.snakemake("-n", "--config", "runs=config/bad.tsv")
    assert out.returncode != 0
    assert "unknown subject 'S9'" in out.stdout + out.stderr
    target = project.snakemake("-n", "subject_S9")
    assert target.returncode != 0


def test_capture_without_a_folder_says_which_option_to_give(project):
    out = project.snakemake("-n", config="config/capture.yaml")
    assert out.returncode != 0
    assert "--config data_root=" in out.stdout + out.stderr


def test_a_single_camera_is_trained_on_and_judged_on_poses_only(project, tmp_path):
    root = write_capture(tmp_path / "toy")
    cameras = json.loads((root / "cameras.json").read_text())
    (root / "cameras.json").write_text(json.dumps({"c0": cameras["c0"]}))
    jobs = project.plan("--config", f"data_root={root}", config="config/capture.yaml")
    assert jobs["train"] == jobs["crop"] == jobs["render"] == jobs["evaluate"] == 1
    assert (jobs["table"], jobs["figure"]) == (2, 2), "held-out poses and speed; poses and training"
    out = project.snakemake("-n", "stage_tradeoff", "--config", f"data_root={root}", config="config/capture.yaml")
    assert out.returncode != 0 and "take a protocol of split self_reenactment" in out.stdout + out.stderr


def test_methods_are_laid_over_a_capture(project, tmp_path):
    root = f"data_root={write_capture(tmp_path / 'toy')}"
    alone = project.plan("--config", root, config="config/capture.yaml")
    jobs = project.plan("--config", root, config="config/capture.yaml config/methods.yaml")
    rows = _sheet(project, "config/methods/runs.tsv")
    more = difference(alone, jobs)
    assert more["train"] == len({row["variant"] for row in rows}) - alone["train"]
    assert more["render"] == more["evaluate"] == len(rows) - alone["evaluate"]
    assert not set(more) & {"ingest", "tracks", "masks", "align", "spectral"}
    assert jobs["table"] == len(_named(project, "config/methods/tables.yaml"))


def test_a_comparison_has_avatars_of_its_own(project, tmp_path):
    root = f"data_root={write_capture(tmp_path / 'toy')}"
    (project.folder / "few.json").write_text('{"compare": {"seeds": [0, 1], "minutes": [2, 5]}}')
    files = "config/capture.yaml config/methods.yaml config/compare.yaml few.json"
    jobs = project.plan("--config", root, config=files)
    compare = _named(project, "config/compare.yaml")["compare"]
    trained = 2 * 2 * len(compare["variants"])
    assert jobs["train"] == trained and jobs["evaluate"] == trained * len(compare.get("protocols", ("nv", "sr")))
    # One shell and one light serve all variants. No report, tables or videos.
    assert jobs["compare"] == 1 and jobs["shell"] == 1 and jobs["light"] == 1
    assert not {"table", "figure", "report", "video", "speed"} & jobs.keys()


def test_a_training_that_starts_from_another_subjects_avatar_comes_after_it(project, tmp_path):
    for name in ("ann", "ben"):
        write_capture(tmp_path / name)
    started = {"crop": "full", "meshes": "fit", "stages": {"train": {"start": "ann/full", "steps": 7}}}
    (project.folder / "started.json").write_text(json.dumps({"variants": {"started": started}}))
    words, files = ["--config", f"data_root={tmp_path}"], "config/capture.yaml started.json"
    models = {one: f"results/capture/train/{one}/model.pt" for one in ("ann/full", "ann/started", "ben/started")}
    done = project.snakemake("--quiet", "all", *words, "--", *list(models.values())[1:], config=files)
    assert done.returncode == 0, (done.stdout + done.stderr)[-3000:]
    calls = [shlex.split(call) for call in (project.folder / "calls").read_text().splitlines()]
    trained = [call for call in calls if call[:1] == ["train"]]
    made = [call[call.index("--out") + 1] for call in trained]
    assert made[0] == models["ann/full"] and sorted(made) == sorted(models.values()), "what none asked for comes first"
    told = [call[call.index("--start") + 1 : call.index("--out")] for call in trained]
    assert told == [[], [models["ann/full"]], [models["ann/full"]]]

    def planned(*more):
        return project.plan(*words, "--", *list(models.values())[1:], config=" ".join([files, *more]))

    assert planned() == {}
    # Another start of the start, by its options, and a file of the user's in place of it.
    (project.folder / "longer.json").write_text(json.dumps({"variants": {"full": {"stages": {"train": {"steps": 9}}}}}))
    assert planned("longer.json") == {"train": 3}
    (project.folder / "given.pt").write_text("a model")
    (project.folder / "given.json").write_text(
        json.dumps({"variants": {"started": {"stages": {"train": {"start": "given.pt"}}}}})
    )
    assert planned("given.json") == {"train": 2}


def test_lint_is_clean(project):
    out = project.snakemake("--lint")
    assert out.returncode == 0, out.stdout + out.stderr


def test_planning_imports_nothing_heavy(project):
    words = ["-X", "importtime", "-m", "snakemake", "-n", "--cores", "1", "--configfile", "config/smoke.yaml"]
    out = subprocess.run(
        [sys.executable, *words],
        cwd=project.folder, env=project.environment, capture_output=True, text=True,
    )  # fmt: skip
    assert out.returncode == 0
    imported = set(re.findall(r"\| +(\w+)$", out.stderr, re.M))
    assert not imported & {"torch", "numba", "cv2", "igl"}
