"""Scratch: the buffers that a kernel's worker fills while it works on a tile, each declared once.

A kernel's module lists its buffers in a table: name, element type, how many elements, and whether only one
pass needs it. Sizes, places, types and the views that the kernel gets all follow from that table.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numba import types

__all__ = [
    "ALIGNMENT",
    "FORWARD",
    "REPLAY",
    "Buffer",
    "Place",
    "array_of",
    "layout",
    "scratch_bytes",
    "scratch_type",
    "scratch_views",
]

FORWARD, REPLAY = "forward", "replay"
ALIGNMENT = 64  # bytes, a line of the cache: every buffer begins at a multiple of it


class Buffer(NamedTuple):
    """One line of a table.

    Attributes:
        name: field of the named tuple that the kernel gets.
        dtype: of its elements; None is the dtype of the image, float32 or float64.
        count: elements, from the sizes that the table is about.
        only: the pass that needs it, FORWARD or REPLAY, if not both; in the other it has no elements.
    """

    name: str
    dtype: Any
    count: Callable[[Any], int]
    only: str = ""


class Place(NamedTuple):
    """Where a buffer lies in the memory of a worker: first byte, elements, element type."""

    offset: int
    count: int
    dtype: np.dtype


def layout(buffers: Sequence[Buffer], sizes: Any, real: Any, replay: bool) -> tuple[dict[str, Place], int]:
    """Places of the buffers, one behind the other, and the bytes that they take.

    Args:
        buffers: the table.
        sizes: what its counts are computed from.
        real: dtype of the image.
        replay: for which pass.
    """
    places, offset = {}, 0
    for buffer in buffers:
        dtype = np.dtype(real if buffer.dtype is None else buffer.dtype)
        count = buffer.count(sizes) if buffer.only in ("", REPLAY if replay else FORWARD) else 0
        places[buffer.name] = Place(offset, count, dtype)
        offset += -(-count * dtype.itemsize // ALIGNMENT) * ALIGNMENT
    return places, offset


def scratch_bytes(buffers: Sequence[Buffer], sizes: Any, real: Any, replay: bool) -> int:
    """Bytes that a worker needs; arguments as `layout`."""
    return layout(buffers, sizes, real, replay)[1]


def scratch_views(
    group: Any, buffers: Sequence[Buffer], sizes: Any, real: Any, replay: bool, memory: np.ndarray
) -> Any:
    """Views of a worker's memory, uint8 of at least `scratch_bytes`, as a named tuple `group`; the rest as `layout`."""
    places, _ = layout(buffers, sizes, real, replay)
    parts = {name: memory[p.offset : p.offset + p.count * p.dtype.itemsize].view(p.dtype) for name, p in places.items()}
    return group(**parts)


def scratch_type(group: Any, buffers: Sequence[Buffer], real: Any) -> Any:
    """Numba's type of `scratch_views`; `real` is its type of the image's numbers."""
    kinds = {buffer.name: array_of(types.int32 if buffer.dtype is np.int32 else real) for buffer in buffers}
    return types.BaseTuple.from_types([kinds[name] for name in group._fields], group)


def array_of(kind: Any, dimensions: int = 1) -> Any:
    """Numba's type of a contiguous array."""
    return types.Array(kind, dimensions, "C")
