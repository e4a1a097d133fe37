"""The re-run contract: which edit re-runs what. Commands are stubs; only plans are compared."""

import re
from pathlib import Path

import pytest
import yaml

from nbavatar.config.sheets import read_subjects

ROOT = Path(__file__).parents[2]

# Some sixty stub jobs and twenty plans.
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def finished(project):
    """The project after a complete run of the smoke configuration, its dataset in place."""
    path = project.folder / "config/smoke.yaml"
    config = yaml.safe_load(path.read_text()) | {"synthetic": False}
    path.write_text(yaml.safe_dump(config))
    base = project.folder / config["data_root"]
    for name in _raw_names():
        (base / name).parent.mkdir(parents=True, exist_ok=True)
        (base / name).write_text("raw")
    done = project.snakemake("--quiet", "all")
    assert done.returncode == 0, (done.stdout + done.stderr)[-3000:]
    yield project
    # Every edit was taken back, so nothing is left to do.
    assert project.plan() == {}


def _raw_names():
    kinds = ("head_keys", "right_hand_keys", "head_bbs", "right_hand_bbs")
    names = ["assets/generic_model.pkl", "assets/landmark_embedding.npy", "assets/mano_v1_2/models/MANO_RIGHT.pkl"]
    for camera in read_subjects(ROOT / "config/smoke/subjects.tsv", "")["S2"].cameras:
        names += [f"train/{kind}/S2/{camera}.mp4" for kind in ("videos", "segmentations")]
        names += [f"train/{kind}/S2/{camera}.npy" for kind in kinds]
    single = ("cameras/S2/cameras.pkl", "params/S2/params_smoothed.pkl", "cutIDs/S2.pkl", "deformations/S2/deforms.npy")
    contacts = ("contacts/S2/contacts_head.npy", "contacts/S2/contacts_rh.npy")
    return [*names, *(f"train/{name}" for name in (*single, *contacts))]


@pytest.fixture
def edit(finished):
    """Changes files, plans, and puts the files back."""
    kept = {}

    def change(name, function):
        path = finished.folder / name
        kept.setdefault(path, path.read_text())
        path.write_text(function(path.read_text()))
        return finished.plan()

    yield change
    for path, text in kept.items():
        path.write_text(text)


def _config(**changes):
    def apply(text):
        config = yaml.safe_load(text)
        for key, value in changes.items():
            target = config
            *parents, last = key.split("__")
            for parent in parents:
                target = target.setdefault(parent, {})
            target[last] = value
        return yaml.safe_dump(config)

    return apply


# `reenact` and `extremes` need no avatar.
AFTER_TRAINING = {
    "train": 13, "render": 18, "evaluate": 18, "speed": 7, "table": 8, "report": 1,
    "figure": 4, "video": 2, "tradeoff": 1,
}  # fmt: skip


def test_nothing_is_done_twice(finished):
    assert finished.plan() == {}


def test_an_option_of_evaluation_runs_evaluation_only(edit):
    plan = edit("config/smoke.yaml", _config(stages__evaluate={"foreground_threshold": 0.9}))
    assert plan == {"evaluate": 18, "table": 7, "figure": 2, "report": 1}  # ablation and pareto show results


def test_an_option_of_one_variant_runs_that_variant_only(edit):
    text = {"stages": {"train": {"channels": 4}}}
    plan = edit("config/smoke.yaml", _config(variants__ch03=text))
    assert plan == {"train": 1, "render": 1, "evaluate": 1, "speed": 1, "table": 1, "figure": 1, "report": 1}


def test_an_option_of_training_retrains_everything_and_rebuilds_no_image(edit):
    plan = edit("config/smoke.yaml", _config(stages__train__seed=7))
    assert plan == AFTER_TRAINING


def test_spelling_out_a_default_runs_nothing(edit):
    from nbavatar.config.run import load_run, stage_options

    def spell_out(text):
        config = yaml.safe_load(text)
        config["stages"]["evaluate"] = stage_options(load_run(config), "evaluate")
        return yaml.safe_dump(config)

    assert edit("config/smoke.yaml", spell_out) == {}


def test_comments_and_docstrings_of_the_library_run_nothing(edit):
    def reword(text):
        return "# a remark\n" + text.replace('"""', '"""Reworded: ', 1)

    assert edit("nbavatar/raster/functional.py", reword) == {}


def test_an_edit_of_the_rasterizer_retrains_and_leaves_masks_and_crops_alone(edit):
    plan = edit("nbavatar/raster/reference.py", lambda text: text + "\nEDITED = 1\n")
    assert not set(plan) & {"ingest", "tracks", "masks", "crop", "spectral", "deform"}
    assert {name: plan[name] for name in ("train", "render", "evaluate")} == {"train": 13, "render": 18, "evaluate": 18}


def test_an_edit_of_the_metrics_does_not_retrain(edit):
    plan = edit("nbavatar/metrics/ssim.py", lambda text: text + "\nEDITED = 1\n")
    assert "train" not in plan and plan["evaluate"] == 18


def test_a_new_row_of_the_sheet_runs_that_row_only(edit):
    plan = edit("config/smoke/runs.tsv", lambda text: text + "S2\tno_nb\tsr1024\n")
    # It is made although no table shows it: a row that nobody asks for would be a silent omission.
    assert plan == {"render": 1, "evaluate": 1, "report": 1} | ({"table": 1} if "table" in plan else {})


def test_an_edit_of_printed_numbers_rebuilds_tables_only(edit):
    plan = edit("config/reported.csv", lambda text: re.sub(r"28\.63", "28.64", text))
    assert plan == {"table": 8, "report": 1}


def test_a_touched_but_unchanged_input_runs_nothing(finished):
    path = finished.folder / "config/reported.csv"
    path.write_text(path.read_text())
    assert finished.plan() == {}


def test_a_lost_result_is_made_again_with_what_follows(finished):
    path = finished.folder / "results/smoke/eval/S2/ch03/nv1024.json"
    kept = path.read_text()
    path.unlink()
    plan = finished.plan()
    path.write_text(kept)
    assert plan["evaluate"] == 1 and "train" not in plan
