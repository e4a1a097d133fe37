"""Numba-CUDA kernels of the rasterizer: one thread a pixel, one block a tile.

The arithmetic of a hit is that of `scalar.py`, compiled here for a GPU thread. A thread takes the
billboards of its tile in order of the least depth that they reach and keeps the nearest hits in a
short queue in local memory; a hit nearer than anything that the billboards still to come can reach
is final and is blended. Where the queue is full its farthest hit gives way and the thread goes
through the list once more, from that hit on: the order is exact however many hits a pixel has, in
fixed memory and without a word to the host. With a queue that gives up its nearest hit instead,
the same loop gives `kbuffer(n)` and `center`.

The backward kernel repeats the loop, notes its hits on a tape and walks them from back to front,
which needs no division by a transmittance. It sums gradients by atomic additions, whose order is
not fixed: results differ from run to run by rounding.
"""

# Inside a kernel, numba's own types apply; its stubs describe the host's side.
# pyright: reportOptionalSubscript=false, reportArgumentType=false, reportOperatorIssue=false

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numba import cuda

from nbavatar.jit import scalar
from nbavatar.rendering.binning import RECORD
from nbavatar.rendering.cuda_binning import TILE

__all__ = ["CENTER", "KBUFFER", "RAY", "SUMS", "THREADS", "finish", "traverse"]

THREADS = TILE * TILE
CENTER, KBUFFER, RAY = 0, 1, 2
SUMS = 10  # numbers summed for a billboard: gradients of three affine functions and of the fade


def _device(function: Any) -> Any:
    return cuda.jit(device=True)(function)


@_device
def _minimum(a, b):
    return a if a < b else b


@_device
def _maximum(a, b):
    return a if a > b else b


@_device
def _select(condition, yes, no):
    return yes if condition else no


@_device
def _floor(a):
    return math.floor(a)


@cuda.jit
def finish(sums, box, texels, grad_plane, grad_fade):
    """Turns sums about each record's origin into gradients by `plane` and `fade`, float64."""
    i = cuda.grid(1)
    if i >= box.shape[0]:
        return
    scale = 0.5 * (texels - 1) if texels > 1 else 1.0
    ox, oy = (box[i, 0] + box[i, 2]) // 2 + 0.5, (box[i, 1] + box[i, 3]) // 2 + 0.5
    for j in range(3):
        origin = ox if j == 0 else oy
        s, t, w = sums[SUMS * i + j], sums[SUMS * i + 3 + j], sums[SUMS * i + 6 + j]
        if j < 2:
            s += sums[SUMS * i + 2] * origin
            t += sums[SUMS * i + 5] * origin
            w += sums[SUMS * i + 8] * origin
        grad_plane[i, 0, j] = scale * s
        grad_plane[i, 1, j] = scale * t
        grad_plane[i, 2, j] = w
    grad_fade[i] = sums[SUMS * i + 9]


@lru_cache(maxsize=64)
def traverse(real: Any, channels: int, capacity: int, mode: int, replay: bool) -> Any:
    """Builds the kernel that blends the tiles, or, as `replay`, computes the gradients.

    Args:
        real: np.float32 or np.float64, the type of all arithmetic.
        channels: C.
        capacity: hits that a queue holds, a power of 2; more than the n of `kbuffer(n)`.
        mode: CENTER, KBUFFER or RAY.
        replay: whether to compute the gradients.

    Returns:
        Kernel for THREADS threads a block and a block a tile, with arguments
        `first_tile`; `start` (tiles + 1,), `members` (E,) the tiles' lists; `record`, `box`, `place` (F,);
        `features`, `alpha` flat textures of any floating type; `limits`: zero, one, texels a side,
        min(1, texels - 1), 1 / near, alpha_min, t_min, alpha_max; `texels`, `width`, `height`, `across`
        (tiles), `queue`; `image` (C H W,), `opacity` (H W,), `hits` (H W,) int32: results, or in the
        replay the gradients by the first two and what was counted; and for the replay `ends` (H W,)
        int64, running number of hits, `base` those before the tape begins, `tape` (3 hits,), `who`
        (hits,) int32, `grad_features`, `grad_alpha` flat, `sums` (SUMS F,) float64, `status` (1,).
    """
    scalars = scalar.build(_device, _floor, _minimum, _maximum, _select)
    affine, first_texel, weights = scalars.affine, scalars.first_texel, scalars.weights
    slopes, mix, plane_slopes = scalars.slopes, scalars.mix, scalars.plane_slopes
    mask, room = capacity - 1, max(channels, 1)

    @_device
    def locate(record, r, dx, dy, limits):
        """Texel coordinates under a pixel, 1 / inverse depth, and whether there is anything in front."""
        zero, one, inverse_near = limits[0], limits[1], limits[4]
        w = affine(record[r + 6], record[r + 7], record[r + 8], dx, dy)
        hit = w > zero and w <= inverse_near
        p = one / w if hit else one
        s = affine(record[r], record[r + 1], record[r + 2], dx, dy) * p
        t = affine(record[r + 3], record[r + 4], record[r + 5], dx, dy) * p
        return hit, s, t, p

    @_device
    def corners(member, column, row, step, texels):
        """Index of the first texel, and what to add for the texels to the right and below."""
        first = (np.int64(member) * texels + np.int64(row)) * texels + np.int64(column)
        right = np.int64(step)
        return first, right, right * texels

    @_device
    def sample(alpha, first, right, below, x0, x1, y0, y1):
        return mix(real(alpha[first]), real(alpha[first + right]), real(alpha[first + below]),
                   real(alpha[first + below + right]), x0, x1, y0, y1)  # fmt: skip

    @_device
    def emit(slot, at_s, at_t, opacities, waiting, through, number, colour, features, limits, texels, image, opacity,
             pixel, pixels, at, allotted, tape, who):  # fmt: skip
        """Blends the hit in a slot, or notes it; returns the transmittance behind it."""
        zero, one, size, step = limits[0], limits[1], limits[2], limits[3]
        s, t, member = at_s[slot], at_t[slot], waiting[slot]
        a = _minimum(opacities[slot], limits[7])
        column, row = first_texel(s, size, zero, one), first_texel(t, size, zero, one)
        x0, x1 = weights(s, column, step, zero, one)
        y0, y1 = weights(t, row, step, zero, one)
        first, right, below = corners(member, column, row, step, texels)
        first, right, below = first * channels, right * channels, below * channels
        worth = zero
        for c in range(channels):
            value = mix(real(features[first + c]), real(features[first + right + c]),
                        real(features[first + below + c]), real(features[first + below + right + c]),
                        x0, x1, y0, y1)  # fmt: skip
            if replay:
                worth += image[np.int64(c) * pixels + pixel] * value
            else:
                colour[c] += through * a * value
        # The two kernels may round differently: a hit that the forward pass did not count has no place on the tape.
        if replay and number < allotted:
            spot = at + number
            tape[3 * spot] = worth + opacity[pixel]
            tape[3 * spot + 1] = a
            tape[3 * spot + 2] = through
            who[spot] = member
        return through * (one - a)

    @_device
    def spread(member, worth, a, through, behind, x, y, record, box, features, alpha, limits, texels, image, pixel,
               pixels, grad_features, grad_alpha, sums):  # fmt: skip
        """Adds one hit's gradients; returns what the pixel is worth from this hit on."""
        zero, one, size, step, alpha_max = limits[0], limits[1], limits[2], limits[3], limits[7]
        w, by_a = through * a, through * (worth - behind)
        r = member * RECORD
        dx, dy = real(x - (box[member, 0] + box[member, 2]) // 2), real(y - (box[member, 1] + box[member, 3]) // 2)
        fade = record[r + 10]
        _, s, t, p = locate(record, r, dx, dy, limits)
        column, row = first_texel(s, size, zero, one), first_texel(t, size, zero, one)
        x0, x1 = weights(s, column, step, zero, one)
        y0, y1 = weights(t, row, step, zero, one)
        a0, a1 = slopes(s, column, step, zero, one)
        b0, b1 = slopes(t, row, step, zero, one)
        first, right, below = corners(member, column, row, step, texels)
        raw = sample(alpha, first, right, below, x0, x1, y0, y1)
        by_s, by_t = zero, zero
        if fade * raw <= alpha_max:  # a capped alpha does not move
            cuda.atomic.add(sums, SUMS * member + 9, np.float64(by_a * raw))
            by_a = by_a * fade
            by_s = by_a * sample(alpha, first, right, below, a0, a1, y0, y1)
            by_t = by_a * sample(alpha, first, right, below, x0, x1, b0, b1)
            cuda.atomic.add(grad_alpha, first, by_a * y0 * x0)
            cuda.atomic.add(grad_alpha, first + right, by_a * y0 * x1)
            cuda.atomic.add(grad_alpha, first + below, by_a * y1 * x0)
            cuda.atomic.add(grad_alpha, first + below + right, by_a * y1 * x1)
        first, right, below = first * channels, right * channels, below * channels
        for c in range(channels):
            t00, t01 = real(features[first + c]), real(features[first + right + c])
            t10, t11 = real(features[first + below + c]), real(features[first + below + right + c])
            by_colour = w * image[np.int64(c) * pixels + pixel]
            by_s += by_colour * mix(t00, t01, t10, t11, a0, a1, y0, y1)
            by_t += by_colour * mix(t00, t01, t10, t11, x0, x1, b0, b1)
            cuda.atomic.add(grad_features, first + c, by_colour * y0 * x0)
            cuda.atomic.add(grad_features, first + right + c, by_colour * y0 * x1)
            cuda.atomic.add(grad_features, first + below + c, by_colour * y1 * x0)
            cuda.atomic.add(grad_features, first + below + right + c, by_colour * y1 * x1)
        middle = (size - one) * real(0.5)  # of a texture: where its plane's coordinates are 0
        gs, gt, gw = plane_slopes(by_s, by_t, s - middle, t - middle, p)
        at = SUMS * member
        cuda.atomic.add(sums, at, np.float64(gs * dx))
        cuda.atomic.add(sums, at + 1, np.float64(gs * dy))
        cuda.atomic.add(sums, at + 2, np.float64(gs))
        cuda.atomic.add(sums, at + 3, np.float64(gt * dx))
        cuda.atomic.add(sums, at + 4, np.float64(gt * dy))
        cuda.atomic.add(sums, at + 5, np.float64(gt))
        cuda.atomic.add(sums, at + 6, np.float64(gw * dx))
        cuda.atomic.add(sums, at + 7, np.float64(gw * dy))
        cuda.atomic.add(sums, at + 8, np.float64(gw))
        return a * worth + (one - a) * behind

    @cuda.jit
    def kernel(first_tile, start, members, record, box, place, features, alpha, limits, texels, width, height, across,
               queue, image, opacity, hits, ends, base, tape, who, grad_features, grad_alpha, sums,
               status):  # fmt: skip
        at_s, at_t = cuda.local.array(capacity, real), cuda.local.array(capacity, real)
        keys, opacities = cuda.local.array(capacity, real), cuda.local.array(capacity, real)
        waiting = cuda.local.array(capacity, np.int32)
        colour = cuda.local.array(room, real)
        tile = first_tile + cuda.blockIdx.x
        # a warp covers 8x4 pixels: its threads meet the same billboards
        warp, lane = cuda.threadIdx.x // 32, cuda.threadIdx.x % 32
        x = tile % across * TILE + warp % 2 * 8 + lane % 8
        y = tile // across * TILE + warp // 2 * 4 + lane // 8
        if x >= width or y >= height:
            return
        pixels = np.int64(width) * height
        pixel = np.int64(y) * width + x
        zero, one, size, t_min = limits[0], limits[1], limits[2], limits[6]
        at, allotted = np.int64(0), np.int64(0)
        if replay:
            allotted = np.int64(hits[pixel])
            if allotted == 0:
                return
            at = ends[pixel] - allotted - base
            if at + allotted > who.shape[0]:
                status[0] = 1
                return
        for c in range(room):
            colour[c] = zero
        through, number = one, 0
        resumed, again = False, True
        cut_key, cut_place = zero, 0
        while again:
            again = False
            begin, count = 0, 0
            dropped, drop_key, drop_place = False, zero, 0
            for j in range(start[tile], start[tile + 1]):
                i = members[j]
                r = i * RECORD
                reach = record[r + 11]
                if dropped and reach < drop_key:
                    break  # nothing that follows can be nearer than what is left for the next round
                if x < box[i, 0] or x >= box[i, 2] or y < box[i, 1] or y >= box[i, 3]:
                    continue
                dx, dy = real(x - (box[i, 0] + box[i, 2]) // 2), real(y - (box[i, 1] + box[i, 3]) // 2)
                hit, s, t, _ = locate(record, r, dx, dy, limits)
                if not (hit and s > -one and s < size and t > -one and t < size):
                    continue
                column, row = first_texel(s, size, zero, one), first_texel(t, size, zero, one)
                x0, x1 = weights(s, column, limits[3], zero, one)
                y0, y1 = weights(t, row, limits[3], zero, one)
                first, right, below = corners(i, column, row, limits[3], texels)
                raw = sample(alpha, first, right, below, x0, x1, y0, y1)
                if not raw >= limits[5]:
                    continue
                key = affine(record[r + 6], record[r + 7], record[r + 9], dx, dy)
                own = place[i]
                if mode == RAY:
                    if resumed and (key > cut_key or (key == cut_key and own < cut_place)):
                        continue
                    if dropped and (key < drop_key or (key == drop_key and own > drop_place)):
                        continue
                    while count > 0 and keys[begin] >= reach and through >= t_min:
                        through = emit(begin, at_s, at_t, opacities, waiting, through, number, colour, features, limits,
                                       texels, image, opacity, pixel, pixels, at, allotted, tape, who)  # fmt: skip
                        number += 1
                        begin = (begin + 1) & mask
                        count -= 1
                    if through < t_min:
                        break
                    if count == capacity:  # the farthest hit gives way, until the next round
                        last = (begin + count - 1) & mask
                        last_place = place[waiting[last]]
                        dropped = True
                        if key < keys[last] or (key == keys[last] and own > last_place):
                            drop_key, drop_place = key, own
                            continue
                        drop_key, drop_place = keys[last], last_place
                        count -= 1
                n = count
                if mode != CENTER:
                    while n > 0:
                        other = (begin + n - 1) & mask
                        if keys[other] > key or (keys[other] == key and place[waiting[other]] < own):
                            break
                        slot = (begin + n) & mask
                        at_s[slot], at_t[slot] = at_s[other], at_t[other]
                        keys[slot], opacities[slot] = keys[other], opacities[other]
                        waiting[slot] = waiting[other]
                        n -= 1
                slot = (begin + n) & mask
                at_s[slot], at_t[slot] = s, t
                keys[slot], opacities[slot] = key, record[r + 10] * raw
                waiting[slot] = i
                count += 1
                if mode != RAY and count > queue:
                    through = emit(begin, at_s, at_t, opacities, waiting, through, number, colour, features, limits,
                                   texels, image, opacity, pixel, pixels, at, allotted, tape, who)  # fmt: skip
                    number += 1
                    begin = (begin + 1) & mask
                    count -= 1
                    if through < t_min:
                        break
            while count > 0 and through >= t_min:
                through = emit(begin, at_s, at_t, opacities, waiting, through, number, colour, features, limits, texels,
                               image, opacity, pixel, pixels, at, allotted, tape, who)  # fmt: skip
                number += 1
                begin = (begin + 1) & mask
                count -= 1
            if dropped and through >= t_min:
                again, resumed = True, True
                cut_key, cut_place = drop_key, drop_place
        if replay:
            behind = zero
            number = min(number, allotted)
            while number > 0:
                number -= 1
                spot = at + number
                behind = spread(who[spot], tape[3 * spot], tape[3 * spot + 1], tape[3 * spot + 2], behind, x, y, record,
                                box, features, alpha, limits, texels, image, pixel, pixels, grad_features, grad_alpha,
                                sums)  # fmt: skip
        else:
            for c in range(channels):
                image[np.int64(c) * pixels + pixel] = colour[c]
            opacity[pixel] = one - through
            hits[pixel] = number

    return kernel
