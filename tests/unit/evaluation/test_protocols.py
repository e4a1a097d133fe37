"""Frames of a protocol."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nbavatar.config.core import to_mapping
from nbavatar.config.evaluation import PROTOCOLS, EvaluateConfig, ProtocolConfig, protocol_hash
from nbavatar.errors import ConfigError, DataError
from nbavatar.evaluation.protocols import check_coverage, frames_digest, select_frames

FRAMES = ["f0", "f1", "f2", "f3", "f4"]
SPLIT = {"f0": "train", "f1": "train", "f3": "test", "f4": "test"}


def test_splits_are_disjoint_and_complete():
    assert select_frames(FRAMES, SPLIT, "novel_view") == ["f0", "f1", "f2"]
    assert select_frames(FRAMES, SPLIT, "self_reenactment") == ["f3", "f4"]
    assert select_frames(FRAMES, SPLIT, "all") == FRAMES
    with pytest.raises(ConfigError, match="novel_view, self_reenactment or all"):
        select_frames(FRAMES, SPLIT, "nv")


@given(count=st.integers(1, 60), limit=st.integers(1, 60))
def test_limit_is_spread_evenly(count, limit):
    frames = [f"{i:03}" for i in range(count)]
    chosen = select_frames(frames, {}, "all", limit)
    assert len(chosen) == len(set(chosen)) == min(count, limit) and chosen == sorted(chosen)
    if 1 < limit < count:
        gaps = [int(b) - int(a) for a, b in zip(chosen, chosen[1:])]
        assert chosen[0] == frames[0] and chosen[-1] == frames[-1] and max(gaps) - min(gaps) <= 1


def test_coverage_accepts_exactly_the_protocol():
    allowed = {"102": ["f0", "f1"], "108": ["f0"]}
    check_coverage(["102/f0", "102/f1", "108/f0"], allowed, None, "r.zip")
    check_coverage(["102/f1", "108/f0"], allowed, 1, "r.zip")
    with pytest.raises(
        DataError, match=r"r\.zip: camera 102: expected 2 frames, found 1; render again; missing are f1"
    ):
        check_coverage(["102/f0", "108/f0"], allowed, None, "r.zip")
    with pytest.raises(DataError, match="found a frame outside it"):
        check_coverage(["102/f0", "102/f9"], allowed, None, "r.zip")
    with pytest.raises(DataError, match="expected cameras 102, 108, found camera 110"):
        check_coverage(["110/f0"], allowed, None, "r.zip")


def test_digest_ignores_order_only():
    assert frames_digest(["a/1", "b/2"]) == frames_digest(["b/2", "a/1"]) != frames_digest(["a/1", "b/3"])


def test_hash_changes_with_every_value_that_moves_a_number():
    base = protocol_hash(PROTOCOLS["nv1024"], EvaluateConfig())
    changes = [
        ProtocolConfig(**(to_mapping(PROTOCOLS["nv1024"]) | change))
        for change in (
            {"crop": "box"},
            {"split": "all"},
            {"limit": 3},
            {"background": [0.0, 0.0, 0.0]},
            {"precision": "bf16"},
            {"order": "center"},
            {"roi": False},
            {"refined": False},
        )
    ]
    hashes = {protocol_hash(changed, EvaluateConfig()) for changed in changes}
    hashes.add(protocol_hash(PROTOCOLS["nv1024"], EvaluateConfig(nets=["alex"])))
    hashes.add(protocol_hash(PROTOCOLS["nv1024"], EvaluateConfig(foreground_threshold=0.1)))
    assert len(hashes | {base}) == 11
    assert protocol_hash(PROTOCOLS["nv1024"], EvaluateConfig(nets=["vgg", "alex"], device="cpu")) == base
    assert len({protocol_hash(p, EvaluateConfig()) for p in PROTOCOLS.values()}) == 4
