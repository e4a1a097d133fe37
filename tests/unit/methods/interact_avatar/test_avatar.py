"""The avatar: GaussianAvatars where the networks are silent, and changes only where a hand has a say."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from nbavatar.data.sequences import MeshSequence
from nbavatar.errors import DataError
from nbavatar.methods.create import create_method
from nbavatar.methods.gaussians.avatar import GaussianAvatar
from nbavatar.methods.interact_avatar.avatar import InteractAvatar
from nbavatar.methods.interact_avatar.options import InteractAvatarConfig, InteractAvatarRates
from nbavatar.methods.storage import load_avatar, save_avatar
from nbavatar.training.loop import _tensor_bytes
from tests.scenes.toy import write_scene
from tests.unit.methods.gaussians.test_training import GAUSSIAN_AVATARS, INTERACT_AVATAR, run, same
from tests.unit.methods.interact_avatar.scenes import CONFIG, made, only, stirred, two_hands, verts_of, views

VIEW = torch.eye(4)
VIEW[2, 3] = 1.0
K = torch.tensor([[40.0, 0, 16], [0, 40.0, 16], [0, 0, 1]])
WHOLE = two_hands()


def picture(avatar: GaussianAvatar, verts: dict[str, Tensor]) -> tuple[Tensor, ...]:
    with torch.no_grad():
        return avatar.eval().render(verts, VIEW, K, 32, 32, torch.zeros(3))


@pytest.mark.parametrize("parts", [("head",), ("right_hand",), ("head", "right_hand"), tuple(WHOLE.parts)])
def test_silent_networks_are_gaussian_avatars_bit_for_bit(parts) -> None:
    meshes = only(*parts)
    plain, ours = (
        stirred(made(meshes, method), networks=False).avatar for method in ("gaussian_avatars", "interact_avatar")
    )
    for row in range(4):
        verts = verts_of(meshes, row)
        assert all(torch.equal(a, b) for a, b in zip(picture(plain, verts), picture(ours, verts), strict=True))
    assert float(picture(ours, verts)[1].max()) > 0.05


def test_trained_without_a_hand_it_is_gaussian_avatars_bit_for_bit(tmp_path) -> None:
    scene = write_scene(tmp_path / "scene", meshes=only("head"))
    plain, _ = run(scene, replace(GAUSSIAN_AVATARS, steps=10), tmp_path / "plain")
    ours, _ = run(scene, replace(INTERACT_AVATAR, steps=10), tmp_path / "ours")
    assert not ours.avatar.networks()
    for name in (*plain.avatar.PARAMETERS, *plain.avatar.BUFFERS):
        assert torch.equal(getattr(plain.avatar, name), getattr(ours.avatar, name)), name


@pytest.mark.parametrize("parts", [("right_hand",), ("left_hand", "right_hand"), ("head", "left_hand")])
def test_it_trains_and_is_stored_with_the_parts_that_are_there(tmp_path, parts) -> None:
    meshes = only(*parts)
    scene = write_scene(tmp_path / "scene", meshes=meshes)
    method, summary = run(scene, replace(INTERACT_AVATAR, steps=10), tmp_path / "state")
    avatar: InteractAvatar = method.avatar
    assert summary["finished"] and summary["skipped"] == 0
    assert all(bool((weights != 0).any()) for weights in avatar.hands.parameters() if weights.ndim == 2)
    assert (avatar.face is None) == ("head" not in parts)
    save_avatar(tmp_path / "model.pt", avatar)
    again = load_avatar(tmp_path / "model.pt")
    verts = verts_of(meshes, 2)
    assert all(torch.equal(a, b) for a, b in zip(picture(avatar, verts), picture(again, verts), strict=True))
    assert again.content() == avatar.content()


def test_the_same_training_gives_the_same_bits(tmp_path) -> None:
    scene = write_scene(tmp_path / "scene", meshes=WHOLE)
    one, two = (run(scene, replace(INTERACT_AVATAR, steps=8), tmp_path / name)[0] for name in ("one", "two"))
    other = run(scene, replace(INTERACT_AVATAR, steps=8, seed=1), tmp_path / "other")[0]
    assert same(one, two) and not same(one, other)


def test_networks_that_speak_change_hands_and_the_face_near_them() -> None:
    avatar = stirred(made(WHOLE)).avatar
    verts = verts_of(WHOLE, 3)
    anchor = avatar.anchor(verts)
    change = avatar.pose(anchor).change
    owner = avatar.owner[avatar.binding]
    assert bool((change[owner > 0] != 0).any(1).all())
    touched = anchor.touch[avatar.binding] > 0
    assert bool((change[touched] != 0).any(1).all()) and bool((change[~touched & (owner == 0)] == 0).all())
    assert touched.any() and not touched[owner > 0].any() and not touched[owner == 0].all()
    away = {name: v + (0 if name == "head" else torch.tensor([0.0, 0.0, 9.0])) for name, v in verts.items()}
    far = avatar.pose(avatar.anchor(away)).change
    assert bool((far[owner == 0] == 0).all()) and bool((far[owner > 0] != 0).any())
    # The pose of a hand reaches its own Gaussians: bent fingers are another code.
    bent = verts | {"left_hand": verts["left_hand"] + torch.tensor([[0.02, 0.0, 0.0], *[[0.0] * 3] * 3])}
    other = avatar.pose(avatar.anchor(bent)).change
    left = avatar.parts.index("left_hand")
    assert not torch.equal(other[owner == left], change[owner == left])
    right = avatar.parts.index("right_hand")
    assert torch.equal(other[owner == right], change[owner == right])


@pytest.mark.parametrize("lost", [("right_hand",), ("right_hand", "left_hand"), ("head",)])
@pytest.mark.parametrize("how", ["missing", "nan"])
def test_a_part_that_a_frame_lacks_is_as_if_it_were_not_there(lost, how) -> None:
    avatar = stirred(made(WHOLE)).avatar
    verts = verts_of(WHOLE, 3)
    there = {name: v for name, v in verts.items() if name not in lost}
    given = there if how == "missing" else there | {name: torch.full_like(verts[name], torch.nan) for name in lost}
    anchor = avatar.anchor(given)
    posed = avatar.pose(anchor)
    shown = avatar.owner[avatar.binding[posed.rows]]
    assert set(shown.tolist()) == {avatar.parts.index(name) for name in there}
    assert all(bool(torch.isfinite(value).all()) for value in posed if value is not None)
    assert bool((anchor.touch > 0).any()) == ("head" not in lost and len(lost) == 1)
    for part, code in zip(avatar.postures, anchor.codes, strict=True):
        assert (
            bool((code == 0).all()) if part in lost else torch.equal(code, avatar.postures[part].describe(verts[part]))
        )
    image = picture(avatar, given)[0]
    assert torch.equal(image, picture(avatar, there)[0]) and torch.isfinite(image).all()


def test_gradients_of_a_pose_are_those_of_finite_differences() -> None:
    avatar = stirred(made(WHOLE)).avatar.double()
    verts = {name: v.double() for name, v in verts_of(WHOLE, 3).items()}
    anchor = avatar.anchor(verts)
    weights = [*avatar.networks(), avatar.offset, avatar.log_scale, avatar.quat, avatar.colour, avatar.opacity_logit]
    random = torch.Generator().manual_seed(0)

    def value() -> Tensor:
        posed = avatar.pose(anchor)
        slopes = torch.Generator().manual_seed(1)
        tensors = (posed.means, posed.quats, posed.scales, posed.opacity_logit, posed.harmonics)
        return sum(
            (t * torch.randn(t.shape, generator=slopes, dtype=torch.float64)).sum() for t in tensors if t is not None
        )

    # A Gaussian's own position reaches its place in the networks as well, which passes no gradient on, by intent.
    gradients = torch.autograd.grad(value(), weights)
    for parameter, gradient in zip(weights, gradients, strict=True):
        if parameter is avatar.offset:
            continue
        direction = torch.randn(parameter.shape, generator=random, dtype=torch.float64)
        with torch.no_grad():
            parameter.add_(1e-6 * direction)
            above = value()
            parameter.sub_(2e-6 * direction)
            below = value()
            parameter.add_(1e-6 * direction)
        slope = float((above - below) / 2e-6)
        assert slope == pytest.approx(float((gradient * direction).sum()), rel=1e-5, abs=1e-5)
    assert gradients[len(avatar.networks())].abs().max() > 0


def test_an_anchor_is_tensors_that_the_trainer_can_count_and_keep() -> None:
    avatar = made(WHOLE).avatar
    anchor = avatar.anchor(verts_of(WHOLE, 0))
    assert avatar.fixed_anchors and _tensor_bytes(anchor) > _tensor_bytes(anchor.bound) > 0
    assert not any(tensor.requires_grad for tensor in (*anchor.codes, anchor.centres, anchor.groups, anchor.touch))


def test_poses_are_learnt_from_the_training_frames_alone() -> None:
    changed = {
        name: replace(part, verts=np.concatenate((part.verts[:3], part.verts[3:] + 0.1 * part.rest[:, ::-1])))
        for name, part in WHOLE.parts.items()
    }
    one, two = (
        create_method(MeshSequence(WHOLE.frames, parts, {}), {}, views(3), CONFIG).avatar
        for parts in (WHOLE.parts, changed)
    )
    for name, value in one.state_dict().items():
        assert torch.equal(value, two.state_dict()[name]), name


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [("width", 10**6, "width 1000000"), ("reach", float("nan"), "reach nan"), ("points", 0, "points 0")],
)
def test_sizes_that_no_training_writes_are_refused_before_memory_is_asked_for(tmp_path, name, value, message) -> None:
    save_avatar(tmp_path / "model.pt", made(WHOLE).avatar)
    content = torch.load(tmp_path / "model.pt", weights_only=True)
    torch.save(content | {name: value}, tmp_path / "broken.pt")
    with pytest.raises(DataError, match=message):
        load_avatar(tmp_path / "broken.pt")


def test_a_price_on_the_changes_keeps_them_small(tmp_path) -> None:
    scene = write_scene(tmp_path / "scene", meshes=WHOLE)
    sizes = []
    for weight in (0.0, 10.0):
        rates = InteractAvatarRates(networks=0.02)
        options = InteractAvatarConfig(weight_change=weight, width=16, features=8, rates=rates)
        _, summary = run(scene, replace(INTERACT_AVATAR, steps=12, interact_avatar=options), tmp_path / f"{weight}")
        sizes.append(summary["last"]["change"])
    assert 0 <= sizes[1] < 0.5 * sizes[0]
