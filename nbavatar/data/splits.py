"""Uncut runs of a video, chosen frames, and the held-out blocks of the self-reenactment protocol.

Neighbouring frames are near copies of each other, so held-out frames are contiguous blocks, never random picks; and
a block never crosses a cut. The choice depends on frame numbers only, and `split_digest` names it in captions.
"""

import hashlib
from collections.abc import Mapping, Sequence

from nbavatar.errors import DataError

__all__ = ["choose_frames", "held_out_blocks", "runs_from_cuts", "segments_of", "split_digest"]


def runs_from_cuts(cuts: Sequence[Sequence[int]], count: int, where: str) -> list[tuple[int, int]]:
    """Uncut runs from pairs (last frame before a cut, first frame after it).

    Args:
        cuts: pairs in increasing order; may be empty. Frames between the two of a pair belong to no run.
        count: number of frames.
        where: file, for the error line.

    Returns:
        (first, last) of each run, both inclusive.

    Raises:
        DataError: not pairs of whole numbers, not increasing, or outside the video.
    """
    runs, first = [], 0
    for number, pair in enumerate(cuts):
        field = f"cut {number}"
        values = [int(v) for v in pair] if len(pair) == 2 and all(float(v).is_integer() for v in pair) else None
        if values is None:
            raise DataError.of(where, field, expected="(last frame before, first frame after)", found=list(pair))
        last, following = values
        if not first <= last < following < count:
            expected = f"{first} <= last < next < {count}, increasing"
            raise DataError.of(where, field, expected=expected, found=f"({last}, {following})")
        runs.append((first, last))
        first = following
    return [*runs, (first, count - 1)]


def choose_frames(
    runs: Sequence[tuple[int, int]], *, start: int = 0, every: int = 1, max_frames: int = 0
) -> tuple[list[int], list[tuple[int, int]]]:
    """Picks frames: from `start` on, one in `every` (counted anew in each run), at most `max_frames` (0 = all).

    Returns:
        frame numbers, increasing; and the runs as (first, last) POSITIONS in that list, inclusive.
    """
    frames: list[int] = []
    segments: list[tuple[int, int]] = []
    for first, last in runs:
        picked = list(range(max(first, start), last + 1, every))
        if max_frames:
            picked = picked[: max_frames - len(frames)]
        if picked:
            segments.append((len(frames), len(frames) + len(picked) - 1))
            frames.extend(picked)
    return frames, segments


def segments_of(frames: Sequence[str], cuts: Sequence[Sequence[str]], where: str) -> list[tuple[int, int]]:
    """Uncut runs, as positions, of frames named by ids, cut at pairs (last id before, first id after) of them."""
    position = {frame: i for i, frame in enumerate(frames)}
    return runs_from_cuts(sorted((position[a], position[b]) for a, b in cuts), len(frames), where)


def held_out_blocks(segments: Sequence[tuple[int, int]], *, fraction: float, blocks: int = 1) -> list[str]:
    """`train` or `test` for each frame: the last `fraction` of each piece of each run is held out.

    Each run is divided into `blocks` equal pieces (fewer where pieces would be shorter than two frames). If rounding
    leaves no test frame at all, the longest run gives its last one. A run of one frame is trained on.

    Args:
        segments: (first, last) positions of the uncut runs, inclusive, covering 0..N-1 in order.
        fraction: share held out, 0 for none.
        blocks: pieces a run.

    Returns:
        N words.
    """
    total = segments[-1][1] + 1 if segments else 0
    words = ["train"] * total
    if fraction <= 0.0:
        return words
    for first, last in segments:
        length = last - first + 1
        pieces = max(1, min(blocks, length // 2))
        edges = [first + round(i * length / pieces) for i in range(pieces + 1)]
        for begin, end in zip(edges, edges[1:]):
            held = min(round(fraction * (end - begin)), end - begin - 1)
            words[end - held : end] = ["test"] * held
    if "test" not in words and total > 1:
        first, last = max(segments, key=lambda run: run[1] - run[0])
        if last > first:
            words[last] = "test"
    return words


def split_digest(split: Mapping[str, str]) -> str:
    """12 hex digits that name a split: which frames there are and which of them are held out."""
    text = "\n".join(f"{frame} {split[frame]}" for frame in sorted(split))
    return hashlib.sha256(text.encode()).hexdigest()[:12]
