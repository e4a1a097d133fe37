"""Numba kernels of the Gaussian rasterizer for the CPU: eight pixels of a row at a time.

All pixels of a tile take its Gaussians in the same order, so a hit is blended into eight pixels by
a dozen vector instructions. Which columns of a row a Gaussian reaches follows in closed form from its
record (`projection.py`); what lies off that span costs nothing.

The backward pass repeats the forward one, notes the transmittance and alpha of every hit, and walks
the notes from back to front, which needs no division by a transmittance. A Gaussian's share in a tile is
nine sums over its pixels, in its own coordinates u and v; each is written once, by the tile, and a second
kernel adds those of a Gaussian up in a fixed order. Results do not depend on threads or timing.
"""

import numpy as np

from nbavatar.jit.compile import inlined, kernel
from nbavatar.jit.lanes import (
    LANES,
    bits,
    choose,
    count_bits,
    first_lanes,
    load,
    minimum,
    ramp,
    spread,
    store,
    total,
)  # fmt: skip
from nbavatar.jit.memory import fetch_add, get, pointer, put
from nbavatar.rendering.binning import RECORD, TILE_WIDTH, tile_bounds
from nbavatar.rendering.gaussians.lanes import falloff

__all__ = ["CHUNKS", "PARTS", "gather_parts", "traverse"]

CHUNKS = TILE_WIDTH // LANES  # of a row of a tile, at most
PARTS = 9  # sums that a tile leaves for a Gaussian
_SLACK = 0.01  # pixels by which spans are widened; an alpha decides by itself


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


@kernel
def traverse(turn, tiles, start, members_, record_, box, colours_, limits_, shape, image, alpha, grads, parts_, real_,
             whole_, status):  # fmt: skip
    """Works through tiles until none is left: blends them, or leaves the sums that `gather_parts` needs.

    Args:
        turn: (1,) int64, next position in `tiles`, shared by all workers.
        tiles: (n,) int32, in the order in which to take them.
        start, members, record, box: see Bins; `record` flat.
        colours: (N, 3) flat.
        limits: zero, one, alpha_min, alpha_max, t_min, in the dtype of the image.
        shape: width, height, tiles across, rows worked on at once, replay.
        image, alpha: (3, H, W), (H, W) results; not written in the replay.
        grads: (4, H, W), gradients of colour and alpha; used in the replay.
        parts: (entries, PARTS) flat, by position in the tiles' lists; written in the replay.
        real, whole: scratch of this worker.
        status: [hits blended].
    """
    width, height, across, rows, replay = shape[0], shape[1], shape[2], shape[3], shape[4] != 0
    members, record, colours, limits = (
        pointer(members_, 0), pointer(record_, 0), pointer(colours_, 0), pointer(limits_, 0),
    )  # fmt: skip
    parts, real, whole = pointer(parts_, 0), pointer(real_, 0), pointer(whole_, 0)
    zero, one, t_min = get(limits, 0), get(limits, 1), get(limits, 4)
    least, most, stop = spread(get(limits, 2)), spread(get(limits, 3)), spread(t_min)
    nothing, unit, steps = spread(zero), spread(one), ramp(zero)
    # Scratch: transmittance (negative once finished), three sums of colour or four gradients, what lies
    # behind, each with room for a vector that starts on the last pixel; then the replay's notes.
    band = TILE_WIDTH * rows + LANES
    red, green, blue, cover, behind, notes = band, 2 * band, 3 * band, 4 * band, 5 * band, 6 * band
    hits = 0
    while True:
        position = fetch_add(turn, 1)
        if position >= len(tiles):
            break
        tile = tiles[position]
        left, tile_top, right, tile_bottom = tile_bounds(tile, across, width, height)
        if replay:
            for i in range(PARTS * start[tile], PARTS * start[tile + 1]):
                put(parts, i, zero)
        for top in range(tile_top, tile_bottom, rows):
            bottom = min(top + rows, tile_bottom)
            for i in range(notes):
                put(real, i, zero)
            for y in range(top, bottom):
                for x in range(left, right):
                    put(real, (y - top) * TILE_WIDTH + x - left, one)
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
                opacity = spread(zero + type(zero)(get(record, r + 10)))
                slope = spread(type(zero)(p)) * steps
                r_, g_, b_ = (
                    spread(get(colours, 3 * i)), spread(get(colours, 3 * i + 1)), spread(get(colours, 3 * i + 2)),
                )  # fmt: skip
                for y in range(y_first, y_end):
                    v = k * (y - y_origin) + v_origin
                    rest = reach * reach - v * v
                    if rest < 0.0:
                        continue
                    u_row = s * (y - y_origin) + u_origin
                    x_from, x_to = _span(wide, -u_row * wide, rest, x_first, x_end, x_origin)
                    vv = spread(type(zero)(v * v))
                    for x in range(x_from, x_to, LANES):
                        u = spread(type(zero)(p * (x - x_origin) + u_row)) + slope
                        raw = opacity * falloff(u * u + vv)
                        at = (y - top) * TILE_WIDTH + x - left
                        through = load(real, at)
                        hit = first_lanes(x_to - x) & (raw >= least) & (through > nothing)
                        a = minimum(raw, most)
                        after = through * (unit - a)
                        blended = hit & (after >= stop)
                        word = bits(blended)
                        finished = bits(hit) ^ word
                        store(real, at, choose(hit, choose(blended, after, nothing - through), through))
                        if finished != 0:
                            active -= count_bits(finished)
                        if word == 0:
                            continue
                        if replay:
                            hits += count_bits(word)
                            note = notes + 2 * LANES * count
                            store(real, note, through)
                            store(real, note + LANES, choose(blended, raw, nothing))
                            put(whole, 2 * count, entry)
                            put(whole, 2 * count + 1, at)
                            count += 1
                        else:
                            w = choose(blended, through * a, nothing)
                            store(real, red + at, load(real, red + at) + w * r_)
                            store(real, green + at, load(real, green + at) + w * g_)
                            store(real, blue + at, load(real, blue + at) + w * b_)
                if active == 0:
                    break
            if not replay:
                for y in range(top, bottom):
                    for x in range(left, right):
                        at = (y - top) * TILE_WIDTH + x - left
                        image[0, y, x] = get(real, red + at)
                        image[1, y, x] = get(real, green + at)
                        image[2, y, x] = get(real, blue + at)
                        alpha[y, x] = one - abs(get(real, at))
                continue
            for y in range(top, bottom):
                for x in range(left, right):
                    at = (y - top) * TILE_WIDTH + x - left
                    put(real, red + at, grads[0, y, x])
                    put(real, green + at, grads[1, y, x])
                    put(real, blue + at, grads[2, y, x])
                    put(real, cover + at, grads[3, y, x])
            while count > 0:
                entry = get(whole, 2 * count - 2)
                i = get(members, entry)
                r = i * RECORD
                x_origin, y_origin = (box[i, 0] + box[i, 2]) // 2, (box[i, 1] + box[i, 3]) // 2
                p, s, u_origin = get(record, r), get(record, r + 1), get(record, r + 2)
                k, v_origin = get(record, r + 4), get(record, r + 5)
                slope = spread(type(zero)(p)) * steps
                r_, g_, b_ = (
                    spread(get(colours, 3 * i)), spread(get(colours, 3 * i + 1)), spread(get(colours, 3 * i + 2)),
                )  # fmt: skip
                s_u, s_v, s_uu, s_uv, s_vv = nothing, nothing, nothing, nothing, nothing
                s_1, s_r, s_g, s_b = nothing, nothing, nothing, nothing
                while count > 0 and get(whole, 2 * count - 2) == entry:
                    count -= 1
                    at = get(whole, 2 * count + 1)
                    y, x = top + at // TILE_WIDTH, left + at % TILE_WIDTH
                    v = spread(type(zero)(k * (y - y_origin) + v_origin))
                    u = spread(type(zero)(p * (x - x_origin) + (s * (y - y_origin) + u_origin))) + slope
                    note = notes + 2 * LANES * count
                    through, raw = load(real, note), load(real, note + LANES)
                    by_r, by_g, by_b = load(real, red + at), load(real, green + at), load(real, blue + at)
                    a = minimum(raw, most)
                    after = load(real, behind + at)
                    gain = r_ * by_r + g_ * by_g + b_ * by_b + load(real, cover + at) - after
                    store(real, behind + at, after + a * gain)
                    w = through * a
                    s_r, s_g, s_b = s_r + w * by_r, s_g + w * by_g, s_b + w * by_b
                    h = choose(raw <= most, through * gain * raw, nothing)  # a capped alpha does not move
                    hu, hv = h * u, h * v
                    s_1, s_u, s_v = s_1 + h, s_u + hu, s_v + hv
                    s_uu, s_uv, s_vv = s_uu + hu * u, s_uv + hu * v, s_vv + hv * v
                spot = PARTS * np.int64(entry)
                put(parts, spot, get(parts, spot) + total(s_u))
                put(parts, spot + 1, get(parts, spot + 1) + total(s_v))
                put(parts, spot + 2, get(parts, spot + 2) + total(s_uu))
                put(parts, spot + 3, get(parts, spot + 3) + total(s_uv))
                put(parts, spot + 4, get(parts, spot + 4) + total(s_vv))
                put(parts, spot + 5, get(parts, spot + 5) + total(s_1))
                put(parts, spot + 6, get(parts, spot + 6) + total(s_r))
                put(parts, spot + 7, get(parts, spot + 7) + total(s_g))
                put(parts, spot + 8, get(parts, spot + 8) + total(s_b))
    status[0] = hits


@kernel
def gather_parts(sequence, first, where, parts, form, opacities, grad_form, grad_opacities, grad_colours):
    """Adds up what the tiles left for each Gaussian and turns it into gradients.

    With h = a dL/da at a pixel, dL/du = -h u and dL/dv = -h v; u and v are linear in the form's numbers,
    and the offsets from the mean that multiply them are dy = v / k and dx = (u - s dy) / p.

    Args:
        sequence, first, where: see Bins.
        parts: (entries, PARTS), of `traverse`.
        form: (N, 5) float64, see Projection.
        opacities: (N,).
        grad_form, grad_opacities, grad_colours: (N, 5) float64, (N,), (N, 3) results.
    """
    sums = np.zeros(PARTS)
    for rank in range(len(sequence)):
        i = sequence[rank]
        sums[:] = 0.0
        for entry in range(first[rank], first[rank + 1]):
            for j in range(PARTS):
                sums[j] += parts[where[entry], j]
        p, s, k = form[i, 0], form[i, 1], form[i, 2]
        grad_form[i, 0] = -(sums[2] - s / k * sums[3]) / p
        grad_form[i, 1] = -sums[3] / k
        grad_form[i, 2] = -sums[4] / k
        grad_form[i, 3] = p * sums[0]
        grad_form[i, 4] = s * sums[0] + k * sums[1]
        grad_opacities[i] = sums[5] / opacities[i] if first[rank + 1] > first[rank] else 0.0
        for j in range(3):
            grad_colours[i, j] = sums[6 + j]
