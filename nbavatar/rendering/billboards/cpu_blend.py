"""Numba kernel that blends the CPU rasterizer's tiles, and in a replay notes what the gradients need.

Exact order without a full sort: a tile takes its billboards by the least depth that they reach.
Hits wait in short queues (`cpu_queue.py`); from time to time those nearer than anything that the
billboards still to come can reach are final and are blended. A pixel that has become opaque, or will
be once its waiting hits are blended, takes no more hits from behind them. With a queue of n hits, or
none, the same loop gives `kbuffer(n)` and `center`.

Everything is done for eight pixels at a time, the texels of a hit in rows of eight channels.
"""

import numpy as np

from nbavatar.jit.compile import inlined, kernel
from nbavatar.jit.lanes import LANES, load, spread, store
from nbavatar.jit.memory import ahead, fetch_add, get, pointer, prefetch, put
from nbavatar.rendering.billboards.cpu_groups import evaluate, list_groups, list_hits, locate
from nbavatar.rendering.billboards.cpu_hits import read_limits, spread_limits
from nbavatar.rendering.billboards.cpu_pixels import blend_at_once, keep_worth, settle, write
from nbavatar.rendering.billboards.cpu_queue import append, drain, pass_through
from nbavatar.rendering.billboards.cpu_scratch import ROW, Layout, Scene, divide
from nbavatar.rendering.binning import RECORD, TILE_WIDTH, tile_bounds
from nbavatar.rendering.sorting import LONGEST

__all__ = ["blend_tiles", "note_tiles"]

_PATIENCE = 2048  # hits that wait in a tile's queues before it is looked which of them are final
_AHEAD = 512  # texels of the next billboard's opacity that are asked for in advance


@inlined
def _note_spots(scene, k, hits, bundle, rows_above, spots):
    """Writes where the hits of the billboard in hand are, bundle by bundle, and that none is blended yet: replay.

    Args:
        bundle: number of the first among the notes; rows_above: of the tile, over the band.
    """
    nothing, down = scene.limits.zero, spread(np.int32(rows_above << ROW))
    for h in range(0, hits, LANES):
        at = 2 * (bundle * LANES + h)
        store(scene.notes, at, nothing)
        store(scene.notes, at + LANES, nothing)
        store(spots, bundle * LANES + h, load(k.groups.spot, h) + down)


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
                once, bundles that there is room for.
            image, opacity: (C, H, W), (H, W) results, flat; not written in the replay.
            grads: (H, W, stride) flat, gradients of the image, filled up with zeros; grad_opacity: (H, W) flat. These
                and what follows are used in the replay.
            notes: per bundle of hits, T a and then the gradient by a of the LANES hits; 0 where there is none.
            spots: per bundle, the pixels' places in the tile.
            ranges: per band and tile entry, first and end of its bundles, from those of the tile on.
            made: (tiles + 1,) int64; bundles made in each tile, written by the forward pass; in the replay their
                running number, the tile's first.
            base: number of the first of the bundles in `notes`.
            real, whole: scratch of this worker; see `scratch_sizes`.
            status: [number of tiles given up, billboard with a NaN alpha + 1, hits, tiles given up ...]. The forward
                pass gives up a tile whose queues are too short, the replay one that differs from what was made.
        """
        texels, channels, width, height, across, queue, capacity, rows, room = (
            shape[0], shape[1], shape[2], shape[3], shape[4], shape[5], shape[6], shape[7], shape[8],
        )  # fmt: skip
        members, record, rank = pointer(members_, 0), pointer(record_, 0), pointer(rank_, 0)
        alpha, limits = pointer(alpha_, 0), pointer(limits_, 0)
        image, opacity = pointer(image_, 0), pointer(opacity_, 0)
        notes, spots, ranges = pointer(notes_, 0), pointer(spots_, 0), pointer(ranges_, 0)
        numbers = read_limits(limits)
        zero, one = numbers.zero, numbers.one
        stride = (channels + LANES - 1) // LANES * LANES
        plane = TILE_WIDTH * rows + LANES
        k = divide(real, whole, plane, stride, capacity, room, replay)
        scene = Scene(
            pointer(features_, 0), Layout(texels, min(1, texels - 1), channels, stride), numbers,
            spread_limits(numbers), room * LANES, pointer(grads_, 0), pointer(grad_opacity_, 0), notes,
            pointer(status, 0),
        )  # fmt: skip
        for i in range(max(capacity, LONGEST) * plane):  # a free place's number is looked up as well
            put(k.queues.ids, i, 0)
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
            total, hits_before = 0, status[2]
            overflow = False
            for top in range(tile_top, tile_bottom, rows):
                bottom = min(top + rows, tile_bottom)
                pixels = TILE_WIDTH * (bottom - top)
                for i in range(plane):  # pixels off the image count as finished
                    put(k.through, i, zero)
                    put(k.floor, i, numbers.infinite)
                for y in range(bottom - top):
                    for x in range(right - left):
                        put(k.through, y * TILE_WIDTH + x, one)
                        put(k.floor, y * TILE_WIDTH + x, numbers.none)
                if replay:
                    put(k.length, 0, 0)
                    for i in range(plane):
                        put(k.behind, i, zero)
                else:
                    for i in range(pixels * stride):
                        put(k.sums, i, zero)
                for i in range(plane):
                    put(k.queues.count, i, 0)
                active = (bottom - top) * (right - left)
                level, bundles, waiting, patience = 0, 0, 0, _PATIENCE
                for entry in range(first_entry, end_entry + 1):
                    final = entry == end_entry
                    i = 0
                    reach = numbers.lowest
                    if not final:
                        i = get(members, entry)
                        reach = get(record, i * RECORD + 11)
                    if level > 0 and (final or (queue < 0 and (level == capacity or waiting >= patience))):
                        full = level == capacity
                        level, stay, finished = drain(scene, k, replay, reach, pixels)
                        active -= finished
                        # As many must come as have stayed, so that the sorting stays in proportion.
                        waiting, patience = 0, max(_PATIENCE, stay)
                        overflow = full and 2 * level > capacity and not final
                    if final or overflow or active == 0:
                        break
                    x_first, x_end = max(left, box[i, 0]) - left, min(right, box[i, 2]) - left
                    y_first, y_end = max(top, box[i, 1]) - top, min(bottom, box[i, 3]) - top
                    if y_first >= y_end:
                        continue
                    if entry + 1 < end_entry:  # the next billboard's opacities come while this one is worked on
                        for j in range(0, min(texels * texels, _AHEAD), 64 // alpha_.itemsize):
                            prefetch(alpha, np.int64(get(members, entry + 1)) * texels * texels + j)
                    x_origin, y_origin = (box[i, 0] + box[i, 2]) // 2 - left, (box[i, 1] + box[i, 3]) // 2 - top
                    texture, mine = np.int64(i) * texels * texels, ahead(record, i * RECORD)
                    features = ahead(scene.features, texture * channels)
                    count = list_groups(scene, k, mine, x_first, x_end, x_origin, y_first, y_end, y_origin, reach)
                    locate(scene, k, mine, features, count, x_origin, y_origin, reach)
                    hits, broken = list_hits(scene, k, mine, ahead(alpha, texture), count)
                    if broken:
                        status[1] = i + 1
                    more = (hits + LANES - 1) // LANES
                    if replay and noted + bundles + more > made[tile + 1] - base:  # there is no room for them
                        overflow = True
                        break
                    for bundle in range(bundles, bundles + more):
                        put(k.rank, bundle, get(rank, i))
                    if replay:
                        evaluate(scene, k, features, more * LANES, k.features)
                        keep_worth(scene, k, hits, bundles, left, top, width)
                        _note_spots(scene, k, hits, noted + bundles, top - tile_top, spots)
                        at = 2 * ((top - tile_top) // rows * len(members_) + entry)
                        put(ranges, at, total + bundles)
                        put(ranges, at + 1, total + bundles + more)
                    elif queue != 0:
                        evaluate(scene, k, features, hits, ahead(k.features, bundles * LANES * stride))
                    if queue < 0:
                        level = max(level, append(k, hits, bundles))
                        waiting += hits
                    elif queue > 0:
                        active -= pass_through(scene, k, replay, hits, bundles, queue)
                        level = queue
                    else:
                        active -= blend_at_once(scene, k, replay, count, hits, features, bundles)
                    bundles += more
                if overflow:
                    break
                noted += bundles
                total += bundles
                if replay:
                    settle(scene, k, noted - bundles)
                else:
                    write(scene, k, image, opacity, left, right, top, bottom, width, height)
            if overflow:
                status[3 + status[0]] = tile
                status[0] += 1
                status[2] = hits_before
            elif not replay:
                made[tile] = total

    return work


blend_tiles, note_tiles = _build(False), _build(True)
