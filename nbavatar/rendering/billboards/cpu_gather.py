"""Numba kernel that gathers the noted hits into gradients, billboard by billboard.

Every gradient has one writer and a fixed order of summation: results do not depend on threads or timing.
"""

import numpy as np

from nbavatar.jit.compile import inlined, kernel
from nbavatar.jit.lanes import (
    LANES,
    any_lane,
    bits,
    choose,
    count_trailing_zeros,
    first_lanes,
    load,
    load_where,
    spread,
    store,
    store_where,
    to_real,
    total,
    transpose,
)  # fmt: skip
from nbavatar.jit.memory import ahead, fetch_add, get, pointer, prefetch, put
from nbavatar.rendering.billboards.cpu_hits import (
    cells,
    corners,
    footprint,
    intersect,
    mix,
    patch_of,
    plane_slopes,
    read_limits,
    slopes,
    spread_limits,
)  # fmt: skip
from nbavatar.rendering.billboards.cpu_scratch import COLUMN, ROW
from nbavatar.rendering.binning import RECORD, TILE_HEIGHT, TILE_WIDTH

__all__ = ["gather_gradients", "interleave", "scratch_size"]

_AHEAD = 8192  # numbers of the next billboard's textures that are asked for in advance
_NOTES = 8  # bundles of the next tile's notes likewise


def scratch_size(texels: int, channels: int) -> int:
    """Numbers that a worker needs."""
    return texels * texels * (LANES + -(-channels // LANES) * LANES) + 16 * LANES


@inlined
def _plane(planes, channel, channels, pixels, pixel, here):
    """Pixels of a channel; 0 where there is none."""
    none = first_lanes(0)
    return load_where(planes, min(channel, channels - 1) * pixels + pixel, here if channel < channels else none)


@kernel
def interleave(turn, chunk, planes_, rows_, channels, pixels):
    """Turns images of one channel each into rows of one pixel each, filled up with zeros to whole vectors.

    Args:
        turn: (1,) int64, next of the pixels, shared by all workers; `chunk`, whole vectors, are taken at a time.
        planes: (channels, pixels) flat; rows: (pixels, stride) flat, the result.
    """
    planes, rows = pointer(planes_, 0), pointer(rows_, 0)
    stride = (channels + LANES - 1) // LANES * LANES
    while True:
        begin = fetch_add(turn, chunk)
        if begin >= pixels:
            break
        for pixel in range(begin, min(begin + chunk, pixels), LANES):
            here = first_lanes(pixels - pixel)
            for c in range(0, channels, LANES):
                columns = transpose((
                    _plane(planes, c, channels, pixels, pixel, here),
                    _plane(planes, c + 1, channels, pixels, pixel, here),
                    _plane(planes, c + 2, channels, pixels, pixel, here),
                    _plane(planes, c + 3, channels, pixels, pixel, here),
                    _plane(planes, c + 4, channels, pixels, pixel, here),
                    _plane(planes, c + 5, channels, pixels, pixel, here),
                    _plane(planes, c + 6, channels, pixels, pixel, here),
                    _plane(planes, c + 7, channels, pixels, pixel, here),
                ))  # fmt: skip
                for lane in range(min(LANES, pixels - pixel)):
                    store(rows, (pixel + lane) * stride + c, columns[lane])


@inlined
def _add(totals, at, value):
    store(totals, at, load(totals, at) + value)


@inlined
def _texels(word, k, grads, width, spots, features, totals, alphas, channels, stride, right, below, zero):
    """Adds the hits with a bit in `word` to the texels' gradients, one after the other.

    Args:
        grads: gradients of the image's rows from the tile's first pixel on; spots: the hits' places in the tile.
        k: rows of LANES numbers: weights of features (0-3) and of alpha (4-7) at the four texels; results: the
            gradients' products with the four texels' features (8-11); `cell` (12): first texels, as numbers.
        totals, alphas: gradients of this billboard's features, `stride` a texel, and alpha.
    """
    while word != 0:
        lane = count_trailing_zeros(word)
        word &= word - 1
        cell = np.int64(get(k, 12 * LANES + lane))
        # one after the other: of a single-texel texture all four are the same place
        put(alphas, cell, get(alphas, cell) + get(k, 4 * LANES + lane))
        put(alphas, cell + right, get(alphas, cell + right) + get(k, 5 * LANES + lane))
        put(alphas, cell + below, get(alphas, cell + below) + get(k, 6 * LANES + lane))
        put(alphas, cell + below + right, get(alphas, cell + below + right) + get(k, 7 * LANES + lane))
        w00, w01 = spread(get(k, lane)), spread(get(k, LANES + lane))
        w10, w11 = spread(get(k, 2 * LANES + lane)), spread(get(k, 3 * LANES + lane))
        d00, d01, d10, d11 = spread(zero), spread(zero), spread(zero), spread(zero)
        texel, sums = ahead(features, cell * channels), ahead(totals, cell * stride)
        spot = np.int64(get(spots, lane))
        grads_here = ahead(grads, ((spot >> ROW) * width + (spot & COLUMN)) * stride)
        for c in range(0, channels, LANES):
            used = first_lanes(channels - c)
            grad = load(grads_here, c)
            d00 = d00 + grad * load_where(texel, c, used)
            d01 = d01 + grad * load_where(texel, right * channels + c, used)
            d10 = d10 + grad * load_where(texel, below * channels + c, used)
            d11 = d11 + grad * load_where(texel, (below + right) * channels + c, used)
            _add(sums, c, grad * w00)
            _add(sums, right * stride + c, grad * w01)
            _add(sums, below * stride + c, grad * w10)
            _add(sums, (below + right) * stride + c, grad * w11)
        put(k, 8 * LANES + lane, total(d00))
        put(k, 9 * LANES + lane, total(d01))
        put(k, 10 * LANES + lane, total(d10))
        put(k, 11 * LANES + lane, total(d11))


@inlined
def _hand_over(totals, alphas, grad_features, grad_alpha, area, channels, stride, fresh):
    """Copies a billboard's sums to the results, or adds them."""
    for texel in range(area):
        for c in range(0, channels, LANES):
            used = first_lanes(channels - c)
            value = load(totals, texel * stride + c)
            if not fresh:
                value = value + load_where(grad_features, texel * channels + c, used)
            store_where(grad_features, texel * channels + c, value, used)
        put(grad_alpha, texel, get(alphas, texel) if fresh else get(grad_alpha, texel) + get(alphas, texel))


@kernel
def gather_gradients(turn, chunk, first_tile, end_tile, bands, sequence, first, tile, where, ranges_, made, notes_,
                     spots_, base, record_, box, features_, alpha_, limits_, shape, grads_, fresh, grad_features_,
                     grad_alpha_, grad_plane, grad_fade, real):  # fmt: skip
    """Gathers the noted hits of tiles `first_tile ... end_tile`.

    Args:
        turn: (1,) int64, next of the billboards, shared by all workers; `chunk` are taken at a time.
        bands: in which each tile was worked on.
        sequence, first, tile, where, record, box: see Bins; `record` flat.
        ranges, made, notes, spots, base, features, alpha, limits, grads: see `blend_tiles`.
        shape: texels, channels, width, tiles across.
        fresh: whether the gradients are still uninitialised memory.
        grad_features, grad_alpha: like the textures, flat.
        grad_plane: (F, 3, 3) float64; `grad_fade`: (F,) float64.
        real: scratch of this worker; see `scratch_size`.
    """
    texels, channels, width, across = shape[0], shape[1], shape[2], shape[3]
    limits, record, features, alpha = (
        pointer(limits_, 0), pointer(record_, 0), pointer(features_, 0), pointer(alpha_, 0),
    )  # fmt: skip
    ranges, notes, spots, grads = pointer(ranges_, 0), pointer(notes_, 0), pointer(spots_, 0), pointer(grads_, 0)
    numbers = read_limits(limits)
    common = spread_limits(numbers)
    zero, step, none = numbers.zero, min(1, texels - 1), common.zero
    area, stride = texels * texels, (channels + LANES - 1) // LANES * LANES
    k, alphas = pointer(real, 0), pointer(real, 16 * LANES)
    totals = pointer(real, 16 * LANES + area * LANES)
    scale = 0.5 * (texels - 1) if texels > 1 else 1.0
    middle = spread(zero + np.float32(0.5 * (texels - 1)))  # of a texture: where its plane's coordinates are 0
    for j in range(16 * LANES):
        put(k, j, zero)
    while True:
        begin = fetch_add(turn, chunk)
        if begin >= len(sequence):
            break
        for order in range(begin, min(begin + chunk, len(sequence))):
            i = np.int64(sequence[order])
            used = False
            x_origin, y_origin = (box[i, 0] + box[i, 2]) // 2, (box[i, 1] + box[i, 3]) // 2
            patch = patch_of(ahead(record, i * RECORD))
            s_x, s_y, s_1, t_x, t_y, t_1, w_x, w_y, w_1, g_fade = (
                none, none, none, none, none, none, none, none, none, none,
            )  # fmt: skip
            if order + 1 < len(sequence) and first[order + 1] < first[order + 2]:
                # the next billboard's texture comes while this one is worked on
                following = np.int64(sequence[order + 1]) * area
                for j in range(0, min(area * channels, _AHEAD), 64 // alpha_.itemsize):
                    prefetch(features, following * channels + j)
                for j in range(0, min(area, _AHEAD), 64 // alpha_.itemsize):
                    prefetch(alpha, following + j)
            for entry in range(first[order], first[order + 1]):
                if tile[entry] < first_tile or tile[entry] >= end_tile:
                    continue
                noted = made[tile[entry]] - base
                left, top = tile[entry] % across * TILE_WIDTH, tile[entry] // across * TILE_HEIGHT
                there = ahead(grads, (np.int64(top) * width + left) * stride)
                if entry + 1 < first[order + 1]:  # and the notes of the next tile
                    at = get(ranges, 2 * where[entry + 1]) + made[tile[entry + 1]] - base
                    for j in range(0, _NOTES * 2 * LANES, 64 // alpha_.itemsize):
                        prefetch(notes, 2 * LANES * at + j)
                for band in range(bands):
                    at = 2 * (band * len(where) + where[entry])
                    for bundle in range(noted + get(ranges, at), noted + get(ranges, at + 1)):
                        share, by_a = load(notes, 2 * LANES * bundle), load(notes, 2 * LANES * bundle + LANES)
                        hit = (share > none) | (by_a > none) | (by_a < none)
                        if not any_lane(hit):
                            continue
                        if not used:
                            used = True
                            for j in range(area):
                                put(alphas, j, zero)
                            for j in range(area * stride):
                                put(totals, j, zero)
                        spot = load(spots, LANES * bundle)
                        dx = to_real((spot & spread(np.int32(COLUMN))) + spread(np.int32(left - x_origin)), zero)
                        dy = to_real((spot >> spread(np.int32(ROW))) + spread(np.int32(top - y_origin)), zero)
                        s, t, p, _ = intersect(patch, dx, dy, common)
                        foot = footprint(s, t, common)
                        cell = cells(foot, texels)
                        a0, a1 = slopes(s, foot.column, common.step, none, common.one)
                        b0, b1 = slopes(t, foot.row, common.step, none, common.one)
                        t00, t01, t10, t11 = corners(pointer(alpha_, i * area), cell, step, step * texels)
                        sample = mix(t00, t01, t10, t11, foot.x0, foot.x1, foot.y0, foot.y1)
                        moves = hit & (patch.fade * sample <= common.alpha_max)  # a capped alpha does not
                        by_a = choose(moves, by_a, none)
                        g_fade = g_fade + by_a * sample
                        by_a = by_a * patch.fade
                        by_s = by_a * mix(t00, t01, t10, t11, a0, a1, foot.y0, foot.y1)
                        by_t = by_a * mix(t00, t01, t10, t11, foot.x0, foot.x1, b0, b1)
                        for j, w in enumerate((share, by_a)):
                            at_row = 4 * LANES * j
                            store(k, at_row, w * foot.y0 * foot.x0)
                            store(k, at_row + LANES, w * foot.y0 * foot.x1)
                            store(k, at_row + 2 * LANES, w * foot.y1 * foot.x0)
                            store(k, at_row + 3 * LANES, w * foot.y1 * foot.x1)
                        store(k, 12 * LANES, foot.row * spread(zero + np.float32(texels)) + foot.column)
                        _texels(bits(hit), k, there, width, ahead(spots, LANES * bundle),
                                pointer(features_, i * area * channels), totals, alphas,
                                channels, stride, step, step * texels, zero)  # fmt: skip
                        d00, d01, d10, d11 = (
                            load(k, 8 * LANES), load(k, 9 * LANES), load(k, 10 * LANES), load(k, 11 * LANES),
                        )  # fmt: skip
                        by_s = by_s + share * mix(d00, d01, d10, d11, a0, a1, foot.y0, foot.y1)
                        by_t = by_t + share * mix(d00, d01, d10, d11, foot.x0, foot.x1, b0, b1)
                        gs, gt, gw = plane_slopes(
                            choose(hit, by_s, none), choose(hit, by_t, none), s - middle, t - middle, p
                        )
                        s_x, s_y, s_1 = s_x + gs * dx, s_y + gs * dy, s_1 + gs
                        t_x, t_y, t_1 = t_x + gt * dx, t_y + gt * dy, t_1 + gt
                        w_x, w_y, w_1 = w_x + gw * dx, w_y + gw * dy, w_1 + gw
            grad_features = pointer(grad_features_, i * area * channels)
            grad_alpha = pointer(grad_alpha_, i * area)
            if fresh:
                for j in range(9):
                    grad_plane[i, j // 3, j % 3] = 0.0
                grad_fade[i] = 0.0
            if used:
                _hand_over(totals, alphas, grad_features, grad_alpha, area, channels, stride, fresh)
            elif fresh:
                for j in range(area * channels):
                    put(grad_features, j, zero)
                for j in range(area):
                    put(grad_alpha, j, zero)
            if not used:
                continue
            # from texel coordinates about the record's origin to texture coordinates about the image's
            ox, oy = x_origin + 0.5, y_origin + 0.5
            s_x1, s_y1, s_11 = np.float64(total(s_x)), np.float64(total(s_y)), np.float64(total(s_1))
            t_x1, t_y1, t_11 = np.float64(total(t_x)), np.float64(total(t_y)), np.float64(total(t_1))
            w_x1, w_y1, w_11 = np.float64(total(w_x)), np.float64(total(w_y)), np.float64(total(w_1))
            s_x1, s_y1 = s_x1 + s_11 * ox, s_y1 + s_11 * oy
            t_x1, t_y1 = t_x1 + t_11 * ox, t_y1 + t_11 * oy
            w_x1, w_y1 = w_x1 + w_11 * ox, w_y1 + w_11 * oy
            grad_plane[i, 0, 0] += scale * s_x1
            grad_plane[i, 0, 1] += scale * s_y1
            grad_plane[i, 0, 2] += scale * s_11
            grad_plane[i, 1, 0] += scale * t_x1
            grad_plane[i, 1, 1] += scale * t_y1
            grad_plane[i, 1, 2] += scale * t_11
            grad_plane[i, 2, 0] += w_x1
            grad_plane[i, 2, 1] += w_y1
            grad_plane[i, 2, 2] += w_11
            grad_fade[i] += np.float64(total(g_fade))
