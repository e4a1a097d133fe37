"""Numba kernels of `nbavatar.math.blur`: from row to row first, then along each row, so that both run over memory."""

import numpy as np

from nbavatar.jit.compile import inlined, kernel

__all__ = ["blur_rows"]


@kernel
def blur_rows(planes: np.ndarray, window: np.ndarray, first: int, last: int, result: np.ndarray) -> None:
    """Blurs some rows of planes (N, H + K - 1, W + K - 1), which have half a window of zeros around them."""
    half = len(window) // 2
    across = np.zeros(planes.shape[2], planes.dtype)
    for plane in range(len(planes)):
        for row in range(first, last):
            _across(planes[plane], row + half, window, across)
            _along(across, window, result[plane, row])


@inlined
def _across(planes: np.ndarray, row: int, window: np.ndarray, result: np.ndarray) -> None:
    """Sums the rows around one, weighted."""
    half = len(window) // 2
    centre, middle = planes[row], window[half]
    for i in range(len(result)):
        result[i] = middle * centre[i]
    for k in range(half):
        weight, above, below = window[k], planes[row + k - half], planes[row + half - k]
        for i in range(len(result)):
            result[i] += weight * (above[i] + below[i])


@inlined
def _along(values: np.ndarray, window: np.ndarray, result: np.ndarray) -> None:
    """The same within a row, half a window longer at both ends than its result."""
    half, width = len(window) // 2, len(result)
    centre, middle = values[half : half + width], window[half]
    for i in range(width):
        result[i] = middle * centre[i]
    for k in range(half):
        weight, left, right = window[k], values[k : k + width], values[2 * half - k : 2 * half - k + width]
        for i in range(width):
            result[i] += weight * (left[i] + right[i])
