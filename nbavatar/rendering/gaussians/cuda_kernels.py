"""Numba-CUDA kernel of the Gaussian rasterizer: one thread a pixel, one block a tile.

The records and lists are those that the billboards' kernels make (`rendering.cuda_binning`). The replay
repeats the forward pass, records its hits on a tape and walks them from back to front, which needs no division by
a transmittance. It sums gradients by atomic additions, whose order is not fixed: results differ from run to run
by rounding.
"""

# Inside a kernel, numba's own types apply; its stubs describe the host's side.
# pyright: reportOptionalSubscript=false, reportArgumentType=false, reportOperatorIssue=false

import math
from functools import lru_cache
from typing import Any, NamedTuple

from numba import cuda

from nbavatar.rendering.binning import RECORD
from nbavatar.rendering.cuda_binning import TILE

__all__ = ["SUMS", "THREADS", "Constants", "traverse"]

THREADS = TILE * TILE
SUMS = 9  # numbers summed for a Gaussian: h u, h v, h u^2, h u v, h v^2, h and three colours


class Constants(NamedTuple):
    """Numbers that steer the kernels, of the type of all arithmetic."""

    zero: Any
    one: Any
    minus_half: Any
    alpha_min: Any
    alpha_max: Any
    t_min: Any


@lru_cache(maxsize=4)
def traverse(real: Any, replay: bool) -> Any:
    """Builds the kernel that blends the tiles, or, as `replay`, sums up what gradients need.

    Args:
        real: np.float32 or np.float64, the type of all arithmetic.
        replay: which of the two.

    Returns:
        Kernel for THREADS threads a block and a block a tile, with arguments `first_tile`; `bins`, `shape`, `images`
        and `tape` of the billboards' kernels (`cuda_arguments`); `colours` (3 N,); `constants`; and for the replay
        `sums` (SUMS N,) float64 and `status` (1,), set where the tape is too short.
    """

    @cuda.jit(device=True)
    def coordinates(record, box, i, x, y):
        """Coordinates u and v of a pixel in Gaussian i."""
        r = i * RECORD
        dx = real(x - (box[i, 0] + box[i, 2]) // 2)
        dy = real(y - (box[i, 1] + box[i, 3]) // 2)
        u = record[r] * dx + (record[r + 1] * dy + record[r + 2])
        return u, record[r + 4] * dy + record[r + 5]

    @cuda.jit
    def kernel(first_tile, bins, colours, constants, shape, images, tape, sums, status):
        zero, one, alpha_max = constants.zero, constants.one, constants.alpha_max
        start, members, record, box = bins.start, bins.members, bins.record, bins.box
        image, alpha, hits = images.features, images.opacity, images.hits
        tile = first_tile + cuda.blockIdx.x
        x = tile % shape.across * TILE + cuda.threadIdx.x % TILE
        y = tile // shape.across * TILE + cuda.threadIdx.x // TILE
        if x >= shape.width or y >= shape.height:
            return
        pixel = y * shape.width + x
        area = shape.width * shape.height
        begin = tape.ends[pixel] - hits[pixel] - tape.base if replay else 0
        transmittance, red, green, blue = one, zero, zero, zero
        count = 0
        for entry in range(start[tile], start[tile + 1]):
            i = members[entry]
            if x < box[i, 0] or x >= box[i, 2] or y < box[i, 1] or y >= box[i, 3]:
                continue
            u, v = coordinates(record, box, i, x, y)
            raw = record[i * RECORD + 10] * math.exp(constants.minus_half * (u * u + v * v))
            if not raw >= constants.alpha_min:
                continue
            a = min(raw, alpha_max)
            after = transmittance * (one - a)
            if after < constants.t_min:
                break
            if replay:
                at = begin + count
                if at >= tape.primitives.shape[0]:
                    status[0] = 1
                    break
                tape.values[2 * at] = transmittance
                tape.values[2 * at + 1] = raw
                tape.primitives[at] = i
            else:
                weight = transmittance * a
                red += weight * colours[3 * i]
                green += weight * colours[3 * i + 1]
                blue += weight * colours[3 * i + 2]
            count += 1
            transmittance = after
        if not replay:
            image[pixel], image[area + pixel], image[2 * area + pixel] = red, green, blue
            alpha[pixel] = one - transmittance
            hits[pixel] = count
            return
        dL_dr, dL_dg, dL_db, dL_dopacity = image[pixel], image[area + pixel], image[2 * area + pixel], alpha[pixel]
        suffix = zero
        while count > 0:
            count -= 1
            at = begin + count
            i = tape.primitives[at]
            transmittance, raw = tape.values[2 * at], tape.values[2 * at + 1]
            a = min(raw, alpha_max)
            dL_dweight = colours[3 * i] * dL_dr + colours[3 * i + 1] * dL_dg + colours[3 * i + 2] * dL_db + dL_dopacity
            gain = dL_dweight - suffix
            suffix += a * gain
            weight = transmittance * a
            place = SUMS * i
            cuda.atomic.add(sums, place + 6, weight * dL_dr)
            cuda.atomic.add(sums, place + 7, weight * dL_dg)
            cuda.atomic.add(sums, place + 8, weight * dL_db)
            if raw <= alpha_max:  # a capped alpha does not move
                u, v = coordinates(record, box, i, x, y)
                h = transmittance * gain * raw
                cuda.atomic.add(sums, place, h * u)
                cuda.atomic.add(sums, place + 1, h * v)
                cuda.atomic.add(sums, place + 2, h * u * u)
                cuda.atomic.add(sums, place + 3, h * u * v)
                cuda.atomic.add(sums, place + 4, h * v * v)
                cuda.atomic.add(sums, place + 5, h)

    return kernel
