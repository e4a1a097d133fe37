"""What one pickle may ask for: bytes of memory, and keys of dictionaries and sets."""

from typing import Any

import numpy as np

__all__ = ["MAX_COMPOSITE_KEYS", "ORDERED_ENTRY", "Budget", "Refused", "checked_key", "weight"]

MAX_COMPOSITE_KEYS = 2_000
"""Keys of one pickle that are tuples or frozensets."""
ORDERED_ENTRY = 200
"""Bytes of an entry of the largest kind of container, an ordered dictionary."""
_KEY_PARTS = 64
_LARGEST_KEY = 1 << 60


class Refused(Exception):
    """Something outside the allow-list; its text says what."""


class Budget:
    """Bytes that the content of one file may take together: what is reasonable for a file of this size.

    Asked before memory is; what is only walked over is counted too, which bounds the time.

    Args:
        file_bytes: size of the file.
    """

    def __init__(self, file_bytes: int) -> None:
        self._left = (1 << 29) + 4 * file_bytes
        self._composite = MAX_COMPOSITE_KEYS

    def take(self, count: int) -> None:
        """Counts so many bytes; ValueError when the budget is spent."""
        self._left -= count
        if self._left < 0:
            raise ValueError("its content takes far more memory than the file has bytes")

    def take_composite_key(self) -> None:
        """Counts a key that is a tuple or a frozenset."""
        self._composite -= 1
        if self._composite < 0:
            raise Refused("thousands of keys that are tuples")


def checked_key(value: Any, budget: Budget) -> Any:
    """A key that is hashed and compared in a moment: `_hashable` counts its parts."""
    if type(value) is str:
        return value
    if _hashable(value, _KEY_PARTS) < 0:
        raise Refused("a key of many parts")
    if isinstance(value, (tuple, frozenset)):
        budget.take_composite_key()
    return value


def _hashable(value: Any, left: int) -> int:
    """How many parts are left of `left` after those of a key; below zero when there are more."""
    if left <= 0:
        return -1
    if isinstance(value, (tuple, frozenset)):
        for part in value:
            left = _hashable(part, left - 1)
            if left < 0:
                break
        return left
    if isinstance(value, int) and abs(value) >= _LARGEST_KEY:
        raise Refused("a key of so many digits")
    if value is not None and not isinstance(value, (str, bytes, int, float, np.integer, np.floating, np.bool_)):
        raise Refused(f"a key of class {type(value).__name__}")
    return left


def weight(value: Any) -> int:
    """Bytes that a copy of a value takes at most, in whatever container; of what it holds, only the references."""
    if isinstance(value, str):
        return 4 * len(value)
    if isinstance(value, (bytes, bytearray, memoryview)):
        return len(value)
    if isinstance(value, (list, tuple, dict, set, frozenset)):
        return ORDERED_ENTRY * len(value)
    return value.bit_length() // 8 if isinstance(value, int) else 0
