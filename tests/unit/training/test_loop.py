"""The trainer: it learns, resumes exactly, survives bad steps and stops with one line."""

import errno
import fcntl
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nbavatar.cli import main
from nbavatar.config.core import to_mapping
from nbavatar.config.training import TrainConfig
from nbavatar.data.sequences import MeshSequence, Part, read_sequence
from nbavatar.data.views import ViewStore, views_of
from nbavatar.errors import DataError, NBAvatarError
from nbavatar.io.framepack import FramePack
from nbavatar.methods.billboards.initial import initial_avatar
from nbavatar.methods.billboards.training import parameter_groups
from nbavatar.methods.create import create_method
from nbavatar.optimization.muon import Muon
from nbavatar.training.loop import train
from nbavatar.training.state import RunFolder
from tests.scenes.toy import sequence, write_scene
from tests.scenes.training import train_config
from tests.unit.disks import fill

CONFIG = train_config(
    steps=12, texels=4, unet={"width": 4, "depth": 3, "max_width": 8, "convs": 1}, weight_lpips=0.0, previews=0,
    checkpoint_seconds=0.0, coarse_side=16, prefetch=2,
)  # fmt: skip


def run(scene: dict, config: TrainConfig, folder: Path, **options):
    """Train in this process; returns avatar and summary."""
    torch.set_num_threads(1)
    meshes, _ = read_sequence(scene["meshes"])
    coords = {k[: -len(".coords")]: v for k, v in np.load(scene["spectral"]).items() if k.endswith(".coords")}
    packs = [FramePack(path) for path in scene["packs"]]
    views = views_of(packs, meshes.frames, [pack.split("train") for pack in packs], layers=("rgb", "alpha"))
    method = create_method(meshes, coords, views, config)
    avatar = method.avatar
    store = RunFolder(folder, {"config": to_mapping(config)})
    verts = {part: torch.from_numpy(mesh.verts) for part, mesh in meshes.parts.items() if part in avatar.parts}
    summary = train(
        method, ViewStore(packs, views, avatar.parts, 10**8), len(views), verts, options.pop("lpips", None), config,
        store, **options,
    )  # fmt: skip
    return avatar, summary


def same(a, b) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a.state_dict().values(), b.state_dict().values(), strict=True))


def test_train_is_deterministic_and_depends_on_the_seed(scene, tmp_path) -> None:
    first, _ = run(scene, CONFIG, tmp_path / "a")
    again, _ = run(scene, replace(CONFIG, cache_mb=0, prefetch=0), tmp_path / "b")
    other, _ = run(scene, replace(CONFIG, seed=1), tmp_path / "c")
    assert same(first, again)
    assert not same(first, other)


@pytest.mark.parametrize(("at", "optimizer"), [(1, "adam"), (5, "adam"), (11, "adam"), (5, "muon")])
def test_train_resumed_equals_unbroken_bit_for_bit(scene, tmp_path, at: int, optimizer: str) -> None:
    config = train_config(CONFIG, unet_optimizer=optimizer)
    whole, _ = run(scene, config, tmp_path / "whole")
    calls = iter(range(100))
    _, cut = run(scene, config, tmp_path / "cut", should_stop=lambda: next(calls) == at)
    assert not cut["finished"] and cut["steps"] == at
    resumed, summary = run(scene, config, tmp_path / "cut")
    assert summary["finished"] and same(whole, resumed)
    events = [RunFolder(tmp_path / name, {"config": to_mapping(config)}).events() for name in ("whole", "cut")]
    steps = [[event["step"] for event in found] for found in events]
    assert steps[0] == steps[1] == sorted(set(steps[0]))


def test_train_learns_the_toy_scene(scene, tmp_path) -> None:
    config = replace(CONFIG, steps=120, checkpoint_seconds=60.0, rate_factor=4.0)
    _, summary = run(scene, config, tmp_path)
    events = RunFolder(tmp_path, {"config": to_mapping(config)}).events()
    # Full-resolution losses only: coarse pictures are another measure.
    assert summary["last"]["mse"] < 0.25 * events[0]["mse"]
    assert summary["skipped"] == 0


def test_parameter_groups_have_the_rates_of_the_supplement(scene) -> None:
    meshes, _ = read_sequence(scene["meshes"])
    for deferred in (True, False):
        config = train_config(CONFIG, init="random", deferred=deferred)
        avatar = initial_avatar(meshes, {}, [], config)
        rates = {group["name"]: group["lr"] for group in parameter_groups(avatar, config)}
        decays = {group["name"]: group["final"] for group in parameter_groups(avatar, config) if "final" in group}
        assert decays == {"position": 0.01}
        expected = {"position": 1.6e-4, "rotation": 1e-3, "scale": 5e-3, "alpha": 5e-4}
        expected |= {"features": 5e-4, "renderer": 1e-3} if deferred else {"features": 2.5e-3}
        assert rates == expected
        grouped = sum(p.numel() for group in parameter_groups(avatar, config) for p in group["params"])
        assert grouped == sum(p.numel() for p in avatar.parameters())


def test_muon_moves_the_hidden_convolutions_and_adam_the_rest(scene) -> None:
    meshes, _ = read_sequence(scene["meshes"])
    config = train_config(CONFIG, init="random", unet_optimizer="muon", clip=0.5, rates={"renderer": 4e-3})
    avatar = initial_avatar(meshes, {}, [], config)
    groups = parameter_groups(avatar, config)
    parameters = [id(p) for group in groups for p in group["params"]]
    assert sorted(parameters) == sorted(id(p) for p in avatar.parameters())
    (muon,) = (group for group in groups if group.get("muon"))
    assert muon["lr"] == 4e-3 and muon["clip"] == 0.5
    assert avatar.unet is not None and [id(p) for p in muon["params"]] == [id(p) for p in avatar.unet.hidden_weights()]
    plain = initial_avatar(meshes, {}, [], train_config(CONFIG, init="random", deferred=False, unet_optimizer="muon"))
    assert not any(group.get("muon") for group in parameter_groups(plain, config))


def test_the_trainer_moves_matrices_by_muon_at_the_rate_of_the_moment(scene, tmp_path, monkeypatch) -> None:
    rates = []
    step = Muon.step

    def watched(self) -> None:
        rates.extend(group["lr"] for group in self.param_groups)
        step(self)

    monkeypatch.setattr(Muon, "step", watched)
    config = train_config(CONFIG, steps=12, schedule="fast", unet_optimizer="muon", rates={"renderer": 4e-3})
    run(scene, config, tmp_path / "whole")
    assert len(rates) == 12 and rates[0] == 4e-3 and rates[-1] < 0.5 * rates[0] and rates == sorted(rates, reverse=True)
    once = train_config(config, steps=1, schedule="paper")
    moved, _ = run(scene, once, tmp_path / "muon")
    other, _ = run(scene, train_config(once, unet_optimizer="adam"), tmp_path / "adam")
    meshes, _ = read_sequence(scene["meshes"])
    coords = {k[: -len(".coords")]: v for k, v in np.load(scene["spectral"]).items() if k.endswith(".coords")}
    start = initial_avatar(meshes, coords, [], once)
    hidden = {id(weight) for weight in moved.unet.hidden_weights()}
    # The first steps see the same gradients: matrices differ, all else has Adam's bits.
    for a, b, before in zip(moved.parameters(), other.parameters(), start.parameters(), strict=True):
        assert torch.equal(a, b) == (id(a) not in hidden)
        if id(a) in hidden:
            assert 0.1 < float((a - before).detach().square().mean().sqrt()) / 4e-3 < 0.25


def test_bad_steps_are_skipped_counted_and_end_the_training_with_one_line(scene, tmp_path) -> None:
    calls = iter(range(10**6))

    def broken(x, y):
        return (x - y).mean().reshape(1) * (float("nan") if next(calls) in (2, 3, 6) else 1.0)

    config = train_config(CONFIG, weight_lpips=0.1)
    avatar, summary = run(scene, config, tmp_path / "a", lpips=broken)
    assert summary["skipped"] == 3 and summary["finished"]
    assert all(torch.isfinite(p).all() for p in avatar.parameters())

    def nowhere(x, y):
        return (x - y).mean().reshape(1) * float("nan")

    with pytest.raises(NBAvatarError, match=r"4 steps in a row up to step 3 had a loss .* not finite .*rate_factor"):
        run(scene, replace(config, max_bad_steps=4), tmp_path / "b", lpips=nowhere)


def test_a_training_that_renders_nothing_stops(tmp_path) -> None:
    meshes = sequence()
    far = {name: replace(part, verts=part.verts + np.float32(10.0)) for name, part in meshes.parts.items()}
    scene = write_scene(tmp_path / "scene", meshes=replace(meshes, parts=far))
    kept = write_scene(tmp_path / "kept")  # its masks are where the person was
    with pytest.raises(
        NBAvatarError, match=r"miss the masks in all 8 views .* up to step 175 .*silhouette loss 1"
    ) as error:
        run({**scene, "packs": kept["packs"]}, replace(CONFIG, steps=1000), tmp_path / "t")
    assert "\n" not in str(error.value)


def test_a_hundred_times_the_rate_recovers_or_stops_with_a_line(scene, tmp_path) -> None:
    try:
        avatar, _ = run(scene, replace(CONFIG, steps=40, rate_factor=100.0), tmp_path)
        assert all(torch.isfinite(p).all() for p in avatar.parameters())
    except NBAvatarError as error:
        assert "\n" not in str(error)


@pytest.mark.parametrize(
    "change",
    [
        {"texels": 1},
        {"channels": 1},
        {"channels": 24},
        {"deferred": False},
        {"init": "random"},
        {"weight_nb": 0.0},
        {"weight_knn": 0.0, "weight_delta": 0.0},
        {"parts": ["head"]},
        {"parts": ["right_hand"]},
        {"dice": "haha"},
        {"roi": False},
        {"schedule": "paper", "steps": 8},
        {"precision": "bf16"},
        {"clip": 1.0},
        {"order": "center"},
    ],
    ids=str,
)
def test_every_variant_trains(scene, tmp_path, change: dict) -> None:
    avatar, summary = run(scene, train_config(CONFIG, **({"steps": 8} | change)), tmp_path)
    assert summary["finished"] and summary["skipped"] == 0
    assert all(torch.isfinite(p).all() for p in avatar.parameters())


def test_refinement_moves_meshes_of_training_frames(scene, tmp_path) -> None:
    config = train_config(CONFIG, refine={"modes": 3, "rate": 1e-3})
    avatar, _ = run(scene, config, tmp_path)
    assert avatar.refinement is not None
    assert avatar.refinement.get_parameter("bend_head").abs().max() > 0
    # Nothing in common: held-out frames, which have no refinement, must find the avatar where the others do.
    for values in avatar.refinement.parameters():
        torch.testing.assert_close(values.mean(0), torch.zeros_like(values[0]), atol=1e-9, rtol=0)


def test_empty_masks_train_to_nothing(tmp_path) -> None:
    scene = write_scene(tmp_path / "scene", empty=True)
    _, summary = run(scene, replace(CONFIG, steps=60, rate_factor=5.0), tmp_path / "state")
    assert summary["skipped"] == 0
    assert summary["last"]["psnr"] > 15


def test_one_frame_and_a_frame_without_hand(tmp_path) -> None:
    whole = sequence()
    hand = whole.parts["right_hand"]
    verts = hand.verts.copy()
    verts[1] = np.nan
    parts = {**whole.parts, "right_hand": Part(hand.faces, hand.rest, verts)}
    lost = write_scene(tmp_path / "lost", meshes=MeshSequence(whole.frames, parts, {}))
    assert run(lost, CONFIG, tmp_path / "a")[1]["skipped"] == 0
    single = write_scene(tmp_path / "single", meshes=whole.subset(["f0"]))
    single["packs"] = single["packs"][:1]
    assert run(single, CONFIG, tmp_path / "b")[1]["skipped"] == 0


def test_a_frame_without_a_head_trains(tmp_path) -> None:
    whole = sequence()
    head = whole.parts["head"]
    verts = head.verts.copy()
    verts[1] = np.nan
    scene = write_scene(
        tmp_path / "lost",
        meshes=MeshSequence(whole.frames, {**whole.parts, "head": Part(head.faces, head.rest, verts)}, {}),
    )
    avatar, summary = run(scene, CONFIG, tmp_path / "state")
    assert summary["skipped"] == 0
    assert all(torch.isfinite(p).all() for p in avatar.parameters())


@pytest.mark.slow
def test_a_hundred_thousand_faces_train(tmp_path) -> None:
    whole = sequence()
    fine = MeshSequence(whole.frames, {"head": _sphere(224, 224, len(whole.frames))}, {})
    assert len(fine.parts["head"].faces) >= 100_000
    scene = write_scene(tmp_path / "fine", size=128, meshes=fine)
    _, summary = run(scene, train_config(CONFIG, steps=2, texels=2, schedule="paper"), tmp_path / "state")
    assert summary["skipped"] == 0 and summary["primitives"] == len(fine.parts["head"].faces)


def _sphere(rings: int, columns: int, frames: int) -> Part:
    """A sphere of 15 cm with 2 * rings * columns faces (slivers at the poles), at rest."""
    polar, around = np.meshgrid(
        np.linspace(0.01, np.pi - 0.01, rings + 1), np.linspace(0, 2 * np.pi, columns, endpoint=False), indexing="ij"
    )
    points = 0.15 * np.stack([np.sin(polar) * np.cos(around), np.cos(polar), np.sin(polar) * np.sin(around)], -1)
    index = np.arange((rings + 1) * columns).reshape(rings + 1, columns)
    a, b, c, d = index[:-1], np.roll(index, -1, 1)[:-1], index[1:], np.roll(index, -1, 1)[1:]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([b, d, c], -1).reshape(-1, 3)])
    rest = points.reshape(-1, 3).astype(np.float32)
    return Part(faces.astype(np.int64), rest, np.repeat(rest[None], frames, 0))


def test_time_budget_ends_the_training(scene, tmp_path) -> None:
    began = time.monotonic()
    _, summary = run(scene, replace(CONFIG, max_minutes=0.02), tmp_path)
    assert summary["finished"] and 1.0 <= time.monotonic() - began < 10.0
    assert summary["steps"] > 3


def test_previews_are_drawn_early_middle_and_late(scene, tmp_path) -> None:
    run(scene, replace(CONFIG, previews=3), tmp_path)
    names = sorted(path.name for path in (tmp_path / "previews").glob("*.png"))
    assert names == ["step_0000001.png", "step_0000006.png", "step_0000012.png"]


def test_state_of_another_experiment_is_moved_aside(tmp_path) -> None:
    RunFolder(tmp_path / "s", {"a": 1}).save({"step": 3})
    assert RunFolder(tmp_path / "s", {"a": 1}).load() == {"step": 3}
    other = RunFolder(tmp_path / "s", {"a": 2})
    assert other.load() is None and other.moved_to is not None
    assert (other.moved_to / "state.pt").exists()


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS])
def test_a_disk_without_locks_is_no_obstacle(tmp_path, monkeypatch, number) -> None:
    def flock(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", flock)
    RunFolder(tmp_path / "s", {"a": 1}).save({"step": 3})
    assert RunFolder(tmp_path / "s", {"a": 1}).load() == {"step": 3}
    number = errno.EIO
    with pytest.raises(OSError, match="Input/output"):
        RunFolder(tmp_path / "s", {"a": 1})


def test_two_trainings_never_share_a_folder(tmp_path) -> None:
    first = RunFolder(tmp_path / "s", {"a": 1})
    for key in ({"a": 1}, {"a": 2}):  # neither resumed nor moved aside while it is written to
        with pytest.raises(DataError, match="another training that writes to it"):
            RunFolder(tmp_path / "s", key)
    assert [path.name for path in tmp_path.iterdir()] == ["s"]
    del first
    RunFolder(tmp_path / "s", {"a": 1})


def test_a_training_that_failed_frees_its_folder_though_somebody_keeps_its_error(tmp_path) -> None:
    with pytest.raises(RuntimeError) as kept, RunFolder(tmp_path / "s", {}) as held:
        raise RuntimeError
    assert kept.value.__traceback__ is not None and held.path.exists()  # as a notebook or a debugger keeps them
    RunFolder(tmp_path / "s", {})


def test_events_after_the_checkpoint_and_torn_lines_are_dropped(tmp_path) -> None:
    folder = RunFolder(tmp_path / "s", {})
    for step in (1, 2, 3):
        folder.log({"step": step})
    folder.save({"step": 2})
    with open(tmp_path / "s" / "events.jsonl", "a") as stream:
        stream.write('{"step": 4, "mse"')
    del folder  # the lock goes with it, as with a process that ends
    again = RunFolder(tmp_path / "s", {})
    again.load()
    assert [event["step"] for event in again.events()] == [1, 2]
    lines = (tmp_path / "s" / "events.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in lines] == [1, 2]


def _command(scene: dict, out: Path, config: TrainConfig) -> list[str]:
    frames = [str(path) for path in scene["packs"]]
    rest = ["--meshes", scene["meshes"], "--spectral", scene["spectral"], "--out", out, "--device", "cpu"]
    return ["train", "--frames", *frames, *map(str, rest), "--cfg", json.dumps(to_mapping(config))]


@pytest.mark.slow
def test_killed_at_any_moment_the_same_command_gives_the_same_weights(scene, tmp_path) -> None:
    config = replace(CONFIG, steps=30)
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    program = [sys.executable, "-m", "nbavatar"]
    broken, whole = tmp_path / "broken.pt", tmp_path / "whole.pt"
    events = Path(f"{broken}.state") / "events.jsonl"
    command = program + _command(scene, broken, config)
    # Killed as soon as it trains, and again a little later.
    for lines in (1, 2):
        process = subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        while process.poll() is None and not (events.exists() and events.read_text().count("\n") >= lines):
            time.sleep(0.005)
        process.send_signal(signal.SIGKILL)
        process.wait()
    subprocess.run(command, env=environment, check=True, capture_output=True)
    subprocess.run(program + _command(scene, whole, config), env=environment, check=True, capture_output=True)
    a, b = (torch.load(path, weights_only=True)["state"] for path in (broken, whole))
    assert a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def test_on_a_full_disk_it_stops_and_goes_on_from_its_checkpoint(scene, tmp_path, small_disk, capsys) -> None:
    whole, broken = tmp_path / "whole.pt", small_disk / "broken.pt"
    assert main(_command(scene, whole, CONFIG)) == 0
    size = Path(f"{whole}.state", "state.pt").stat().st_size
    filler = fill(small_disk, 3 * size // 2)  # the first checkpoint finds room, the second, written beside it, does not
    capsys.readouterr()
    assert main(_command(scene, broken, CONFIG)) == 2
    error = capsys.readouterr().err
    assert f"nbavatar train: error: {broken}.state/state.pt: expected room to write, found a full disk" in error
    assert "Traceback" not in error and not broken.exists()
    first = torch.load(f"{broken}.state/state.pt", weights_only=True)["step"]
    assert 0 < first < CONFIG.steps
    filler.unlink()
    assert main(_command(scene, broken, CONFIG)) == 0
    a, b = (torch.load(path, weights_only=True)["state"] for path in (broken, whole))
    assert a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)
    assert not [path for path in small_disk.rglob("*") if ".tmp" in path.name]


@pytest.mark.slow
def test_terminated_it_saves_and_says_how_to_go_on(scene, tmp_path) -> None:
    config = replace(CONFIG, steps=100_000, checkpoint_seconds=1000.0)
    command = [sys.executable, "-m", "nbavatar", *_command(scene, tmp_path / "m.pt", config)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    events = tmp_path / "m.pt.state" / "events.jsonl"
    while not (events.exists() and events.read_text()):
        time.sleep(0.02)
        assert process.poll() is None
    process.send_signal(signal.SIGTERM)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 143 and "the same command goes on" in error
    assert (tmp_path / "m.pt.state" / "state.pt").exists() and not (tmp_path / "m.pt").exists()


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"--meshes": "absent.npz"}, "absent.npz: expected a file (--meshes), found no such file"),
        ({"--cfg": '{"stepz": 3}'}, "unknown key 'stepz'; did you mean 'steps'?"),
        ({"--cfg": '{"channels": 3}'}, "unknown key 'channels'; write billboards: {channels: ...}"),
        ({"--cfg": '{"parts": ["left_hand"]}'}, "expected parts of the meshes (head, right_hand), found left_hand"),
        ({"--cfg": '{"billboards": {"channels": 0}}'}, "billboards.channels: expected at least 1"),
    ],
)
def test_bad_input_is_one_line_and_exit_2(scene, tmp_path, capsys, change: dict, line: str) -> None:
    command = _command(scene, tmp_path / "m.pt", CONFIG)
    for option, value in change.items():
        command[command.index(option) + 1] = value
    assert main(command) == 2
    error = capsys.readouterr().err.strip()
    assert line in error and "\n" not in error
    assert not (tmp_path / "m.pt").exists()


def test_missing_coordinates_are_named(scene, tmp_path, capsys) -> None:
    command = _command(scene, tmp_path / "m.pt", CONFIG)
    del command[command.index("--spectral") : command.index("--spectral") + 2]
    assert main(command) == 2
    assert "spectral coordinates: head.coords: expected this array, found none" in capsys.readouterr().err
