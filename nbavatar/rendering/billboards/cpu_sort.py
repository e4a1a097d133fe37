"""The order of blending: a queue of hits at each pixel, which wait until nothing nearer can come.

Queues are stored slot by slot: slot j of all pixels, then slot j + 1. A hit is put behind those that wait. In `ray`
order the queues are sorted when it is looked which hits are final, those of eight pixels at a time by the same
comparisons: no branch depends on a single pixel. With `kbuffer(n)` the nearest of n + 1 hits is blended.
"""

import numpy as np

from nbavatar.jit.compile import inlined
from nbavatar.jit.lane_memory import gather, load, store
from nbavatar.jit.lanes import LANES, any_lane, broadcast, first_lanes, largest_lane, mask_to_int, maximum, select
from nbavatar.jit.memory import get, put
from nbavatar.rendering.billboards.cpu_blend import blend, blend_one, finish
from nbavatar.rendering.billboards.cpu_scratch import SHIFT
from nbavatar.rendering.sorting import LONGEST, merge_exchange, network

__all__ = ["blend_final", "enqueue", "enqueue_and_blend", "sort_queues"]

_sort_2, _sort_4, _sort_8, _sort_all = network(2), network(4), network(8), network(LONGEST)
_sort_any = inlined(merge_exchange)


@inlined
def _enqueue_one(scene, scratch, h, pixel, hit):
    """Writes the current billboard's hit h behind those that wait at its pixel; returns how many they were."""
    lane, length = np.int64(get(scratch.hit_lane, h)), np.int64(get(scratch.queue_length, pixel))
    at = length * scene.stride + pixel
    put(scratch.queue_key, at, get(scratch.key, lane))
    put(scratch.queue_alpha, at, get(scratch.alpha, lane))
    put(scratch.queue_hit, at, hit)
    return length


@inlined
def enqueue(scene, scratch, hits, bundles):
    """Puts the hits of the current billboard behind the queues of their pixels.

    Args:
        bundles: of hits that the band had before.

    Returns:
        Length of the longest of these queues.
    """
    longest = 0
    for h in range(hits):
        pixel = np.int64(get(scratch.hit_pixel, h))
        length = _enqueue_one(scene, scratch, h, pixel, bundles * LANES + h) + 1
        put(scratch.queue_length, pixel, length)
        longest = max(longest, length)
    return longest


@inlined
def _nearest(scene, scratch, pixel, length):
    """Place of the nearest hit in a queue: the one with the greatest key, of equal ones with the lowest rank."""
    nearest, nearest_key = pixel, get(scratch.queue_key, pixel)
    for slot in range(1, length):
        at = slot * scene.stride + pixel
        key = get(scratch.queue_key, at)
        if key == nearest_key:
            hit, other = np.int64(get(scratch.queue_hit, at)), np.int64(get(scratch.queue_hit, nearest))
            first = get(scratch.bundle_rank, hit >> SHIFT) < get(scratch.bundle_rank, other >> SHIFT)
            nearest = at if first else nearest
        nearest, nearest_key = at if key > nearest_key else nearest, key if key > nearest_key else nearest_key
    return nearest


@inlined
def enqueue_and_blend(scene, scratch, replay, hits, bundles, limit):
    """Puts hits behind queues of a fixed length; where one gets longer, its nearest hit is blended.

    Args:
        bundles: of hits that the band had before; limit: that length.

    Returns:
        Number of pixels that this has finished.
    """
    stride, finished = np.int64(scene.stride), 0
    for h in range(hits):
        pixel = np.int64(get(scratch.hit_pixel, h))
        length = _enqueue_one(scene, scratch, h, pixel, bundles * LANES + h)
        if length < limit:
            put(scratch.queue_length, pixel, length + 1)
            continue
        last, nearest = length * stride + pixel, _nearest(scene, scratch, pixel, limit + 1)
        transmittance, alpha = get(scratch.transmittance, pixel), get(scratch.queue_alpha, nearest)
        blend_one(scene, scratch, replay, pixel, np.int64(get(scratch.queue_hit, nearest)), transmittance, alpha)
        put(scratch.queue_key, nearest, get(scratch.queue_key, last))
        put(scratch.queue_alpha, nearest, get(scratch.queue_alpha, last))
        put(scratch.queue_hit, nearest, get(scratch.queue_hit, last))
        transmittance = transmittance * (scene.constants.one - alpha)
        put(scratch.transmittance, pixel, transmittance)
        if transmittance < scene.constants.t_min:
            put(scratch.cutoff, pixel, scene.constants.infinite_key)
            put(scratch.queue_length, pixel, 0)
            finished += 1
    return finished


@inlined
def _exchange(queues, i, j):
    """Brings slots i and j of the same queues in order: by key, equal ones by rank."""
    scene, scratch, first = queues
    a, b = i * scene.stride + first, j * scene.stride + first
    key, other_key = load(scratch.queue_key, a), load(scratch.queue_key, b)
    hit, other_hit = load(scratch.queue_hit, a), load(scratch.queue_hit, b)
    alpha, other_alpha = load(scratch.queue_alpha, a), load(scratch.queue_alpha, b)
    swap, tied = key < other_key, (key == other_key) & (key > scene.lanes.empty_key)
    if any_lane(tied):
        shift = broadcast(np.int32(SHIFT))
        rank, other_rank = gather(scratch.bundle_rank, hit >> shift), gather(scratch.bundle_rank, other_hit >> shift)
        swap = swap | (tied & (other_rank < rank))
    store(scratch.queue_key, a, select(swap, other_key, key))
    store(scratch.queue_key, b, select(swap, key, other_key))
    store(scratch.queue_hit, a, select(swap, other_hit, hit))
    store(scratch.queue_hit, b, select(swap, hit, other_hit))
    store(scratch.queue_alpha, a, select(swap, other_alpha, alpha))
    store(scratch.queue_alpha, b, select(swap, alpha, other_alpha))


@inlined
def sort_queues(scene, scratch, first, length, longest):
    """Sorts the queues of the pixels `first + lane`, nearest hit first, of the lengths `length`, at most `longest`."""
    keys, alphas, hits = scratch.queue_key, scratch.queue_alpha, scratch.queue_hit
    stride, empty_key = scene.stride, scene.lanes.empty_key
    if longest <= 2:
        tied = _sort_2(keys, alphas, hits, first, stride, length, empty_key)
    elif longest <= 4:
        tied = _sort_4(keys, alphas, hits, first, stride, length, empty_key)
    elif longest <= 8:
        tied = _sort_8(keys, alphas, hits, first, stride, length, empty_key)
    elif longest <= LONGEST:
        tied = _sort_all(keys, alphas, hits, first, stride, length, empty_key)
    else:
        tied = first_lanes(0)
        for slot in range(longest):
            at = slot * stride + first
            store(keys, at, select(length > broadcast(np.int32(slot)), load(keys, at), empty_key))
    if longest > LONGEST or any_lane(tied):
        _sort_any(longest, _exchange, (scene, scratch, first))


@inlined
def blend_final(scene, scratch, replay, nearest_key, pixels):
    """Sorts the queues and blends all hits that nothing still to come can precede.

    What waits tells from which key on hits can be ignored, the cutoff: where the transmittance behind it is so small
    that they would not be blended.

    Args:
        nearest_key: that no hit still to come exceeds.
        pixels: in the band.

    Returns:
        Slots still in use, about how many hits still wait, and pixels that this has finished.
    """
    one, empty_key, t_min = scene.lanes.one, scene.lanes.empty_key, scene.lanes.t_min
    bound, zero = broadcast(nearest_key), broadcast(np.int32(0))
    in_use, waiting, finished = 0, 0, 0
    for first in range(0, pixels, LANES):
        length = load(scratch.queue_length, first)
        longest = np.int64(largest_lane(length))
        if longest == 0:
            continue
        sort_queues(scene, scratch, first, length, longest)
        transmittance, cutoff = load(scratch.transmittance, first), load(scratch.cutoff, first)
        behind_all, held = transmittance, zero  # transmittance behind all hits so far, and their number
        freed = longest  # slots in front of the first in which a hit has to wait
        for slot in range(longest):
            at = slot * scene.stride + first
            key, alpha, hits = load(scratch.queue_key, at), load(scratch.queue_alpha, at), load(scratch.queue_hit, at)
            hit_mask, final = key > empty_key, key >= bound
            blended = hit_mask & final & (transmittance >= t_min)
            if any_lane(blended):
                blend(scene, scratch, replay, blended, first, transmittance, transmittance * alpha, hits)
                transmittance = select(blended, transmittance * (one - alpha), transmittance)
            behind_all = select(hit_mask, behind_all * (one - alpha), behind_all)
            held = held + mask_to_int(hit_mask)
            waits = hit_mask & (key < bound)
            if freed < slot or any_lane(waits):
                freed = min(freed, slot)
                cutoff = select(waits & (behind_all < t_min), maximum(cutoff, key), cutoff)
                to = at - freed * scene.stride
                store(scratch.queue_key, to, select(waits, key, empty_key))
                store(scratch.queue_alpha, to, alpha)
                store(scratch.queue_hit, to, hits)
        store(scratch.transmittance, first, transmittance)
        store(scratch.cutoff, first, cutoff)
        opaque, closed = finish(scene, scratch, first, transmittance)
        finished += closed
        held = held - broadcast(np.int32(freed))
        held = select(opaque, zero, select(held > zero, held, zero))
        store(scratch.queue_length, first, held)
        longest = np.int64(largest_lane(held))
        in_use = max(in_use, longest)
        waiting += LANES * longest
    return in_use, waiting, finished
