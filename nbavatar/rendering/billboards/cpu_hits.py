"""Steps that the CPU kernels share: where a billboard crosses a row, and what eight pixels of it see.

A *group* is eight neighbouring pixels of a row under one billboard, looked at together. A *hit* is a pixel of a group
that sees the billboard. The hits of a billboard in a tile follow each other without gaps; eight of them are a
*bundle*, and bundles are what is remembered and differentiated.
"""

from typing import Any, NamedTuple

import numpy as np

from nbavatar.jit import scalar
from nbavatar.jit.compile import inlined
from nbavatar.jit.lanes import (
    LANES,
    choose,
    floor,
    gather,
    gather_pairs,
    maximum,
    minimum,
    ramp,
    spread,
    store,
    to_int,
)  # fmt: skip
from nbavatar.jit.memory import ahead, get
from nbavatar.rendering.binning import TILE_HEIGHT

__all__ = [
    "FADE", "Footprint", "Limits", "Patch", "affine", "cells", "corners", "footprint", "intersect", "mix", "patch_of",
    "plane_slopes", "read_limits", "slopes", "spans", "spread_limits", "write_limits",
]  # fmt: skip

_S = scalar.build(inlined, floor, minimum, maximum, choose)
affine, first_texel, weights, slopes, mix, plane_slopes = (
    _S.affine, _S.first_texel, _S.weights, _S.slopes, _S.mix, _S.plane_slopes,
)  # fmt: skip

_MARGIN = 0.1  # pixels by which a row's span is widened; coverage itself is decided pixel by pixel


class Limits(NamedTuple):
    """Numbers that steer the kernels, each once or in all lanes."""

    zero: Any
    one: Any
    size: Any  # texels a side
    step: Any  # min(1, texels - 1): from a texel to the next
    inverse_near: Any
    alpha_min: Any
    t_min: Any
    alpha_max: Any
    none: Any  # -infinity, the key of an empty place
    lowest: Any  # key that every hit's exceeds
    infinite: Any


class Patch(NamedTuple):
    """A billboard's record (see `binning.pack`), each number in all lanes."""

    s_x: Any
    s_y: Any
    s_1: Any
    t_x: Any
    t_y: Any
    t_1: Any
    w_x: Any
    w_y: Any
    w_1: Any
    key: Any
    fade: Any


FADE = Patch._fields.index("fade")


class Footprint(NamedTuple):
    """First texel (column, row) around a hit, and the weights of that and the next one."""

    column: Any
    row: Any
    x0: Any
    x1: Any
    y0: Any
    y1: Any


def write_limits(texels: int, near: float, alpha_min: float, t_min: float, alpha_max: float, dtype: Any) -> np.ndarray:
    """The array from which `read_limits` takes the numbers."""
    largest = np.finfo(dtype).max
    limits = Limits(0, 1, texels, min(1, texels - 1), 1 / near, alpha_min, t_min, alpha_max, -np.inf, -largest, np.inf)
    return np.array(limits, dtype)


@inlined
def read_limits(limits):
    """The numbers in the array of `write_limits`."""
    return Limits(
        get(limits, 0), get(limits, 1), get(limits, 2), get(limits, 3), get(limits, 4), get(limits, 5),
        get(limits, 6), get(limits, 7), get(limits, 8), get(limits, 9), get(limits, 10),
    )  # fmt: skip


@inlined
def spread_limits(numbers):
    """The same in all lanes."""
    return Limits(
        spread(numbers.zero), spread(numbers.one), spread(numbers.size), spread(numbers.step),
        spread(numbers.inverse_near), spread(numbers.alpha_min), spread(numbers.t_min), spread(numbers.alpha_max),
        spread(numbers.none), spread(numbers.lowest), spread(numbers.infinite),
    )  # fmt: skip


@inlined
def patch_of(record):
    """Spreads a billboard's record."""
    return Patch(
        spread(get(record, 0)), spread(get(record, 1)), spread(get(record, 2)), spread(get(record, 3)),
        spread(get(record, 4)), spread(get(record, 5)), spread(get(record, 6)), spread(get(record, 7)),
        spread(get(record, 8)), spread(get(record, 9)), spread(get(record, 10)),
    )  # fmt: skip


@inlined
def spans(record, size, one, x_first, x_end, x_origin, y_first, y_end, y_origin, ends):
    """Columns of each row, of x_first ... x_end, that the patch may cover.

    Texel coordinates lie in (-1, size) where four affine functions are positive: s + w, size w - s and the
    same for t. Row y_first + k gets the columns ends[k] ... ends[TILE_HEIGHT + k], the latter excluded.
    """
    zero = one - one
    margin = spread(zero + np.float32(_MARGIN))
    w_x, w_y, w_1 = get(record, 6), get(record, 7), get(record, 8)
    for k in range(0, y_end - y_first, LANES):
        dy = spread(zero + np.float32(y_first + k - y_origin)) + ramp(zero)
        low, high = spread(zero + np.float32(x_first - x_origin)), spread(zero + np.float32(x_end - 1 - x_origin))
        for side in range(4):
            at = 3 * (side >> 1)
            p_x, p_y, p_1 = get(record, at), get(record, at + 1), get(record, at + 2)
            if side & 1 == 0:
                slope, by_y, rest = p_x + w_x, p_y + w_y, p_1 + w_1
            else:
                slope, by_y, rest = size * w_x - p_x, size * w_y - p_y, size * w_1 - p_1
            value = spread(by_y) * dy + spread(rest)
            if slope > zero:  # of no number, as 0 / 0, `maximum` and `minimum` give the second
                low = maximum(value * spread(-one / slope) - margin, low)
            elif slope < zero:
                high = minimum(value * spread(-one / slope) + margin, high)
            else:
                high = choose(value < spread(zero), low - spread(one), high)
        some = low <= high
        low, high = choose(some, low, spread(zero)), choose(some, high, spread(-one))
        origin = spread(np.int32(x_origin))
        store(ends, k, to_int(-floor(-low)) + origin)
        store(ends, TILE_HEIGHT + k, to_int(floor(high) + spread(one)) + origin)


@inlined
def intersect(patch, dx, dy, limits):
    """Texel coordinates s, t under the pixels, depth, and where there is anything in front of the near plane.

    Where there is not, s and t lie outside the texture: no address may depend on what they would be.
    """
    w = affine(patch.w_x, patch.w_y, patch.w_1, dx, dy)
    valid = (w > limits.zero) & (w <= limits.inverse_near)
    p = limits.one / choose(valid, w, limits.one)
    s = affine(patch.s_x, patch.s_y, patch.s_1, dx, dy) * p
    t = affine(patch.t_x, patch.t_y, patch.t_1, dx, dy) * p
    return choose(valid, s, -limits.one), choose(valid, t, -limits.one), p, valid


@inlined
def footprint(s, t, limits):
    """Texels and weights of hits at texel coordinates s, t."""
    zero, one = limits.zero, limits.one
    column, row = first_texel(s, limits.size, zero, one), first_texel(t, limits.size, zero, one)
    x0, x1 = weights(s, column, limits.step, zero, one)
    y0, y1 = weights(t, row, limits.step, zero, one)
    return Footprint(column, row, x0, x1, y0, y1)


@inlined
def cells(foot, texels):
    """Numbers of the first texels within the texture."""
    return to_int(foot.row) * spread(np.int32(texels)) + to_int(foot.column)


@inlined
def corners(texture, cell, right, below):
    """Four texels around hits; `right` and `below` are how far the neighbours are."""
    if right == 0:  # a single texel
        texel = gather(texture, cell)
        return texel, texel, texel, texel
    above, beside = gather_pairs(texture, cell)
    lower, last = gather_pairs(ahead(texture, below), cell)
    return above, beside, lower, last
