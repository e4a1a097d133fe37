"""Foreground colours of partly covered pixels.

At the edge of hair or skin a camera sees a mixture `I = a F + (1 - a) B` of foreground and backdrop. Putting such a
pixel on another background with the same `a` keeps a rim of the old backdrop. Here F is estimated by fusing blurred
neighbours with the equation itself (Forte 2021, "Approximate fast foreground colour estimation"), in two passes of
falling radius.
"""

import cv2
import numpy as np

__all__ = ["estimate_foreground"]


def estimate_foreground(image: np.ndarray, alpha: np.ndarray, *, radii: tuple[int, ...] = (45, 5)) -> np.ndarray:
    """Replaces the colours of partly covered pixels by foreground colours.

    Args:
        image: uint8 RGB `[H, W, 3]`.
        alpha: uint8 `[H, W]`, coverage.
        radii: half sizes of the blurs of the passes [px].

    Returns:
        uint8 RGB `[H, W, 3]`; pixels of coverage 0 and 255 are as they were.
    """
    partial = (alpha > 0) & (alpha < 255)
    if not partial.any():
        return image
    rows, columns = np.flatnonzero(partial.any(axis=1)), np.flatnonzero(partial.any(axis=0))
    reach = max(radii)
    window = (
        slice(max(rows[0] - reach, 0), rows[-1] + reach + 1),
        slice(max(columns[0] - reach, 0), columns[-1] + reach + 1),
    )
    a = alpha[window].astype(np.float32)[..., None] / 255
    seen = image[window].astype(np.float32)
    front = back = seen
    for radius in radii:
        size = (2 * radius + 1, 2 * radius + 1)
        weight, rest = _blur(a, size), _blur(1 - a, size)
        near = np.where(weight > 1e-5, _blur(front * a, size) / np.maximum(weight, 1e-5), seen)
        behind = np.where(rest > 1e-5, _blur(back * (1 - a), size) / np.maximum(rest, 1e-5), seen)
        front = (near + a * (seen - a * near - (1 - a) * behind)).clip(0, 255)
        back = behind
    result = image.copy()
    result[window] = np.where(partial[window][..., None], np.rint(front).astype(np.uint8), image[window])
    return result


def _blur(values: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    blurred = cv2.blur(values, size, borderType=cv2.BORDER_REPLICATE)
    return blurred if blurred.ndim == 3 else blurred[..., None]
