"""Numba kernels of `nbavatar.math.blur`: from row to row first, then along each row, so that both run over memory."""

import numpy as np
import torch
from numba import types

from nbavatar.jit.compile import inlined, kernel, prepare

__all__ = ["blur_rows", "prepare_kernels"]


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


def prepare_kernels(dtype: torch.dtype) -> None:
    """Has the kernel compiled for a dtype, float32 or float64, by one of several processes that start at once."""
    real = types.float32 if dtype == torch.float32 else types.float64
    planes, i64 = types.Array(real, 3, "C"), types.int64
    prepare(f"blur-{real}", {blur_rows: (planes, types.Array(real, 1, "C"), i64, i64, planes)})
