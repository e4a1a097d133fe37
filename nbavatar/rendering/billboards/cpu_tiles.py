"""Numba kernels that work through the tiles: forward, they blend; in the replay they record what the gradients need.

Exact order without a full sort: a tile takes its billboards by the least depth that they reach.
Hits wait in short queues (`cpu_sort.py`); from time to time those nearer than anything that the
billboards still to come can reach are final and are blended. A pixel that has become opaque, or will
be once its waiting hits are blended, takes no more hits from behind them. With a queue of n hits, or
none, the same loop gives `kbuffer(n)` and `center`.

Everything is done for eight pixels at a time, the texels of a hit in rows of eight channels.
"""

import numpy as np

from nbavatar.jit.compile import inlined, kernel
from nbavatar.jit.lanes import LANES
from nbavatar.jit.memory import advance, fetch_add, get, pointer, pointers, prefetch, put
from nbavatar.rendering.billboards.cpu_blend import blend_unsorted, write_band
from nbavatar.rendering.billboards.cpu_intersection import NEAREST_KEY, broadcast_constants
from nbavatar.rendering.billboards.cpu_rasterize import intersect_packets, list_hits, list_packets, sample_features
from nbavatar.rendering.billboards.cpu_replay import differentiate, record_pixels, record_weight_adjoints
from nbavatar.rendering.billboards.cpu_scratch import BROKEN, GIVEN_UP, HITS, LIST, Band, Extent, Scene, layout_of
from nbavatar.rendering.billboards.cpu_sort import blend_final, enqueue, enqueue_and_blend
from nbavatar.rendering.binning import RECORD, TILE_WIDTH, tile_bounds
from nbavatar.rendering.sorting import LONGEST

__all__ = ["blend_tiles", "replay_tiles"]

_PATIENCE = 2048  # hits that wait in a tile's queues before it is looked which of them are final
_AHEAD = 512  # texels of the next billboard's alpha that are asked for in advance


@inlined
def _clear(scene, scratch, band, replay):
    """Prepares the scratch for a band; pixels off the image count as finished."""
    constants = scene.constants
    for i in range(band.pixels):
        put(scratch.transmittance, i, constants.zero)
        put(scratch.cutoff, i, constants.infinite_key)
        put(scratch.queue_length, i, 0)
    for y in range(band.bottom - band.top):
        for x in range(band.right - band.left):
            put(scratch.transmittance, y * TILE_WIDTH + x, constants.one)
            put(scratch.cutoff, y * TILE_WIDTH + x, constants.empty_key)
    if replay:
        put(scratch.blended_count, 0, 0)
        for i in range(band.pixels):
            put(scratch.suffix, i, constants.zero)
    else:
        for i in range(TILE_WIDTH * (band.bottom - band.top) * scene.layout.stride):
            put(scratch.colour, i, constants.zero)


@inlined
def _extent(box, i, band):
    """Where billboard i lies in the band; its box is that of `Bins`."""
    return Extent(
        max(band.left, box[i, 0]) - band.left, min(band.right, box[i, 2]) - band.left,
        (box[i, 0] + box[i, 2]) // 2 - band.left,
        max(band.top, box[i, 1]) - band.top, min(band.bottom, box[i, 3]) - band.top,
        (box[i, 1] + box[i, 3]) // 2 - band.top,
    )  # fmt: skip


def _build(replay):
    """The kernel that blends, or the one that repeats the blending and writes the tape.

    Two kernels from one source: neither holds the other's code, which would take registers from its own.
    """

    @kernel
    def work(counter, tiles, bins, textures_, constants, shape, images_, adjoints_, tape_, scratch_, status):
        """Works through tiles until none is left: blends them, or records what `gather_gradients` needs.

        Args:
            counter: (1,) int64, next position in `tiles`, shared by all workers.
            tiles: (n,) int32, in the order in which to take them.
            bins: see Bins.
            textures, shape, scratch: see `cpu_scratch`.
            constants: see `cpu_intersection`.
            images: of the forward pass, results; without elements in the replay.
            adjoints, tape: of the replay; without elements in the forward pass.
            status: [number of tiles given up, billboard with a NaN alpha + 1, hits, tiles given up ...]. The forward
                pass gives up a tile whose queues are too short, the replay one that differs from what it had before.
        """
        texels, width, height, queue, capacity, rows = (
            shape.texels, shape.width, shape.height, shape.queue, shape.capacity, shape.rows,
        )  # fmt: skip
        box, tile_start, packed = bins.box, bins.tile_start, pointers(bins)
        members, record, rank = packed.members, packed.record, packed.rank
        textures, scratch, tape = pointers(textures_), pointers(scratch_), pointers(tape_)
        layout = layout_of(shape)
        stride = layout.stride
        pixels = TILE_WIDTH * rows + LANES
        scene = Scene(
            textures.features, textures.uniform, layout, constants, broadcast_constants(constants), pixels,
            shape.bundles * LANES, pointers(adjoints_), tape, pointer(status, 0),
        )  # fmt: skip
        for i in range(max(capacity, LONGEST) * pixels):  # a free slot's number is looked up as well
            put(scratch.queue_hit, i, 0)
        if not replay:
            for i in range(stride):
                put(scratch.feature, shape.bundles * LANES * stride + i, constants.zero)
        while True:
            position = fetch_add(counter, 1)
            if position >= len(tiles):
                break
            tile = tiles[position]
            left, tile_top, right, tile_bottom = tile_bounds(tile, shape.across, width, height)
            first_entry, end_entry = tile_start[tile], tile_start[tile + 1]
            taped = get(tape.tile_bundle, tile) - tape.first if replay else 0
            total, hits_before = 0, status[HITS]
            overflow = False
            for top in range(tile_top, tile_bottom, rows):
                band = Band(left, right, top, min(top + rows, tile_bottom), pixels)
                _clear(scene, scratch, band, replay)
                active = (band.bottom - top) * (right - left)
                level, bundles, waiting, patience = 0, 0, 0, _PATIENCE
                for entry in range(first_entry, end_entry + 1):
                    last = entry == end_entry
                    i = 0
                    nearest_key = constants.lowest_key
                    if not last:
                        i = get(members, entry)
                        nearest_key = get(record, i * RECORD + NEAREST_KEY)
                    if level > 0 and (last or (queue < 0 and (level == capacity or waiting >= patience))):
                        full = level == capacity
                        level, stay, finished = blend_final(
                            scene, scratch, replay, nearest_key, TILE_WIDTH * (band.bottom - top)
                        )
                        active -= finished
                        # As many must come as have stayed, so that the sorting stays in proportion.
                        waiting, patience = 0, max(_PATIENCE, stay)
                        overflow = full and 2 * level > capacity and not last
                    if last or overflow or active == 0:
                        break
                    extent = _extent(box, i, band)
                    if extent.y_first >= extent.y_end:
                        continue
                    if entry + 1 < end_entry:  # the next billboard's alphas come while this one is worked on
                        for j in range(0, min(texels * texels, _AHEAD), 64 // textures_.alpha.itemsize):
                            prefetch(textures.alpha, np.int64(get(members, entry + 1)) * texels * texels + j)
                    texture, own = np.int64(i) * texels * texels, advance(record, i * RECORD)
                    features = advance(textures.features, texture * shape.channels)
                    uniform = advance(textures.uniform, np.int64(i) * stride)
                    count = list_packets(scene, scratch, own, extent)
                    intersect_packets(scene, scratch, own, features, count, extent)
                    hits, broken = list_hits(scene, scratch, own, advance(textures.alpha, texture), count)
                    if broken:
                        status[BROKEN] = i + 1
                    more = (hits + LANES - 1) // LANES
                    if replay and taped + bundles + more > get(tape.tile_bundle, tile + 1) - tape.first:
                        overflow = True  # there is no room for them
                        break
                    for bundle in range(bundles, bundles + more):
                        put(scratch.bundle_rank, bundle, get(rank, i))
                    if replay:
                        sample_features(scene, scratch, features, uniform, more * LANES, scratch.hit_feature)
                        record_weight_adjoints(scene, scratch, hits, bundles, band, width)
                        record_pixels(scene, scratch, hits, taped + bundles, top - tile_top)
                        at = 2 * ((top - tile_top) // rows * len(bins.members) + entry)
                        put(tape.ranges, at, total + bundles)
                        put(tape.ranges, at + 1, total + bundles + more)
                    elif queue != 0:
                        row = advance(scratch.feature, bundles * LANES * stride)
                        sample_features(scene, scratch, features, uniform, hits, row)
                    if queue < 0:
                        level = max(level, enqueue(scene, scratch, hits, bundles))
                        waiting += hits
                    elif queue > 0:
                        active -= enqueue_and_blend(scene, scratch, replay, hits, bundles, queue)
                        level = queue
                    else:
                        active -= blend_unsorted(scene, scratch, replay, count, hits, features, uniform, bundles)
                    bundles += more
                if overflow:
                    break
                taped += bundles
                total += bundles
                if replay:
                    differentiate(scene, scratch, taped - bundles)
                else:
                    write_band(scene, scratch, pointers(images_), band, width, height)
            if overflow:
                status[LIST + status[GIVEN_UP]] = tile
                status[GIVEN_UP] += 1
                status[HITS] = hits_before
            elif not replay:
                images_.bundles[tile] = total

    return work


blend_tiles, replay_tiles = _build(False), _build(True)
