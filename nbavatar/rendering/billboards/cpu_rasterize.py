"""Which pixels of a tile a billboard hits, with which alpha, and its features there.

Each step is a loop of its own over all of the billboard's packets or hits. No branch in them depends on the data:
what is found is written to the next place in any case, and the place moves on only where it was to be kept. So
a processor works on several packets at once, where a test of each would have it guess wrongly and start again.
"""

import numpy as np

from nbavatar.jit.compile import inlined
from nbavatar.jit.lane_memory import load, masked_load, store
from nbavatar.jit.lanes import (
    LANES,
    any_lane,
    broadcast,
    count_bits,
    first_lanes,
    is_nan,
    lane_numbers,
    mask_bits,
    minimum,
    select,
    set_lanes,
    to_real,
)
from nbavatar.jit.memory import advance, get, prefetch, put
from nbavatar.rendering.billboards.cpu_intersection import (
    FADE,
    NEAREST_KEY,
    affine,
    corners,
    first_texels,
    footprint,
    intersect,
    patch_of,
    spans,
)
from nbavatar.rendering.billboards.cpu_scratch import COLUMN, CORNER, ROW
from nbavatar.rendering.binning import TILE_HEIGHT, TILE_WIDTH

__all__ = ["feature_of", "intersect_packets", "list_hits", "list_packets", "sample_features"]


@inlined
def list_packets(scene, scratch, record, extent):
    """Lists the packets that the billboard may cover, row by row; returns how many.

    Packets are left out where all pixels are closed to keys as near as the billboard's.

    Args:
        record: pointer to the billboard's.
        extent: see `cpu_scratch.Extent`.
    """
    spans(record, scene.constants.size, scene.constants.one, extent, scratch.span)
    nearest_key = broadcast(get(record, NEAREST_KEY))
    count = 0
    for y in range(extent.y_first, extent.y_end):
        x, end = get(scratch.span, y - extent.y_first), get(scratch.span, TILE_HEIGHT + y - extent.y_first)
        columns = broadcast(x) + lane_numbers() * broadcast(np.int32(LANES))
        store(scratch.packet_pixel, count, columns + broadcast(np.int32(y * TILE_WIDTH)))
        store(scratch.packet_width, count, broadcast(end) - columns)
        count += (np.int64(end) - np.int64(x) + LANES - 1) // LANES
    kept = 0
    for j in range(count):
        first, width = get(scratch.packet_pixel, j), get(scratch.packet_width, j)
        put(scratch.packet_pixel, kept, first)
        put(scratch.packet_width, kept, width)
        open_lanes = first_lanes(np.int64(width)) & (load(scratch.cutoff, np.int64(first)) <= nearest_key)
        kept += 1 if any_lane(open_lanes) else 0
    return kept


@inlined
def intersect_packets(scene, scratch, record, features, count, extent):
    """Writes the keys, the first texels and their bilinear weights of the listed packets, and asks for their features.

    Args:
        features: pointer to the billboard's; count: of packets; the others: see `list_packets`.
    """
    layout, lanes, patch = scene.layout, scene.lanes, patch_of(record)
    below = layout.step * layout.texels * layout.channels
    nearest_key = broadcast(get(record, NEAREST_KEY))
    for j in range(count):
        first, at = np.int64(get(scratch.packet_pixel, j)), j * LANES
        dx = to_real(broadcast(np.int32((first & COLUMN) - extent.x_origin)) + lane_numbers(), scene.constants.zero)
        dy = to_real(broadcast(np.int32((first >> ROW) - extent.y_origin)), scene.constants.zero)
        s, t, _, valid = intersect(patch, dx, dy, lanes)
        foot = footprint(s, t, lanes)
        key = affine(patch.w_x, patch.w_y, patch.key, dx, dy)
        cutoff = load(scratch.cutoff, first)
        width = np.int64(get(scratch.packet_width, j))
        hit_mask = first_lanes(width) & valid & (cutoff <= nearest_key) & (key >= cutoff)
        store(scratch.key, at, select(hit_mask, key, lanes.empty_key))
        store(scratch.texel, at, first_texels(foot, layout.texels))
        store(scratch.corner_weight, at, foot.y0 * foot.x0)
        store(scratch.corner_weight, at + CORNER, foot.y0 * foot.x1)
        store(scratch.corner_weight, at + 2 * CORNER, foot.y1 * foot.x0)
        store(scratch.corner_weight, at + 3 * CORNER, foot.y1 * foot.x1)
        for lane in (0, LANES // 2, LANES - 1):
            texel = np.int64(get(scratch.texel, at + lane)) * layout.channels
            prefetch(features, texel)
            prefetch(features, texel + below)


@inlined
def list_hits(scene, scratch, record, alpha, count):
    """Lists the hits among the packets, one behind the other; writes the alphas of all.

    Args:
        record: pointer to the billboard's; `alpha`: to its alpha texture; count: of packets.

    Returns:
        How many there are, and whether an alpha is no number.
    """
    layout, lanes = scene.layout, scene.lanes
    fade = broadcast(get(record, FADE))
    weight = scratch.corner_weight
    hits, broken = 0, first_lanes(0)
    for j in range(count):
        at = j * LANES
        key = load(scratch.key, at)
        t00, t01, t10, t11 = corners(alpha, load(scratch.texel, at), layout.step, layout.step * layout.texels)
        above = t00 * load(weight, at) + t01 * load(weight, at + CORNER)
        sample = above + (t10 * load(weight, at + 2 * CORNER) + t11 * load(weight, at + 3 * CORNER))
        hit_mask = key > lanes.empty_key
        broken = broken | (hit_mask & is_nan(sample))
        hit_mask = hit_mask & (sample >= lanes.alpha_min)
        store(scratch.key, at, select(hit_mask, key, lanes.empty_key))
        store(scratch.alpha, at, minimum(fade * sample, lanes.alpha_max))
        word = mask_bits(hit_mask)
        numbers = set_lanes(word)
        store(scratch.hit_lane, hits, broadcast(np.int32(at)) + numbers)
        store(scratch.hit_pixel, hits, broadcast(get(scratch.packet_pixel, j)) + numbers)
        hits += count_bits(word)
    zeros = broadcast(np.int32(0))  # where hits are taken LANES at a time, the band's first pixel fills up
    store(scratch.hit_lane, hits, zeros)
    store(scratch.hit_pixel, hits, zeros)
    return hits, any_lane(broken)


@inlined
def feature_of(scene, scratch, features, uniform, lane, c):
    """Features from channel c on under a lane of the packets; `features`, `uniform`: pointers to the billboard's."""
    layout = scene.layout
    weight = advance(scratch.corner_weight, lane)
    w00, w01 = broadcast(get(weight, 0)), broadcast(get(weight, CORNER))
    w10, w11 = broadcast(get(weight, 2 * CORNER)), broadcast(get(weight, 3 * CORNER))
    feature = scene.lanes.zero
    if c < layout.channels:
        used = first_lanes(layout.channels - c)
        right, below = layout.step * layout.channels, layout.step * layout.texels * layout.channels
        texel = advance(features, np.int64(get(scratch.texel, lane)) * layout.channels + c)
        above = masked_load(texel, 0, used) * w00 + masked_load(texel, right, used) * w01
        feature = above + (masked_load(texel, below, used) * w10 + masked_load(texel, right + below, used) * w11)
    if layout.image_channels > layout.channels:
        feature = feature + load(uniform, c) * ((w00 + w01) + (w10 + w11))
    return feature


@inlined
def sample_features(scene, scratch, features, uniform, hits, rows):
    """Writes the features of the listed hits to `rows`, `stride` numbers for each."""
    stride = scene.layout.stride
    for h in range(hits):
        lane, row = np.int64(get(scratch.hit_lane, h)), advance(rows, h * stride)
        if stride == LANES:  # the usual case: no loop
            store(row, 0, feature_of(scene, scratch, features, uniform, lane, 0))
        else:
            for c in range(0, stride, LANES):
                store(row, c, feature_of(scene, scratch, features, uniform, lane, c))
