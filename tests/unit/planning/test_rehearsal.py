"""The rehearsal is the paper: what it may lay over is written here, and nothing else passes."""

import yaml

from nbavatar.config.core import merge, to_mapping
from nbavatar.config.run import load_run, stage_options
from nbavatar.config.sheets import read_subjects
from tests.unit.planning.plans import ROOT

# Data that everybody has, and how much of it: frames, steps, and passes over the same.
ALLOWED = {
    "": {"run", "synthetic", "data_root", "size_label", "tradeoff", "extremes", "stages"},
    "train": {"steps", "previews"},
    "speed": {"frames", "repeats", "warmup"},
    "evaluate": {"mean_frames"},
    "table": {"difference"},  # the printed numbers beside ours all the same
    "video": {"max_frames", "seconds"},
}
ALLOWED_SMALL = ALLOWED | {"": ALLOWED[""] | {"subjects", "runs", "only", "reenact"}}


def _laid_over(*names):
    layers = [yaml.safe_load((ROOT / f"config/{name}.yaml").read_text()) for name in ("paper", *names)]
    mapping: dict = {}
    for layer in layers:
        mapping = merge(mapping, layer)
    return layers[-1], load_run(mapping), load_run(layers[0])


def _differs(run, paper, allowed):
    """Places of values that differ from the paper's and may not."""
    found = [key for key, value in to_mapping(run).items() if value != to_mapping(paper)[key]]
    wrong = [key for key in found if key not in allowed[""]]
    for stage, options in to_mapping(paper.stages).items():
        if stage == "synthesize":  # no stage of the paper
            continue
        for variant in (None, *paper.variants):
            mine, theirs = stage_options(run, stage, variant), stage_options(paper, stage, variant)
            keys = [key for key in options if mine.get(key) != theirs.get(key) and key not in allowed.get(stage, ())]
            wrong += [f"{stage}.{key}" for key in keys]
    return wrong


def test_the_rehearsal_differs_from_the_paper_by_data_frames_steps_and_passes_alone():
    layer, run, paper = _laid_over("rehearsal")
    assert _differs(run, paper, ALLOWED) == []
    assert set(layer) <= ALLOWED[""]
    made = run.stages.synthesize
    assert (made.width, made.height, made.mesh, made.layout) == (1920, 1080, "full", "decaf")
    sheet = read_subjects(ROOT / run.subjects, "")
    assert set(made.subjects) == set(sheet) == {"S1", "S2", "S3", "S4"}
    assert set(made.cameras) == {camera for subject in sheet.values() for camera in subject.cameras}
    assert run.tradeoff.variants == paper.tradeoff.variants and run.tradeoff.also == paper.tradeoff.also
    assert "rehearsal" in run.size_label


def test_the_small_rehearsal_has_fewer_people_and_cameras_besides():
    _, run, paper = _laid_over("rehearsal", "rehearsal/small")
    assert _differs(run, paper, ALLOWED_SMALL) == []
    sheet = read_subjects(ROOT / run.subjects, "")
    paper_sheet = read_subjects(ROOT / paper.subjects, "")
    for name, subject in sheet.items():
        assert subject.test_camera == paper_sheet[name].test_camera
        assert set(subject.train_cameras) < set(paper_sheet[name].train_cameras)
    assert run.only == list(run.stages.synthesize.subjects)
    assert set(run.stages.synthesize.cameras) == set(sheet[run.only[0]].cameras)
    assert (run.stages.synthesize.width, run.stages.synthesize.height) == (1920, 1080)
