"""Numba kernel that gathers what is on the tape into gradients, billboard by billboard: the adjoint of sampling.

Every gradient has one writer and a fixed order of summation: results do not depend on threads or timing.
"""

from collections import namedtuple
from typing import Any, NamedTuple

import numpy as np

from nbavatar.jit.compile import inlined, kernel
from nbavatar.jit.lane_memory import load, masked_load, masked_store, store
from nbavatar.jit.lanes import (
    LANES,
    any_lane,
    broadcast,
    count_trailing_zeros,
    first_lanes,
    mask_bits,
    select,
    sum_lanes,
    to_real,
    transpose,
)
from nbavatar.jit.memory import advance, fetch_add, get, pointer, pointers, prefetch, put
from nbavatar.rendering.billboards.cpu_intersection import (
    broadcast_constants,
    corners,
    first_texels,
    footprint,
    intersect,
    mix,
    patch_of,
    plane_slopes,
    slopes,
)
from nbavatar.rendering.billboards.cpu_scratch import COLUMN, ROW, layout_of, whole_vectors
from nbavatar.rendering.binning import RECORD, TILE_HEIGHT, TILE_WIDTH
from nbavatar.rendering.scratch import Buffer

__all__ = ["GATHER_BUFFERS", "GatherScratch", "Gradients", "Part", "gather_gradients", "interleave"]

_AHEAD = 8192  # numbers of the next billboard's textures that are asked for in advance
_AHEAD_TAPE = 8  # bundles of the next tile's tape likewise

GATHER_BUFFERS = (
    # of a bundle: one vector for each of the four texels about its hits
    # the texel's bilinear weight times that of the hit, and then times the adjoint of the hit's alpha sample
    Buffer("corner_weight", None, lambda n: 8 * LANES),
    Buffer("product", None, lambda n: 4 * LANES),  # adjoint of the pixel's colour times the texel's features
    Buffer("texel", None, lambda n: LANES),  # numbers of the first texels, as floating-point numbers
    # of the current billboard
    Buffer("dL_dalpha", None, lambda n: n.texels**2),
    # whole vectors a texel, of the texture's channels only; the size counts all of the image's
    Buffer("dL_dfeature", None, lambda n: n.texels**2 * n.stride),
    Buffer("dL_duniform", None, lambda n: n.stride),  # of all channels; the texture's own are not read
)
GatherScratch = namedtuple("GatherScratch", [buffer.name for buffer in GATHER_BUFFERS])


class Part(NamedTuple):
    """What one call of `gather_gradients` is about."""

    chunk: Any  # billboards that a worker takes at a time
    first_tile: Any
    end_tile: Any
    bands: Any  # in which each tile was worked on
    fresh: Any  # whether the gradients are still uninitialised memory


class Gradients(NamedTuple):
    """Results: like the textures, flat; (F, 3, 3) and (F,) float64.

    Of the uniform channels' rows only those channels mean anything.
    """

    features: Any
    alpha: Any
    uniform: Any
    plane: Any
    fade: Any


@inlined
def _plane(planes, channel, channels, pixels, pixel, mask):
    """Pixels of a channel; 0 where there is none."""
    return masked_load(
        planes, min(channel, channels - 1) * pixels + pixel, mask if channel < channels else first_lanes(0)
    )


@kernel
def interleave(counter, chunk, planes_, rows_, channels, pixels):
    """Turns images of one channel each into rows of one pixel each, filled up with zeros to whole vectors.

    Args:
        counter: (1,) int64, next of the pixels, shared by all workers; `chunk`, whole vectors, are taken at a time.
        planes: (channels, pixels) flat; rows: (pixels, stride) flat, the result.
    """
    planes, rows = pointer(planes_, 0), pointer(rows_, 0)
    stride = whole_vectors(channels)
    while True:
        begin = fetch_add(counter, chunk)
        if begin >= pixels:
            break
        for pixel in range(begin, min(begin + chunk, pixels), LANES):
            mask = first_lanes(pixels - pixel)
            for c in range(0, channels, LANES):
                columns = transpose((
                    _plane(planes, c, channels, pixels, pixel, mask),
                    _plane(planes, c + 1, channels, pixels, pixel, mask),
                    _plane(planes, c + 2, channels, pixels, pixel, mask),
                    _plane(planes, c + 3, channels, pixels, pixel, mask),
                    _plane(planes, c + 4, channels, pixels, pixel, mask),
                    _plane(planes, c + 5, channels, pixels, pixel, mask),
                    _plane(planes, c + 6, channels, pixels, pixel, mask),
                    _plane(planes, c + 7, channels, pixels, pixel, mask),
                ))  # fmt: skip
                for lane in range(min(LANES, pixels - pixel)):
                    store(rows, (pixel + lane) * stride + c, columns[lane])


@inlined
def _add(totals, at, value):
    store(totals, at, load(totals, at) + value)


@inlined
def _add_hits(word, scratch, adjoints, width, pixels, features, uniform, layout, zero):
    """Adds the hits of a bundle with a bit in `word` to the textures' gradients, one after the other.

    Args:
        adjoints: of the image's rows from the tile's first pixel on; width: of the image; pixels: the hits' places in
            the tile.
        scratch: `corner_weight`, `texel` given, `product` and the gradients are results.
        features, uniform: pointers to the billboard's.
    """
    channels, stride, right, below = layout.channels, layout.stride, layout.step, layout.step * layout.texels
    kept = whole_vectors(channels)
    alpha, product = scratch.dL_dalpha, scratch.product
    while word != 0:
        lane = count_trailing_zeros(word)
        word &= word - 1
        texel = np.int64(get(scratch.texel, lane))
        # one after the other: of a single-texel texture all four are the same place
        weight = advance(scratch.corner_weight, 4 * LANES + lane)
        put(alpha, texel, get(alpha, texel) + get(weight, 0))
        put(alpha, texel + right, get(alpha, texel + right) + get(weight, LANES))
        put(alpha, texel + below, get(alpha, texel + below) + get(weight, 2 * LANES))
        put(alpha, texel + below + right, get(alpha, texel + below + right) + get(weight, 3 * LANES))
        weight = advance(scratch.corner_weight, lane)
        w00, w01 = broadcast(get(weight, 0)), broadcast(get(weight, LANES))
        w10, w11 = broadcast(get(weight, 2 * LANES)), broadcast(get(weight, 3 * LANES))
        d00, d01, d10, d11 = broadcast(zero), broadcast(zero), broadcast(zero), broadcast(zero)
        source, totals = advance(features, texel * channels), advance(scratch.dL_dfeature, texel * kept)
        pixel = np.int64(get(pixels, lane))
        row = advance(adjoints, ((pixel >> ROW) * width + (pixel & COLUMN)) * stride)
        for c in range(0, channels, LANES):
            used = first_lanes(channels - c)
            dL_dcolour = load(row, c)
            d00 = d00 + dL_dcolour * masked_load(source, c, used)
            d01 = d01 + dL_dcolour * masked_load(source, right * channels + c, used)
            d10 = d10 + dL_dcolour * masked_load(source, below * channels + c, used)
            d11 = d11 + dL_dcolour * masked_load(source, (below + right) * channels + c, used)
            _add(totals, c, dL_dcolour * w00)
            _add(totals, right * kept + c, dL_dcolour * w01)
            _add(totals, below * kept + c, dL_dcolour * w10)
            _add(totals, (below + right) * kept + c, dL_dcolour * w11)
        if layout.image_channels > channels:
            inside, same = (w00 + w01) + (w10 + w11), broadcast(zero)
            for c in range(channels // LANES * LANES, layout.image_channels, LANES):
                dL_dcolour = load(row, c)
                same = same + dL_dcolour * load(uniform, c)
                _add(scratch.dL_duniform, c, dL_dcolour * inside)
            d00, d01, d10, d11 = d00 + same, d01 + same, d10 + same, d11 + same
        put(product, lane, sum_lanes(d00))
        put(product, LANES + lane, sum_lanes(d01))
        put(product, 2 * LANES + lane, sum_lanes(d10))
        put(product, 3 * LANES + lane, sum_lanes(d11))


@inlined
def _hand_over(scratch, features, alpha, uniform, layout, fresh):
    """Copies a billboard's sums to the results, or adds them."""
    channels, kept = layout.channels, whole_vectors(layout.channels)
    for texel in range(layout.texels * layout.texels):
        for c in range(0, channels, LANES):
            used = first_lanes(channels - c)
            value = load(scratch.dL_dfeature, texel * kept + c)
            if not fresh:
                value = value + masked_load(features, texel * channels + c, used)
            masked_store(features, texel * channels + c, value, used)
        value = get(scratch.dL_dalpha, texel)
        put(alpha, texel, value if fresh else get(alpha, texel) + value)
    if layout.image_channels > channels:
        for c in range(0, layout.stride, LANES):
            value = load(scratch.dL_duniform, c)
            store(uniform, c, value if fresh else load(uniform, c) + value)


@kernel
def gather_gradients(counter, part, bins, textures_, constants, shape, adjoints_, tape_, gradients_, scratch_):
    """Gathers the hits on the tape of tiles `first_tile ... end_tile`.

    Args:
        counter: (1,) int64, next of the billboards, shared by all workers.
        part, gradients: see above; scratch: `GatherScratch`.
        bins: see Bins.
        textures, shape, adjoints, tape: see `cpu_scratch`; constants: see `cpu_intersection`.
    """
    texels, width, across = shape.texels, shape.width, shape.across
    order, box, entry_start, entry_tile, position = (
        bins.order, bins.box, bins.entry_start, bins.entry_tile, bins.position,
    )  # fmt: skip
    record, textures, tape, scratch = pointers(bins).record, pointers(textures_), pointers(tape_), pointers(scratch_)
    adjoints, gradients = pointers(adjoints_).features, pointers(gradients_)
    grad_plane, grad_fade = gradients_.plane, gradients_.fade
    tile_bundle = tape_.tile_bundle
    lanes = broadcast_constants(constants)
    zero, zeros = constants.zero, lanes.zero
    layout = layout_of(shape)
    area, step, size = texels * texels, layout.step, textures_.alpha.itemsize
    scale = 0.5 * (texels - 1) if texels > 1 else 1.0
    middle = broadcast(zero + np.float32(0.5 * (texels - 1)))  # of a texture: where its plane's coordinates are 0
    for j in range(4 * LANES):  # lanes without a hit are read as well
        put(scratch.product, j, zero)
    while True:
        begin = fetch_add(counter, part.chunk)
        if begin >= len(order):
            break
        for place in range(begin, min(begin + part.chunk, len(order))):
            i = np.int64(order[place])
            used = False
            x_origin, y_origin = (box[i, 0] + box[i, 2]) // 2, (box[i, 1] + box[i, 3]) // 2
            patch = patch_of(advance(record, i * RECORD))
            s_x, s_y, s_1, t_x, t_y, t_1, w_x, w_y, w_1, dL_dfade = (
                zeros, zeros, zeros, zeros, zeros, zeros, zeros, zeros, zeros, zeros,
            )  # fmt: skip
            if place + 1 < len(order) and entry_start[place + 1] < entry_start[place + 2]:
                # the next billboard's texture comes while this one is worked on
                following = np.int64(order[place + 1]) * area
                for j in range(0, min(area * shape.channels, _AHEAD), 64 // size):
                    prefetch(textures.features, following * shape.channels + j)
                for j in range(0, min(area, _AHEAD), 64 // size):
                    prefetch(textures.alpha, following + j)
            for entry in range(entry_start[place], entry_start[place + 1]):
                tile = entry_tile[entry]
                if tile < part.first_tile or tile >= part.end_tile:
                    continue
                taped = tile_bundle[tile] - tape.first
                left, top = tile % across * TILE_WIDTH, tile // across * TILE_HEIGHT
                tile_adjoints = advance(adjoints, (np.int64(top) * width + left) * layout.stride)
                if entry + 1 < entry_start[place + 1]:  # and the tape of the next tile
                    at = get(tape.ranges, 2 * position[entry + 1]) + tile_bundle[entry_tile[entry + 1]] - tape.first
                    for j in range(0, _AHEAD_TAPE * 2 * LANES, 64 // size):
                        prefetch(tape.values, 2 * LANES * at + j)
                for band in range(part.bands):
                    at = 2 * (band * len(position) + position[entry])
                    for bundle in range(taped + get(tape.ranges, at), taped + get(tape.ranges, at + 1)):
                        values = advance(tape.values, 2 * LANES * bundle)
                        weight, dL_da = load(values, 0), load(values, LANES)
                        hit_mask = (weight > zeros) | (dL_da > zeros) | (dL_da < zeros)
                        if not any_lane(hit_mask):
                            continue
                        if not used:
                            used = True
                            for j in range(area):
                                put(scratch.dL_dalpha, j, zero)
                            for j in range(area * whole_vectors(shape.channels)):
                                put(scratch.dL_dfeature, j, zero)
                            for j in range(layout.stride):
                                put(scratch.dL_duniform, j, zero)
                        pixel = load(tape.pixels, LANES * bundle)
                        dx = to_real((pixel & broadcast(np.int32(COLUMN))) + broadcast(np.int32(left - x_origin)), zero)
                        dy = to_real((pixel >> broadcast(np.int32(ROW))) + broadcast(np.int32(top - y_origin)), zero)
                        s, t, p, _ = intersect(patch, dx, dy, lanes)
                        foot = footprint(s, t, lanes)
                        x0_slope, x1_slope = slopes(s, foot.column, lanes.step, zeros, lanes.one)
                        y0_slope, y1_slope = slopes(t, foot.row, lanes.step, zeros, lanes.one)
                        t00, t01, t10, t11 = corners(
                            advance(textures.alpha, i * area), first_texels(foot, texels), step, step * texels
                        )
                        sample = mix(t00, t01, t10, t11, foot.x0, foot.x1, foot.y0, foot.y1)
                        moves = hit_mask & (patch.fade * sample <= lanes.alpha_max)  # a capped alpha does not
                        dL_da = select(moves, dL_da, zeros)
                        dL_dfade = dL_dfade + dL_da * sample
                        dL_dsample = dL_da * patch.fade
                        dL_ds = dL_dsample * mix(t00, t01, t10, t11, x0_slope, x1_slope, foot.y0, foot.y1)
                        dL_dt = dL_dsample * mix(t00, t01, t10, t11, foot.x0, foot.x1, y0_slope, y1_slope)
                        for j, factor in enumerate((weight, dL_dsample)):
                            target = advance(scratch.corner_weight, 4 * LANES * j)
                            store(target, 0, factor * foot.y0 * foot.x0)
                            store(target, LANES, factor * foot.y0 * foot.x1)
                            store(target, 2 * LANES, factor * foot.y1 * foot.x0)
                            store(target, 3 * LANES, factor * foot.y1 * foot.x1)
                        store(scratch.texel, 0, foot.row * broadcast(zero + np.float32(texels)) + foot.column)
                        _add_hits(
                            mask_bits(hit_mask), scratch, tile_adjoints, width, advance(tape.pixels, LANES * bundle),
                            advance(textures.features, i * area * shape.channels),
                            advance(textures.uniform, i * layout.stride), layout, zero,
                        )  # fmt: skip
                        d00, d01 = load(scratch.product, 0), load(scratch.product, LANES)
                        d10, d11 = load(scratch.product, 2 * LANES), load(scratch.product, 3 * LANES)
                        dL_ds = dL_ds + weight * mix(d00, d01, d10, d11, x0_slope, x1_slope, foot.y0, foot.y1)
                        dL_dt = dL_dt + weight * mix(d00, d01, d10, d11, foot.x0, foot.x1, y0_slope, y1_slope)
                        dL_dps, dL_dpt, dL_dpw = plane_slopes(
                            select(hit_mask, dL_ds, zeros), select(hit_mask, dL_dt, zeros), s - middle, t - middle, p
                        )
                        s_x, s_y, s_1 = s_x + dL_dps * dx, s_y + dL_dps * dy, s_1 + dL_dps
                        t_x, t_y, t_1 = t_x + dL_dpt * dx, t_y + dL_dpt * dy, t_1 + dL_dpt
                        w_x, w_y, w_1 = w_x + dL_dpw * dx, w_y + dL_dpw * dy, w_1 + dL_dpw
            grad_features = advance(gradients.features, i * area * shape.channels)
            grad_alpha = advance(gradients.alpha, i * area)
            grad_uniform = advance(gradients.uniform, i * layout.stride)
            if part.fresh:
                for j in range(9):
                    grad_plane[i, j // 3, j % 3] = 0.0
                grad_fade[i] = 0.0
            if used:
                _hand_over(scratch, grad_features, grad_alpha, grad_uniform, layout, part.fresh)
            elif part.fresh:
                for j in range(area * shape.channels):
                    put(grad_features, j, zero)
                for j in range(area):
                    put(grad_alpha, j, zero)
                if layout.image_channels > shape.channels:
                    for j in range(layout.stride):
                        put(grad_uniform, j, zero)
            if not used:
                continue
            # from texel coordinates about the record's origin to texture coordinates about the image's
            ox, oy = x_origin + 0.5, y_origin + 0.5
            s_x1, s_y1, s_11 = np.float64(sum_lanes(s_x)), np.float64(sum_lanes(s_y)), np.float64(sum_lanes(s_1))
            t_x1, t_y1, t_11 = np.float64(sum_lanes(t_x)), np.float64(sum_lanes(t_y)), np.float64(sum_lanes(t_1))
            w_x1, w_y1, w_11 = np.float64(sum_lanes(w_x)), np.float64(sum_lanes(w_y)), np.float64(sum_lanes(w_1))
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
            grad_fade[i] += np.float64(sum_lanes(dL_dfade))
