"""The re-run contract: which edit re-runs what. Commands are stubs; only plans are compared."""

import os
import re
import shutil
from pathlib import Path

import pytest
import yaml

from nbavatar.config.sheets import read_subjects
from tests.scenes.capture import write_capture
from tests.workflow.conftest import ALL, Project, counted

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
    project.whole = project.plan()
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


JUDGED = dict.fromkeys(("render", "evaluate", "speed", "table", "report", "collect", "figure", "video"), ALL)
TRAINED = {"train": ALL, **JUDGED}


def test_nothing_is_done_twice(finished):
    assert finished.plan() == {}


def test_an_option_of_evaluation_runs_evaluation_only(edit, finished):
    plan = edit("config/smoke.yaml", _config(stages__evaluate={"foreground_threshold": 0.9}))
    # One table shows timings alone; of the figures, two show results.
    layouts = yaml.safe_load((finished.folder / "config/smoke/figures.yaml").read_text()).values()
    shown = {
        "table": finished.whole["table"] - 1,
        "figure": sum(figure["kind"] in ("comparison", "pareto") for figure in layouts),
    }
    assert plan == counted({"evaluate": ALL, "report": 1, "collect": 1}, finished.whole) | shown


def test_an_option_of_one_variant_runs_that_variant_only(edit):
    text = {"stages": {"train": {"billboards": {"channels": 4}}}}
    plan = edit("config/smoke.yaml", _config(variants__ch03=text))
    shown = {"table": 1, "figure": 1, "report": 1, "collect": 1}
    assert plan == {"train": 1, "render": 1, "evaluate": 1, "speed": 1} | shown


def test_an_option_of_training_retrains_everything_and_rebuilds_no_image(edit, finished):
    plan = edit("config/smoke.yaml", _config(stages__train__seed=7))
    # One figure shows meshes alone; `reenact` and `extremes` need no avatar.
    expected = counted(TRAINED | {"tradeoff": ALL}, finished.whole)
    assert plan == expected | {"figure": expected["figure"] - 1}


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

    assert edit("nbavatar/rendering/billboards/functional.py", reword) == {}


def test_an_edit_of_the_rasterizer_retrains_and_leaves_masks_and_crops_alone(edit, finished):
    plan = edit("nbavatar/rendering/billboards/reference.py", lambda text: text + "\nEDITED = 1\n")
    assert not set(plan) & {"ingest", "tracks", "masks", "crop", "spectral", "deform"}
    expected = counted(dict.fromkeys(("train", "render", "evaluate"), ALL), finished.whole)
    assert {name: plan[name] for name in expected} == expected


def test_an_edit_of_the_metrics_does_not_retrain(edit, finished):
    plan = edit("nbavatar/metrics/ssim.py", lambda text: text + "\nEDITED = 1\n")
    assert "train" not in plan and plan["evaluate"] == finished.whole["evaluate"]


def test_a_new_row_of_the_sheet_runs_that_row_only(edit):
    plan = edit("config/smoke/runs.tsv", lambda text: text + "S2\tno_nb\tsr1024\n")
    # It is made although no table shows it: a row that nobody asks for would be a silent omission.
    assert plan == {"render": 1, "evaluate": 1, "report": 1, "collect": 1} | ({"table": 1} if "table" in plan else {})


def test_an_edit_of_printed_numbers_rebuilds_tables_only(edit, finished):
    plan = edit("config/reported.csv", lambda text: re.sub(r"28\.63", "28.64", text))
    assert plan == counted({"table": ALL, "report": 1}, finished.whole)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("config/reported.csv", {"table": ALL, "report": 1}),
        ("resources/synthetic/smoke/train/params/S2/params_smoothed.pkl", {"tracks": 1, "fit": 1, "ingest": 0}),
        ("resources/synthetic/smoke/assets/generic_model.pkl", {"tracks": 1, "fit": 1, "reenact": 1, "ingest": 0}),
    ],
)
def test_a_file_whose_place_an_older_one_takes_is_seen(finished, name, expected):
    path = finished.folder / name
    kept, times = path.read_text(), path.stat()
    _older(name)(finished.folder)
    plan = finished.plan()
    path.write_text(kept)
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    assert {rule: plan.get(rule, 0) for rule in expected} == counted(expected, finished.whole)


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


# A capture: 3 cameras, of which c1 is held out.
CHECKED = {"check": 1, "check_sheet": 1}
HELD_OUT = {"render": 1, "evaluate": 1, "table": 1, "figure": 2, "report": 1, "collect": 1}


class Capture:
    """A capture, and the project in which everything has been made of it."""

    def __init__(self, folder: Path, *words: str) -> None:
        self.project = Project(folder / "p")
        self.root = write_capture(folder / "toy")
        self.words = ["--config", f"data_root={self.root}", *words]
        self.whole = self.plan()
        self.run()
        assert self.plan() == {}

    def counted(self, expected: dict[str, int]) -> dict[str, int]:
        return counted(expected, self.whole)

    def run(self) -> None:
        done = self.project.snakemake("--quiet", "all", *self.words, config="config/capture.yaml")
        assert done.returncode == 0, (done.stdout + done.stderr)[-3000:]

    def plan(self, *configs: str) -> dict[str, int]:
        return self.project.plan(*self.words, config=" ".join(["config/capture.yaml", *configs]))


@pytest.fixture(scope="module")
def captured(tmp_path_factory):
    return Capture(tmp_path_factory.mktemp("captured"))


@pytest.fixture
def change(captured):
    """Changes a folder of the capture, plans, and puts it back with its times."""
    kept = captured.root.with_name("kept")

    def apply(edit, *configs):
        os.rename(captured.root, kept)
        shutil.copytree(kept, captured.root)  # times stay, but not those of renamings
        edit(captured.root)
        return captured.plan(*configs)

    yield apply
    shutil.rmtree(captured.root)
    os.rename(kept, captured.root)


def _edited(name):
    """In place, with the same size: only the time tells."""

    def edit(root):
        path = root / name
        with path.open("r+b") as stream:
            first = stream.read(1)
            stream.seek(0)
            stream.write(first)
        os.utime(path, ns=(0, path.stat().st_mtime_ns + 1_000_000))

    return edit


def _older(name):
    """By a file that is older than everything that was made: out of a backup, or copied with its times."""

    def edit(root):
        (root / name).write_text((root / name).read_text() + "\n")
        os.utime(root / name, (10**9, 10**9))

    return edit


def _replaced(name):
    """By a rename, as editors save."""

    def edit(root):
        new = root / "new"
        new.write_bytes((root / name).read_bytes() + b"more")
        os.replace(new, root / name)

    return edit


def _exchanged(folder, first, second):
    """Two files of one size and one time, as archives leave them, exchanged by renaming."""

    def edit(root):
        a, b, c = (root / folder / name for name in (first, second, "other"))
        os.rename(a, c)
        os.rename(b, a)
        os.rename(c, b)

    return edit


def _added(name):
    def edit(root):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(b"new")

    return edit


MASKED = {**CHECKED, "masks": 1, "crop": 1}
# Meshes are drawn to the outlines of the training cameras' masks, and what the head lacks is carved from them.
CARVED = {**MASKED, "align": 1, "shell": 1, "light": 1, "spectral": 1}
SEEN = {**CHECKED, "ingest": 1, "masks": 1, "crop": 1}
MOVED = {**CHECKED, **dict.fromkeys(("tracks", "masks", "crop", "align", "shell", "light", "spectral"), ALL), **TRAINED}
EDITS = {
    "nothing but a copy": (lambda root: None, {}),
    "a mask": (_edited("masks/c0/f1.png"), CARVED | TRAINED),
    "a mask of the held-out camera": (_edited("masks/c1/f1.png"), MASKED | HELD_OUT),
    "a mask replaced": (_replaced("masks/c2/f3.png"), CARVED | TRAINED),
    "a mask removed": (lambda root: (root / "masks/c0/f2.png").unlink(), CARVED | TRAINED),
    "coverage added": (_added("alpha/c0/f0.png"), CARVED | TRAINED),
    "an image": (_edited("images/c0/f1.png"), SEEN | {"align": 1, "shell": 1, "light": 1, "spectral": 1} | TRAINED),
    "an image of the held-out camera": (_edited("images/c1/f0.png"), SEEN | HELD_OUT),
    "an image renamed": (
        lambda root: (root / "images/c2/f0.png").rename(root / "images/c2/f0.PNG"),
        SEEN | {"align": 1, "shell": 1, "light": 1, "spectral": 1} | TRAINED,
    ),
    "a mesh": (_edited("meshes/f2.npz"), MOVED),
    "a mesh replaced": (_replaced("meshes/f0.npz"), MOVED),
    "the cameras, by an older file": (_older("cameras.json"), MOVED | {"ingest": ALL}),
    "the splits, by an older file": (_older("splits.json"), MOVED | {"ingest": ALL}),
    "the topology": (_edited("meshes/topology.npz"), MOVED),
    "what is no frame": (_added("masks/c0/notes.txt"), {}),
    "a frame that splits.json leaves out": (_added("images/c0/f9.png"), {}),
    "a hidden file": (_added("meshes/.f0.npz.swp"), {}),
}


@pytest.mark.parametrize("case", EDITS)
def test_files_of_a_capture_run_what_depends_on_them(captured, change, case):
    edit, expected = EDITS[case]
    assert change(edit) == captured.counted(expected)


def test_files_that_exchange_their_names_are_seen(captured):
    pair = [captured.root / "masks/c0" / name for name in ("f0.png", "f1.png")]
    kept = [(path, path.read_bytes(), path.stat().st_mtime_ns) for path in pair]
    for path in pair:
        path.write_bytes(b"1234" + path.name.encode())
        os.utime(path, ns=(0, 10**18))
    captured.run()
    assert captured.plan() == {}
    _exchanged("masks/c0", "f0.png", "f1.png")(captured.root)
    assert captured.plan() == captured.counted(CARVED | TRAINED)
    for path, content, time in kept:
        path.write_bytes(content)
        os.utime(path, ns=(0, time))
    captured.run()


def test_options_that_change_with_a_file_are_not_forgotten(captured, change):
    """Snakemake looks for no other change behind a job that has to run: the check must not be such a job."""
    (captured.project.folder / "seed.json").write_text('{"stages": {"train": {"seed": 7}}}')
    plan = change(_edited("masks/c1/f1.png"), "seed.json")
    assert plan == captured.counted(MASKED | TRAINED)


def test_a_check_that_fails_stops_and_leaves_what_was_made(captured):
    defect = captured.project.folder / "defect"
    path = captured.root / "masks/c1/f1.png"
    before = path.stat().st_mtime_ns
    os.utime(path, ns=(0, before + 1))
    defect.touch()
    done = captured.project.snakemake(*captured.words, config="config/capture.yaml")
    text = done.stdout + done.stderr
    assert done.returncode != 0 and "cameras.json: a defect" in text
    assert "rule check:" in text and not re.search(r"rule (masks|ingest|train|evaluate):", text)
    defect.unlink()
    os.utime(path, ns=(0, before))
    assert captured.plan() == {}


def test_supplied_masks_run_what_depends_on_them(tmp_path):
    own = tmp_path / "own"
    for name in ("toy/c0/f0.png", "toy/c1/f0.png", "c2/f0.png"):
        _added(name)(own)
    words = [f"stages={{masks: {{supplied: {own}}}}}"]
    capture = Capture(tmp_path, *words)
    for name, expected in (
        ("toy/c0/f1.png", CARVED | TRAINED),
        ("toy/c1/f0.png", MASKED | HELD_OUT),
        ("c2/f0.png", CARVED | TRAINED),
    ):
        (own / name).write_bytes(b"mended")
        assert capture.plan() == capture.counted(expected), name
        capture.run()
    (own / "toy/c2.mp4").write_bytes(b"film")  # comes before c2/
    assert capture.plan() == capture.counted(CARVED | TRAINED)
    _edited("masks/c0/f0.png")(capture.root)
    _added("c0/f0.png")(own)
    assert capture.plan() == capture.counted(CARVED | TRAINED)
