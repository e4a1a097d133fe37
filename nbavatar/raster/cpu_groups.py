"""The groups of one billboard in one tile: which there are, where they meet the texture, how opaque it is there.

Each step is a loop of its own over all of the billboard's groups. No branch in them depends on the data: what
is found is written to the next place in any case, and the place moves on only where it was worth keeping. So a
processor works on several groups at once, where a test of each would have it guess wrongly and start again.
"""

import numpy as np

from nbavatar.raster.binning import TILE_HEIGHT, TILE_WIDTH
from nbavatar.raster.compile import inlined
from nbavatar.raster.cpu_hits import affine, cells, corners, footprint, intersect
from nbavatar.raster.lanes import (
    LANES,
    any_lane,
    bits,
    choose,
    count_bits,
    first_lanes,
    is_nan,
    lane_numbers,
    load,
    minimum,
    spread,
    store,
    to_real,
)  # fmt: skip
from nbavatar.raster.memory import get, prefetch, put

__all__ = ["COLUMN", "ROW", "list_groups", "locate", "sample"]

ROW, COLUMN = TILE_WIDTH.bit_length() - 1, TILE_WIDTH - 1  # a pixel's place in a band is row << ROW | column


@inlined
def list_groups(k, left, top, y_first, y_end, near):
    """Lists the groups in the columns that `spans` has found; returns how many.

    Args:
        left, top: first column and row of the band.
        y_first, y_end: the billboard's rows in it.
        near: key that no hit of the billboard exceeds, in all lanes; where the pixels are closed to such, the
            group is left out.
    """
    count = 0
    for y in range(y_first, y_end):
        x, end = get(k.ends, y - y_first), get(k.ends, TILE_HEIGHT + y - y_first)
        columns = spread(x) + lane_numbers() * spread(np.int32(LANES))
        store(k.first, count, columns + spread(np.int32((y - top) * TILE_WIDTH - left)))
        store(k.rest, count, spread(end) - columns)
        count += (np.int64(end) - np.int64(x) + LANES - 1) // LANES
    kept = 0
    for j in range(count):
        first, rest = get(k.first, j), get(k.rest, j)
        put(k.first, kept, first)
        put(k.rest, kept, rest)
        kept += 1 if any_lane(first_lanes(np.int64(rest)) & (load(k.floor, np.int64(first)) <= near)) else 0
    return kept


@inlined
def locate(scene, k, patch, count, texture, x_origin, y_origin, near, texels):
    """Writes the keys, the first texels and the weights of the listed groups, and asks for their features.

    Args:
        texture: number of the billboard's first texel.
        x_origin, y_origin: pixel that the record refers to, counted from the band's first.
    """
    common = scene.limits
    for j in range(count):
        first = np.int64(get(k.first, j))
        dx = to_real(spread(np.int32((first & COLUMN) - x_origin)) + lane_numbers(), scene.zero)
        dy = to_real(spread(np.int32((first >> ROW) - y_origin)), scene.zero)
        s, t, _, valid = intersect(patch, dx, dy, common)
        foot = footprint(s, t, common)
        key = affine(patch.w_x, patch.w_y, patch.key, dx, dy)
        floor = load(k.floor, first)
        hit = first_lanes(np.int64(get(k.rest, j))) & valid & (floor <= near) & (key >= floor)
        store(k.key, j * LANES, choose(hit, key, common.none))
        store(k.cell, j * LANES, cells(foot, texels))
        at = 4 * LANES * j
        store(k.weights, at, foot.y0 * foot.x0)
        store(k.weights, at + LANES, foot.y0 * foot.x1)
        store(k.weights, at + 2 * LANES, foot.y1 * foot.x0)
        store(k.weights, at + 3 * LANES, foot.y1 * foot.x1)
        for lane in (0, LANES // 2, LANES - 1):
            texel = (texture + np.int64(get(k.cell, j * LANES + lane))) * scene.channels
            prefetch(scene.features, texel)
            prefetch(scene.features, texel + scene.below)


@inlined
def sample(scene, k, alpha, fade, count, groups, rank, right, below):
    """Writes the opacities of the located groups and takes those with a hit into `order`.

    Args:
        alpha: pointer to the billboard's opacity texture; right, below: from a texel to its neighbours.
        groups: that the band had before; rank: of the billboard.

    Returns:
        Groups and hits found, and whether an opacity is no number.
    """
    common = scene.limits
    found, hits, broken = 0, 0, first_lanes(0)
    for j in range(count):
        key, at = load(k.key, j * LANES), 4 * LANES * j
        t00, t01, t10, t11 = corners(alpha, load(k.cell, j * LANES), right, below)
        above = t00 * load(k.weights, at) + t01 * load(k.weights, at + LANES)
        value = above + (t10 * load(k.weights, at + 2 * LANES) + t11 * load(k.weights, at + 3 * LANES))
        hit = key > common.none
        broken = broken | (hit & is_nan(value))
        hit = hit & (value >= common.alpha_min)
        store(k.key, j * LANES, choose(hit, key, common.none))
        store(k.opacity, (groups + found) * LANES, minimum(fade * value, common.alpha_max))
        put(k.rank, groups + found, rank)
        put(k.order, found, j)
        word = bits(hit)
        hits += count_bits(word)
        found += 1 if word != 0 else 0
    return found, hits, any_lane(broken)
