"""What is done with a hit whose turn has come, and with the pixels of a band at its end."""

import numpy as np

from nbavatar.jit.compile import inlined
from nbavatar.jit.lanes import (
    LANES,
    bits,
    choose,
    count_bits,
    count_trailing_zeros,
    first_lanes,
    gather,
    load,
    spread,
    store,
    store_where,
    stream,
    transpose,
)  # fmt: skip
from nbavatar.jit.memory import ahead, get, put
from nbavatar.rendering.billboards.cpu_groups import features_of
from nbavatar.rendering.billboards.cpu_scratch import COLUMN, LANE, ROW, SHIFT
from nbavatar.rendering.binning import TILE_WIDTH

__all__ = ["LARGE", "blend", "blend_at_once", "blend_one", "close", "keep_worth", "settle", "write"]

LARGE = 1 << 22  # numbers of an image that the caches do not hold


@inlined
def _add(scene, k, hits, features):
    """Adds the hits of the billboard in hand to their pixels, each with its share."""
    groups, stride = k.groups, scene.layout.stride
    for h in range(hits):
        hit, pixel = np.int64(get(groups.hit, h)), np.int64(get(groups.spot, h))
        share, sums = spread(get(groups.share, hit)), ahead(k.sums, pixel * stride)
        if stride == LANES:  # the usual case: no loop
            store(sums, 0, load(sums, 0) + share * features_of(scene, k, features, hit, 0))
        else:
            for c in range(0, stride, LANES):
                store(sums, c, load(sums, c) + share * features_of(scene, k, features, hit, c))


@inlined
def _grad(scene, k, lane, c):
    """Gradient of the image, from channel c on, at the pixel whose number is in `whole`."""
    return load(scene.grads, np.int64(get(k.whole, lane)) * scene.layout.stride + c)


@inlined
def keep_worth(scene, k, hits, bundles, left, top, width):
    """Notes what the hits of the billboard in hand would change if their share of the pixels grew: replay.

    Args:
        bundles: of hits that the band had before.
    """
    stride = scene.layout.stride
    for h in range(0, hits, LANES):
        spot, hit = load(k.groups.spot, h), load(k.groups.hit, h)
        y = (spot >> spread(np.int32(ROW))) + spread(np.int32(top))
        pixels = y * spread(np.int32(width)) + (spread(np.int32(left)) + (spot & spread(np.int32(COLUMN))))
        store(k.whole, 0, pixels)
        worth = gather(scene.grad_opacity, pixels)
        for c in range(0, stride, LANES):
            row = ahead(k.features, h * stride + c)
            columns = transpose((
                load(row, 0) * _grad(scene, k, 0, c), load(row, stride) * _grad(scene, k, 1, c),
                load(row, 2 * stride) * _grad(scene, k, 2, c), load(row, 3 * stride) * _grad(scene, k, 3, c),
                load(row, 4 * stride) * _grad(scene, k, 4, c), load(row, 5 * stride) * _grad(scene, k, 5, c),
                load(row, 6 * stride) * _grad(scene, k, 6, c), load(row, 7 * stride) * _grad(scene, k, 7, c),
            ))  # fmt: skip
            above = (columns[0] + columns[1]) + (columns[2] + columns[3])
            worth = worth + (above + ((columns[4] + columns[5]) + (columns[6] + columns[7])))
        number = bundles * LANES + h
        store(k.worth, number, worth)
        store(k.opacity, number, gather(k.groups.alpha, hit))


@inlined
def _note(k, at, pixel, number, through):
    """Notes as the band's hit `at` to be blended that this one was, at a pixel which so much light reaches: replay."""
    put(k.blended, at, number)
    put(k.pixel, at, pixel)
    put(k.light, at, through)


@inlined
def blend_one(scene, k, replay, pixel, number, through, opacity):
    """Blends a hit that has waited at a pixel of the band which the light `through` reaches."""
    put(scene.status, 2, get(scene.status, 2) + 1)
    if replay:
        _note(k, get(k.length, 0), pixel, number, through)
        put(k.length, 0, get(k.length, 0) + 1)
    else:
        stride = scene.layout.stride
        share, sums, row = spread(through * opacity), ahead(k.sums, pixel * stride), ahead(k.features, number * stride)
        for c in range(0, stride, LANES):
            store(sums, c, load(sums, c) + share * load(row, c))


@inlined
def _add_rows(k, first, stride, c):
    for lane in range(LANES):
        at = (first + lane) * stride + c
        row = load(k.features, np.int64(get(k.whole, lane)) * stride + c)
        store(k.sums, at, load(k.sums, at) + row * spread(get(k.row, lane)))


@inlined
def blend(scene, k, replay, now, first, through, share, ids):
    """Blends one hit at each of the pixels `first + lane` in the mask `now`, or, in the replay, notes it.

    Args:
        first: place of lane 0 in the band.
        through: transmittance in front of the hits; `share`: it times their opacity; `ids`: their numbers.
    """
    word = bits(now)
    put(scene.status, 2, get(scene.status, 2) + count_bits(word))
    if replay:
        store(k.whole, 0, ids)
        store(k.row, 0, through)
        at = np.int64(get(k.length, 0))
        put(k.length, 0, at + count_bits(word))
        while word != 0:
            lane = count_trailing_zeros(word)
            word &= word - 1
            _note(k, at, first + lane, get(k.whole, lane), get(k.row, lane))
            at += 1
    else:  # other lanes add a row of zeros
        store(k.whole, 0, choose(now, ids, spread(np.int32(scene.room))))
        store(k.row, 0, choose(now, share, scene.limits.zero))
        if scene.layout.stride == LANES:
            _add_rows(k, first, LANES, 0)
        else:
            for c in range(0, scene.layout.stride, LANES):
                _add_rows(k, first, scene.layout.stride, c)


@inlined
def blend_at_once(scene, k, replay, count, hits, features, bundles):
    """Blends the hits of the billboard in hand; returns the number of pixels that this has finished.

    Args:
        count: groups of the billboard; bundles: that the band had before.
    """
    groups = k.groups
    one, none, finished = scene.limits.one, scene.limits.none, 0
    for j in range(count):
        first, at = np.int64(get(groups.first, j)), j * LANES
        hit, through, opacity = load(groups.key, at) > none, load(k.through, first), load(groups.alpha, at)
        store(groups.share, at, through if replay else through * opacity)
        through = choose(hit, through * (one - opacity), through)
        store(k.through, first, through)
        _, closed = close(scene, k, first, through)
        finished += closed
    put(scene.status, 2, get(scene.status, 2) + hits)
    if replay:
        at = np.int64(get(k.length, 0))
        put(k.length, 0, at + hits)
        for h in range(hits):
            through = get(groups.share, np.int64(get(groups.hit, h)))
            _note(k, at + h, get(groups.spot, h), bundles * LANES + h, through)
    else:
        _add(scene, k, hits, features)
    return finished


@inlined
def close(scene, k, first, through):
    """Notes which of the pixels `first + lane` are finished and how many of them have just become so."""
    infinite = scene.limits.infinite
    floor = load(k.floor, first)
    done = through < scene.limits.t_min
    store(k.floor, first, choose(done, infinite, floor))
    return done, count_bits(bits(done & (floor < infinite)))


@inlined
def _columns(k, at, stride):
    """Features of eight neighbouring pixels, channel by channel, from `at` on."""
    return transpose((
        load(k.sums, at), load(k.sums, at + stride), load(k.sums, at + 2 * stride), load(k.sums, at + 3 * stride),
        load(k.sums, at + 4 * stride), load(k.sums, at + 5 * stride), load(k.sums, at + 6 * stride),
        load(k.sums, at + 7 * stride),
    ))  # fmt: skip


@inlined
def write(scene, k, image, opacity, left, right, top, bottom, width, height):
    """Writes a band's pixels into the results, which begin at multiples of 64 bytes."""
    one = scene.limits.one
    area, stride = np.int64(width) * height, scene.layout.stride
    if width % (2 * LANES) == 0 and area * scene.layout.channels >= LARGE:
        # A large image is not in the caches when it is read: writing past them saves reading the memory first. The
        # second half of a line follows the first at once: few lines can be under way.
        for y in range(top, bottom):
            for x in range(left, right, 2 * LANES):
                first = (y - top) * TILE_WIDTH + x - left
                pixel = np.int64(y) * width + x
                stream(opacity, pixel, one - load(k.through, first))
                stream(opacity, pixel + LANES, one - load(k.through, first + LANES))
                for c in range(0, scene.layout.channels, LANES):
                    here = _columns(k, first * stride + c, stride)
                    beside = _columns(k, (first + LANES) * stride + c, stride)
                    for lane in range(min(LANES, scene.layout.channels - c)):
                        stream(image, (c + lane) * area + pixel, here[lane])
                        stream(image, (c + lane) * area + pixel + LANES, beside[lane])
        return
    for y in range(top, bottom):
        for x in range(left, right, LANES):
            used = first_lanes(right - x)
            first = (y - top) * TILE_WIDTH + x - left
            pixel = np.int64(y) * width + x
            store_where(opacity, pixel, one - load(k.through, first), used)
            for c in range(0, scene.layout.channels, LANES):
                columns = _columns(k, first * stride + c, stride)
                for lane in range(min(LANES, scene.layout.channels - c)):
                    store_where(image, (c + lane) * area + pixel, columns[lane], used)


@inlined
def settle(scene, k, noted):
    """Writes T a and the gradient by a of the band's blended hits, from the last to the first.

    Args:
        noted: place of the band's first bundle among the notes.
    """
    one = scene.numbers.one
    for at in range(np.int64(get(k.length, 0)) - 1, -1, -1):
        number, pixel, through = np.int64(get(k.blended, at)), np.int64(get(k.pixel, at)), get(k.light, at)
        worth, a, behind = get(k.worth, number), get(k.opacity, number), get(k.behind, pixel)
        note = 2 * LANES * (noted + (number >> SHIFT)) + (number & LANE)
        put(scene.notes, note, through * a)
        put(scene.notes, note + LANES, through * (worth - behind))
        put(k.behind, pixel, a * worth + (one - a) * behind)
