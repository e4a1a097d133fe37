"""Calls timed in turns, one of each at a time, so that what else the machine does meets them all alike."""

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

__all__ = ["Turns", "in_turns", "median_ratio"]


class Turns(NamedTuple):
    """Times of each call, one a turn.

    Attributes:
        wall: by the clock [ms].
        spent: processor time over all threads [ms], which other programs disturb less.
    """

    wall: dict[str, list[float]]
    spent: dict[str, list[float]]


def in_turns(calls: Mapping[str, Callable[[int], Any]], repeats: int) -> Turns:
    """Times of calls.

    Args:
        calls: name -> what is timed; it is given the number of its turn. Whatever a first call prepares has been done.
        repeats: turns.
    """
    turns = Turns({name: [] for name in calls}, {name: [] for name in calls})
    for turn in range(repeats):
        for name, call in calls.items():
            began, used = time.perf_counter(), time.process_time()
            call(turn)
            turns.wall[name].append(1e3 * (time.perf_counter() - began))
            turns.spent[name].append(1e3 * (time.process_time() - used))
    return turns


def median_ratio(above: Sequence[float], below: Sequence[float]) -> float:
    """Median over the turns of one call's time by another's."""
    return statistics.median(a / b for a, b in zip(above, below, strict=True))
