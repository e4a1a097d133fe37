"""Numba kernels of the Gaussian rasterizer for the CPU: eight pixels of a row at a time.

All pixels of a tile take its Gaussians in the same order, so a hit is blended into eight pixels by
a dozen vector instructions. Which columns of a row a Gaussian reaches follows in closed form from its
record (`projection.py`); what lies off that span costs nothing.

The replay repeats the forward pass, records the transmittance and alpha of every hit on a tape, and walks the
tape from back to front, which needs no division by a transmittance. A Gaussian's share in a tile is
nine sums over its pixels, in its own coordinates u and v; each is written once, by the tile, and a second
kernel adds those of a Gaussian up in a fixed order. Results do not depend on threads or timing.
"""

from collections import namedtuple
from typing import Any, NamedTuple

import numpy as np

from nbavatar.jit.compile import inlined, kernel
from nbavatar.jit.lane_memory import load, store
from nbavatar.jit.lanes import LANES, broadcast, count_bits, first_lanes, mask_bits, minimum, ramp, select, sum_lanes
from nbavatar.jit.memory import fetch_add, get, pointer, pointers, put
from nbavatar.rendering.binning import RECORD, TILE_WIDTH, tile_bounds
from nbavatar.rendering.gaussians.lanes import falloff
from nbavatar.rendering.scratch import REPLAY, Buffer

__all__ = [
    "BUFFERS", "PARTS", "Constants", "Images", "Scratch", "Shape", "Sizes", "gather_parts", "traverse",
]  # fmt: skip

PARTS = 9  # sums that a tile leaves for a Gaussian
_SLACK = 0.01  # pixels by which spans are widened; an alpha decides by itself


class Sizes(NamedTuple):
    """What the scratch's sizes follow from."""

    rows: int  # of a band
    longest: int  # list of a tile

    @property
    def pixels(self) -> int:
        """Of a band, and room for a vector that begins at the last."""
        return TILE_WIDTH * self.rows + LANES

    @property
    def packets(self) -> int:
        """Eight neighbouring pixels of a row under one Gaussian: at most so many in a band."""
        return self.longest * self.rows * (TILE_WIDTH // LANES)


BUFFERS = (
    # of the band's pixels
    Buffer("transmittance", None, lambda n: n.pixels),  # negative once finished
    Buffer("red", None, lambda n: n.pixels),  # blended colour; its adjoint in the second part of the replay
    Buffer("green", None, lambda n: n.pixels),
    Buffer("blue", None, lambda n: n.pixels),
    Buffer("dL_dopacity", None, lambda n: n.pixels, only=REPLAY),
    Buffer("suffix", None, lambda n: n.pixels, only=REPLAY),  # suffix sum B of the hits differentiated so far
    # the tape: of each packet with a hit
    Buffer("tape_transmittance", None, lambda n: LANES * n.packets, only=REPLAY),  # in front of its hits
    Buffer("tape_alpha", None, lambda n: LANES * n.packets, only=REPLAY),  # before the cap; 0 where there is no hit
    Buffer("tape_entry", np.int32, lambda n: n.packets, only=REPLAY),  # in the tiles' lists
    Buffer("tape_pixel", np.int32, lambda n: n.packets, only=REPLAY),  # place of its first pixel in the band
)
Scratch = namedtuple("Scratch", [buffer.name for buffer in BUFFERS])


class Shape(NamedTuple):
    """Whole numbers that `traverse` takes."""

    width: Any  # of the image [px]
    height: Any
    across: Any  # tiles side by side
    rows: Any  # of a band


class Constants(NamedTuple):
    """Numbers that steer `traverse`, in the dtype of the image."""

    zero: Any
    one: Any
    alpha_min: Any
    alpha_max: Any
    t_min: Any


class Images(NamedTuple):
    """Colour (3, H, W) and accumulated alpha (H, W)."""

    colour: Any
    alpha: Any


@inlined
def _span(wide, middle, rest, first, end, origin):
    """Columns first ... end narrowed to those where u^2 <= rest.

    `wide` is the distance in which u grows by 1 and `middle`, less the origin, the place where u = 0.
    """
    half = np.sqrt(rest) * wide + _SLACK
    low, high = max(middle - half, np.float64(first - origin)), min(middle + half, np.float64(end - 1 - origin))
    if not (low <= high):
        return first, first
    return origin + int(np.ceil(low)), origin + int(np.floor(high)) + 1


@inlined
def _colour(colours, i):
    """Red, green and blue of Gaussian i, each in all lanes."""
    return broadcast(get(colours, 3 * i)), broadcast(get(colours, 3 * i + 1)), broadcast(get(colours, 3 * i + 2))


@inlined
def _add_part(parts, entry, part, value):
    """Adds the lanes of a value to one of an entry's sums."""
    at = PARTS * np.int64(entry) + part
    put(parts, at, get(parts, at) + sum_lanes(value))


@kernel
def traverse(counter, tiles, bins, colours_, constants, shape, images, adjoints, parts_, scratch_):
    """Works through tiles until none is left: blends them, or leaves the sums that `gather_parts` needs.

    Args:
        counter: (1,) int64, next position in `tiles`, shared by all workers.
        tiles: (n,) int32, in the order in which to take them.
        bins: see Bins, with records in float64.
        colours: (N, 3) flat.
        constants, shape, scratch: see above.
        images: results; without elements in the replay.
        adjoints: (4, H, W), of colour and alpha; without elements in the forward pass, which tells the two apart.
        parts: (entries, PARTS) flat, by position in the tiles' lists; written in the replay.

    Returns:
        Number of hits on the tape.
    """
    width, height, rows, replay = shape.width, shape.height, shape.rows, len(adjoints) != 0
    box, start, image, alpha = bins.box, bins.tile_start, images.colour, images.alpha
    packed, colours, parts, scratch = pointers(bins), pointer(colours_, 0), pointer(parts_, 0), pointers(scratch_)
    members, record = packed.members, packed.record
    zero, one = constants.zero, constants.one
    alpha_min, alpha_max, t_min = (
        broadcast(constants.alpha_min), broadcast(constants.alpha_max), broadcast(constants.t_min),
    )  # fmt: skip
    zeros, ones, steps = broadcast(zero), broadcast(one), ramp(zero)
    hits = 0
    while True:
        position = fetch_add(counter, 1)
        if position >= len(tiles):
            break
        tile = tiles[position]
        left, tile_top, right, tile_bottom = tile_bounds(tile, shape.across, width, height)
        if replay:
            for i in range(PARTS * start[tile], PARTS * start[tile + 1]):
                put(parts, i, zero)
        for top in range(tile_top, tile_bottom, rows):
            bottom = min(top + rows, tile_bottom)
            for i in range(TILE_WIDTH * rows + LANES):
                put(scratch.transmittance, i, zero)
                put(scratch.red, i, zero)
                put(scratch.green, i, zero)
                put(scratch.blue, i, zero)
                if replay:
                    put(scratch.dL_dopacity, i, zero)
                    put(scratch.suffix, i, zero)
            for y in range(top, bottom):
                for x in range(left, right):
                    put(scratch.transmittance, (y - top) * TILE_WIDTH + x - left, one)
            active = (bottom - top) * (right - left)
            count = 0
            for entry in range(start[tile], start[tile + 1]):
                i = get(members, entry)
                x_first, x_end = max(left, box[i, 0]), min(right, box[i, 2])
                y_first, y_end = max(top, box[i, 1]), min(bottom, box[i, 3])
                if y_first >= y_end:
                    continue
                r = i * RECORD
                x_origin, y_origin = (box[i, 0] + box[i, 2]) // 2, (box[i, 1] + box[i, 3]) // 2
                p, s, u_origin = get(record, r), get(record, r + 1), get(record, r + 2)
                k, v_origin, reach = get(record, r + 4), get(record, r + 5), get(record, r + 8)
                wide = 1.0 / p
                opacity = broadcast(zero + type(zero)(get(record, r + 10)))
                slope = broadcast(type(zero)(p)) * steps
                red, green, blue = _colour(colours, i)
                for y in range(y_first, y_end):
                    v = k * (y - y_origin) + v_origin
                    rest = reach * reach - v * v
                    if rest < 0.0:
                        continue
                    u_row = s * (y - y_origin) + u_origin
                    x_from, x_to = _span(wide, -u_row * wide, rest, x_first, x_end, x_origin)
                    vv = broadcast(type(zero)(v * v))
                    for x in range(x_from, x_to, LANES):
                        u = broadcast(type(zero)(p * (x - x_origin) + u_row)) + slope
                        raw = opacity * falloff(u * u + vv)
                        at = (y - top) * TILE_WIDTH + x - left
                        transmittance = load(scratch.transmittance, at)
                        hit_mask = first_lanes(x_to - x) & (raw >= alpha_min) & (transmittance > zeros)
                        a = minimum(raw, alpha_max)
                        after = transmittance * (ones - a)
                        blended = hit_mask & (after >= t_min)
                        word = mask_bits(blended)
                        finished = mask_bits(hit_mask) ^ word
                        left_over = select(hit_mask, select(blended, after, zeros - transmittance), transmittance)
                        store(scratch.transmittance, at, left_over)
                        if finished != 0:
                            active -= count_bits(finished)
                        if word == 0:
                            continue
                        if replay:
                            hits += count_bits(word)
                            store(scratch.tape_transmittance, LANES * count, transmittance)
                            store(scratch.tape_alpha, LANES * count, select(blended, raw, zeros))
                            put(scratch.tape_entry, count, entry)
                            put(scratch.tape_pixel, count, at)
                            count += 1
                        else:
                            weight = select(blended, transmittance * a, zeros)
                            store(scratch.red, at, load(scratch.red, at) + weight * red)
                            store(scratch.green, at, load(scratch.green, at) + weight * green)
                            store(scratch.blue, at, load(scratch.blue, at) + weight * blue)
                if active == 0:
                    break
            if not replay:
                for y in range(top, bottom):
                    for x in range(left, right):
                        at = (y - top) * TILE_WIDTH + x - left
                        image[0, y, x] = get(scratch.red, at)
                        image[1, y, x] = get(scratch.green, at)
                        image[2, y, x] = get(scratch.blue, at)
                        alpha[y, x] = one - abs(get(scratch.transmittance, at))
                continue
            for y in range(top, bottom):
                for x in range(left, right):
                    at = (y - top) * TILE_WIDTH + x - left
                    put(scratch.red, at, adjoints[0, y, x])
                    put(scratch.green, at, adjoints[1, y, x])
                    put(scratch.blue, at, adjoints[2, y, x])
                    put(scratch.dL_dopacity, at, adjoints[3, y, x])
            while count > 0:
                entry = get(scratch.tape_entry, count - 1)
                i = get(members, entry)
                r = i * RECORD
                x_origin, y_origin = (box[i, 0] + box[i, 2]) // 2, (box[i, 1] + box[i, 3]) // 2
                p, s, u_origin = get(record, r), get(record, r + 1), get(record, r + 2)
                k, v_origin = get(record, r + 4), get(record, r + 5)
                slope = broadcast(type(zero)(p)) * steps
                red, green, blue = _colour(colours, i)
                s_u, s_v, s_uu, s_uv, s_vv = zeros, zeros, zeros, zeros, zeros
                s_1, s_r, s_g, s_b = zeros, zeros, zeros, zeros
                while count > 0 and get(scratch.tape_entry, count - 1) == entry:
                    count -= 1
                    at = get(scratch.tape_pixel, count)
                    y, x = top + at // TILE_WIDTH, left + at % TILE_WIDTH
                    v = broadcast(type(zero)(k * (y - y_origin) + v_origin))
                    u = broadcast(type(zero)(p * (x - x_origin) + (s * (y - y_origin) + u_origin))) + slope
                    transmittance, raw = (
                        load(scratch.tape_transmittance, LANES * count), load(scratch.tape_alpha, LANES * count),
                    )  # fmt: skip
                    dL_dr, dL_dg, dL_db = load(scratch.red, at), load(scratch.green, at), load(scratch.blue, at)
                    a = minimum(raw, alpha_max)
                    suffix = load(scratch.suffix, at)
                    # v_k - B_{k+1}; B_k = B_{k+1} + a_k (v_k - B_{k+1})
                    gain = red * dL_dr + green * dL_dg + blue * dL_db + load(scratch.dL_dopacity, at) - suffix
                    store(scratch.suffix, at, suffix + a * gain)
                    weight = transmittance * a
                    s_r, s_g, s_b = s_r + weight * dL_dr, s_g + weight * dL_dg, s_b + weight * dL_db
                    h = select(raw <= alpha_max, transmittance * gain * raw, zeros)  # a capped alpha does not move
                    hu, hv = h * u, h * v
                    s_1, s_u, s_v = s_1 + h, s_u + hu, s_v + hv
                    s_uu, s_uv, s_vv = s_uu + hu * u, s_uv + hu * v, s_vv + hv * v
                _add_part(parts, entry, 0, s_u)
                _add_part(parts, entry, 1, s_v)
                _add_part(parts, entry, 2, s_uu)
                _add_part(parts, entry, 3, s_uv)
                _add_part(parts, entry, 4, s_vv)
                _add_part(parts, entry, 5, s_1)
                _add_part(parts, entry, 6, s_r)
                _add_part(parts, entry, 7, s_g)
                _add_part(parts, entry, 8, s_b)
    return hits


@kernel
def gather_parts(bins, parts, form, opacities, grad_form, grad_opacities, grad_colours):
    """Adds up what the tiles left for each Gaussian and turns it into gradients.

    With h = a dL/da at a pixel, dL/du = -h u and dL/dv = -h v; u and v are linear in the form's numbers,
    and the offsets from the mean that multiply them are dy = v / k and dx = (u - s dy) / p.

    Args:
        bins: see Bins.
        parts: (entries, PARTS), of `traverse`.
        form: (N, 5) float64, see Projection.
        opacities: (N,).
        grad_form, grad_opacities, grad_colours: (N, 5) float64, (N,), (N, 3) results.
    """
    order, start, position = bins.order, bins.entry_start, bins.position
    sums = np.zeros(PARTS)
    for place in range(len(order)):
        i = order[place]
        sums[:] = 0.0
        for entry in range(start[place], start[place + 1]):
            for j in range(PARTS):
                sums[j] += parts[position[entry], j]
        p, s, k = form[i, 0], form[i, 1], form[i, 2]
        grad_form[i, 0] = -(sums[2] - s / k * sums[3]) / p
        grad_form[i, 1] = -sums[3] / k
        grad_form[i, 2] = -sums[4] / k
        grad_form[i, 3] = p * sums[0]
        grad_form[i, 4] = s * sums[0] + k * sums[1]
        grad_opacities[i] = sums[5] / opacities[i] if start[place + 1] > start[place] else 0.0
        for j in range(3):
            grad_colours[i, j] = sums[6 + j]
