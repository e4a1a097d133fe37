"""All methods of Gaussians on the toy scene: they learn, keep their books in order, and resume exactly."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nbavatar.config.core import to_mapping
from nbavatar.config.training import TrainConfig
from nbavatar.data.sequences import MeshSequence, Part, read_sequence
from nbavatar.data.views import ViewStore, views_of
from nbavatar.errors import DataError
from nbavatar.io.framepack import FramePack
from nbavatar.methods.create import create_method
from nbavatar.methods.gaussian_avatars.options import GaussianAvatarsConfig
from nbavatar.methods.gaussians.avatar import GaussianAvatar
from nbavatar.methods.gaussians.density import densify, remove, reset_opacity
from nbavatar.methods.gaussians.options import BoundRates, DensityConfig
from nbavatar.methods.interact_avatar.options import InteractAvatarConfig, InteractAvatarRates
from nbavatar.methods.splatting_avatar.options import (
    SplattingAvatarConfig,
    SplattingAvatarRates,
    SplattingDensityConfig,
)
from nbavatar.methods.storage import load_avatar, save_avatar
from nbavatar.optimization.adam import Adam
from nbavatar.training.loop import train
from nbavatar.training.state import RunFolder
from tests.scenes.toy import sequence, write_scene

# Density changes every few steps, at a threshold that most Gaussians exceed: growth is what is tested.
DENSE = {
    "start": 0,
    "interval": 2_000,
    "gradient": 1e-6,
    "floor_steps": 4,
    "reset_floor_steps": 15,
    "max_gaussians": 400,
}
CONFIG = TrainConfig(steps=40, previews=0, checkpoint_seconds=0.0, prefetch=2)
GAUSSIAN_AVATARS = replace(
    CONFIG,
    method="gaussian_avatars",
    gaussian_avatars=GaussianAvatarsConfig(density=DensityConfig(**DENSE)),
)
SPLATTING_AVATAR = replace(
    CONFIG,
    method="splatting_avatar",
    splatting_avatar=SplattingAvatarConfig(
        samples=120, weight_lpips=0.0, density=SplattingDensityConfig(**{**DENSE, "interval": 100})
    ),
)
INTERACT_AVATAR = replace(
    CONFIG,
    method="interact_avatar",
    interact_avatar=InteractAvatarConfig(density=DensityConfig(**DENSE), width=16, features=8),
)
RELEASED = replace(SPLATTING_AVATAR, splatting_avatar=replace(SPLATTING_AVATAR.splatting_avatar, mode="released"))
ALL = pytest.mark.parametrize(
    "config",
    [GAUSSIAN_AVATARS, INTERACT_AVATAR, SPLATTING_AVATAR, RELEASED],
    ids=["gaussian_avatars", "interact_avatar", "splatting_avatar", "released"],
)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> dict:
    return write_scene(tmp_path_factory.mktemp("scene"))


def prepare(scene: dict, config: TrainConfig):
    torch.set_num_threads(1)
    meshes, _ = read_sequence(scene["meshes"])
    packs = [FramePack(path) for path in scene["packs"]]
    views = views_of(packs, meshes.frames, [pack.split("train") for pack in packs], layers=("rgb", "alpha"))
    method = create_method(meshes, {}, views, config)
    store = ViewStore(packs, views, method.avatar.parts, 10**8)
    return method, meshes, views, store


def run(scene: dict, config: TrainConfig, folder: Path, **options):
    method, meshes, views, store = prepare(scene, config)
    verts = {part: torch.from_numpy(meshes.parts[part].verts) for part in method.avatar.parts}
    state = RunFolder(folder, {"config": to_mapping(config)})
    summary = train(method, store, len(views), verts, options.pop("lpips", None), config, state, **options)
    return method, summary


def same(a, b) -> bool:
    one, two = a.avatar.state_dict(), b.avatar.state_dict()
    return one.keys() == two.keys() and all(torch.equal(one[name], two[name]) for name in one)


@ALL
def test_it_learns(tmp_path, config) -> None:
    # Rates of a short training; density as published: at this length one densification and no reset.
    rates = {"colour": 0.1, "opacity": 0.2, "scale": 0.05}
    bound = replace(config.gaussian_avatars, density=DensityConfig(), rates=BoundRates(**rates))
    embedded = replace(config.splatting_avatar, density=SplattingDensityConfig(), rates=SplattingAvatarRates(**rates))
    touched = replace(config.interact_avatar, density=DensityConfig(), rates=InteractAvatarRates(**rates))
    config = replace(config, steps=50, gaussian_avatars=bound, interact_avatar=touched, splatting_avatar=embedded)
    fine = write_scene(tmp_path / "fine", meshes=subdivided(sequence()))
    method, summary = run(fine, config, tmp_path / "state")
    assert summary["skipped"] == 0 and summary["primitives"] == method.avatar.primitives
    assert summary["last"]["mse"] < 0.0085  # 20.7 dB; the white or random background alone is 10 to 13 dB


def subdivided(meshes: MeshSequence) -> MeshSequence:
    """The toy's parts with sixteen times the faces, still convex but rounder."""
    parts = {}
    for name, part in meshes.parts.items():
        faces, rest, verts = part.faces, part.rest, part.verts
        for _ in range(2):
            middle = [(rest[faces[:, i]] + rest[faces[:, (i + 1) % 3]]) / 2 for i in range(3)]
            moved = [(verts[:, faces[:, i]] + verts[:, faces[:, (i + 1) % 3]]) / 2 for i in range(3)]
            first = len(rest) + np.arange(3)[:, None] * len(faces) + np.arange(len(faces))
            a, b, c = faces.T
            d, e, f = first
            faces = np.concatenate([np.stack(t, 1) for t in ((a, d, f), (d, b, e), (f, e, c), (d, e, f))])
            rest, verts = np.concatenate([rest, *middle]), np.concatenate([verts, *moved], 1)
        parts[name] = Part(faces, rest, verts)
    return MeshSequence(meshes.frames, parts, {})


@ALL
def test_resumed_equals_unbroken_bit_for_bit_with_a_changing_number(scene, tmp_path, config) -> None:
    config, at = replace(config, steps=24), 10  # two steps after a densification, two before the next
    whole, summary = run(scene, config, tmp_path / "whole")
    first = prepare(scene, config)[0].avatar.primitives
    assert summary["primitives"] != first
    calls = iter(range(100))
    _, cut = run(scene, config, tmp_path / "cut", should_stop=lambda: next(calls) == at)
    assert cut["steps"] == at
    resumed, _ = run(scene, config, tmp_path / "cut")
    assert same(whole, resumed)


@ALL
def test_books_agree_after_fifty_random_operations(scene, config) -> None:
    # Each Gaussian carries a mark in its colour, its moments and its history; after any sequence of operations the
    # mark must still say the same in all three, and bindings must be the ancestor's.
    method, *_ = prepare(scene, config)
    avatar = method.avatar
    optimizer = Adam(method.parameter_groups(), eps=method.adam_eps)
    for name in avatar.PARAMETERS:
        parameter = getattr(avatar, name)
        marks = torch.arange(len(parameter), dtype=torch.float32).view(-1, *[1] * (parameter.ndim - 1))
        parameter.grad = torch.ones_like(parameter) * (marks + 1)
    optimizer.step()
    count = avatar.primitives
    with torch.no_grad():
        avatar.colour[:, 0, 0] = torch.arange(count, dtype=torch.float32)
    binding = (avatar.binding if hasattr(avatar, "binding") else avatar.face).clone()
    first = {name: optimizer.moments(getattr(avatar, name)) for name in avatar.PARAMETERS}
    born = torch.zeros(count, dtype=torch.bool)  # without inherited moments
    random = torch.Generator().manual_seed(0)
    for _ in range(50):
        kind = int(torch.randint(0, 4, (), generator=random))
        if kind in (0, 1):
            gradient = torch.rand(avatar.primitives, generator=random)
            sizes = torch.rand(avatar.primitives, generator=random)
            before = avatar.colour[:, 0, 0].detach().clone()
            source = densify(avatar, optimizer, gradient, sizes, random, threshold=0.9, split_above=0.5, most=4 * count)
            stays = len(born) - int(((gradient >= 0.9) & (sizes > 0.5)).sum()) if len(source) > len(born) else len(born)
            kept = source[: int(stays)]
            born = torch.cat((born[kept], torch.ones(len(source) - len(kept), dtype=torch.bool)))
            assert torch.equal(before[source], avatar.colour[:, 0, 0])
        elif kind == 2:
            source = remove(avatar, optimizer, torch.rand(avatar.primitives, generator=random) < 0.3)
            born = born[source]
        else:
            reset_opacity(avatar, optimizer)
        check_shapes(avatar, optimizer)
    ancestor = avatar.colour[:, 0, 0].detach().long()
    assert born.any() and not born.all()
    for name in avatar.PARAMETERS:
        if name == "opacity_logit":
            continue  # forgotten by resets
        for now, then in zip(optimizer.moments(getattr(avatar, name)), first[name], strict=True):
            expected = then[ancestor].clone()
            expected[born] = 0.0
            assert torch.equal(now, expected), name
    if hasattr(avatar, "binding"):
        assert torch.equal(avatar.binding, binding[ancestor])
        assert torch.bincount(avatar.binding, minlength=len(avatar.faces)).min() >= 1
    else:
        assert avatar.bary.min() >= 0 and (avatar.bary.sum(1) - 1).abs().max() < 1e-5
        assert avatar.face.min() >= 0 and avatar.face.max() < len(avatar.faces)
    # And the optimizer still moves what the avatar holds.
    for name in avatar.PARAMETERS:
        getattr(avatar, name).grad = torch.ones_like(getattr(avatar, name))
    before = {name: getattr(avatar, name).detach().clone() for name in avatar.PARAMETERS}
    optimizer.step()
    for name, old in before.items():
        assert old.numel() == 0 or not torch.equal(old, getattr(avatar, name)), name


def check_shapes(avatar: GaussianAvatar, optimizer: Adam) -> None:
    held = {id(p) for group in optimizer.param_groups for p in group["params"]}
    for name in avatar.PARAMETERS:
        parameter = getattr(avatar, name)
        assert len(parameter) == avatar.primitives and id(parameter) in held
        assert all(moment.shape == parameter.shape for moment in optimizer.moments(parameter))
    for name in avatar.BUFFERS:
        assert len(getattr(avatar, name)) == avatar.primitives


@ALL
def test_saved_and_loaded_it_renders_the_same(scene, tmp_path, config) -> None:
    method, _ = run(scene, config, tmp_path / "state")
    avatar, meshes = method.avatar.eval(), method_meshes(scene)
    save_avatar(tmp_path / "model.pt", avatar)
    content = torch.load(tmp_path / "model.pt", weights_only=True)
    torch.save(content | {"sh_degree": 10**5}, tmp_path / "degree.pt")
    with pytest.raises(DataError, match="harmonics of degree 100000"):  # 120 GB, asked for one Gaussian
        load_avatar(tmp_path / "degree.pt")
    again = load_avatar(tmp_path / "model.pt")
    assert type(again) is type(avatar) and again.primitives == avatar.primitives
    verts = {part: torch.from_numpy(meshes.parts[part].verts[1]) for part in avatar.parts}
    camera = torch.eye(4), torch.tensor([[40.0, 0, 16], [0, 40.0, 16], [0, 0, 1]]), 32, 32
    camera[0][2, 3] = 1.0
    with torch.no_grad():
        one, two = (a.render(verts, *camera, torch.ones(3)) for a in (avatar, again))
    assert all(torch.equal(x, y) for x, y in zip(one, two, strict=True))
    assert one[0].shape == (3, 32, 32) and one[1].max() > 0.03  # just after a reset of the opacities


def method_meshes(scene: dict) -> MeshSequence:
    return read_sequence(scene["meshes"])[0]


@ALL
def test_a_part_may_be_missing_in_a_frame(tmp_path, config) -> None:
    whole = sequence()
    hand = whole.parts["right_hand"]
    verts = hand.verts.copy()
    verts[1] = np.nan
    parts = {**whole.parts, "right_hand": Part(hand.faces, hand.rest, verts)}
    lost = write_scene(tmp_path / "lost", meshes=MeshSequence(whole.frames, parts, {}))
    _, summary = run(lost, config, tmp_path / "state")
    assert summary["finished"] and summary["skipped"] == 0


def test_released_mode_trains_heights_up_to_the_first_walk_and_never_moves(scene, tmp_path) -> None:
    still = replace(RELEASED.splatting_avatar, density=SplattingDensityConfig(start=40_000))
    still = replace(still, walk_interval=20)
    config = replace(RELEASED, splatting_avatar=still, schedule="paper", steps=30)
    calls = iter(range(100))
    short = run(scene, config, tmp_path, should_stop=lambda: next(calls) == 20)[0].avatar
    longer = run(scene, config, tmp_path)[0].avatar
    start = prepare(scene, config)[0].avatar
    assert short.uvd[:, 2].abs().max() > 0 and torch.equal(short.uvd[:, 2], longer.uvd[:, 2])
    assert torch.equal(start.face, longer.face) and torch.equal(start.bary, longer.bary)
    assert longer.uvd[:, :2].abs().max() == 0
    assert not torch.equal(short.colour, longer.colour)


def test_paper_mode_moves_the_embedding(scene, tmp_path) -> None:
    options = replace(SPLATTING_AVATAR.splatting_avatar, density=SplattingDensityConfig(start=40_000))
    options = replace(options, rates=replace(options.rates, embedding=0.05), walk_interval=10)
    config = replace(SPLATTING_AVATAR, splatting_avatar=options, schedule="paper", steps=40)
    start, end = prepare(scene, config)[0].avatar, run(scene, config, tmp_path)[0].avatar
    assert not torch.equal(start.bary, end.bary) and (start.face != end.face).any()
    assert end.bary.min() >= 0 and (end.bary.sum(1) - 1).abs().max() < 1e-5
    assert end.uvd[:, :2].abs().max() == 0
