import json
from pathlib import Path

import pytest
import yaml

from nbavatar.config.reference import reference_page, run_schema
from nbavatar.config.run import load_run, stage_options
from nbavatar.config.sheets import read_rows, read_subjects
from nbavatar.errors import ConfigError

ROOT = Path(__file__).parents[3]
FILES = ("paper", "smoke", "capture")


def _read(name):
    return yaml.safe_load((ROOT / f"config/{name}.yaml").read_text())


@pytest.mark.parametrize("name", FILES)
def test_shipped_configurations_load_and_satisfy_the_schema(name):
    jsonschema = pytest.importorskip("jsonschema")
    mapping = _read(name)
    run = load_run(mapping)
    assert run.run == name
    jsonschema.validate(mapping, run_schema())


def test_generated_files_are_in_step_with_the_code():
    hint = "run `nbavatar schema`"
    assert json.loads((ROOT / "workflow/schemas/config.schema.json").read_text()) == json.loads(
        json.dumps(run_schema())
    ), hint
    assert (ROOT / "config/README.md").read_text() == reference_page(), hint


@pytest.mark.parametrize("name", ["paper", "smoke"])
def test_sheets_name_only_variants_and_protocols_that_exist(name):
    run = load_run(_read(name))
    subjects = read_subjects(ROOT / run.subjects, run.data_root)
    for row in read_rows(ROOT / run.runs, list(subjects)):
        assert row.variant in run.variants
        assert row.protocol in run.protocols


def test_paper_has_the_papers_runs():
    run = load_run(_read("paper"))
    rows = read_rows(ROOT / run.runs, list(read_subjects(ROOT / run.subjects, run.data_root)))
    trainings = {(r.subject, r.variant) for r in rows}
    # Rows that the paper does not print.
    ours = {"no_pbd", "no_spectral", "splatting_avatar_released", "interact_avatar", "interact_avatar512"}
    assert len([t for t in trainings if t[1] not in ours]) == 22
    assert len([r for r in rows if r.variant not in ours]) == 38


def test_paper_keeps_the_papers_settings():
    train = stage_options(load_run(_read("paper")), "train", "full")
    expected = {
        "channels": 6, "texels": 16, "weight_lpips": 0.1, "weight_nb": 0.1, "weight_knn": 0.1, "weight_delta": 0.001,
        "deferred": True, "init": "spectral", "weight_mse": 1.0, "weight_l1": 0.0, "weight_dssim": 0.0,
    }  # fmt: skip
    own = train["billboards"]
    assert {key: own[key] for key in expected} == expected
    assert (train["schedule"], train["lpips_crop"]) == ("paper", 256)
    rates = {"renderer": 1e-3, "features": 5e-4, "alpha": 5e-4, "rotation": 1e-3, "scale": 5e-3, "position": 1.6e-4}
    assert {key: own["rates"][key] for key in rates} == rates
    assert own["rates"]["position_final"] == 0.01


def test_variants_differ_from_full_only_in_what_they_name():
    run = load_run(_read("paper"))
    full = stage_options(run, "train", "full")
    for name, variant in run.variants.items():
        options = stage_options(run, "train", name)
        given = variant.stages.get("train", {})
        if "method" in given:  # the blocks of other methods are not among its options
            assert set(full) - set(options) == {"billboards"} and set(options) - set(full) == {given["method"]}
            continue
        own = given.get("billboards", {})
        assert {key for key in full if options[key] != full[key]} == set(given), name
        assert {key for key, value in full["billboards"].items() if options["billboards"][key] != value} == set(own)


def test_frames_reach_both_readers():
    run = load_run({**_read("smoke"), "frames": {"max_frames": 7, "every": 2}})
    for stage in ("ingest", "tracks"):
        options = stage_options(run, stage)
        assert (options["max_frames"], options["every"]) == (7, 2)


# What YAML makes of `&a {full: *a}`, and of a ladder of lists that hold the one before twice.
_ENDLESS: dict = {}
_ENDLESS["full"] = _ENDLESS
_MANY: list = [1, 2]
for _ in range(40):
    _MANY = [_MANY, _MANY]


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"stage": {}}, "unknown key 'stage'; did you mean 'stages'"),
        ({"stages": {"train": {"step": 3}}}, "config.stages.train: unknown key 'step'; did you mean 'steps'"),
        ({"variants": {"x": {"stages": {"train": {"step": 3}}}}}, "variants.x.*unknown key 'step'"),
        ({"variants": {"x": {"stages": {"trian": {}}}}}, "unknown stage 'trian'; did you mean 'train'"),
        ({"variants": {"x": {"crop": "centre"}}}, "unknown crop 'centre'; did you mean 'center'"),
        ({"protocols": {"p": {"crop": "nope"}}}, "protocols.p.crop: unknown crop"),
        ({"run": "a/b"}, "config.run"),
        ({"variants": {"x": {"stages": {"train": None}}}}, "x.stages.train: expected a mapping of options, found None"),
        ({None: 5}, "expected a name before every ':', found an empty key"),
        ({"variants": {"x": {"stages": {None: {}, "train": {}}}}}, "found an empty key"),
        ({"variants": _ENDLESS}, "found one that holds itself"),
        ({"variants": _MANY}, "refer to one another without end"),
    ],
)
def test_typos_end_in_one_line(change, match):
    with pytest.raises(ConfigError, match=match) as caught:
        load_run({**_read("smoke"), **change})
    assert "\n" not in str(caught.value)
