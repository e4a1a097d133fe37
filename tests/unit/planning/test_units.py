"""Whom each stage works on: counted by differences between two plans, and compared with the sheets."""

import csv
import dataclasses
import json
import re
import subprocess
import sys

import pytest

from nbavatar.config.sheets import Row
from nbavatar.errors import ConfigError
from nbavatar.planning import units
from nbavatar.planning.figures import Shown, shown
from nbavatar.planning.parameters import (
    comparison_text,
    figure_code,
    method_of,
    protocol_text,
    stage_text,
    takes_light,
)
from nbavatar.planning.paths import constraints, fill
from tests.scenes.capture import write_capture
from tests.unit.planning.plans import ROOT, shipped

COUNTED = {
    name: getattr(units, name) for name in ("people", "views", "crops", "avatars", "videos", "timed", "judged_crops")
}


def _more(before, after):
    """How many units of each kind the second plan has that the first one lacks; none is lost."""
    found = {}
    for name, function in COUNTED.items():
        old, new = function(before), function(after)
        assert set(old) <= set(new) and len(new) == len(set(new))
        found |= {name: len(new) - len(old)} if len(new) != len(old) else {}
    return found


def _with_rows(plan, *rows):
    return dataclasses.replace(plan, rows=[*plan.rows, *(Row(*row) for row in rows)])


def test_a_variant_adds_one_training_and_its_videos_where_it_asks_for_them():
    plan = shipped("paper")
    run = dataclasses.replace(plan.run, variants=plan.run.variants | {"new": plan.run.variants["full"]})
    before = dataclasses.replace(plan, run=run)
    assert _more(before, _with_rows(before, ("S2", "new", "nv1024"))) == {"avatars": 1}
    assert _more(before, _with_rows(before, ("S2", "new", "nv1024"), ("S3", "new", "sr1024"))) == {"avatars": 2}
    filmed = dataclasses.replace(before, run=dataclasses.replace(run, videos=[*run.videos, "new"]))
    assert _more(filmed, _with_rows(filmed, ("S2", "new", "nv1024"))) == {"avatars": 1, "videos": 2}


def test_a_row_of_a_known_avatar_adds_nothing_to_train():
    plan = shipped("paper")
    assert _more(plan, _with_rows(plan, ("S2", "ch03", "sr1024"))) == {}


def test_a_subject_adds_its_cameras_in_every_crop():
    whole = shipped("paper")
    without = dataclasses.replace(whole, rows=[row for row in whole.rows if row.subject != "S4"])
    cameras = len(whole.subjects["S4"].cameras)
    more = _more(without, whole)
    assert (more["people"], more["views"], more["crops"]) == (1, cameras, cameras * len(whole.run.crops))
    assert units.timed(without) == units.timed(whole), "a table times the first subject that has a variant"


def test_units_are_those_of_the_sheets():
    plan = shipped("paper")
    with open(ROOT / "config/runs.tsv", newline="") as stream:
        rows = [tuple(row.values()) for row in csv.DictReader(stream, delimiter="\t")]
    assert [dataclasses.astuple(row) for row in plan.rows] == rows
    trained = list(dict.fromkeys((subject, variant) for subject, variant, _ in rows))
    assert [dataclasses.astuple(avatar) for avatar in units.avatars(plan)] == trained


def test_crops_that_train_never_hold_the_camera_that_is_judged():
    plan = shipped("paper")
    for row in plan.rows:
        subject = plan.subjects[row.subject]
        trained = {crop.camera for crop in units.trained_on(plan, row.subject, row.variant)}
        judged = {crop.camera for crop in units.judged_on(plan, row.subject, row.protocol)}
        assert trained == set(subject.train_cameras)
        assert judged == ({subject.test_camera} if row.protocol.startswith("nv") else trained)
        kinds = {crop.crop for crop in units.judged_on(plan, row.subject, row.protocol)}
        assert kinds == {"box" if row.protocol.endswith("512") else "center"}
    with pytest.raises(ConfigError, match="unknown protocol 'nv1025'; did you mean 'nv1024'"):
        units.judged_on(plan, "S1", "nv1025")


def _capture(tmp_path, single=False, **changes):
    root = write_capture(tmp_path / "toy")
    if single:
        cameras = json.loads((root / "cameras.json").read_text())
        (root / "cameras.json").write_text(json.dumps({"c0": cameras["c0"]}))
    return shipped("capture", data_root=str(root), **changes)


def test_meshes_come_from_the_last_stage_that_a_run_has(tmp_path):
    paper = shipped("paper")
    assert units.fitted(paper, "S2") == units.Meshes("fit", "S2")
    assert units.meshes_of(paper, "S2", "full") == units.Meshes("deform", "S2")
    assert units.meshes_of(paper, "S2", "no_pbd") == units.Meshes("fit", "S2")
    wanted = {"full": "deform", "fit": "fit", "tracks": "tracks"}
    variants = {name: {"crop": "full", "meshes": stage, "shell": True} for name, stage in wanted.items()}
    variants["bald"] = variants["full"] | {"shell": False}
    root = str(write_capture(tmp_path / "toy"))

    def stages(contact, iterations, reach):
        chosen = {"tracks": {"contact": contact}, "align": {"iterations": iterations}, "shell": {"reach": reach}}
        plan = shipped("capture", data_root=root, variants=variants, stages=chosen)
        return {name: units.meshes_of(plan, "toy", name).stage for name in variants}

    assert stages("given", 6, 0.2) == {"full": "shell", "fit": "shell", "tracks": "tracks", "bald": "align"}
    assert stages("given", 6, 0.0) == {"full": "align", "fit": "align", "tracks": "tracks", "bald": "align"}
    assert stages("given", 0, 0.0) == {"full": "tracks", "fit": "tracks", "tracks": "tracks", "bald": "tracks"}
    assert stages("solve", 6, 0.2) == {"full": "deform", "fit": "shell", "tracks": "tracks", "bald": "deform"}


def test_light_is_for_billboards_that_decode_it(tmp_path):
    root = str(write_capture(tmp_path / "toy"))
    own = {
        "full": {},
        "no_light": {"billboards": {"shading": False}},
        "no_dnr": {"billboards": {"deferred": False}},
        "gaussian_avatars": {"method": "gaussian_avatars"},
    }
    variants = {name: {"crop": "full", "meshes": "fit", "stages": {"train": train}} for name, train in own.items()}
    for lights in (64, 0):
        plan = shipped("capture", data_root=root, variants=variants, stages={"light": {"lights": lights}})
        assert {name for name in variants if takes_light(plan, name)} == ({"full"} if lights else set())
    assert not takes_light(shipped("paper"), "full")


def test_of_a_single_camera_no_view_is_held_out(tmp_path):
    plan = _capture(tmp_path, single=True)
    assert plan.rows and not any(plan.holds_out_view(row.protocol) for row in plan.rows)
    assert {row.protocol for row in shipped("capture", data_root=str(_capture(tmp_path / "b").run.data_root)).rows} > {
        row.protocol for row in plan.rows
    }
    with pytest.raises(ConfigError, match=r"toy: one camera recorded it.*take a protocol of split self_reenactment"):
        units.judged_on(plan, "toy", "nv")


def test_a_comparison_has_rows_of_its_own_and_no_tables(tmp_path):
    compare = {"variants": ["full"], "steps": [200, 100], "seeds": [0, 1]}
    plan = _capture(tmp_path, compare=compare)
    assert plan.compares and not plan.tables and not plan.figures
    names = [f"full-{steps}steps-seed{seed}" for steps in (100, 200) for seed in (0, 1)]
    assert [avatar.variant for avatar in units.avatars(plan)] == names, "the smallest budget first"
    assert len(plan.rows) == len(names) * len(units.judged(plan)) == 8
    assert units.judged(plan) == [units.Judged("toy", "nv"), units.Judged("toy", "sr")]
    assert json.loads(comparison_text(plan))["steps"] == [200, 100]


def test_figures_show_what_is_made_and_only_their_own_variants():
    plan = shipped("smoke", synthetic=False)
    kinds = {layout.kind for layout in plan.figures.values()}
    assert kinds == {"comparison", "features", "reenactment", "contact", "pareto"}
    for name, layout in plan.figures.items():
        found = shown(plan, name)
        assert found != Shown()
        assert {*found.renders, *found.evaluations} <= set(plan.rows)
        assert {*found.models, *found.histories} <= set(units.avatars(plan))
        assert set(found.timings) <= set(units.timed(plan))
        assert set(found.frames) <= set(units.crops(plan))
        assert layout.kind != "comparison" or {row.variant for row in found.renders} == set(layout.variants)
        assert bool(found.models) == (layout.kind in ("features", "reenactment"))
        assert len(found.models) <= len(found.meshes) + len(found.reenacted)
    assert figure_code(plan, "contact") != figure_code(plan, "features"), "a figure of meshes reaches no method"


def test_options_are_those_of_the_variant():
    plan = shipped("paper")
    train = {name: json.loads(stage_text(plan, "train", name)) for name in ("full", "ch03", "gaussian_avatars")}
    assert method_of(plan, "gaussian_avatars") == train["gaussian_avatars"]["method"] == "gaussian_avatars"
    assert train["ch03"]["billboards"] == train["full"]["billboards"] | {"channels": 3}
    assert "billboards" not in train["gaussian_avatars"]
    assert stage_text(plan, "evaluate", "ch03") == stage_text(plan, "evaluate")
    assert json.loads(protocol_text(plan, "nv512"))["name"] == "nv512"


def test_patterns_are_filled_unit_by_unit():
    found = fill(["a/{run}/{subject}.md", "a/{run}/{subject}.csv"], [units.Person("S1"), units.Person("S2")], run="r")
    assert found == ["a/r/S1.md", "a/r/S1.csv", "a/r/S2.md", "a/r/S2.csv"]
    assert fill("{subject}/{variant}/{protocol}", [Row("S1", "full", "nv")]) == ["S1/full/nv"]
    with pytest.raises(KeyError, match="camera"):
        fill("{subject}/{camera}", [units.Person("S1")])


def test_wildcards_stand_for_the_names_of_the_run_alone():
    plan = shipped("paper", run="a.b")
    limits = constraints(plan)
    assert re.fullmatch(limits["run"], "a.b") and not re.fullmatch(limits["run"], "a-b")
    for wildcard, known in (("subject", plan.subjects), ("variant", plan.run.variants), ("table", plan.tables)):
        assert all(re.fullmatch(limits[wildcard], name) for name in known)
        assert not re.fullmatch(limits[wildcard], "S9")
    assert re.fullmatch(limits["camera"], "084") and not re.fullmatch(limits["camera"], "84")


def test_planning_imports_the_standard_library_and_yaml_alone():
    code = (
        "import sys; before = set(sys.modules)\n"
        "from nbavatar.planning import figures, layouts, parameters, paths, run, units\n"
        "names = {name.partition('.')[0] for name in set(sys.modules) - before}\n"
        "print(*sorted(names - set(sys.stdlib_module_names)))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert out.returncode == 0, out.stderr
    assert set(out.stdout.split()) <= {"nbavatar", "yaml", "_yaml"}


def test_some_of_the_subjects_have_their_rows_tables_and_figures_and_no_others():
    whole, alone, two = shipped("paper"), shipped("paper", only=["S1"]), shipped("paper", only=["S1", "S2"])
    assert {row.subject for row in alone.rows} == {"S1"} and set(alone.subjects) == {"S1"}
    assert alone.rows == [row for row in whole.rows if row.subject == "S1"]
    assert two.rows == [row for row in whole.rows if row.subject in ("S1", "S2")]
    assert alone.run.reenact == [] and two.run.reenact == ["S1/S2"]
    # What the paper shows of S2 alone is not made of S1.
    assert set(whole.tables) - set(alone.tables) == {"ablation", "cost", "channels"}
    assert set(whole.figures) - set(alone.figures) == {"ablation", "channels", "cross_reenactment"}
    assert set(two.tables) == set(whole.tables) and set(two.figures) == set(whole.figures)
    with pytest.raises(ConfigError, match="only: unknown subject 'S9'"):
        shipped("paper", only=["S9"])
