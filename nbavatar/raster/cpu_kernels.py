"""Numba kernels of the CPU rasterizer: blending tile by tile, gradients billboard by billboard.

Exact order without a full sort: a tile takes its billboards by the least depth that they reach.
Hits wait in a short queue per pixel, sorted by depth; those nearer than anything that the
billboards still to come can reach are final and are blended. A pixel that has become opaque
takes no more hits, and a tile whose pixels all have stops. With a queue of n hits, or none, the
same loop gives `kbuffer(n)` and `center`.

The backward pass repeats that loop, notes every blended hit (`replay`), walks each pixel's hits
from back to front, which needs no division by a transmittance, and leaves two numbers a hit.
A second kernel (`collect`) then gathers them billboard by billboard, so every gradient has one
writer and a fixed order of summation: results do not depend on threads or timing.
"""

import numpy as np

from nbavatar.raster import scalar
from nbavatar.raster.binning import RECORD, TILE_HEIGHT, TILE_WIDTH
from nbavatar.raster.compile import inlined, kernel
from nbavatar.raster.memory import fetch_add, get, move4, pointer, put
from nbavatar.raster.vector import (
    LANES,
    count_trailing_zeros,
    evaluate_row,
    make_blend,
    make_dot,
    make_scatter,
    make_slopes,
)

__all__ = ["PIXELS", "collect", "traverse"]

PIXELS = TILE_WIDTH * TILE_HEIGHT


@inlined
def _minimum(a, b):
    return a if a < b else b


@inlined
def _maximum(a, b):
    return a if a > b else b


@inlined
def _select(condition, yes, no):
    return yes if condition else no


_S = scalar.build(inlined, np.floor, _minimum, _maximum, _select)
first_texel, weights, slopes, mix, plane_slopes, affine = (
    _S.first_texel, _S.weights, _S.slopes, _S.mix, _S.plane_slopes, _S.affine,
)  # fmt: skip
_blend8, _blend4, _blend2, _blend1 = (make_blend(n) for n in (8, 4, 2, 1))
_dot8, _dot4, _dot2, _dot1 = (make_dot(n) for n in (8, 4, 2, 1))
_slopes8, _slopes4, _slopes2, _slopes1 = (make_slopes(n) for n in (8, 4, 2, 1))
_scatter8, _scatter4, _scatter2, _scatter1 = (make_scatter(n) for n in (8, 4, 2, 1))


@inlined
def _blend(sums, at, textures, i00, i01, i10, i11, w00, w01, w10, w11, channels):
    c = 0
    while c + 8 <= channels:
        _blend8(sums, at + c, textures, i00 + c, i01 + c, i10 + c, i11 + c, w00, w01, w10, w11)
        c += 8
    if channels & 4:
        _blend4(sums, at + c, textures, i00 + c, i01 + c, i10 + c, i11 + c, w00, w01, w10, w11)
        c += 4
    if channels & 2:
        _blend2(sums, at + c, textures, i00 + c, i01 + c, i10 + c, i11 + c, w00, w01, w10, w11)
        c += 2
    if channels & 1:
        _blend1(sums, at + c, textures, i00 + c, i01 + c, i10 + c, i11 + c, w00, w01, w10, w11)


@inlined
def _dot(grads, at, textures, i00, i01, i10, i11, w00, w01, w10, w11, channels, zero):
    total = zero
    c = 0
    while c + 8 <= channels:
        total += _dot8(grads, at + c, textures, i00 + c, i01 + c, i10 + c, i11 + c, w00, w01, w10, w11)
        c += 8
    if channels & 4:
        total += _dot4(grads, at + c, textures, i00 + c, i01 + c, i10 + c, i11 + c, w00, w01, w10, w11)
        c += 4
    if channels & 2:
        total += _dot2(grads, at + c, textures, i00 + c, i01 + c, i10 + c, i11 + c, w00, w01, w10, w11)
        c += 2
    if channels & 1:
        total += _dot1(grads, at + c, textures, i00 + c, i01 + c, i10 + c, i11 + c, w00, w01, w10, w11)
    return total


@inlined
def _slope(grads, at, textures, i00, i01, i10, i11, x0, x1, y0, y1, a, b, c, d, channels, zero):
    by_s, by_t = zero, zero
    k = 0
    while k + 8 <= channels:
        s, t = _slopes8(grads, at + k, textures, i00 + k, i01 + k, i10 + k, i11 + k, x0, x1, y0, y1, a, b, c, d)
        by_s, by_t = by_s + s, by_t + t
        k += 8
    if channels & 4:
        s, t = _slopes4(grads, at + k, textures, i00 + k, i01 + k, i10 + k, i11 + k, x0, x1, y0, y1, a, b, c, d)
        by_s, by_t = by_s + s, by_t + t
        k += 4
    if channels & 2:
        s, t = _slopes2(grads, at + k, textures, i00 + k, i01 + k, i10 + k, i11 + k, x0, x1, y0, y1, a, b, c, d)
        by_s, by_t = by_s + s, by_t + t
        k += 2
    if channels & 1:
        s, t = _slopes1(grads, at + k, textures, i00 + k, i01 + k, i10 + k, i11 + k, x0, x1, y0, y1, a, b, c, d)
        by_s, by_t = by_s + s, by_t + t
    return by_s, by_t


@inlined
def _scatter(totals, i00, i01, i10, i11, w00, w01, w10, w11, grads, at, channels):
    c = 0
    while c + 8 <= channels:
        _scatter8(totals, i00 + c, i01 + c, i10 + c, i11 + c, w00, w01, w10, w11, grads, at + c)
        c += 8
    if channels & 4:
        _scatter4(totals, i00 + c, i01 + c, i10 + c, i11 + c, w00, w01, w10, w11, grads, at + c)
        c += 4
    if channels & 2:
        _scatter2(totals, i00 + c, i01 + c, i10 + c, i11 + c, w00, w01, w10, w11, grads, at + c)
        c += 2
    if channels & 1:
        _scatter1(totals, i00 + c, i01 + c, i10 + c, i11 + c, w00, w01, w10, w11, grads, at + c)


@inlined
def _span(record, r, size, one, x_first, x_end, x_origin, dy):
    """Columns x_first ... x_end of a row narrowed to those that the patch may cover.

    Texel coordinates lie in (-1, size) where four affine functions are positive: s + w, size w - s and the
    same for t. A tenth of a pixel is added on both sides; coverage itself is decided pixel by pixel.
    """
    low, high = np.float64(x_first - x_origin), np.float64(x_end - 1 - x_origin)
    w_x, w_row = get(record, r + 6), get(record, r + 7) * dy + get(record, r + 8)
    for side in range(4):
        at = r + 3 * (side // 2)
        p_x, p_row = get(record, at), get(record, at + 1) * dy + get(record, at + 2)
        if side % 2 == 0:
            slope, value = p_x + w_x, p_row + w_row
        else:
            slope, value = size * w_x - p_x, size * w_row - p_row
        if slope > 0.0:
            low = max(low, -np.float64(value) / np.float64(slope) - 0.1)
        elif slope < 0.0:
            high = min(high, -np.float64(value) / np.float64(slope) + 0.1)
        elif value < 0.0:
            return x_first, x_first
    if not (low <= high):
        return x_first, x_first
    return x_origin + int(np.ceil(low)), x_origin + int(np.floor(high)) + 1


@inlined
def _release(pixel, slot, member, queue, through, sums, features, grads, grad_at, hits, chain, last, counts, entry,
             limits, texels, channels, replay):  # fmt: skip
    """Blends the hit in a queue's slot, or, in the replay, notes it."""
    zero, one, size, step, alpha_max = get(limits, 0), get(limits, 1), get(limits, 2), get(limits, 3), get(limits, 7)
    s, t, a = get(queue, slot), get(queue, slot + 1), get(queue, slot + 3)
    passed = get(through, pixel)
    a = min(a, alpha_max)
    column, row = first_texel(s, size, zero, one), first_texel(t, size, zero, one)
    x0, x1 = weights(s, column, step, zero, one)
    y0, y1 = weights(t, row, step, zero, one)
    i00 = (np.int64(member) * texels * texels + np.int64(row) * texels + np.int64(column)) * channels
    right, below = np.int64(step) * channels, np.int64(step) * texels * channels
    i01, i10, i11 = i00 + right, i00 + below, i00 + right + below
    if replay:
        worth = get(grads, grad_at + channels)
        if channels > 0:
            worth += _dot(grads, grad_at, features, i00, i01, i10, i11, y0 * x0, y0 * x1, y1 * x0, y1 * x1, channels,
                          zero)  # fmt: skip
        number = get(counts, 0)
        put(counts, 0, number + 1)
        put(hits, 3 * number, worth)
        put(hits, 3 * number + 1, a)
        put(hits, 3 * number + 2, passed)
        put(chain, 2 * number, entry)
        put(chain, 2 * number + 1, get(last, pixel))
        put(last, pixel, number)
    elif channels > 0:
        w = passed * a
        y0, y1 = y0 * w, y1 * w
        _blend(sums, pixel * channels, features, i00, i01, i10, i11, y0 * x0, y0 * x1, y1 * x0, y1 * x1, channels)
    put(through, pixel, passed * (one - a))


@kernel
def traverse(turn, tiles, start, members_, offset_, record_, box, place_, features_, alpha_, limits_, shape, image,
             opacity, grads_, notes_, base, real, whole, status):  # fmt: skip
    """Works through tiles until none is left: blends them, or notes what `collect` needs.

    Args:
        turn: (1,) int64, next position in `tiles`, shared by all workers.
        tiles: (n,) int32, in the order in which to take them.
        start, members, offset, record, box, place: see Bins; `record` flat.
        features, alpha: textures, flat.
        limits: see `evaluate_row`.
        shape: texels, channels, width, height, tiles across, queue, capacity of a queue, rows worked on at
            once, replay.
        image, opacity: (C, H, W), (H, W) results; not written in the replay.
        grads: (H, W, C + 1) flat, gradients of the results with that of alpha last; used in the replay.
        notes: (pixels of all boxes, 2) flat, receives T a and the gradient by a of every hit.
        base: offset of the first of `notes`.
        real, whole: scratch of this worker.
        status: [number of tiles given up, billboard with a NaN alpha + 1, hits, tiles given up ...].
    """
    texels, channels, width, height, across, depth, capacity, rows, replay = (
        shape[0], shape[1], shape[2], shape[3], shape[4], shape[5], shape[6], shape[7], shape[8] != 0,
    )  # fmt: skip
    members, offset, record, place = (
        pointer(members_, 0), pointer(offset_, 0), pointer(record_, 0), pointer(place_, 0),
    )  # fmt: skip
    features, alpha, limits = pointer(features_, 0), pointer(alpha_, 0), pointer(limits_, 0)
    grads, notes = pointer(grads_, 0), pointer(notes_, 0)
    zero, one, size, t_min = get(limits, 0), get(limits, 1), get(limits, 2), get(limits, 6)
    band = TILE_WIDTH * rows
    # Scratch: what a row of pixels found, transmittances, sums of colour, queues; then the replay's hits.
    found, through = pointer(real, 0), pointer(real, 4 * LANES)
    at = 5 * LANES + band
    sums, queue = pointer(real, at), pointer(real, at + band * channels)
    hits = pointer(real, at + band * channels + 4 * band * capacity)
    head, tail, last = pointer(whole, 0), pointer(whole, band), pointer(whole, 2 * band)
    who, counts = pointer(whole, 3 * band), pointer(whole, 3 * band + band * capacity)
    chain = pointer(whole, 3 * band + band * capacity + 1)
    while True:
        position = fetch_add(turn, 1)
        if position >= len(tiles):
            break
        tile = tiles[position]
        left, tile_top = tile % across * TILE_WIDTH, tile // across * TILE_HEIGHT
        right, tile_bottom = min(left + TILE_WIDTH, width), min(tile_top + TILE_HEIGHT, height)
        if replay:
            for i in range(2 * (get(offset, start[tile]) - base), 2 * (get(offset, start[tile + 1]) - base)):
                put(notes, i, zero)
        overflow = False
        for top in range(tile_top, tile_bottom, rows):
            bottom = min(top + rows, tile_bottom)
            for i in range(band):
                put(through, i, zero)
                put(head, i, 0)
                put(tail, i, 0)
                put(last, i, -1)
            for y in range(top, bottom):
                for x in range(left, right):
                    put(through, (y - top) * TILE_WIDTH + x - left, one)
            for i in range(band * channels):
                put(sums, i, zero)
            put(counts, 0, 0)
            active = (bottom - top) * (right - left)
            for entry in range(start[tile], start[tile + 1]):
                i = get(members, entry)
                x_first, x_end = max(left, box[i, 0]), min(right, box[i, 2])
                y_first, y_end = max(top, box[i, 1]), min(bottom, box[i, 3])
                if y_first >= y_end:
                    continue
                r = i * RECORD
                x_origin, y_origin = (box[i, 0] + box[i, 2]) // 2, (box[i, 1] + box[i, 3]) // 2
                fade, reach = get(record, r + 10), get(record, r + 11)
                own_place = get(place, i)
                for y in range(y_first, y_end):
                    dy = zero + np.float32(y - y_origin)
                    row_first, row_end = _span(record, r, size, one, x_first, x_end, x_origin, dy)
                    for x_start in range(row_first, row_end, LANES):
                        row_start = (y - top) * TILE_WIDTH + x_start - left
                        mask = evaluate_row(record, r, zero + np.float32(x_start - x_origin), dy, row_end - x_start,
                                            alpha, np.int64(i) * texels * texels, texels, limits, through, row_start,
                                            found)  # fmt: skip
                        if mask >> 32:
                            status[1] = i + 1
                            mask &= 0xFFFFFFFF
                        while mask != 0:
                            lane = count_trailing_zeros(mask)
                            mask &= mask - 1
                            pixel = row_start + lane
                            key = get(found, 2 * LANES + lane)
                            a = fade * get(found, 3 * LANES + lane)
                            slots = pixel * capacity
                            grad_at = ((y * width) + x_start + lane) * (channels + 1)
                            begin, end = get(head, pixel), get(tail, pixel)
                            if depth < 0:
                                while begin < end and get(queue, 4 * (slots + begin) + 2) >= reach:
                                    _release(pixel, 4 * (slots + begin), get(members, get(who, slots + begin)),
                                             queue, through,
                                             sums, features, grads, grad_at, hits, chain, last, counts,
                                             get(who, slots + begin), limits, texels, channels, replay)  # fmt: skip
                                    begin += 1
                                    if get(through, pixel) < t_min:
                                        begin = end
                                        active -= 1
                                if begin == end:
                                    begin, end = 0, 0
                                    if get(through, pixel) < t_min:
                                        put(head, pixel, 0)
                                        put(tail, pixel, 0)
                                        continue
                            if end == capacity:
                                if begin == 0:
                                    overflow = True
                                    break
                                for j in range(begin, end):
                                    move4(queue, 4 * (slots + j - begin), 4 * (slots + j))
                                    put(who, slots + j - begin, get(who, slots + j))
                                begin, end = 0, end - begin
                            j = end
                            if depth != 0:
                                while j > begin:
                                    other = get(queue, 4 * (slots + j - 1) + 2)
                                    waiting_place = get(place, get(members, get(who, slots + j - 1)))
                                    if other > key or (other == key and waiting_place < own_place):
                                        break
                                    move4(queue, 4 * (slots + j), 4 * (slots + j - 1))
                                    put(who, slots + j, get(who, slots + j - 1))
                                    j -= 1
                            put(queue, 4 * (slots + j), get(found, lane))
                            put(queue, 4 * (slots + j) + 1, get(found, LANES + lane))
                            put(queue, 4 * (slots + j) + 2, key)
                            put(queue, 4 * (slots + j) + 3, a)
                            put(who, slots + j, entry)
                            end += 1
                            if depth >= 0 and end - begin > depth:
                                _release(pixel, 4 * (slots + begin), get(members, get(who, slots + begin)), queue,
                                         through, sums,
                                         features, grads, grad_at, hits, chain, last, counts, get(who, slots + begin),
                                         limits, texels, channels, replay)  # fmt: skip
                                begin += 1
                                if get(through, pixel) < t_min:
                                    begin = end
                                    active -= 1
                                if begin == end:
                                    begin, end = 0, 0
                            put(head, pixel, begin)
                            put(tail, pixel, end)
                        if overflow:
                            break
                    if overflow:
                        break
                if overflow or active == 0:
                    break
            if overflow:
                break
            for y in range(top, bottom):
                for x in range(left, right):
                    pixel = (y - top) * TILE_WIDTH + x - left
                    slots = pixel * capacity
                    for j in range(get(head, pixel), get(tail, pixel)):
                        if get(through, pixel) < t_min:
                            break
                        _release(pixel, 4 * (slots + j), get(members, get(who, slots + j)), queue, through, sums,
                                 features, grads,
                                 (y * width + x) * (channels + 1), hits, chain, last, counts, get(who, slots + j),
                                          limits,
                                 texels, channels, replay)  # fmt: skip
            if replay:
                for y in range(top, bottom):
                    for x in range(left, right):
                        number = get(last, (y - top) * TILE_WIDTH + x - left)
                        behind = zero
                        while number >= 0:
                            worth, a = get(hits, 3 * number), get(hits, 3 * number + 1)
                            passed = get(hits, 3 * number + 2)
                            entry = get(chain, 2 * number)
                            i = get(members, entry)
                            x_first, x_end = max(left, box[i, 0]), min(right, box[i, 2])
                            y_first = max(tile_top, box[i, 1])
                            spot = 2 * (get(offset, entry) - base + (y - y_first) * (x_end - x_first) + x - x_first)
                            put(notes, spot, passed * a)
                            put(notes, spot + 1, passed * (worth - behind))
                            behind = a * worth + (one - a) * behind
                            number = get(chain, 2 * number + 1)
                status[2] += get(counts, 0)
            else:
                for c in range(channels):
                    for y in range(top, bottom):
                        for x in range(left, right):
                            pixel = (y - top) * TILE_WIDTH + x - left
                            image[c, y, x] = get(sums, pixel * channels + c)
                for y in range(top, bottom):
                    for x in range(left, right):
                        opacity[y, x] = one - get(through, (y - top) * TILE_WIDTH + x - left)
        if overflow:
            status[3 + status[0]] = tile
            status[0] += 1


@kernel
def collect(turn, chunk, first_tile, end_tile, sequence, first, tile, where, start, offset, record_, box, features_,
            alpha_, limits, shape, grads_, notes_, base, fresh, grad_features_, grad_alpha_, grad_plane,
            grad_fade):  # fmt: skip
    """Gathers the noted hits of tiles `first_tile ... end_tile` into the gradients, billboard by billboard.

    Args:
        turn: (1,) int64, next of the billboards, shared by all workers; `chunk` are taken at a time.
        fresh: whether the gradients are still uninitialised memory.
        grad_features, grad_alpha: like the textures, flat.
        grad_plane: (F, 3, 3) float64; `grad_fade`: (F,) float64.
        Others: as in `traverse` and Bins.
    """
    texels, channels, width, across = shape[0], shape[1], shape[2], shape[4]
    zero, one, size, step, alpha_max = limits[0], limits[1], limits[2], limits[3], limits[7]
    record, features, alpha = pointer(record_, 0), pointer(features_, 0), pointer(alpha_, 0)
    grads, notes = pointer(grads_, 0), pointer(notes_, 0)
    grad_features, grad_alpha = pointer(grad_features_, 0), pointer(grad_alpha_, 0)
    area = texels * texels
    scale = 0.5 * (texels - 1) if texels > 1 else 1.0
    shift = 0.5 * (texels - 1)
    while True:
        begin = fetch_add(turn, chunk)
        if begin >= len(sequence):
            break
        for k in range(begin, min(begin + chunk, len(sequence))):
            i = sequence[k]
            r = i * RECORD
            if fresh:
                for j in range(np.int64(i) * area * channels, (np.int64(i) + 1) * area * channels):
                    put(grad_features, j, zero)
                for j in range(np.int64(i) * area, (np.int64(i) + 1) * area):
                    put(grad_alpha, j, zero)
            fade = get(record, r + 10)
            x_origin, y_origin = (box[i, 0] + box[i, 2]) // 2, (box[i, 1] + box[i, 3]) // 2
            g_fade = 0.0
            s_x, s_y, s_1, t_x, t_y, t_1, w_x, w_y, w_1 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for entry in range(first[k], first[k + 1]):
                if tile[entry] < first_tile or tile[entry] >= end_tile:
                    continue
                left, top = tile[entry] % across * TILE_WIDTH, tile[entry] // across * TILE_HEIGHT
                x_first, x_end = max(left, box[i, 0]), min(left + TILE_WIDTH, box[i, 2])
                y_first, y_end = max(top, box[i, 1]), min(top + TILE_HEIGHT, box[i, 3])
                spot = 2 * (offset[where[entry]] - base)
                for y in range(y_first, y_end):
                    dy = zero + np.float32(y - y_origin)
                    for x in range(x_first, x_end):
                        w, by_a = get(notes, spot), get(notes, spot + 1)
                        spot += 2
                        if w == zero and by_a == zero:
                            continue
                        dx = zero + np.float32(x - x_origin)
                        p = one / affine(get(record, r + 6), get(record, r + 7), get(record, r + 8), dx, dy)
                        s = affine(get(record, r), get(record, r + 1), get(record, r + 2), dx, dy) * p
                        t = affine(get(record, r + 3), get(record, r + 4), get(record, r + 5), dx, dy) * p
                        column, row = first_texel(s, size, zero, one), first_texel(t, size, zero, one)
                        x0, x1 = weights(s, column, step, zero, one)
                        y0, y1 = weights(t, row, step, zero, one)
                        a0, a1 = slopes(s, column, step, zero, one)
                        b0, b1 = slopes(t, row, step, zero, one)
                        i00 = np.int64(i) * area + np.int64(row) * texels + np.int64(column)
                        right, below = np.int64(step), np.int64(step) * texels
                        i01, i10, i11 = i00 + right, i00 + below, i00 + right + below
                        t00, t01, t10, t11 = get(alpha, i00), get(alpha, i01), get(alpha, i10), get(alpha, i11)
                        sample = mix(t00, t01, t10, t11, x0, x1, y0, y1)
                        by_s, by_t = zero, zero
                        if fade * sample <= alpha_max:  # a capped alpha does not move
                            g_fade += by_a * sample
                            by_a = by_a * fade
                            by_s = by_a * mix(t00, t01, t10, t11, a0, a1, y0, y1)
                            by_t = by_a * mix(t00, t01, t10, t11, x0, x1, b0, b1)
                            put(grad_alpha, i00, get(grad_alpha, i00) + by_a * y0 * x0)
                            put(grad_alpha, i01, get(grad_alpha, i01) + by_a * y0 * x1)
                            put(grad_alpha, i10, get(grad_alpha, i10) + by_a * y1 * x0)
                            put(grad_alpha, i11, get(grad_alpha, i11) + by_a * y1 * x1)
                        if channels > 0:
                            at = (np.int64(y) * width + x) * (channels + 1)
                            i00, i01, i10, i11 = i00 * channels, i01 * channels, i10 * channels, i11 * channels
                            ds, dt = _slope(grads, at, features, i00, i01, i10, i11, x0, x1, y0, y1, a0, a1, b0, b1,
                                            channels, zero)  # fmt: skip
                            by_s, by_t = by_s + w * ds, by_t + w * dt
                            y0, y1 = y0 * w, y1 * w
                            _scatter(grad_features, i00, i01, i10, i11, y0 * x0, y0 * x1, y1 * x0, y1 * x1, grads, at,
                                     channels)  # fmt: skip
                        gs, gt, gw = plane_slopes(by_s, by_t, s, t, p)
                        s_x, s_y, s_1 = s_x + gs * dx, s_y + gs * dy, s_1 + gs
                        t_x, t_y, t_1 = t_x + gt * dx, t_y + gt * dy, t_1 + gt
                        w_x, w_y, w_1 = w_x + gw * dx, w_y + gw * dy, w_1 + gw
            # from texel coordinates about the record's origin to texture coordinates about the image's
            ox, oy = x_origin + 0.5, y_origin + 0.5
            s_x, s_y = s_x + s_1 * ox, s_y + s_1 * oy
            t_x, t_y = t_x + t_1 * ox, t_y + t_1 * oy
            w_x, w_y = w_x + w_1 * ox, w_y + w_1 * oy
            if fresh:
                for j in range(9):
                    grad_plane[i, j // 3, j % 3] = 0.0
                grad_fade[i] = 0.0
            grad_plane[i, 0, 0] += scale * s_x
            grad_plane[i, 0, 1] += scale * s_y
            grad_plane[i, 0, 2] += scale * s_1
            grad_plane[i, 1, 0] += scale * t_x
            grad_plane[i, 1, 1] += scale * t_y
            grad_plane[i, 1, 2] += scale * t_1
            grad_plane[i, 2, 0] += w_x + shift * (s_x + t_x)
            grad_plane[i, 2, 1] += w_y + shift * (s_y + t_y)
            grad_plane[i, 2, 2] += w_1 + shift * (s_1 + t_1)
            grad_fade[i] += g_fade
