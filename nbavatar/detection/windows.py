"""Where to look: upright squares of an image, coarse before fine."""

from collections.abc import Sequence

import numpy as np

from nbavatar.detection.squares import Square

__all__ = ["frame_windows", "mask_window"]

_MARGIN = 1.25
_LEAST_PIXELS = 30


def frame_windows(width: int, height: int) -> list[list[Square]]:
    """Squares over a whole image [px]: one that holds it all, then overlapping ones of half its longer side."""
    longer, half = max(width, height), max(width, height) / 2
    middles = []
    for length in (width, height):
        count = max(1, int(np.ceil(2 * (length - half) / half)) + 1) if length > half else 1
        first, last = (half / 2, length - half / 2) if count > 1 else (length / 2, length / 2)
        middles.append(np.linspace(first, last, count))
    fine = [Square(float(x), float(y), half) for y in middles[1] for x in middles[0]]
    return [[Square(width / 2, height / 2, float(longer))], fine]


def mask_window(mask: np.ndarray, others: Sequence[Square] = ()) -> list[Square]:
    """The square around a mask (bool `[H, W]`) with a margin, before `others`; only these where the mask is empty."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if np.count_nonzero(mask) < _LEAST_PIXELS:
        return list(others)
    (y0, y1), (x0, x1) = (rows[0], rows[-1] + 1), (columns[0], columns[-1] + 1)
    side = _MARGIN * float(max(x1 - x0, y1 - y0))
    return [Square(float(x0 + x1) / 2, float(y0 + y1) / 2, side), *others]
