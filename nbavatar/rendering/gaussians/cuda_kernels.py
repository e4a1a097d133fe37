"""Numba-CUDA kernel of the Gaussian rasterizer: one thread a pixel, one block a tile.

The records and lists are those that the billboards' kernels make (`raster.cuda_binning`). The backward pass
repeats the forward one, notes its hits on a tape and walks them from back to front, which needs no division by
a transmittance. It sums gradients by atomic additions, whose order is not fixed: results differ from run to run
by rounding.
"""

# Inside a kernel, numba's own types apply; its stubs describe the host's side.
# pyright: reportOptionalSubscript=false, reportArgumentType=false, reportOperatorIssue=false

import math
from functools import lru_cache
from typing import Any

from numba import cuda

from nbavatar.rendering.binning import RECORD
from nbavatar.rendering.cuda_binning import TILE

__all__ = ["SUMS", "THREADS", "traverse"]

THREADS = TILE * TILE
SUMS = 9  # numbers summed for a Gaussian: h u, h v, h u^2, h u v, h v^2, h and three colours


@lru_cache(maxsize=4)
def traverse(real: Any, replay: bool) -> Any:
    """Builds the kernel that blends the tiles, or, as `replay`, sums up what gradients need.

    Args:
        real: np.float32 or np.float64, the type of all arithmetic.
        replay: which of the two.

    Returns:
        Kernel for THREADS threads a block and a block a tile, with arguments `first_tile`; `start` (tiles + 1,),
        `members` (E,) the tiles' lists; `record`, `box` (N,); `colours` (3 N,); `limits`: zero, one, -1/2,
        alpha_min, alpha_max, t_min; `width`, `height`, `across` (tiles); `image` (3 H W,), `alpha` (H W,), `hits`
        (H W,) int32: results, or in the replay the gradients by the first two and what was counted; and for the
        replay `ends` (H W,) int64, running number of hits, `base` those before the tape begins, `tape` (2 hits,),
        `who` (hits,) int32, `sums` (SUMS N,) float64, `status` (1,), set where the tape is too short.
    """

    @cuda.jit(device=True)
    def place(record, box, i, x, y):
        """Coordinates u and v of a pixel in Gaussian i."""
        r = i * RECORD
        dx = real(x - (box[i, 0] + box[i, 2]) // 2)
        dy = real(y - (box[i, 1] + box[i, 3]) // 2)
        u = record[r] * dx + (record[r + 1] * dy + record[r + 2])
        return u, record[r + 4] * dy + record[r + 5]

    @cuda.jit
    def kernel(first_tile, start, members, record, box, colours, limits, width, height, across, image, alpha, hits,
               ends, base, tape, who, sums, status):  # fmt: skip
        zero, one, minus_half, alpha_min, alpha_max, t_min = limits
        tile = first_tile + cuda.blockIdx.x
        x = tile % across * TILE + cuda.threadIdx.x % TILE
        y = tile // across * TILE + cuda.threadIdx.x // TILE
        if x >= width or y >= height:
            return
        pixel = y * width + x
        area = width * height
        begin = ends[pixel] - hits[pixel] - base if replay else 0
        through, red, green, blue = one, zero, zero, zero
        count = 0
        for entry in range(start[tile], start[tile + 1]):
            i = members[entry]
            if x < box[i, 0] or x >= box[i, 2] or y < box[i, 1] or y >= box[i, 3]:
                continue
            u, v = place(record, box, i, x, y)
            raw = record[i * RECORD + 10] * math.exp(minus_half * (u * u + v * v))
            if not raw >= alpha_min:
                continue
            a = min(raw, alpha_max)
            after = through * (one - a)
            if after < t_min:
                break
            if replay:
                spot = begin + count
                if spot >= who.shape[0]:
                    status[0] = 1
                    break
                tape[2 * spot] = through
                tape[2 * spot + 1] = raw
                who[spot] = i
            else:
                w = through * a
                red += w * colours[3 * i]
                green += w * colours[3 * i + 1]
                blue += w * colours[3 * i + 2]
            count += 1
            through = after
        if not replay:
            image[pixel], image[area + pixel], image[2 * area + pixel] = red, green, blue
            alpha[pixel] = one - through
            hits[pixel] = count
            return
        by_r, by_g, by_b, by_a = image[pixel], image[area + pixel], image[2 * area + pixel], alpha[pixel]
        behind = zero
        while count > 0:
            count -= 1
            spot = begin + count
            i = who[spot]
            through, raw = tape[2 * spot], tape[2 * spot + 1]
            a = min(raw, alpha_max)
            worth = colours[3 * i] * by_r + colours[3 * i + 1] * by_g + colours[3 * i + 2] * by_b + by_a
            gain = worth - behind
            behind += a * gain
            w = through * a
            at = SUMS * i
            cuda.atomic.add(sums, at + 6, w * by_r)
            cuda.atomic.add(sums, at + 7, w * by_g)
            cuda.atomic.add(sums, at + 8, w * by_b)
            if raw <= alpha_max:  # a capped alpha does not move
                u, v = place(record, box, i, x, y)
                h = through * gain * raw
                cuda.atomic.add(sums, at, h * u)
                cuda.atomic.add(sums, at + 1, h * v)
                cuda.atomic.add(sums, at + 2, h * u * u)
                cuda.atomic.add(sums, at + 3, h * u * v)
                cuda.atomic.add(sums, at + 4, h * v * v)
                cuda.atomic.add(sums, at + 5, h)

    return kernel
