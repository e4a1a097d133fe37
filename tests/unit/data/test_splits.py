import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nbavatar.data.splits import choose_frames, held_out_blocks, runs_from_cuts, segments_of, split_digest
from nbavatar.errors import DataError


def test_runs_follow_the_release_s_meaning_of_cuts():
    assert runs_from_cuts([], 10, "x") == [(0, 9)]
    assert runs_from_cuts([(3, 4), (6, 8)], 10, "x") == [(0, 3), (4, 6), (8, 9)]


@pytest.mark.parametrize("cuts", [[(5, 4)], [(3, 10)], [(3, 4), (2, 5)], [(1, 2, 3)], [(0.5, 2)], [(-1, 2)]])
def test_impossible_cuts_are_named(cuts):
    with pytest.raises(DataError, match=r"cuts\.pkl: cut \d"):
        runs_from_cuts(cuts, 10, "cuts.pkl")


def test_frames_are_counted_anew_in_each_run():
    frames, segments = choose_frames([(0, 4), (5, 11)], every=3)
    assert frames == [0, 3, 5, 8, 11] and segments == [(0, 1), (2, 4)]
    frames, segments = choose_frames([(0, 4), (5, 11)], start=4, max_frames=3)
    assert frames == [4, 5, 6] and segments == [(0, 0), (1, 2)]
    assert choose_frames([(0, 4)], start=9) == ([], [])


@given(
    st.lists(st.integers(1, 40), min_size=1, max_size=5),
    st.floats(0.05, 0.6),
    st.integers(1, 4),
)
def test_held_out_frames_are_blocks_at_the_ends_of_pieces(lengths, fraction, blocks):
    edges = np.cumsum([0, *lengths])
    segments = [(int(a), int(b) - 1) for a, b in zip(edges, edges[1:])]
    words = held_out_blocks(segments, fraction=fraction, blocks=blocks)
    assert len(words) == edges[-1]
    for first, last in segments:
        run = words[first : last + 1]
        assert run[0] == "train", "each run starts with training frames"
        falls = sum(a == "train" and b == "test" for a, b in zip(run, run[1:]))
        assert falls <= blocks, "no more blocks than asked for"
    held = words.count("test")
    assert held < len(words)
    if max(lengths) > 1:
        assert held >= 1
    assert abs(held - fraction * len(words)) <= 0.5 * blocks * len(segments) + len(segments) + 1


def test_no_fraction_holds_out_nothing():
    assert held_out_blocks([(0, 9)], fraction=0.0) == ["train"] * 10


def test_one_run_gives_its_end():
    assert held_out_blocks([(0, 9)], fraction=0.2) == ["train"] * 8 + ["test"] * 2
    assert held_out_blocks([(0, 9)], fraction=0.2, blocks=2) == (["train"] * 4 + ["test"]) * 2


def test_cuts_by_name():
    assert segments_of(["a", "b", "c", "d"], [("b", "c")], "s") == [(0, 1), (2, 3)]


def test_digest_knows_the_split_and_not_the_order():
    one = split_digest({"a": "train", "b": "test"})
    assert one == split_digest({"b": "test", "a": "train"}) and len(one) == 12
    assert one != split_digest({"a": "test", "b": "train"}) != split_digest({"a": "test"})
