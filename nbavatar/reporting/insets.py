"""Where to zoom: the place in a picture where the hand touches the head.

Pixels of a hand label within reach of a head pixel are contact pixels; the window is a square around their centre. A
picture without contact is shown around the middle of its foreground.
"""

import numpy as np

__all__ = ["contact_pixels", "contact_window", "cut"]

_HEAD, _HANDS = 1, (2, 3)


def contact_window(label: np.ndarray | None, alpha: np.ndarray, *, share: float = 0.28) -> tuple[int, int, int, int]:
    """Square window around the contact of hand and head.

    Args:
        label: uint8 [H, W] part labels (1 head, 2 right hand, 3 left hand), or None.
        alpha: uint8 [H, W] coverage, used where there is no contact.
        share: side of the window as a share of the picture's shorter side, in (0, 1].

    Returns:
        x0, y0, x1, y1 [px], x1 - x0 = y1 - y0, inside the picture.
    """
    height, width = alpha.shape
    side = max(1, min(round(share * min(height, width)), height, width))
    centre = None
    if label is not None:
        centre = _middle(_contact(label))
    if centre is None:
        centre = _middle(alpha > 127) or (width / 2, height / 2)
    x0 = int(np.clip(round(centre[0] - side / 2), 0, width - side))
    y0 = int(np.clip(round(centre[1] - side / 2), 0, height - side))
    return x0, y0, x0 + side, y0 + side


def contact_pixels(label: np.ndarray) -> int:
    """How many pixels of a hand lie within reach of a head pixel; label as in ``contact_window``."""
    return int(_contact(label).sum())


def cut(picture: np.ndarray, window: tuple[int, int, int, int]) -> np.ndarray:
    """The part of a picture [H, W, ...] inside a window (x0, y0, x1, y1)."""
    x0, y0, x1, y1 = window
    return np.ascontiguousarray(picture[y0:y1, x0:x1])


def _contact(label: np.ndarray) -> np.ndarray:
    """Hand pixels within 1% of the picture's shorter side of a head pixel."""
    return _grown(label == _HEAD, max(1, round(0.01 * min(label.shape)))) & np.isin(label, _HANDS)


def _grown(mask: np.ndarray, steps: int) -> np.ndarray:
    """Mask grown by a square of ``steps`` pixels each way."""
    height, width = mask.shape
    padded = np.pad(mask, steps)
    rows = np.zeros((height, padded.shape[1]), dtype=bool)
    for shift in range(2 * steps + 1):
        rows |= padded[shift : shift + height]
    grown = np.zeros_like(mask)
    for shift in range(2 * steps + 1):
        grown |= rows[:, shift : shift + width]
    return grown


def _middle(mask: np.ndarray) -> tuple[float, float] | None:
    """Median x and y of a mask, or None if it is empty; the median ignores stray pixels."""
    ys, xs = np.nonzero(mask)
    return (float(np.median(xs)), float(np.median(ys))) if len(xs) else None
