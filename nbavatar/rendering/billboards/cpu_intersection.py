"""Where eight rays meet a billboard, and bilinear sampling there: arithmetic that the CPU kernels share.

A *packet* is eight neighbouring pixels of a row under one billboard, looked at together; its rays are the lanes.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import types

from nbavatar.jit import scalar
from nbavatar.jit.compile import inlined
from nbavatar.jit.lane_memory import gather, gather_pairs, store
from nbavatar.jit.lanes import LANES, broadcast, floor, maximum, minimum, ramp, select, to_int
from nbavatar.jit.memory import advance, get
from nbavatar.rendering.binning import TILE_HEIGHT

__all__ = [
    "FADE", "NEAREST_KEY", "Constants", "Footprint", "Patch", "affine", "broadcast_constants", "constants_of",
    "constants_type", "corners", "first_texels", "footprint", "intersect", "mix", "patch_of", "plane_slopes", "slopes",
    "spans",
]  # fmt: skip

_S = scalar.build(inlined, floor, minimum, maximum, select)
affine, first_texel, weights, slopes, mix, plane_slopes = (
    _S.affine, _S.first_texel, _S.weights, _S.slopes, _S.mix, _S.plane_slopes,
)  # fmt: skip

_MARGIN = 0.1  # pixels by which a row's span is widened; coverage itself is decided pixel by pixel
NEAREST_KEY = 11  # place in a billboard's record: key that no hit of it exceeds


class Constants(NamedTuple):
    """Numbers that steer the kernels, each once or in all lanes."""

    zero: Any
    one: Any
    size: Any  # texels a side
    step: Any  # min(1, texels - 1): from a texel to the next
    inverse_near: Any
    alpha_min: Any
    t_min: Any
    alpha_max: Any
    empty_key: Any  # -infinity: of a lane or a slot without a hit
    lowest_key: Any  # that every hit's exceeds
    infinite_key: Any  # cutoff of a finished pixel


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


def constants_of(texels: int, near: float, alpha_min: float, t_min: float, alpha_max: float, real: Any) -> Constants:
    """The numbers, of NumPy's type `real`."""
    lowest = -np.finfo(real).max
    values = (0, 1, texels, min(1, texels - 1), 1 / near, alpha_min, t_min, alpha_max, -np.inf, lowest, np.inf)
    return Constants(*(real(value) for value in values))


def constants_type(real: Any) -> Any:
    """Numba's type of `constants_of`."""
    return types.BaseTuple.from_types([real] * len(Constants._fields), Constants)


@inlined
def broadcast_constants(numbers):
    """The same in all lanes."""
    return Constants(
        broadcast(numbers.zero), broadcast(numbers.one), broadcast(numbers.size), broadcast(numbers.step),
        broadcast(numbers.inverse_near), broadcast(numbers.alpha_min), broadcast(numbers.t_min),
        broadcast(numbers.alpha_max), broadcast(numbers.empty_key), broadcast(numbers.lowest_key),
        broadcast(numbers.infinite_key),
    )  # fmt: skip


@inlined
def patch_of(record):
    """A billboard's record in all lanes."""
    return Patch(
        broadcast(get(record, 0)), broadcast(get(record, 1)), broadcast(get(record, 2)), broadcast(get(record, 3)),
        broadcast(get(record, 4)), broadcast(get(record, 5)), broadcast(get(record, 6)), broadcast(get(record, 7)),
        broadcast(get(record, 8)), broadcast(get(record, 9)), broadcast(get(record, 10)),
    )  # fmt: skip


@inlined
def spans(record, size, one, extent, ends):
    """Columns of each row of the extent (`cpu_scratch.Extent`) that the patch may cover.

    Texel coordinates lie in (-1, size) where four affine functions are positive: s + w, size w - s and the
    same for t. Row y_first + j gets the columns ends[j] ... ends[TILE_HEIGHT + j], the latter excluded.
    """
    zero = one - one
    margin = broadcast(zero + np.float32(_MARGIN))
    w_x, w_y, w_1 = get(record, 6), get(record, 7), get(record, 8)
    for j in range(0, extent.y_end - extent.y_first, LANES):
        dy = broadcast(zero + np.float32(extent.y_first + j - extent.y_origin)) + ramp(zero)
        low = broadcast(zero + np.float32(extent.x_first - extent.x_origin))
        high = broadcast(zero + np.float32(extent.x_end - 1 - extent.x_origin))
        for side in range(4):
            at = 3 * (side >> 1)
            p_x, p_y, p_1 = get(record, at), get(record, at + 1), get(record, at + 2)
            if side & 1 == 0:
                slope, y_slope, rest = p_x + w_x, p_y + w_y, p_1 + w_1
            else:
                slope, y_slope, rest = size * w_x - p_x, size * w_y - p_y, size * w_1 - p_1
            value = broadcast(y_slope) * dy + broadcast(rest)
            if slope > zero:  # of no number, as 0 / 0, `maximum` and `minimum` give the second
                low = maximum(value * broadcast(-one / slope) - margin, low)
            elif slope < zero:
                high = minimum(value * broadcast(-one / slope) + margin, high)
            else:
                high = select(value < broadcast(zero), low - broadcast(one), high)
        some = low <= high
        low, high = select(some, low, broadcast(zero)), select(some, high, broadcast(-one))
        origin = broadcast(np.int32(extent.x_origin))
        store(ends, j, to_int(-floor(-low)) + origin)
        store(ends, TILE_HEIGHT + j, to_int(floor(high) + broadcast(one)) + origin)


@inlined
def intersect(patch, dx, dy, lanes):
    """Texel coordinates s, t under the pixels, depth, and where there is anything in front of the near plane.

    Where there is not, s and t lie outside the texture: no address may depend on what they would be.
    """
    w = affine(patch.w_x, patch.w_y, patch.w_1, dx, dy)
    valid = (w > lanes.zero) & (w <= lanes.inverse_near)
    p = lanes.one / select(valid, w, lanes.one)
    s = affine(patch.s_x, patch.s_y, patch.s_1, dx, dy) * p
    t = affine(patch.t_x, patch.t_y, patch.t_1, dx, dy) * p
    return select(valid, s, -lanes.one), select(valid, t, -lanes.one), p, valid


@inlined
def footprint(s, t, lanes):
    """Texels and weights of hits at texel coordinates s, t."""
    zero, one = lanes.zero, lanes.one
    column, row = first_texel(s, lanes.size, zero, one), first_texel(t, lanes.size, zero, one)
    x0, x1 = weights(s, column, lanes.step, zero, one)
    y0, y1 = weights(t, row, lanes.step, zero, one)
    return Footprint(column, row, x0, x1, y0, y1)


@inlined
def first_texels(foot, texels):
    """Numbers of the first texels within the texture."""
    return to_int(foot.row) * broadcast(np.int32(texels)) + to_int(foot.column)


@inlined
def corners(texture, first, right, below):
    """Four texels around hits, the first at `first`; `right` and `below` are how far the neighbours are."""
    if right == 0:  # a single texel
        texel = gather(texture, first)
        return texel, texel, texel, texel
    above, beside = gather_pairs(texture, first)
    lower, last = gather_pairs(advance(texture, below), first)
    return above, beside, lower, last
