"""Curves of a training as an offline run of Weights & Biases: what is logged, and that it changes nothing."""

import json
import math
import sys
import types

import numpy as np
import pytest
import torch

from nbavatar.cli import main
from tests.scenes.toy import write_scene
from tests.scenes.training import train_options

OPTIONS = {
    "steps": 30, "previews": 2, "prefetch": 0, "coarse_side": 16,
    **train_options({"texels": 4, "channels": 3, "deferred": False, "init": "random", "weight_lpips": 0.0}),
}  # fmt: skip


class FakeRun:
    def __init__(self, **given):
        self.given, self.logged, self.finished = given, [], False

    def log(self, values, step):
        assert not self.finished
        self.logged.append((step, dict(values)))

    def finish(self):
        self.finished = True


@pytest.fixture
def fake(monkeypatch):
    """A module in wandb's place; its attribute `runs` holds what was begun."""
    module = types.ModuleType("wandb")
    module.runs = []
    module.Settings = lambda **given: given
    module.Image = lambda array: np.asarray(array)

    def init(**given):
        module.runs.append(FakeRun(**given))
        return module.runs[-1]

    module.init = init
    monkeypatch.setitem(sys.modules, "wandb", module)
    return module


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("scene"))


def train(scene, out, **options):
    words = ["train", "--frames", *map(str, scene["packs"]), "--meshes", str(scene["meshes"]), "--out", str(out)]
    return main([*words, "--device", "cpu", "--cfg", json.dumps(OPTIONS | options)])


def weights(path):
    return torch.load(path, weights_only=True)["state"]


def test_the_run_holds_the_same_numbers_and_pictures_and_changes_nothing(scene, tmp_path, fake):
    assert train(scene, tmp_path / "plain/model.pt") == 0 and fake.runs == []
    assert train(scene, tmp_path / "S2/full/model.pt", wandb="heads") == 0
    (run,) = fake.runs
    assert run.finished
    folder = tmp_path / "S2/full/model.pt.state"
    assert {k: run.given[k] for k in ("project", "name", "mode", "dir")} == {
        "project": "heads", "name": "S2/full", "mode": "offline", "dir": str(folder),
    }  # fmt: skip
    assert run.given["config"]["steps"] == 30 and len(run.given["id"]) == 16
    assert run.given["settings"]["disable_git"] and run.given["settings"]["x_disable_meta"]
    events = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
    numbers = [(step, values) for step, values in run.logged if "preview" not in values]
    assert numbers == [
        (event["step"], {f"train/{k}": v for k, v in event.items() if k != "step" and v is not None})
        for event in events
    ]
    pictures = [values["preview"] for _, values in run.logged if "preview" in values]
    assert len(pictures) == len(list((folder / "previews").glob("*.png"))) > 0
    assert all(picture.dtype == np.uint8 and picture.shape[-1] == 3 for picture in pictures)
    plain, logged = weights(tmp_path / "plain/model.pt"), weights(tmp_path / "S2/full/model.pt")
    assert all(torch.equal(plain[name], logged[name]) for name in plain)


def test_a_training_that_is_logged_from_now_on_goes_on_and_keeps_its_id(scene, tmp_path, fake):
    assert train(scene, tmp_path / "model.pt") == 0
    key = (tmp_path / "model.pt.state/key.json").read_bytes()
    assert train(scene, tmp_path / "model.pt", wandb="heads") == 0
    assert (tmp_path / "model.pt.state/key.json").read_bytes() == key
    assert not list(tmp_path.glob("*.stale-*")), "logging is no other experiment"


def test_numbers_that_are_not_finite_are_left_out(tmp_path, fake):
    from nbavatar.training.offline_run import OfflineRun

    run = OfflineRun(str(tmp_path), "heads", "n", {"config": {}})
    run.scalars(3, {"a": math.inf, "b": 1.0, "c": math.nan})
    again = OfflineRun(str(tmp_path), "heads", "n", {"config": {}})
    other = OfflineRun(str(tmp_path), "heads", "n", {"config": {"steps": 2}})
    assert fake.runs[0].logged == [(3, {"b": 1.0})]
    assert fake.runs[0].given["id"] == fake.runs[1].given["id"] != fake.runs[2].given["id"]
    for one in (run, again, other):
        one.close()


@pytest.mark.parametrize("project", ["a/b", "../x", " "])
def test_a_project_that_is_no_name_is_refused(scene, tmp_path, capsys, fake, project):
    assert train(scene, tmp_path / "model.pt", wandb=project) == 2
    assert "wandb" in capsys.readouterr().err and not (tmp_path / "model.pt.state").exists()


def test_without_the_package_nothing_is_begun(scene, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    assert train(scene, tmp_path / "model.pt", wandb="heads") == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "package 'wandb' cannot be imported" in line and "pip install" in line
    assert not (tmp_path / "model.pt.state").exists()


@pytest.mark.slow  # it starts a process of its own
def test_the_real_package_writes_an_offline_run(scene, tmp_path, monkeypatch):
    wandb = pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "online")  # whatever the user's environment says
    assert train(scene, tmp_path / "model.pt", wandb="heads") == 0
    wandb.teardown()  # its process writes on after the run has ended
    (written,) = (tmp_path / "model.pt.state/wandb").glob("offline-run-*/run-*.wandb")
    assert written.stat().st_size > 1000
    pictures = list(written.parent.glob("files/media/images/*.png"))
    assert len(pictures) == len(list((tmp_path / "model.pt.state/previews").glob("*.png")))
