"""Training gives the same bits whatever its threads do, on the CPU.

The gradient of an indexed tensor (`means[neighbours]`) is a sum over the places that read a row. With several threads
torch adds to a row in the order in which they come, and sums of floats depend on their order: in 60 backward passes of
the neighbour regulariser of 11,514 billboards on two threads, 48 differed from the first. With one thread, and where
torch is asked for deterministic algorithms, it adds in the order of the indices.
"""

import contextlib
from collections.abc import Iterator

import torch

__all__ = ["sums_in_order"]


@contextlib.contextmanager
def sums_in_order(device: str) -> Iterator[None]:
    """Torch adds in one order while this is held; as before afterwards.

    On a GPU nothing changes: resampling has no deterministic kernel there, and torch would refuse it.
    """
    if device != "cpu":
        yield
        return
    before = torch.are_deterministic_algorithms_enabled(), torch.is_deterministic_algorithms_warn_only_enabled()
    filled = torch.utils.deterministic.fill_uninitialized_memory
    torch.use_deterministic_algorithms(True)
    torch.utils.deterministic.fill_uninitialized_memory = False  # costs a pass over memory; nothing reads it unwritten
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(before[0], warn_only=before[1])
        torch.utils.deterministic.fill_uninitialized_memory = filled
