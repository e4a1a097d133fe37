"""Queues of hits, one a pixel, which wait until nothing nearer can come.

They are stored slot by slot: slot j of all pixels, then slot j + 1. In `ray` order a hit is put behind those that
wait, and the queues are sorted when it is looked which hits are final, those of eight pixels at a time by the same
comparisons: no branch depends on a single pixel. With a queue of n hits they are kept sorted, the nearest in slot 0.
"""

import numpy as np

from nbavatar.raster.compile import inlined
from nbavatar.raster.cpu_pixels import SHIFT, blend, close
from nbavatar.raster.lanes import (
    LANES,
    any_lane,
    choose,
    first_lanes,
    gather,
    lane_numbers,
    largest,
    load,
    maximum,
    spread,
    store,
    truths,
)  # fmt: skip
from nbavatar.raster.memory import get, put
from nbavatar.raster.sorting import LONGEST, merge_exchange, network

__all__ = ["append", "drain", "enqueue", "pop"]

_sort_2, _sort_4, _sort_8, _sort_all = network(2), network(4), network(8), network(LONGEST)
_sort_any = inlined(merge_exchange)


@inlined
def append(scene, k, j, group, first):
    """Puts the hits of group j of the billboard in hand behind the queues of the pixels `first + lane`.

    A lane without a hit is written as well, to a place that stays free.

    Returns:
        How many hits wait at each of the pixels then.
    """
    for lane in range(LANES):
        at, number = np.int64(get(k.free, first + lane)), group * LANES + lane
        put(k.keys, at, get(k.key, j * LANES + lane))
        put(k.opacities, at, get(k.opacity, number))
        put(k.ids, at, number)
    hit = truths(load(k.key, j * LANES) > scene.limits.none)
    count = load(k.count, first) + hit
    store(k.count, first, count)
    store(k.free, first, load(k.free, first) + hit * spread(np.int32(scene.plane)))
    return count


@inlined
def enqueue(scene, k, key, group, first, level):
    """Puts hits into the sorted queues of the pixels `first + lane`; returns how many slots are in use then.

    Of equal keys the one of lower rank goes first.
    """
    none, shift = scene.limits.none, spread(np.int32(SHIFT))
    ids, opacity = spread(np.int32(group * LANES)) + lane_numbers(), load(k.opacity, group * LANES)
    slot = 0
    while True:
        at = slot * scene.plane + first
        held, held_id, held_opacity = load(k.keys, at), load(k.ids, at), load(k.opacities, at)
        ahead = key > held
        tie = (key == held) & (key > none)
        if any_lane(tie):
            ahead = ahead | (tie & (gather(k.rank, ids >> shift) < gather(k.rank, held_id >> shift)))
        store(k.keys, at, choose(ahead, key, held))
        store(k.ids, at, choose(ahead, ids, held_id))
        store(k.opacities, at, choose(ahead, opacity, held_opacity))
        key, ids, opacity = choose(ahead, held, key), choose(ahead, held_id, ids), choose(ahead, held_opacity, opacity)
        slot += 1
        if not any_lane(key > none):
            return max(level, slot)


@inlined
def pop(scene, k, replay, first, full, level, noted):
    """Blends the nearest hit of the queues in the mask `full`; returns the number of pixels that this has finished."""
    one, none = scene.limits.one, scene.limits.none
    through, opacity = load(k.through, first), load(k.opacities, first)
    blend(scene, k, replay, full, first, through, through * opacity, load(k.ids, first), noted)
    through = choose(full, through * (one - opacity), through)
    store(k.through, first, through)
    done, finished = close(scene, k, first, through)
    for slot in range(level):
        to, at = slot * scene.plane + first, (slot + 1) * scene.plane + first
        key = load(k.keys, to)
        if slot + 1 < level:
            key = choose(full, load(k.keys, at), key)
            store(k.ids, to, choose(full, load(k.ids, at), load(k.ids, to)))
            store(k.opacities, to, choose(full, load(k.opacities, at), load(k.opacities, to)))
        else:
            key = choose(full, none, key)
        store(k.keys, to, choose(done, none, key))
    return finished


@inlined
def _exchange(queues, i, j):
    """Brings slots i and j of the same queues in order: by key, equal ones by rank."""
    scene, k, first = queues
    a, b = i * scene.plane + first, j * scene.plane + first
    key, other = load(k.keys, a), load(k.keys, b)
    number, other_number = load(k.ids, a), load(k.ids, b)
    opacity, other_opacity = load(k.opacities, a), load(k.opacities, b)
    behind, tie = key < other, (key == other) & (key > scene.limits.none)
    if any_lane(tie):
        shift = spread(np.int32(SHIFT))
        behind = behind | (tie & (gather(k.rank, other_number >> shift) < gather(k.rank, number >> shift)))
    store(k.keys, a, choose(behind, other, key))
    store(k.keys, b, choose(behind, key, other))
    store(k.ids, a, choose(behind, other_number, number))
    store(k.ids, b, choose(behind, number, other_number))
    store(k.opacities, a, choose(behind, other_opacity, opacity))
    store(k.opacities, b, choose(behind, opacity, other_opacity))


@inlined
def _sort(scene, k, first, count, most):
    """Sorts the queues `first + lane`, in which `count` hits wait, `most` at most."""
    plane, none = scene.plane, scene.limits.none
    if most <= 2:
        tied = _sort_2(k.keys, k.opacities, k.ids, first, plane, count, none)
    elif most <= 4:
        tied = _sort_4(k.keys, k.opacities, k.ids, first, plane, count, none)
    elif most <= 8:
        tied = _sort_8(k.keys, k.opacities, k.ids, first, plane, count, none)
    elif most <= LONGEST:
        tied = _sort_all(k.keys, k.opacities, k.ids, first, plane, count, none)
    else:
        tied = first_lanes(0)
        for slot in range(most):
            at = slot * plane + first
            store(k.keys, at, choose(count > spread(np.int32(slot)), load(k.keys, at), none))
    if most > LONGEST or any_lane(tied):
        _sort_any(most, _exchange, (scene, k, first))


@inlined
def drain(scene, k, replay, reach, pixels, noted):
    """Blends all hits at least as near as `reach`; sorts the queues on the way.

    What waits tells from which key on hits can be ignored: where so little light comes through it that they would
    not be blended.

    Args:
        reach: key that no hit still to come exceeds.
        pixels: in the band.

    Returns:
        Slots still in use, about how many hits still wait, and pixels that this has finished.
    """
    one, none, t_min = scene.limits.one, scene.limits.none, scene.limits.t_min
    near, zero = spread(reach), spread(np.int32(0))
    in_use, waiting, finished = 0, 0, 0
    for first in range(0, pixels, LANES):
        count = load(k.count, first)
        most = np.int64(largest(count))
        if most == 0:
            continue
        _sort(scene, k, first, count, most)
        through, floor = load(k.through, first), load(k.floor, first)
        behind, held = through, zero  # transmittance behind all hits so far, and their number
        gone = most  # slots in front of the first in which a hit has to wait
        for slot in range(most):
            at = slot * scene.plane + first
            key, opacity, ids = load(k.keys, at), load(k.opacities, at), load(k.ids, at)
            some, final = key > none, key >= near
            now = some & final & (through >= t_min)
            if any_lane(now):
                blend(scene, k, replay, now, first, through, through * opacity, ids, noted)
                through = choose(now, through * (one - opacity), through)
            behind = choose(some, behind * (one - opacity), behind)
            held = held + truths(some)
            waits = some & (key < near)
            if gone < slot or any_lane(waits):
                gone = min(gone, slot)
                floor = choose(waits & (behind < t_min), maximum(floor, key), floor)
                to = at - gone * scene.plane
                store(k.keys, to, choose(waits, key, none))
                store(k.opacities, to, opacity)
                store(k.ids, to, ids)
        store(k.through, first, through)
        store(k.floor, first, floor)
        done, closed = close(scene, k, first, through)
        finished += closed
        held = held - spread(np.int32(gone))
        held = choose(done, zero, choose(held > zero, held, zero))
        store(k.count, first, held)
        store(k.free, first, held * spread(np.int32(scene.plane)) + (spread(np.int32(first)) + lane_numbers()))
        most = np.int64(largest(held))
        in_use = max(in_use, most)
        waiting += LANES * most
    return in_use, waiting, finished
