"""Contact frames of a sequence are found, and simulating less changes little."""

import numpy as np
import pytest

from nbavatar.data.sequences import MeshSequence, Part
from nbavatar.physics.shapes import capsule_hand, press, round_head
from nbavatar.studies.tradeoff.contact import contact_only_rows, contact_scene

DEPTHS = [-0.03, 0.004, 0.008, -0.02, float("nan")]


@pytest.fixture(scope="module")
def pressed() -> MeshSequence:
    """A hand away from the cheek, 4 and 8 mm in it, away again, and not there."""
    rest, faces = round_head(500)
    hand, hand_faces = capsule_hand(120)
    heads = np.repeat(rest[None].astype(np.float32), len(DEPTHS), 0)
    hands = np.stack([press(hand, depth) for depth in DEPTHS]).astype(np.float32)
    parts = {
        "head": Part(faces, rest.astype(np.float32), heads),
        "right_hand": Part(hand_faces, hand.astype(np.float32), hands),
    }
    return MeshSequence([f"f{i}" for i in range(len(DEPTHS))], parts, {})


def test_frames_are_told_apart_by_their_contact(pressed) -> None:
    scene = contact_scene(pressed, 5)
    assert scene is not None and scene.deepest.tolist() == [1, 2] and scene.free.tolist() == [0, 3]
    one = contact_scene(pressed, 1)
    assert one is not None and one.deepest.tolist() == [2] and one.free.tolist() == [0]


def test_contact_only_leaves_the_rest_of_the_head_alone(pressed) -> None:
    scene = contact_scene(pressed, 2)
    assert scene is not None
    touching, free = contact_only_rows(scene, 1)
    head = len(pressed.parts["head"].rest)
    assert (touching["scene"], free["scene"]) == ("frames with contact", "frames without contact")
    assert 0 < touching["on_posed"] < head == touching["off_posed"] == free["off_posed"] and free["on_posed"] == 0
    # Skin beyond the reach of contact hardly moves; without contact nothing does.
    assert touching["error_mm"] < 0.5 and free["error_mm"] == 0 and free["worst_mm"] < 1e-6
    assert touching["on_ms"] > 0 and touching["on_memory_mb"] > 0


def test_without_a_hand_or_a_touch_there_is_no_scene(pressed) -> None:
    assert contact_scene(MeshSequence(pressed.frames, {"head": pressed.parts["head"]}, {}), 2) is None
    assert contact_scene(pressed.subset(["f0", "f3"]), 2) is None
