"""Numba-CUDA kernels that prepare billboards for the tiles: one thread a billboard.

The same records, boxes and test of tile against patch as on the CPU (`binning.py`).
"""

import math

import numpy as np
from numba import cuda

from nbavatar.rendering import binning
from nbavatar.rendering.binning import RECORD

__all__ = ["TILE", "count_tiles", "fill_tiles"]

TILE = 16  # pixels a side of a tile
_SLACK = binning._SLACK

_touches = cuda.jit(device=True)(binning._touches.py_func)


@cuda.jit
def count_tiles(plane, fade, nearest, bounds, reference, texels, width, height, support, record, box, counts):
    """Writes the records and pixel boxes of billboards (see `binning.pack`) and the number of tiles each touches.

    Args:
        plane: (F, 3, 3) float64; fade, nearest: (F,) float64; bounds: (F, 4) float64, of a Projection.
        reference: (1,) float64, inverse depth that keys are relative to.
        texels, width, height, support: as in `binning.pack`.
        record: (F * RECORD,), box: (F, 4) int32, counts: (F,) int64, results.
    """
    i = cuda.grid(1)
    if i >= plane.shape[0]:
        return
    counts[i] = 0
    for j in range(4):
        box[i, j] = 0
    x0, y0 = bounds[i, 0] - 0.5 - _SLACK, bounds[i, 1] - 0.5 - _SLACK
    x1, y1 = bounds[i, 2] - 0.5 + _SLACK, bounds[i, 3] - 0.5 + _SLACK
    if not (x0 <= x1 and y0 <= y1 and x1 >= 0 and y1 >= 0 and x0 < width and y0 < height):
        return
    # on the device `floor` and `ceil` give floating-point numbers
    left, top = np.int32(math.ceil(max(x0, 0.0))), np.int32(math.ceil(max(y0, 0.0)))
    right, bottom = np.int32(math.floor(min(x1, width - 1.0))) + 1, np.int32(math.floor(min(y1, height - 1.0))) + 1
    if left >= right or top >= bottom:
        return
    box[i, 0], box[i, 1], box[i, 2], box[i, 3] = left, top, right, bottom
    scale, shift = (0.5 * (texels - 1), 0.5 * (texels - 1)) if texels > 1 else (1.0, 0.0)
    x, y = (left + right) // 2 + 0.5, (top + bottom) // 2 + 0.5
    r = i * RECORD
    w = plane[i, 2, 0] * x + plane[i, 2, 1] * y + plane[i, 2, 2]
    for row in range(2):
        value = plane[i, row, 0] * x + plane[i, row, 1] * y + plane[i, row, 2]
        for j in range(2):
            record[r + 3 * row + j] = scale * plane[i, row, j] + shift * plane[i, 2, j]
        record[r + 3 * row + 2] = scale * value + shift * w
    record[r + 6], record[r + 7], record[r + 8] = plane[i, 2, 0], plane[i, 2, 1], w
    record[r + 9] = w - reference[0]
    record[r + 10] = fade[i]
    record[r + 11] = (1.0 + 1e-5) / nearest[i] - reference[0]
    total = 0
    for tile_row in range(top // TILE, (bottom - 1) // TILE + 1):
        y_first, y_end = max(tile_row * TILE, top), min((tile_row + 1) * TILE, bottom)
        for column in range(left // TILE, (right - 1) // TILE + 1):
            x_first, x_end = max(column * TILE, left), min((column + 1) * TILE, right)
            if _touches(plane, i, support, x_first, y_first, x_end, y_end):
                total += 1
    counts[i] = total


@cuda.jit
def fill_tiles(plane, box, order, ends, support, across, tiles, members, status):
    """Lists the tiles that billboards touch, in `order`; entries beyond the arrays raise the flag.

    Args:
        order: (F,) int64, billboards in the order in which tiles take them.
        ends: (F,) int64, running number of entries up to and with each of `order`.
        tiles, members: (E,) int32, results.
        status: (1,) int32, set to 1 if E is too small.
    """
    k = cuda.grid(1)
    if k >= order.shape[0]:
        return
    i = order[k]
    entry = ends[k - 1] if k > 0 else 0
    if ends[k] > tiles.shape[0]:
        status[0] = 1
        return
    if ends[k] == entry:
        return
    for row in range(box[i, 1] // TILE, (box[i, 3] - 1) // TILE + 1):
        y_first, y_end = max(row * TILE, box[i, 1]), min((row + 1) * TILE, box[i, 3])
        for column in range(box[i, 0] // TILE, (box[i, 2] - 1) // TILE + 1):
            x_first, x_end = max(column * TILE, box[i, 0]), min((column + 1) * TILE, box[i, 2])
            if _touches(plane, i, support, x_first, y_first, x_end, y_end):
                tiles[entry] = row * across + column
                members[entry] = i
                entry += 1
