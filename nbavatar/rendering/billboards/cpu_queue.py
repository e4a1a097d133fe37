"""Queues of hits, one a pixel, which wait until nothing nearer can come.

They are stored slot by slot: slot j of all pixels, then slot j + 1. A hit is put behind those that wait. In `ray`
order the queues are sorted when it is looked which hits are final, those of eight pixels at a time by the same
comparisons: no branch depends on a single pixel. With `kbuffer(n)` the nearest of n + 1 hits is blended.
"""

import numpy as np

from nbavatar.jit.compile import inlined
from nbavatar.jit.lanes import (
    LANES,
    any_lane,
    choose,
    first_lanes,
    gather,
    largest,
    load,
    maximum,
    spread,
    store,
    truths,
)  # fmt: skip
from nbavatar.jit.memory import get, put
from nbavatar.rendering.billboards.cpu_pixels import blend, blend_one, close
from nbavatar.rendering.billboards.cpu_scratch import SHIFT
from nbavatar.rendering.sorting import LONGEST, merge_exchange, network

__all__ = ["append", "drain", "pass_through"]

_sort_2, _sort_4, _sort_8, _sort_all = network(2), network(4), network(8), network(LONGEST)
_sort_any = inlined(merge_exchange)


@inlined
def _put_behind(k, h, pixel, number):
    """Writes hit h of the billboard in hand behind those that wait at its pixel; returns how many they were."""
    groups, queues, hit = k.groups, k.queues, np.int64(get(k.groups.hit, h))
    count = np.int64(get(queues.count, pixel))
    at = count * queues.plane + pixel
    put(queues.keys, at, get(groups.key, hit))
    put(queues.opacities, at, get(groups.alpha, hit))
    put(queues.ids, at, number)
    return count


@inlined
def append(k, hits, bundles):
    """Puts the hits of the billboard in hand behind the queues of their pixels.

    Args:
        bundles: of hits that the band had before.

    Returns:
        How many hits wait then at the pixel with the most of them.
    """
    most = 0
    for h in range(hits):
        pixel = np.int64(get(k.groups.spot, h))
        count = _put_behind(k, h, pixel, bundles * LANES + h) + 1
        put(k.queues.count, pixel, count)
        most = max(most, count)
    return most


@inlined
def _nearest(k, pixel, length):
    """Place of the nearest hit in a queue: the one with the greatest key, of equal ones with the lowest rank."""
    queues = k.queues
    nearest, best = pixel, get(queues.keys, pixel)
    for slot in range(1, length):
        at = slot * queues.plane + pixel
        key = get(queues.keys, at)
        if key == best:
            bundle, other = np.int64(get(queues.ids, at)) >> SHIFT, np.int64(get(queues.ids, nearest)) >> SHIFT
            nearest = at if get(k.rank, bundle) < get(k.rank, other) else nearest
        nearest, best = at if key > best else nearest, key if key > best else best
    return nearest


@inlined
def pass_through(scene, k, replay, hits, bundles, length):
    """Puts hits behind queues of a fixed length; where one gets longer, its nearest hit is blended.

    Args:
        bundles: of hits that the band had before.

    Returns:
        Number of pixels that this has finished.
    """
    plane, finished = np.int64(k.queues.plane), 0
    for h in range(hits):
        pixel = np.int64(get(k.groups.spot, h))
        count = _put_behind(k, h, pixel, bundles * LANES + h)
        if count < length:
            put(k.queues.count, pixel, count + 1)
            continue
        last, nearest = count * plane + pixel, _nearest(k, pixel, length + 1)
        through, opacity = get(k.through, pixel), get(k.queues.opacities, nearest)
        blend_one(scene, k, replay, pixel, np.int64(get(k.queues.ids, nearest)), through, opacity)
        put(k.queues.keys, nearest, get(k.queues.keys, last))
        put(k.queues.opacities, nearest, get(k.queues.opacities, last))
        put(k.queues.ids, nearest, get(k.queues.ids, last))
        through = through * (scene.numbers.one - opacity)
        put(k.through, pixel, through)
        if through < scene.numbers.t_min:
            put(k.floor, pixel, scene.numbers.infinite)
            put(k.queues.count, pixel, 0)
            finished += 1
    return finished


@inlined
def _exchange(queues, i, j):
    """Brings slots i and j of the same queues in order: by key, equal ones by rank."""
    scene, k, first = queues
    a, b = i * k.queues.plane + first, j * k.queues.plane + first
    key, other = load(k.queues.keys, a), load(k.queues.keys, b)
    number, other_number = load(k.queues.ids, a), load(k.queues.ids, b)
    opacity, other_opacity = load(k.queues.opacities, a), load(k.queues.opacities, b)
    behind, tie = key < other, (key == other) & (key > scene.limits.none)
    if any_lane(tie):
        shift = spread(np.int32(SHIFT))
        behind = behind | (tie & (gather(k.rank, other_number >> shift) < gather(k.rank, number >> shift)))
    store(k.queues.keys, a, choose(behind, other, key))
    store(k.queues.keys, b, choose(behind, key, other))
    store(k.queues.ids, a, choose(behind, other_number, number))
    store(k.queues.ids, b, choose(behind, number, other_number))
    store(k.queues.opacities, a, choose(behind, other_opacity, opacity))
    store(k.queues.opacities, b, choose(behind, opacity, other_opacity))


@inlined
def _sort(scene, k, first, count, most):
    """Sorts the queues `first + lane`, in which `count` hits wait, `most` at most."""
    plane, none = k.queues.plane, scene.limits.none
    if most <= 2:
        tied = _sort_2(k.queues.keys, k.queues.opacities, k.queues.ids, first, plane, count, none)
    elif most <= 4:
        tied = _sort_4(k.queues.keys, k.queues.opacities, k.queues.ids, first, plane, count, none)
    elif most <= 8:
        tied = _sort_8(k.queues.keys, k.queues.opacities, k.queues.ids, first, plane, count, none)
    elif most <= LONGEST:
        tied = _sort_all(k.queues.keys, k.queues.opacities, k.queues.ids, first, plane, count, none)
    else:
        tied = first_lanes(0)
        for slot in range(most):
            at = slot * plane + first
            store(k.queues.keys, at, choose(count > spread(np.int32(slot)), load(k.queues.keys, at), none))
    if most > LONGEST or any_lane(tied):
        _sort_any(most, _exchange, (scene, k, first))


@inlined
def drain(scene, k, replay, reach, pixels):
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
        count = load(k.queues.count, first)
        most = np.int64(largest(count))
        if most == 0:
            continue
        _sort(scene, k, first, count, most)
        through, floor = load(k.through, first), load(k.floor, first)
        behind, held = through, zero  # transmittance behind all hits so far, and their number
        gone = most  # slots in front of the first in which a hit has to wait
        for slot in range(most):
            at = slot * k.queues.plane + first
            key, opacity, ids = load(k.queues.keys, at), load(k.queues.opacities, at), load(k.queues.ids, at)
            some, final = key > none, key >= near
            now = some & final & (through >= t_min)
            if any_lane(now):
                blend(scene, k, replay, now, first, through, through * opacity, ids)
                through = choose(now, through * (one - opacity), through)
            behind = choose(some, behind * (one - opacity), behind)
            held = held + truths(some)
            waits = some & (key < near)
            if gone < slot or any_lane(waits):
                gone = min(gone, slot)
                floor = choose(waits & (behind < t_min), maximum(floor, key), floor)
                to = at - gone * k.queues.plane
                store(k.queues.keys, to, choose(waits, key, none))
                store(k.queues.opacities, to, opacity)
                store(k.queues.ids, to, ids)
        store(k.through, first, through)
        store(k.floor, first, floor)
        done, closed = close(scene, k, first, through)
        finished += closed
        held = held - spread(np.int32(gone))
        held = choose(done, zero, choose(held > zero, held, zero))
        store(k.queues.count, first, held)
        most = np.int64(largest(held))
        in_use = max(in_use, most)
        waiting += LANES * most
    return in_use, waiting, finished
