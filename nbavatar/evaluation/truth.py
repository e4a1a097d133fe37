"""What a truth shows: which of its pixels are foreground, and which images say nothing about an avatar.

Background like background is a perfect picture: images that show nobody would only raise every mean. Whatever averages
figures over images (metrics, speed against accuracy, sensitivity to the protocol) leaves them out by this one rule.
"""

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from nbavatar.errors import DataError

__all__ = ["foreground", "nobody", "showing_someone"]

_Item = TypeVar("_Item")


def foreground(alpha: np.ndarray, threshold: float = 0.5) -> np.ndarray:
    """Pixels whose true coverage reaches a threshold, bool [H, W].

    Args:
        alpha: uint8 [H, W], coverage, 255 = full.
        threshold: in [0, 1].
    """
    return alpha >= threshold * 255


def nobody(count: int) -> DataError:
    """The error for truths of which none shows anyone; `count` is how many there are."""
    return DataError.of(
        "truth", "alpha", expected="someone in one of its images at least", found=f"{count} images of background",
        fix="look at the masks: is their foreground 255, their coverage a half or more?",
    )  # fmt: skip


def showing_someone(items: Sequence[_Item], alpha: Callable[[_Item], np.ndarray]) -> list[_Item]:
    """Those of the images that show someone.

    Args:
        items: names, views, or whatever stands for an image.
        alpha: its true coverage, uint8 [H, W].

    Raises:
        DataError: none of them shows anyone.
    """
    shown = [item for item in items if foreground(alpha(item)).any()]
    if not shown:
        raise nobody(len(items))
    return shown
