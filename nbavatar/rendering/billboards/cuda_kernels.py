"""Numba-CUDA kernels of the rasterizer: one thread a pixel, one block a tile.

The arithmetic of a hit is that of `scalar.py`, compiled here for a GPU thread. A thread takes the
billboards of its tile in order of the least depth that they reach and keeps the nearest hits in a
short queue in local memory; a hit nearer than anything that the billboards still to come can reach
is final and is blended. Where the queue is full its farthest hit gives way and the thread goes
through the list once more, from that hit on: the order is exact however many hits a pixel has, in
fixed memory and without a word to the host. With a queue that gives up its nearest hit instead,
the same loop gives `kbuffer(n)` and `center`.

The replay repeats the loop, records its hits on a tape and walks them from back to front,
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
from nbavatar.rendering.billboards.cuda_arguments import Footprint, Queue, Scene
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
        Kernel for THREADS threads a block and a block a tile, with arguments `first_tile` and `bins`, `textures`,
        `constants`, `shape`, `images`, `tape`, `gradients` (see `cuda_arguments`); the replay uses the last two.
    """
    scalars = scalar.build(_device, _floor, _minimum, _maximum, _select)
    affine, first_texel, weights = scalars.affine, scalars.first_texel, scalars.weights
    slopes, mix, plane_slopes = scalars.slopes, scalars.mix, scalars.plane_slopes
    mask, room = capacity - 1, max(channels, 1)

    @_device
    def intersect(record, r, dx, dy, constants):
        """Whether there is anything in front, texel coordinates under a pixel, 1 / inverse depth."""
        zero, one = constants.zero, constants.one
        w = affine(record[r + 6], record[r + 7], record[r + 8], dx, dy)
        hit = w > zero and w <= constants.inverse_near
        p = one / w if hit else one
        s = affine(record[r], record[r + 1], record[r + 2], dx, dy) * p
        t = affine(record[r + 3], record[r + 4], record[r + 5], dx, dy) * p
        return hit, s, t, p

    @_device
    def footprint(s, t, constants):
        """Texels and weights of a hit."""
        zero, one = constants.zero, constants.one
        column, row = first_texel(s, constants.size, zero, one), first_texel(t, constants.size, zero, one)
        x0, x1 = weights(s, column, constants.step, zero, one)
        y0, y1 = weights(t, row, constants.step, zero, one)
        return Footprint(column, row, x0, x1, y0, y1)

    @_device
    def corners(billboard, foot, step, texels):
        """Index of the first texel, and what to add for the texels to the right and below."""
        first = (np.int64(billboard) * texels + np.int64(foot.row)) * texels + np.int64(foot.column)
        right = np.int64(step)
        return first, right, right * texels

    @_device
    def sample(alpha, first, right, below, x0, x1, y0, y1):
        return mix(real(alpha[first]), real(alpha[first + right]), real(alpha[first + below]),
                   real(alpha[first + below + right]), x0, x1, y0, y1)  # fmt: skip

    @_device
    def blend(queue, slot, transmittance, number, colour, scene, pixel, first_taped, allotted):
        """Blends the hit in a slot, or records it on the tape; returns the transmittance behind it.

        `number` is that of the hit at this pixel, whose hits have `allotted` places on the tape from `first_taped` on.
        """
        constants, shape, features, tape = scene.constants, scene.shape, scene.textures.features, scene.tape
        billboard = queue.billboard[slot]
        a = _minimum(queue.alpha[slot], constants.alpha_max)
        foot = footprint(queue.s[slot], queue.t[slot], constants)
        first, right, below = corners(billboard, foot, constants.step, shape.texels)
        first, right, below = first * channels, right * channels, below * channels
        pixels = np.int64(shape.width) * shape.height
        dL_dweight = constants.zero
        for c in range(channels):
            value = mix(real(features[first + c]), real(features[first + right + c]),
                        real(features[first + below + c]), real(features[first + below + right + c]),
                        foot.x0, foot.x1, foot.y0, foot.y1)  # fmt: skip
            if replay:
                dL_dweight += scene.images.features[np.int64(c) * pixels + pixel] * value
            else:
                colour[c] += transmittance * a * value
        # The two kernels may round differently: a hit that the forward pass did not count has no place on the tape.
        if replay and number < allotted:
            at = first_taped + number
            tape.values[3 * at] = dL_dweight + scene.images.opacity[pixel]
            tape.values[3 * at + 1] = a
            tape.values[3 * at + 2] = transmittance
            tape.primitives[at] = billboard
        return transmittance * (constants.one - a)

    @_device
    def scatter(at, suffix, x, y, scene):
        """Adds the gradients of the hit at a place on the tape; returns the suffix sum from this hit on."""
        constants, shape, adjoints, tape = scene.constants, scene.shape, scene.images.features, scene.tape
        features, alpha, gradients = scene.textures.features, scene.textures.alpha, scene.gradients
        record, box, sums = scene.bins.record, scene.bins.box, gradients.sums
        zero, one = constants.zero, constants.one
        billboard = tape.primitives[at]
        dL_dweight, a, transmittance = tape.values[3 * at], tape.values[3 * at + 1], tape.values[3 * at + 2]
        weight, dL_da = transmittance * a, transmittance * (dL_dweight - suffix)
        pixel, pixels = np.int64(y) * shape.width + x, np.int64(shape.width) * shape.height
        r = billboard * RECORD
        dx = real(x - (box[billboard, 0] + box[billboard, 2]) // 2)
        dy = real(y - (box[billboard, 1] + box[billboard, 3]) // 2)
        fade = record[r + 10]
        _, s, t, p = intersect(record, r, dx, dy, constants)
        foot = footprint(s, t, constants)
        x0, x1, y0, y1 = foot.x0, foot.x1, foot.y0, foot.y1
        x0_slope, x1_slope = slopes(s, foot.column, constants.step, zero, one)
        y0_slope, y1_slope = slopes(t, foot.row, constants.step, zero, one)
        first, right, below = corners(billboard, foot, constants.step, shape.texels)
        raw = sample(alpha, first, right, below, x0, x1, y0, y1)
        dL_ds, dL_dt = zero, zero
        if fade * raw <= constants.alpha_max:  # a capped alpha does not move
            cuda.atomic.add(sums, SUMS * billboard + 9, np.float64(dL_da * raw))
            dL_dsample = dL_da * fade
            dL_ds = dL_dsample * sample(alpha, first, right, below, x0_slope, x1_slope, y0, y1)
            dL_dt = dL_dsample * sample(alpha, first, right, below, x0, x1, y0_slope, y1_slope)
            cuda.atomic.add(gradients.alpha, first, dL_dsample * y0 * x0)
            cuda.atomic.add(gradients.alpha, first + right, dL_dsample * y0 * x1)
            cuda.atomic.add(gradients.alpha, first + below, dL_dsample * y1 * x0)
            cuda.atomic.add(gradients.alpha, first + below + right, dL_dsample * y1 * x1)
        first, right, below = first * channels, right * channels, below * channels
        for c in range(channels):
            t00, t01 = real(features[first + c]), real(features[first + right + c])
            t10, t11 = real(features[first + below + c]), real(features[first + below + right + c])
            dL_dfeature = weight * adjoints[np.int64(c) * pixels + pixel]
            dL_ds += dL_dfeature * mix(t00, t01, t10, t11, x0_slope, x1_slope, y0, y1)
            dL_dt += dL_dfeature * mix(t00, t01, t10, t11, x0, x1, y0_slope, y1_slope)
            cuda.atomic.add(gradients.features, first + c, dL_dfeature * y0 * x0)
            cuda.atomic.add(gradients.features, first + right + c, dL_dfeature * y0 * x1)
            cuda.atomic.add(gradients.features, first + below + c, dL_dfeature * y1 * x0)
            cuda.atomic.add(gradients.features, first + below + right + c, dL_dfeature * y1 * x1)
        middle = (constants.size - one) * real(0.5)  # of a texture: where its plane's coordinates are 0
        dL_dps, dL_dpt, dL_dpw = plane_slopes(dL_ds, dL_dt, s - middle, t - middle, p)
        place = SUMS * billboard
        cuda.atomic.add(sums, place, np.float64(dL_dps * dx))
        cuda.atomic.add(sums, place + 1, np.float64(dL_dps * dy))
        cuda.atomic.add(sums, place + 2, np.float64(dL_dps))
        cuda.atomic.add(sums, place + 3, np.float64(dL_dpt * dx))
        cuda.atomic.add(sums, place + 4, np.float64(dL_dpt * dy))
        cuda.atomic.add(sums, place + 5, np.float64(dL_dpt))
        cuda.atomic.add(sums, place + 6, np.float64(dL_dpw * dx))
        cuda.atomic.add(sums, place + 7, np.float64(dL_dpw * dy))
        cuda.atomic.add(sums, place + 8, np.float64(dL_dpw))
        return a * dL_dweight + (one - a) * suffix

    @cuda.jit
    def kernel(first_tile, bins, textures, constants, shape, images, tape, gradients):
        queue = Queue(
            cuda.local.array(capacity, real), cuda.local.array(capacity, real), cuda.local.array(capacity, real),
            cuda.local.array(capacity, real), cuda.local.array(capacity, np.int32),
        )  # fmt: skip
        colour = cuda.local.array(room, real)
        scene = Scene(bins, textures, constants, shape, images, tape, gradients)
        tile = first_tile + cuda.blockIdx.x
        # a warp covers 8x4 pixels: its threads meet the same billboards
        warp, lane = cuda.threadIdx.x // 32, cuda.threadIdx.x % 32
        x = tile % shape.across * TILE + warp % 2 * 8 + lane % 8
        y = tile // shape.across * TILE + warp // 2 * 4 + lane // 8
        if x >= shape.width or y >= shape.height:
            return
        pixel, pixels = np.int64(y) * shape.width + x, np.int64(shape.width) * shape.height
        zero, one, size, t_min = constants.zero, constants.one, constants.size, constants.t_min
        members, record, box, rank = bins.members, bins.record, bins.box, bins.rank
        first_taped, allotted = np.int64(0), np.int64(0)
        if replay:
            allotted = np.int64(images.hits[pixel])
            if allotted == 0:
                return
            first_taped = tape.ends[pixel] - allotted - tape.base
            if first_taped + allotted > tape.primitives.shape[0]:
                gradients.status[0] = 1
                return
        for c in range(room):
            colour[c] = zero
        transmittance, number = one, 0
        resumed, again = False, True
        cut_key, cut_rank = zero, 0
        while again:
            again = False
            begin, count = 0, 0
            dropped, drop_key, drop_rank = False, zero, 0
            for j in range(bins.start[tile], bins.start[tile + 1]):
                i = members[j]
                r = i * RECORD
                nearest_key = record[r + 11]
                if dropped and nearest_key < drop_key:
                    break  # nothing that follows can be nearer than what is left for the next round
                if x < box[i, 0] or x >= box[i, 2] or y < box[i, 1] or y >= box[i, 3]:
                    continue
                dx, dy = real(x - (box[i, 0] + box[i, 2]) // 2), real(y - (box[i, 1] + box[i, 3]) // 2)
                hit, s, t, _ = intersect(record, r, dx, dy, constants)
                if not (hit and s > -one and s < size and t > -one and t < size):
                    continue
                foot = footprint(s, t, constants)
                first, right, below = corners(i, foot, constants.step, shape.texels)
                raw = sample(textures.alpha, first, right, below, foot.x0, foot.x1, foot.y0, foot.y1)
                if not raw >= constants.alpha_min:
                    continue
                key = affine(record[r + 6], record[r + 7], record[r + 9], dx, dy)
                own_rank = rank[i]
                if mode == RAY:
                    if resumed and (key > cut_key or (key == cut_key and own_rank < cut_rank)):
                        continue
                    if dropped and (key < drop_key or (key == drop_key and own_rank > drop_rank)):
                        continue
                    while count > 0 and queue.key[begin] >= nearest_key and transmittance >= t_min:
                        transmittance = blend(
                            queue, begin, transmittance, number, colour, scene, pixel, first_taped, allotted
                        )
                        number += 1
                        begin = (begin + 1) & mask
                        count -= 1
                    if transmittance < t_min:
                        break
                    if count == capacity:  # the farthest hit gives way, until the next round
                        last = (begin + count - 1) & mask
                        last_rank = rank[queue.billboard[last]]
                        dropped = True
                        if key < queue.key[last] or (key == queue.key[last] and own_rank > last_rank):
                            drop_key, drop_rank = key, own_rank
                            continue
                        drop_key, drop_rank = queue.key[last], last_rank
                        count -= 1
                n = count
                if mode != CENTER:
                    while n > 0:
                        other = (begin + n - 1) & mask
                        nearer = queue.key[other] > key
                        if nearer or (queue.key[other] == key and rank[queue.billboard[other]] < own_rank):
                            break
                        slot = (begin + n) & mask
                        queue.s[slot], queue.t[slot] = queue.s[other], queue.t[other]
                        queue.key[slot], queue.alpha[slot] = queue.key[other], queue.alpha[other]
                        queue.billboard[slot] = queue.billboard[other]
                        n -= 1
                slot = (begin + n) & mask
                queue.s[slot], queue.t[slot] = s, t
                queue.key[slot], queue.alpha[slot] = key, record[r + 10] * raw
                queue.billboard[slot] = i
                count += 1
                if mode != RAY and count > shape.queue:
                    transmittance = blend(
                        queue, begin, transmittance, number, colour, scene, pixel, first_taped, allotted
                    )
                    number += 1
                    begin = (begin + 1) & mask
                    count -= 1
                    if transmittance < t_min:
                        break
            while count > 0 and transmittance >= t_min:
                transmittance = blend(queue, begin, transmittance, number, colour, scene, pixel, first_taped, allotted)
                number += 1
                begin = (begin + 1) & mask
                count -= 1
            if dropped and transmittance >= t_min:
                again, resumed = True, True
                cut_key, cut_rank = drop_key, drop_rank
        if replay:
            suffix = zero
            number = min(number, allotted)
            while number > 0:
                number -= 1
                suffix = scatter(first_taped + number, suffix, x, y, scene)
        else:
            for c in range(channels):
                images.features[np.int64(c) * pixels + pixel] = colour[c]
            images.opacity[pixel] = one - transmittance
            images.hits[pixel] = number

    return kernel
