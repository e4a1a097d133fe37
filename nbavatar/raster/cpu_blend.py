"""Numba kernel that blends the CPU rasterizer's tiles, and in a replay notes what the gradients need.

Exact order without a full sort: a tile takes its billboards by the least depth that they reach.
Hits wait in short queues (`cpu_queue.py`); from time to time those nearer than anything that the
billboards still to come can reach are final and are blended. A pixel that has become opaque, or will
be once its waiting hits are blended, takes no more hits from behind them. With a queue of n hits, or
none, the same loop gives `kbuffer(n)` and `center`.

Everything is done for eight pixels at a time, the texels of a hit in rows of eight channels.
"""

import numpy as np

from nbavatar.raster.binning import RECORD, TILE_WIDTH, tile_bounds
from nbavatar.raster.compile import inlined, kernel
from nbavatar.raster.cpu_groups import COLUMN, ROW, list_groups, locate, sample
from nbavatar.raster.cpu_hits import INFINITE, LOWEST, NONE, ONE, SIZE, ZERO, patch_of, read_limits, spans
from nbavatar.raster.cpu_pixels import Scene, blend, close, divide, evaluate, keep_worth, settle, write
from nbavatar.raster.cpu_queue import append, drain, enqueue, pop
from nbavatar.raster.lanes import LANES, any_lane, choose, first_lanes, lane_numbers, load, spread, store
from nbavatar.raster.memory import ahead, fetch_add, get, pointer, prefetch, put
from nbavatar.raster.sorting import LONGEST

__all__ = ["blend_tiles", "note_tiles"]

_PATIENCE = 2048  # hits that wait in a tile's queues before it is looked which of them are final
_AHEAD = 512  # texels of the next billboard's opacity that are asked for in advance


@inlined
def _interpolate(scene, k, replay, texture, found, groups, noted, left, top, width, spots):
    """Evaluates the features of a billboard's groups with a hit; the replay also notes where the groups are.

    Args:
        texture: number of the billboard's first feature.
        found: groups with a hit, in `order`; groups: that the band had before.
        noted: place of the band's first group among the notes.
    """
    features, nothing = ahead(scene.features, texture), scene.limits.zero
    for m in range(found):
        j, group = np.int64(get(k.order, m)), groups + m
        if replay:
            first = np.int64(get(k.first, j))
            x, y = left + (first & COLUMN), top + (first >> ROW)
            evaluate(scene, k, features, j, k.features)
            keep_worth(scene, k, j, group, y * width + x)
            at = noted + group
            store(scene.notes, 2 * LANES * at, nothing)
            store(scene.notes, 2 * LANES * at + LANES, nothing)
            put(spots, 2 * at, x)
            put(spots, 2 * at + 1, y)
        else:
            evaluate(scene, k, features, j, ahead(k.features, group * LANES * scene.stride))


@inlined
def _wait(scene, k, replay, queue, found, groups, noted, level, capacity):
    """Has the hits found wait for their turn, or blends them where the order is the billboards'.

    Returns:
        Slots of the queues in use, or as many as there are if one is full, and pixels that this has finished.
    """
    one, none, finished = scene.limits.one, scene.limits.none, 0
    last, full = spread(np.int32(capacity - 1)), first_lanes(0)
    for m in range(found):
        j, group = np.int64(get(k.order, m)), groups + m
        first, key = np.int64(get(k.first, j)), load(k.key, j * LANES)
        if queue == 0:
            hit = key > none
            through, opaque = load(k.through, first), load(k.opacity, group * LANES)
            ids = spread(np.int32(group * LANES)) + lane_numbers()
            blend(scene, k, replay, hit, first, through, through * opaque, ids, noted)
            through = choose(hit, through * (one - opaque), through)
            store(k.through, first, through)
            _, closed = close(scene, k, first, through)
            finished += closed
        elif queue < 0:
            full = full | (append(scene, k, j, group, first) > last)
        else:
            level = enqueue(scene, k, key, group, first, level)
            if level > queue:
                over = load(k.keys, queue * scene.plane + first) > none
                if any_lane(over):
                    finished += pop(scene, k, replay, first, over, level, noted)
    if queue < 0 and found > 0:
        level = capacity if any_lane(full) else max(level, 1)
    return level, finished


def _build(replay):
    """The kernel that blends, or the one that repeats the blending and notes its gradients' parts.

    Two kernels from one source: neither holds the other's code, which would take registers from its own.
    """

    @kernel
    def work(turn, tiles, start, members_, record_, box, rank_, features_, alpha_, limits_, shape, image_, opacity_,
             grads_, grad_opacity_, notes_, spots_, ranges_, made, base, real, whole, status):  # fmt: skip
        """Works through tiles until none is left: blends them, or notes what `gather_gradients` needs.

        Args:
            turn: (1,) int64, next position in `tiles`, shared by all workers.
            tiles: (n,) int32, in the order in which to take them.
            start, members, record, box, rank: see Bins (`place` is the rank); `record` flat.
            features, alpha: textures, flat.
            limits: see `cpu_hits`.
            shape: texels, channels, width, height, tiles across, queue, capacity of a queue, rows worked on at
                once, groups that there is room for.
            image, opacity: (C, H, W), (H, W) results, flat; not written in the replay.
            grads: (H, W, stride) flat, gradients of the image, filled up with zeros; grad_opacity: (H, W) flat. These
                and what follows are used in the replay.
            notes: per group of hits, T a and then the gradient by a of the LANES hits; 0 where there is none.
            spots: per group, x of the first pixel and y.
            ranges: per band and tile entry, first and end of its groups, from those of the tile on.
            made: (tiles + 1,) int64; groups made in each tile, written by the forward pass; in the replay their
                running number, the tile's first.
            base: number of the first of the groups in `notes`.
            real, whole: scratch of this worker; see `scratch_sizes`.
            status: [number of tiles given up, billboard with a NaN alpha + 1, hits, tiles given up ...].
        """
        texels, channels, width, height, across, queue, capacity, rows, room = (
            shape[0], shape[1], shape[2], shape[3], shape[4], shape[5], shape[6], shape[7], shape[8],
        )  # fmt: skip
        members, record, rank = pointer(members_, 0), pointer(record_, 0), pointer(rank_, 0)
        alpha, limits = pointer(alpha_, 0), pointer(limits_, 0)
        image, opacity = pointer(image_, 0), pointer(opacity_, 0)
        notes, spots, ranges = pointer(notes_, 0), pointer(spots_, 0), pointer(ranges_, 0)
        zero, one, none = get(limits, ZERO), get(limits, ONE), get(limits, NONE)
        stride = (channels + LANES - 1) // LANES * LANES
        plane = TILE_WIDTH * rows + LANES
        k = divide(real, whole, plane, stride, capacity, room, replay)
        step = min(1, texels - 1)
        scene = Scene(
            pointer(features_, 0), read_limits(limits), zero, step * channels, step * texels * channels,
            step * (texels + 1) * channels, channels, stride, plane, room * LANES,
            pointer(grads_, 0), pointer(grad_opacity_, 0), notes, pointer(status, 0),
        )  # fmt: skip
        for i in range(max(capacity, LONGEST) * plane):  # a free place's number is looked up as well
            put(k.ids, i, 0)
        if not replay:
            for i in range(stride):
                put(k.features, room * LANES * stride + i, zero)
        while True:
            position = fetch_add(turn, 1)
            if position >= len(tiles):
                break
            tile = tiles[position]
            left, tile_top, right, tile_bottom = tile_bounds(tile, across, width, height)
            first_entry, end_entry = start[tile], start[tile + 1]
            noted = made[tile] - base if replay else 0
            total_groups, hits_before = 0, status[2]
            overflow = False
            for top in range(tile_top, tile_bottom, rows):
                bottom = min(top + rows, tile_bottom)
                pixels = TILE_WIDTH * (bottom - top)
                for i in range(plane):  # pixels off the image count as finished
                    put(k.through, i, zero)
                    put(k.floor, i, get(limits, INFINITE))
                for y in range(bottom - top):
                    for x in range(right - left):
                        put(k.through, y * TILE_WIDTH + x, one)
                        put(k.floor, y * TILE_WIDTH + x, none)
                if replay:
                    for i in range(plane):
                        put(k.last, i, -1)
                else:
                    for i in range(pixels * stride):
                        put(k.sums, i, zero)
                for i in range(plane):
                    put(k.count, i, 0)
                    put(k.free, i, i)
                if queue > 0:
                    for i in range(capacity * plane):
                        put(k.keys, i, none)
                active = (bottom - top) * (right - left)
                level, groups, waiting, patience = 0, 0, 0, _PATIENCE
                for entry in range(first_entry, end_entry + 1):
                    final = entry == end_entry
                    i = 0
                    reach = get(limits, LOWEST)
                    if not final:
                        i = get(members, entry)
                        reach = get(record, i * RECORD + 11)
                    if level > 0 and (final or (queue < 0 and (level == capacity or waiting >= patience))):
                        if queue > 0:
                            for i in range(plane):
                                put(k.count, i, level)
                        full = level == capacity
                        level, stay, finished = drain(scene, k, replay, reach, pixels, noted)
                        active -= finished
                        # As many must come as have stayed, so that the sorting stays in proportion.
                        waiting, patience = 0, max(_PATIENCE, stay)
                        overflow = full and 2 * level > capacity and not final
                    if final or overflow or active == 0:
                        break
                    first_group = groups
                    x_first, x_end = max(left, box[i, 0]), min(right, box[i, 2])
                    y_first, y_end = max(top, box[i, 1]), min(bottom, box[i, 3])
                    if y_first >= y_end:
                        continue
                    r = i * RECORD
                    if entry + 1 < end_entry:  # the next billboard's opacities come while this one is worked on
                        for j in range(0, min(texels * texels, _AHEAD), 64 // alpha_.itemsize):
                            prefetch(alpha, np.int64(get(members, entry + 1)) * texels * texels + j)
                    x_origin, y_origin = (box[i, 0] + box[i, 2]) // 2, (box[i, 1] + box[i, 3]) // 2
                    patch = patch_of(record, r)
                    texture = np.int64(i) * texels * texels
                    spans(record, r, get(limits, SIZE), one, x_first, x_end, x_origin, y_first, y_end, y_origin, k.ends)
                    count = list_groups(k, left, top, y_first, y_end, spread(reach))
                    locate(scene, k, patch, count, texture, x_origin - left, y_origin - top, spread(reach), texels)
                    found, hits, broken = sample(
                        scene, k, ahead(alpha, texture), patch.fade, count, groups, get(rank, i), step, step * texels
                    )
                    if broken:
                        status[1] = i + 1
                    waiting += hits
                    _interpolate(scene, k, replay, texture * channels, found, groups, noted, left, top, width, spots)
                    level, finished = _wait(scene, k, replay, queue, found, groups, noted, level, capacity)
                    active -= finished
                    groups += found
                    if replay:
                        at = 2 * ((top - tile_top) // rows * len(members_) + entry)
                        put(ranges, at, first_group + total_groups)
                        put(ranges, at + 1, groups + total_groups)
                if overflow:
                    break
                noted += groups
                total_groups += groups
                if replay:
                    settle(scene, k, left, right, top, bottom, noted - groups, zero, one)
                else:
                    write(scene, k, image, opacity, left, right, top, bottom, width, height)
            if overflow:
                status[3 + status[0]] = tile
                status[0] += 1
                status[2] = hits_before
            elif not replay:
                made[tile] = total_groups

    return work


blend_tiles, note_tiles = _build(False), _build(True)
