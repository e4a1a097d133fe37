"""Queues of hits, one a pixel, sorted by depth: the nearest in slot 0.

They are stored slot by slot: slot j of all pixels, then slot j + 1. A new row of hits passes the slots from
the nearest on and in each the nearer of two stays, so no branch depends on a single pixel. Where hundreds of
hits wait at a pixel that is too slow: there they are put behind the queue and sorted before it is looked at.
"""

import numpy as np

from nbavatar.raster.compile import inlined
from nbavatar.raster.cpu_pixels import SHIFT, blend, close
from nbavatar.raster.lanes import (
    LANES,
    any_lane,
    bits,
    choose,
    count_trailing_zeros,
    first_lanes,
    gather,
    load,
    maximum,
    spread,
    store,
)  # fmt: skip
from nbavatar.raster.memory import get, put

__all__ = ["append", "arrange", "count_waiting", "drain", "enqueue", "pop"]


@inlined
def enqueue(scene, k, key, ids, first, level):
    """Puts hits into the queues of the pixels `first + lane`; returns how many slots are in use then.

    Of equal keys the one of lower rank goes first.
    """
    none, shift = scene.limits.none, spread(np.int32(SHIFT))
    slot = 0
    while True:
        at = slot * scene.plane + first
        held, held_id = load(k.keys, at), load(k.ids, at)
        ahead = key > held
        tie = (key == held) & (key > none)
        if any_lane(tie):
            ahead = ahead | (tie & (gather(k.rank, ids >> shift) < gather(k.rank, held_id >> shift)))
        store(k.keys, at, choose(ahead, key, held))
        store(k.ids, at, choose(ahead, ids, held_id))
        key, ids = choose(ahead, held, key), choose(ahead, held_id, ids)
        slot += 1
        if not any_lane(key > none):
            return max(level, slot)


@inlined
def append(scene, k, word, key, ids, first, level):
    """Puts the hits with a bit in `word` behind the queues; returns how many slots are in use then."""
    store(k.row, 0, key)
    store(k.whole, 0, ids)
    while word != 0:
        lane = count_trailing_zeros(word)
        word &= word - 1
        pixel = first + lane
        slot = np.int64(get(k.count, pixel))
        put(k.keys, slot * scene.plane + pixel, get(k.row, lane))
        put(k.ids, slot * scene.plane + pixel, get(k.whole, lane))
        put(k.count, pixel, slot + 1)
        level = max(level, slot + 1)
    return level


@inlined
def _behind(k, key, number, other_key, other):
    """Whether a hit is blended after another one."""
    if key != other_key:
        return key < other_key
    return get(k.rank, number >> SHIFT) > get(k.rank, other >> SHIFT)


@inlined
def _sink(scene, k, pixel, slot, end, key, number):
    """Moves a hit down from `slot` in the heap of the slots before `end`, the last one to be blended on top."""
    while True:
        child = 2 * slot + 1
        if child >= end:
            break
        at = child * scene.plane + pixel
        child_key, child_number = get(k.keys, at), np.int64(get(k.ids, at))
        if child + 1 < end:
            other_key = get(k.keys, at + scene.plane)
            other_number = np.int64(get(k.ids, at + scene.plane))
            if _behind(k, other_key, other_number, child_key, child_number):
                child, child_key, child_number = child + 1, other_key, other_number
        if not _behind(k, child_key, child_number, key, number):
            break
        put(k.keys, slot * scene.plane + pixel, child_key)
        put(k.ids, slot * scene.plane + pixel, child_number)
        slot = child
    put(k.keys, slot * scene.plane + pixel, key)
    put(k.ids, slot * scene.plane + pixel, number)


@inlined
def arrange(scene, k, pixels):
    """Brings queues that were filled by `append` into the order that `enqueue` keeps, by heap sort."""
    for pixel in range(pixels):
        count = np.int64(get(k.count, pixel))
        for step in range(count // 2 + count - 1):
            if step < count // 2:  # builds the heap
                slot, end = count // 2 - 1 - step, count
                at = slot * scene.plane + pixel
                key, number = get(k.keys, at), np.int64(get(k.ids, at))
            else:  # takes the hit on top out to the end
                slot, end = 0, count - 1 - (step - count // 2)
                at = end * scene.plane + pixel
                key, number = get(k.keys, at), np.int64(get(k.ids, at))
                put(k.keys, at, get(k.keys, pixel))
                put(k.ids, at, get(k.ids, pixel))
            _sink(scene, k, pixel, slot, end, key, number)


@inlined
def count_waiting(scene, k, pixels, level, none):
    """Counts the slots in use at each pixel, `level` at most; an empty one holds the key `none`."""
    for pixel in range(pixels):
        slot = 0
        while slot < level and get(k.keys, slot * scene.plane + pixel) > none:
            slot += 1
        put(k.count, pixel, slot)


@inlined
def _shift(scene, k, first, slot, source, level, moved, done):
    """Moves slot `source` of the pixels in the mask `moved` to `slot`; empties it for those that are done."""
    none = scene.limits.none
    to, at = slot * scene.plane + first, source * scene.plane + first
    if source < level:
        key = choose(done, none, choose(moved, load(k.keys, at), load(k.keys, to)))
        store(k.ids, to, choose(moved, load(k.ids, at), load(k.ids, to)))
    else:
        key = choose(done | moved, none, load(k.keys, to))
    store(k.keys, to, key)
    return key


@inlined
def pop(scene, k, replay, first, full, level, noted):
    """Blends the nearest hit of the queues in the mask `full`; returns the number of pixels that this has finished."""
    one = scene.limits.one
    through, opacity = load(k.through, first), gather(k.opacity, load(k.ids, first))
    blend(scene, k, replay, full, first, through, through * opacity, load(k.ids, first), noted)
    through = choose(full, through * (one - opacity), through)
    store(k.through, first, through)
    done, finished = close(scene, k, first, through)
    for slot in range(level):
        _shift(scene, k, first, slot, slot + 1, level, full, done)
    return finished


@inlined
def drain(scene, k, replay, reach, level, pixels, noted):
    """Blends all hits at least as near as `reach`; returns slots in use and pixels that this has finished.

    A blended hit stays in its slot, with the key infinity, until the slot can go for all lanes. What waits
    tells from which key on hits can be ignored: where so little light comes through it that they would not
    be blended.

    Args:
        reach: key that no hit still to come exceeds.
        level: slots in use before; pixels: in the band.
    """
    one, none, t_min, infinite = (
        scene.limits.one, scene.limits.none, scene.limits.t_min,
        scene.limits.infinite,
    )  # fmt: skip
    near = spread(reach)
    in_use, finished = 0, 0
    for first in range(0, pixels, LANES):
        key, through = load(k.keys, first), load(k.through, first)
        slot, gone = 0, 0
        while any_lane(key >= near):
            at = slot * scene.plane + first
            now = (key >= near) & (key < infinite) & (through >= t_min)
            word = bits(now)
            if word != 0:
                opacity = gather(k.opacity, load(k.ids, at))
                blend(scene, k, replay, now, first, through, through * opacity, load(k.ids, at), noted)
                through = choose(now, through * (one - opacity), through)
            store(k.keys, at, choose(key >= near, infinite, key))
            slot += 1
            if gone == slot - 1 and not any_lane((key > none) & (key < near)):
                gone = slot
            if slot == level:
                break
            key = load(k.keys, at + scene.plane)
        store(k.through, first, through)
        done, count = close(scene, k, first, through)
        finished += count
        floor = load(k.floor, first)
        every = first_lanes(LANES)
        slots = 0
        for slot in range(level):
            key = load(k.keys, slot * scene.plane + first)
            if gone > 0 or count > 0:
                key = _shift(scene, k, first, slot, slot + gone, level, every, done)
            if not any_lane(key > none):
                if gone == 0 and count == 0:
                    break
                continue
            slots = slot + 1
            waits = (key > none) & (key < infinite)
            opacity = gather(k.opacity, load(k.ids, slot * scene.plane + first))
            through = choose(waits, through * (one - opacity), through)
            floor = choose(waits & (through < t_min), maximum(floor, key), floor)
        store(k.floor, first, floor)
        in_use = max(in_use, slots)
    return in_use, finished
