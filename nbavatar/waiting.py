"""How long a thread of torch that waits for others keeps its processor. Standard library only.

Torch's builds for Linux divide an operation among threads by GNU's OpenMP, whose threads wait for each other by
spinning: 300,000 turns, some 16 ms, before they sleep. That is quick where every thread has a processor of its own.
Where other programs want the processors too, a thread that spins takes the time that the one it waits for needs, and
a training step takes many times as long (`nbavatar bench waiting --busy 2`). A few turns bridge the gap between two
operations all the same.
"""
# provenance: neutral, because it changes when results come, not what they are.

import os

__all__ = ["SPINS", "VARIABLES", "wait_briefly"]

SPINS = 10_000
"""Turns before a waiting thread sleeps, some half a millisecond. With a tenth of it a step takes 1.14 of its time on an
idle machine, with three times as much longer beside other programs (docs/benchmarks.md)."""

VARIABLES = ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")
"""Environment variables by which a user may say it otherwise; `active` or a number of turns."""


def wait_briefly() -> None:
    """Sets how this process and those below it wait, unless the user has; before torch is imported."""
    if not any(name in os.environ for name in VARIABLES):
        os.environ["GOMP_SPINCOUNT"] = str(SPINS)
