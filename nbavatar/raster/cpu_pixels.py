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
    total,
    transpose,
)  # fmt: skip
from nbavatar.raster.memory import ahead, get, pointer, put

__all__ = ["LANE", "SHIFT", "Scene", "Scratch", "blend", "close", "divide", "scratch_sizes", "settle", "write"]

SHIFT, LANE = 3, LANES - 1  # a hit's number is LANES * group + lane


class Scratch(NamedTuple):
    """Memory of one worker; see `blend_tiles`. Whole numbers are int32."""

    through: Any  # transmittance of each pixel
    floor: Any  # hits with a smaller key than this are of no use to the pixel
    sums: Any  # blended features, `stride` a pixel
    keys: Any  # queues: keys, `plane` a slot; an empty place holds -infinity
    dims: Any  # queues: opacities
    ids: Any  # queues: numbers of the hits
    weights: Any  # of each hit's first texel; those of the next three follow `room` numbers on each
    opacity: Any  # of each hit
    place: Any  # rank of each group's billboard
    row: Any  # room for two rows of numbers
    whole: Any  # and for one of whole numbers
    ends: Any  # columns of a billboard's rows
    count: Any  # slots in use at each pixel, where hits are put behind the queues unsorted
    texel: Any  # int64: first channel of each hit's first texel
    before: Any  # replay: the hit blended before each hit at its pixel, or -1
    last: Any  # replay: the hit blended last at each pixel


def scratch_sizes(rows: int, capacity: int, channels: int, groups: int, replay: bool) -> tuple[int, int, int]:
    """Numbers, int32 and int64 that a worker needs for bands of `rows` rows with `groups` groups of hits."""
    plane = TILE_WIDTH * rows + LANES
    stride = -(-channels // LANES) * LANES
    reals = 2 * plane + plane * stride + 2 * capacity * plane + 2 * LANES + groups * 5 * LANES
    wholes = capacity * plane + groups + LANES + 2 * TILE_HEIGHT + plane
    return reals, wholes + (groups * LANES + plane if replay else 0), groups * LANES


class Scene(NamedTuple):
    """What stays the same for all tiles; see `blend_tiles`."""

    features: Any
    limits: Any  # see `cpu_hits`
    right: Any  # from a texel's first channel to that of the one beside it
    below: Any  # under it
    last: Any  # under and beside it
    channels: Any
    stride: Any  # numbers kept of a pixel's features: the channels, filled up to whole vectors
    plane: Any  # pixels of a slot of the queues
    room: Any  # hits that the scratch holds
    replay: Any
    grads: Any
    grad_opacity: Any
    notes: Any
    status: Any


@inlined
def divide(real, whole, wide, plane, stride, capacity, groups):
    """Divides a worker's arrays as `scratch_sizes` counts."""
    keys = 2 * plane + plane * stride
    row = keys + 2 * capacity * plane
    weights = row + 2 * LANES
    place = capacity * plane
    rest = place + groups
    count = rest + LANES + 2 * TILE_HEIGHT
    before = count + plane
    return Scratch(
        pointer(real, 0), pointer(real, plane), pointer(real, 2 * plane), pointer(real, keys),
        pointer(real, keys + capacity * plane), pointer(whole, 0), pointer(real, weights),
        pointer(real, weights + groups * 4 * LANES), pointer(whole, place), pointer(real, row), pointer(whole, rest),
        pointer(whole, rest + LANES), pointer(whole, count), pointer(wide, 0), pointer(whole, before),
        pointer(whole, before + groups * LANES),
    )  # fmt: skip


@inlined
def _sample(scene, texel, weights, c):
    """Channels c ... c + LANES - 1 of a hit, 0 where there are none.

    Args:
        texel: pointer to its first texel; weights: pointer to that one's weight.
    """
    used = first_lanes(scene.channels - c)
    above = load_where(texel, c, used) * spread(get(weights, 0))
    above = above + load_where(texel, scene.right + c, used) * spread(get(weights, scene.room))
    under = load_where(texel, scene.below + c, used) * spread(get(weights, 2 * scene.room))
    under = under + load_where(texel, scene.last + c, used) * spread(get(weights, 3 * scene.room))
    return above + under


@inlined
def blend(scene, k, word, first, pixel, through, share, ids, noted):
    """Blends one hit at each of the pixels `first + lane` with a bit in `word`, or, in the replay, notes it.

    Args:
        first, pixel: place of lane 0 in the band and in the image.
        through: transmittance in front of the hits; `share`: it times their opacity; `ids`: their numbers.
        noted: place of the band's first group among the notes.
    """
    store(k.whole, 0, ids)
    store(k.row, 0, share)
    store(k.row, LANES, through)
    put(scene.status, 2, get(scene.status, 2) + count_bits(word))
    while word != 0:
        lane = count_trailing_zeros(word)
        word &= word - 1
        number = np.int64(get(k.whole, lane))
        texel, weights = ahead(scene.features, get(k.texel, number)), ahead(k.weights, number)
        if scene.replay:
            worth = scene.limits.zero
            grads = ahead(scene.grads, (pixel + lane) * scene.stride)
            for c in range(0, scene.channels, LANES):
                worth = worth + _sample(scene, texel, weights, c) * load(grads, c)
            note = 2 * LANES * (noted + (number >> SHIFT)) + (number & LANE)
            put(scene.notes, note, get(k.row, LANES + lane))
            put(scene.notes, note + LANES, total(worth) + get(scene.grad_opacity, pixel + lane))
            put(k.before, number, get(k.last, first + lane))
            put(k.last, first + lane, number)
        else:
            share = spread(get(k.row, lane))
            sums = ahead(k.sums, (first + lane) * scene.stride)
            for c in range(0, scene.channels, LANES):
                store(sums, c, load(sums, c) + _sample(scene, texel, weights, c) * share)


@inlined
def close(scene, k, first, through):
    """Notes which of the pixels `first + lane` are finished and how many of them have just become so."""
    infinite = scene.limits.infinite
    floor = load(k.floor, first)
    done = through < scene.limits.t_min
    store(k.floor, first, choose(done, infinite, floor))
    return done, count_bits(bits(done & (floor < infinite)))


@inlined
def write(scene, k, image, opacity, left, right, top, bottom, width, height):
    """Writes a band's pixels into the results."""
    one = scene.limits.one
    area, stride = np.int64(width) * height, scene.stride
    for y in range(top, bottom):
        for x in range(left, right, LANES):
            used = first_lanes(right - x)
            first = (y - top) * TILE_WIDTH + x - left
            pixel = np.int64(y) * width + x
            store_where(opacity, pixel, one - load(k.through, first), used)
            for c in range(0, scene.channels, LANES):
                at = first * stride + c
                columns = transpose((
                    load(k.sums, at), load(k.sums, at + stride), load(k.sums, at + 2 * stride),
                    load(k.sums, at + 3 * stride), load(k.sums, at + 4 * stride), load(k.sums, at + 5 * stride),
                    load(k.sums, at + 6 * stride), load(k.sums, at + 7 * stride),
                ))  # fmt: skip
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
