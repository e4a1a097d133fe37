"""The groups of one billboard in one tile: which there are, where they meet the texture, which of their pixels are hit.

Each step is a loop of its own over all of the billboard's groups or hits. No branch in them depends on the data:
what is found is written to the next place in any case, and the place moves on only where it was worth keeping. So
a processor works on several groups at once, where a test of each would have it guess wrongly and start again.
"""

import numpy as np

from nbavatar.jit.compile import inlined
from nbavatar.jit.lanes import (
    LANES,
    any_lane,
    bits,
    choose,
    count_bits,
    first_lanes,
    is_nan,
    lane_numbers,
    lanes_of,
    load,
    load_where,
    minimum,
    spread,
    store,
    to_real,
)  # fmt: skip
from nbavatar.jit.memory import ahead, get, prefetch, put
from nbavatar.rendering.billboards.cpu_hits import (
    FADE,
    affine,
    cells,
    corners,
    footprint,
    intersect,
    patch_of,
    spans,
)
from nbavatar.rendering.billboards.cpu_scratch import COLUMN, PART, ROW
from nbavatar.rendering.binning import TILE_HEIGHT, TILE_WIDTH

__all__ = ["evaluate", "features_of", "list_groups", "list_hits", "locate"]


@inlined
def list_groups(scene, k, record, x_first, x_end, x_origin, y_first, y_end, y_origin, near):
    """Lists the groups that the billboard may cover, row by row; returns how many.

    Args:
        record: pointer to the billboard's.
        x_first ... y_origin: the billboard's columns and rows in the band, and the pixel that the record refers to,
            all counted from the band's first.
        near: key that no hit of the billboard exceeds. Where the pixels are closed to such, the group is left out.
    """
    groups, numbers = k.groups, scene.numbers
    spans(record, numbers.size, numbers.one, x_first, x_end, x_origin, y_first, y_end, y_origin, groups.ends)
    count = 0
    for y in range(y_first, y_end):
        x, end = get(groups.ends, y - y_first), get(groups.ends, TILE_HEIGHT + y - y_first)
        columns = spread(x) + lane_numbers() * spread(np.int32(LANES))
        store(groups.first, count, columns + spread(np.int32(y * TILE_WIDTH)))
        store(groups.rest, count, spread(end) - columns)
        count += (np.int64(end) - np.int64(x) + LANES - 1) // LANES
    kept = 0
    for j in range(count):
        first, rest = get(groups.first, j), get(groups.rest, j)
        put(groups.first, kept, first)
        put(groups.rest, kept, rest)
        kept += 1 if any_lane(first_lanes(np.int64(rest)) & (load(k.floor, np.int64(first)) <= spread(near))) else 0
    return kept


@inlined
def locate(scene, k, record, features, count, x_origin, y_origin, near):
    """Writes the keys, the first texels and the weights of the listed groups, and asks for their features.

    Args:
        features: pointer to the billboard's; the others: see `list_groups`.
    """
    groups, layout, common, patch = k.groups, scene.layout, scene.limits, patch_of(record)
    below = layout.step * layout.texels * layout.channels
    for j in range(count):
        first, at = np.int64(get(groups.first, j)), j * LANES
        dx = to_real(spread(np.int32((first & COLUMN) - x_origin)) + lane_numbers(), scene.numbers.zero)
        dy = to_real(spread(np.int32((first >> ROW) - y_origin)), scene.numbers.zero)
        s, t, _, valid = intersect(patch, dx, dy, common)
        foot = footprint(s, t, common)
        key = affine(patch.w_x, patch.w_y, patch.key, dx, dy)
        least = load(k.floor, first)
        hit = first_lanes(np.int64(get(groups.rest, j))) & valid & (least <= spread(near)) & (key >= least)
        store(groups.key, at, choose(hit, key, common.none))
        store(groups.cell, at, cells(foot, layout.texels))
        store(groups.weights, at, foot.y0 * foot.x0)
        store(groups.weights, at + PART, foot.y0 * foot.x1)
        store(groups.weights, at + 2 * PART, foot.y1 * foot.x0)
        store(groups.weights, at + 3 * PART, foot.y1 * foot.x1)
        for lane in (0, LANES // 2, LANES - 1):
            texel = np.int64(get(groups.cell, at + lane)) * layout.channels
            prefetch(features, texel)
            prefetch(features, texel + below)


@inlined
def list_hits(scene, k, record, alpha, count):
    """Lists the hits among the located groups, one behind the other; writes the opacities of all.

    Args:
        record: pointer to the billboard's; `alpha`: to its opacity texture.

    Returns:
        How many there are, and whether an opacity is no number.
    """
    groups, layout, common = k.groups, scene.layout, scene.limits
    fade = spread(get(record, FADE))
    hits, broken = 0, first_lanes(0)
    for j in range(count):
        at = j * LANES
        key = load(groups.key, at)
        t00, t01, t10, t11 = corners(alpha, load(groups.cell, at), layout.step, layout.step * layout.texels)
        above = t00 * load(groups.weights, at) + t01 * load(groups.weights, at + PART)
        value = above + (t10 * load(groups.weights, at + 2 * PART) + t11 * load(groups.weights, at + 3 * PART))
        hit = key > common.none
        broken = broken | (hit & is_nan(value))
        hit = hit & (value >= common.alpha_min)
        store(groups.key, at, choose(hit, key, common.none))
        store(groups.alpha, at, minimum(fade * value, common.alpha_max))
        word = bits(hit)
        lanes = lanes_of(word)
        store(groups.hit, hits, spread(np.int32(at)) + lanes)
        store(groups.spot, hits, spread(get(groups.first, j)) + lanes)
        hits += count_bits(word)
    nothing = spread(np.int32(0))  # where hits are taken LANES at a time, the band's first pixel fills up
    store(groups.hit, hits, nothing)
    store(groups.spot, hits, nothing)
    return hits, any_lane(broken)


@inlined
def features_of(scene, k, features, hit, c):
    """Features from channel c on under a lane of the groups; `features`: pointer to the billboard's."""
    groups, layout = k.groups, scene.layout
    used = first_lanes(layout.channels - c)
    right, below = layout.step * layout.channels, layout.step * layout.texels * layout.channels
    texel = ahead(features, np.int64(get(groups.cell, hit)) * layout.channels + c)
    weights = ahead(groups.weights, hit)
    above = load_where(texel, 0, used) * spread(get(weights, 0))
    above = above + load_where(texel, right, used) * spread(get(weights, PART))
    under = load_where(texel, below, used) * spread(get(weights, 2 * PART))
    return above + (under + load_where(texel, right + below, used) * spread(get(weights, 3 * PART)))


@inlined
def evaluate(scene, k, features, hits, rows):
    """Writes the features of the listed hits to `rows`, `stride` numbers for each."""
    stride = scene.layout.stride
    for h in range(hits):
        hit, row = np.int64(get(k.groups.hit, h)), ahead(rows, h * stride)
        if stride == LANES:  # the usual case: no loop
            store(row, 0, features_of(scene, k, features, hit, 0))
        else:
            for c in range(0, stride, LANES):
                store(row, c, features_of(scene, k, features, hit, c))
