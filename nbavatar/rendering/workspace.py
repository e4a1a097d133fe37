"""Large arrays whose memory is used again.

The first touch of a fresh page costs the system five times what it costs to fill it, and large blocks go back to
the system whenever they are freed. Notes and gradients of a backward pass are as large in the next step as in this
one; large pages in place of reuse were no faster.
"""

import math
import sys
import threading

import numpy as np
import torch

__all__ = ["empty", "release"]

_SMALL = 1 << 20  # bytes; the allocator itself keeps smaller blocks
_KEPT = 1 << 29  # bytes in blocks that nothing uses
_BLOCKS: list[np.ndarray] = []  # the least recently given out first
_LOCK = threading.Lock()


def _unused(position: int) -> bool:
    """Whether nothing but the list refers to a block: a view keeps its block alive, a tensor its view."""
    return sys.getrefcount(_BLOCKS[position]) == 2  # the list's own and the argument's


def empty(shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """Uninitialised array (...) of a dtype; its memory is free again once nothing refers to the array.

    It begins at a multiple of 64 bytes.
    Up to 512 MiB of blocks are kept for their next use.
    """
    size = math.prod(shape) * dtype.itemsize
    with _LOCK:
        block = _take(size)
    return block[:size].view(dtype).reshape(shape)


def release() -> None:
    """Gives the blocks that nothing uses back to the system."""
    with _LOCK:
        for block in reversed(range(len(_BLOCKS))):
            if _unused(block):
                del _BLOCKS[block]


def _take(size: int) -> np.ndarray:
    """A block of at least `size` bytes."""
    free = [block for block in range(len(_BLOCKS)) if _unused(block)]
    fitting = [block for block in free if size <= _BLOCKS[block].nbytes <= 2 * size]
    if fitting:
        taken = _BLOCKS.pop(min(fitting, key=lambda block: _BLOCKS[block].nbytes))
    else:
        kept = sum(_BLOCKS[block].nbytes for block in free)
        for dropped, block in enumerate(free):
            if kept + size <= _KEPT:
                break
            kept -= _BLOCKS.pop(block - dropped).nbytes
        taken = torch.empty(size, dtype=torch.uint8).numpy()  # aligned to the lines of the cache, unlike NumPy's
    if _SMALL <= size <= _KEPT:
        _BLOCKS.append(taken)
    return taken
