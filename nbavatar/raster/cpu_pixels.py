"""What a tile keeps of its pixels and hits while it is worked on, and what is done with a hit whose turn has come."""

from typing import Any, NamedTuple

import numpy as np

from nbavatar.raster.binning import TILE_HEIGHT, TILE_WIDTH
from nbavatar.raster.compile import inlined
from nbavatar.raster.lanes import (
    LANES,
    bits,
    choose,
    count_bits,
    count_trailing_zeros,
    first_lanes,
    load,
    load_where,
    spread,
    store,
    store_where,
    stream,
    transpose,
)  # fmt: skip
from nbavatar.raster.memory import ahead, get, pointer, put
from nbavatar.raster.sorting import LONGEST

__all__ = [
    "LANE", "LARGE", "SHIFT", "Scene", "Scratch", "blend", "close", "divide", "evaluate", "keep_worth", "scratch_sizes",
    "settle", "write",
]  # fmt: skip

SHIFT, LANE = 3, LANES - 1  # a hit's number is LANES * group + lane
LARGE = 1 << 22  # numbers of an image that the caches do not hold
_GROUPS = TILE_HEIGHT * (TILE_WIDTH // LANES) + LANES  # of one billboard in a tile; lists are filled LANES at a time


class Scratch(NamedTuple):
    """Memory of one worker; see `blend_tiles`. Whole numbers are int32."""

    # of the band's pixels
    through: Any  # transmittance
    floor: Any  # hits with a smaller key than this are of no use to the pixel
    sums: Any  # blended features, `stride` a pixel
    count: Any  # hits that wait
    free: Any  # place of the first free slot; follows from `count`, but is read lane by lane
    last: Any  # replay: the hit blended last
    # queues of hits, `plane` a slot, LONGEST slots at least
    keys: Any
    opacities: Any
    ids: Any  # numbers of the hits
    # of the band's hits
    opacity: Any
    features: Any  # `stride` a hit, and a row of zeros behind them; replay: of one group
    worth: Any  # replay: what a hit's share of its pixel changes
    before: Any  # replay: the hit blended before it at its pixel, or -1
    rank: Any  # of each group's billboard
    # of the billboard in hand, group by group
    key: Any  # of its hits; -infinity where there is none
    weights: Any  # of their four texels
    cell: Any  # number of their first texel in the texture
    first: Any  # place of the first pixel in the band
    rest: Any  # pixels from there to the end of the billboard's row
    order: Any  # those with a hit
    ends: Any  # columns of the billboard's rows
    # room for a row of numbers
    row: Any
    whole: Any


def scratch_sizes(rows: int, capacity: int, channels: int, groups: int, replay: bool) -> tuple[int, int]:
    """Numbers and int32 that a worker needs for bands of `rows` rows with `groups` groups of hits; see `divide`."""
    plane = TILE_WIDTH * rows + LANES
    stride = -(-channels // LANES) * LANES
    hits, slots = groups * LANES, max(capacity, LONGEST)
    features = LANES * stride + hits if replay else (hits + 1) * stride
    reals = plane * (2 + stride + 2 * slots) + hits + LANES + features + 5 * LANES * _GROUPS + LANES
    wholes = plane * (2 + slots) + groups + 1 + (LANES + 3) * _GROUPS + 2 * TILE_HEIGHT + LANES
    return reals, wholes + (hits + plane if replay else 0)


@inlined
def divide(real, whole, plane, stride, capacity, groups, replay):
    """Divides a worker's arrays as `scratch_sizes` counts.

    Opacities and ranks have room for a group more, which is written before it is known whether it has a hit.
    """
    hits, slots = groups * LANES, max(capacity, LONGEST)
    floor, sums, keys = plane, 2 * plane, (2 + stride) * plane
    opacities = keys + slots * plane
    opacity = opacities + slots * plane
    key = opacity + hits + LANES
    weights = key + LANES * _GROUPS
    row = weights + 4 * LANES * _GROUPS
    features = row + LANES
    worth = features + LANES * stride
    ids = 2 * plane
    rank = ids + slots * plane
    cell = rank + groups + 1
    first = cell + LANES * _GROUPS
    rest, order, ends = first + _GROUPS, first + 2 * _GROUPS, first + 3 * _GROUPS
    line = ends + 2 * TILE_HEIGHT
    last = line + LANES
    before = last + plane
    if not replay:  # not used, and no room
        worth, last, before = 0, 0, 0
    return Scratch(
        pointer(real, 0), pointer(real, floor), pointer(real, sums),
        pointer(whole, 0), pointer(whole, plane), pointer(whole, last),
        pointer(real, keys), pointer(real, opacities), pointer(whole, ids),
        pointer(real, opacity), pointer(real, features), pointer(real, worth), pointer(whole, before),
        pointer(whole, rank),
        pointer(real, key), pointer(real, weights), pointer(whole, cell), pointer(whole, first), pointer(whole, rest),
        pointer(whole, order), pointer(whole, ends),
        pointer(real, row), pointer(whole, line),
    )  # fmt: skip


class Scene(NamedTuple):
    """What stays the same for all tiles; see `blend_tiles`."""

    features: Any
    limits: Any  # see `cpu_hits`
    zero: Any  # a single one
    right: Any  # from a texel's first channel to that of the one beside it
    below: Any  # under it
    last: Any  # under and beside it
    channels: Any
    stride: Any  # numbers kept of a pixel's features: the channels, filled up to whole vectors
    plane: Any  # pixels of a slot of the queues
    room: Any  # hits that the scratch holds
    grads: Any
    grad_opacity: Any
    notes: Any
    status: Any


@inlined
def _evaluate(scene, k, texture, j, rows, stride, c):
    used = first_lanes(scene.channels - c)
    cell, weights = ahead(k.cell, LANES * j), ahead(k.weights, 4 * LANES * j)
    for lane in range(LANES):
        texel = ahead(texture, np.int64(get(cell, lane)) * scene.channels + c)
        above = load_where(texel, 0, used) * spread(get(weights, lane))
        above = above + load_where(texel, scene.right, used) * spread(get(weights, LANES + lane))
        under = load_where(texel, scene.below, used) * spread(get(weights, 2 * LANES + lane))
        under = under + load_where(texel, scene.last, used) * spread(get(weights, 3 * LANES + lane))
        store(rows, lane * stride + c, above + under)


@inlined
def evaluate(scene, k, texture, j, rows):
    """Writes the features under all lanes of group j of the billboard in hand, hits or not, to `rows`.

    To leave lanes out would cost more than to work on them: see `cpu_groups`.
    """
    if scene.stride == LANES:  # the usual case; its offsets are constants
        _evaluate(scene, k, texture, j, rows, LANES, 0)
    else:
        for c in range(0, scene.stride, LANES):
            _evaluate(scene, k, texture, j, rows, scene.stride, c)


@inlined
def keep_worth(scene, k, j, group, pixel):
    """Notes what the hits of group j would change if their share of the pixels from `pixel` on grew: replay."""
    stride = scene.stride
    worth = load_where(scene.grad_opacity, pixel, load(k.key, LANES * j) > scene.limits.none)
    for c in range(0, stride, LANES):
        row, grad = ahead(k.features, c), ahead(scene.grads, pixel * stride + c)
        columns = transpose((
            load(row, 0) * load(grad, 0), load(row, stride) * load(grad, stride),
            load(row, 2 * stride) * load(grad, 2 * stride), load(row, 3 * stride) * load(grad, 3 * stride),
            load(row, 4 * stride) * load(grad, 4 * stride), load(row, 5 * stride) * load(grad, 5 * stride),
            load(row, 6 * stride) * load(grad, 6 * stride), load(row, 7 * stride) * load(grad, 7 * stride),
        ))  # fmt: skip
        above = (columns[0] + columns[1]) + (columns[2] + columns[3])
        worth = worth + (above + ((columns[4] + columns[5]) + (columns[6] + columns[7])))
    store(k.worth, group * LANES, worth)


@inlined
def _add(k, first, stride, c):
    for lane in range(LANES):
        at = (first + lane) * stride + c
        row = load(k.features, np.int64(get(k.whole, lane)) * stride + c)
        store(k.sums, at, load(k.sums, at) + row * spread(get(k.row, lane)))


@inlined
def blend(scene, k, replay, now, first, through, share, ids, noted):
    """Blends one hit at each of the pixels `first + lane` in the mask `now`, or, in the replay, notes it.

    Args:
        first: place of lane 0 in the band.
        through: transmittance in front of the hits; `share`: it times their opacity; `ids`: their numbers.
        noted: place of the band's first group among the notes.
    """
    word = bits(now)
    put(scene.status, 2, get(scene.status, 2) + count_bits(word))
    if replay:
        store(k.whole, 0, ids)
        store(k.row, 0, through)
        while word != 0:
            lane = count_trailing_zeros(word)
            word &= word - 1
            number = np.int64(get(k.whole, lane))
            note = 2 * LANES * (noted + (number >> SHIFT)) + (number & LANE)
            put(scene.notes, note, get(k.row, lane))
            put(scene.notes, note + LANES, get(k.worth, number))
            put(k.before, number, get(k.last, first + lane))
            put(k.last, first + lane, number)
    else:  # other lanes add a row of zeros
        store(k.whole, 0, choose(now, ids, spread(np.int32(scene.room))))
        store(k.row, 0, choose(now, share, scene.limits.zero))
        if scene.stride == LANES:
            _add(k, first, LANES, 0)
        else:
            for c in range(0, scene.stride, LANES):
                _add(k, first, scene.stride, c)


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
    area, stride = np.int64(width) * height, scene.stride
    if width % (2 * LANES) == 0 and area * scene.channels >= LARGE:
        # A large image is not in the caches when it is read: writing past them saves reading the memory first. The
        # second half of a line follows the first at once: few lines can be under way.
        for y in range(top, bottom):
            for x in range(left, right, 2 * LANES):
                first = (y - top) * TILE_WIDTH + x - left
                pixel = np.int64(y) * width + x
                stream(opacity, pixel, one - load(k.through, first))
                stream(opacity, pixel + LANES, one - load(k.through, first + LANES))
                for c in range(0, scene.channels, LANES):
                    here = _columns(k, first * stride + c, stride)
                    beside = _columns(k, (first + LANES) * stride + c, stride)
                    for lane in range(min(LANES, scene.channels - c)):
                        stream(image, (c + lane) * area + pixel, here[lane])
                        stream(image, (c + lane) * area + pixel + LANES, beside[lane])
        return
    for y in range(top, bottom):
        for x in range(left, right, LANES):
            used = first_lanes(right - x)
            first = (y - top) * TILE_WIDTH + x - left
            pixel = np.int64(y) * width + x
            store_where(opacity, pixel, one - load(k.through, first), used)
            for c in range(0, scene.channels, LANES):
                columns = _columns(k, first * stride + c, stride)
                for lane in range(min(LANES, scene.channels - c)):
                    store_where(image, (c + lane) * area + pixel, columns[lane], used)


@inlined
def settle(scene, k, left, right, top, bottom, noted, zero, one):
    """Turns a band's notes (T and the worth of a hit) into T a and the gradient by a, from back to front."""
    for y in range(bottom - top):
        for x in range(right - left):
            number = np.int64(get(k.last, y * TILE_WIDTH + x))
            behind = zero
            while number >= 0:
                note = 2 * LANES * (noted + (number >> SHIFT)) + (number & LANE)
                through, worth, a = get(scene.notes, note), get(scene.notes, note + LANES), get(k.opacity, number)
                put(scene.notes, note, through * a)
                put(scene.notes, note + LANES, through * (worth - behind))
                behind = a * worth + (one - a) * behind
                number = np.int64(get(k.before, number))
