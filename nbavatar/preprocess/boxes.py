"""Boxes and crop windows in pixels: x0, y0, x1, y1, with x1 and y1 exclusive. NaN rows are missing detections."""

import numpy as np

__all__ = ["center_square", "fill_missing", "padded_square", "square_window", "union_box"]


def union_box(boxes: np.ndarray) -> np.ndarray:
    """Smallest box that holds all valid rows of `[..., 4]`; NaN if there is none."""
    rows = np.asarray(boxes, dtype=np.float64).reshape(-1, 4)
    rows = rows[np.isfinite(rows).all(axis=1)]
    if not len(rows):
        return np.full(4, np.nan)
    return np.concatenate([rows[:, :2].min(axis=0), rows[:, 2:].max(axis=0)])


def fill_missing(boxes: np.ndarray) -> np.ndarray:
    """Boxes `[N, 4]` with NaN rows interpolated over time, and held constant beyond the first and last valid row."""
    boxes = np.asarray(boxes, dtype=np.float64)
    good = np.flatnonzero(np.isfinite(boxes).all(axis=1))
    if not len(good):
        return boxes.copy()
    time = np.arange(len(boxes))
    return np.stack([np.interp(time, good, boxes[good, i]) for i in range(4)], axis=1)


def square_window(box: np.ndarray, width: int, height: int, *, pad: float, side: int = 0) -> tuple[int, int, int]:
    """Square window over a box, in whole pixels.

    The window is shifted into the image where it fits. One that is larger than the image holds all of it and sticks out
    (what lies outside is black and empty).

    Args:
        box: x0, y0, x1, y1 [px].
        width: image width [px].
        height: image height [px].
        pad: margin on each side as a share of the longer side of the box.
        side: side of the window [px], instead of one that fits the box.

    Returns:
        x0, y0, side [px].
    """
    x0, y0, x1, y1 = (float(v) for v in box)
    side = side or max(2, int(np.ceil(max(x1 - x0, y1 - y0) * (1 + 2 * pad))))
    corner = []
    for low, high, limit in ((x0, x1, width), (y0, y1, height)):
        first = int(np.floor((low + high - side) / 2 + 0.5))
        corner.append(min(max(first, min(0, limit - side)), max(0, limit - side)))
    return corner[0], corner[1], side


def center_square(width: int, height: int) -> tuple[int, int, int]:
    """Largest centred square of an image: x0, y0, side [px]. An odd rest goes to the right or the bottom."""
    side = min(width, height)
    return (width - side) // 2, (height - side) // 2, side


def padded_square(width: int, height: int, multiple: int) -> tuple[int, int, int]:
    """Smallest centred square around an image whose side is a multiple of `multiple`: x0, y0 (<= 0), side [px]."""
    side = -(-max(width, height) // multiple) * multiple
    return -((side - width) // 2), -((side - height) // 2), side
