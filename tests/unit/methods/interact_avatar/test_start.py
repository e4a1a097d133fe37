"""What an avatar takes over from another one beside its Gaussians."""

from dataclasses import replace

import pytest
import torch

from nbavatar.data.sequences import MeshSequence
from nbavatar.methods.create import create_method
from nbavatar.methods.start import start_from
from tests.unit.methods.interact_avatar.scenes import CONFIG, made, only, stirred, two_hands, verts_of, views

WHOLE = two_hands()


def test_another_persons_networks_come_with_their_poses_and_not_with_the_rest_pose() -> None:
    person = {name: replace(part, rest=1.1 * part.rest, verts=1.1 * part.verts) for name, part in WHOLE.parts.items()}
    method, other = made(MeshSequence(WHOLE.frames, person, {})), stirred(made(WHOLE)).avatar
    own = {part: posture.rest.clone() for part, posture in method.avatar.postures.items()}
    taken = start_from(method, other, "start.pt")
    assert taken.over == [*WHOLE.parts, *(f"networks of {name}" for name in ("right_hand", "left_hand", "the face"))]
    assert not taken.left
    avatar = method.avatar
    assert all(torch.equal(a, b) for a, b in zip(avatar.networks(), other.networks(), strict=True))
    for part, posture in avatar.postures.items():
        assert torch.equal(posture.rest, own[part]) and torch.equal(posture.basis, other.postures[part].basis)
    assert bool((avatar.pose(avatar.anchor(verts_of(WHOLE, 2))).change != 0).any())


@pytest.mark.parametrize(
    ("start", "options", "over", "left"),
    [
        (("head", "right_hand"), {}, ("right_hand",), ("the face (other parts)",)),
        (("left_hand",), {}, ("left_hand",), ()),
        (
            ("head", "right_hand", "left_hand"), {"width": 9}, (),
            ("right_hand (other sizes)", "left_hand (other sizes)", "the face (other sizes)"),
        ),
    ],
)  # fmt: skip
def test_networks_that_do_not_fit_start_as_without(start, options, over, left) -> None:
    meshes = only(*start)
    config = replace(CONFIG, interact_avatar=replace(CONFIG.interact_avatar, **options))
    other = stirred(create_method(meshes, {}, views(), config)).avatar
    method, without = made(WHOLE), made(WHOLE).avatar
    before = {name: value.clone() for name, value in without.state_dict().items()}
    taken = start_from(method, other, "start.pt")
    assert taken.over == [*start, *(f"networks of {name}" for name in over)]
    assert [words for words in taken.left if "networks" in words] == [f"networks of {words}" for words in left]
    for name, value in method.avatar.state_dict().items():
        if name.startswith(("hands.", "face.", "points.", "postures.")):
            known = any(part in name for part in over) and not name.endswith(".rest")
            assert torch.equal(value, other.state_dict()[name] if known else before[name]), name


def test_without_a_hand_there_are_no_networks_to_speak_of() -> None:
    taken = start_from(made(only("head")), stirred(made(WHOLE)).avatar, "start.pt")
    assert taken.over == ["head"] and taken.left == ["right_hand (only there)", "left_hand (only there)"]
