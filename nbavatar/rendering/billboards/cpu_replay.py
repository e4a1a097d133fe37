"""The adjoint of blending: the replay repeats the blending, records its hits and differentiates them back to front.

With v_k the adjoint of hit k's weight T_k a_k, and B_k = a_k v_k + (1 - a_k) B_{k+1} the suffix sum of what is blended
from hit k on, relative to the transmittance in front of it: dL/da_k = T_k (v_k - B_{k+1}). See docs/rasterizer.md.
"""

import numpy as np

from nbavatar.jit.compile import inlined
from nbavatar.jit.lane_memory import gather, load, store
from nbavatar.jit.lanes import LANES, broadcast, transpose
from nbavatar.jit.memory import advance, get, put
from nbavatar.rendering.billboards.cpu_scratch import COLUMN, LANE, ROW, SHIFT

__all__ = ["differentiate", "record_hit", "record_pixels", "record_weight_adjoints", "reserve"]


@inlined
def reserve(scratch, hits):
    """Place of the next of the band's blended hits, of which there are then so many more."""
    at = np.int64(get(scratch.blended_count, 0))
    put(scratch.blended_count, 0, at + hits)
    return at


@inlined
def record_hit(scratch, at, pixel, hit, transmittance):
    """Records that the band's hit to be blended as number `at` was this one, and the transmittance in front of it."""
    put(scratch.blended_hit, at, hit)
    put(scratch.blended_pixel, at, pixel)
    put(scratch.blended_transmittance, at, transmittance)


@inlined
def _adjoint(scene, scratch, lane, c):
    """Adjoint of the image, from channel c on, at the pixel whose number is in `lane_int`."""
    return load(scene.adjoints.features, np.int64(get(scratch.lane_int, lane)) * scene.layout.stride + c)


@inlined
def record_weight_adjoints(scene, scratch, hits, bundles, band, width):
    """Records dL/dw = f . dL/dcolour + dL/dopacity, and the alphas, of the current billboard's hits.

    Args:
        bundles: of hits that the band had before; band: see `cpu_scratch`; width: of the image [px].
    """
    stride = scene.layout.stride
    for h in range(0, hits, LANES):
        pixel, lane = load(scratch.hit_pixel, h), load(scratch.hit_lane, h)
        y = (pixel >> broadcast(np.int32(ROW))) + broadcast(np.int32(band.top))
        x = broadcast(np.int32(band.left)) + (pixel & broadcast(np.int32(COLUMN)))
        image_pixel = y * broadcast(np.int32(width)) + x
        store(scratch.lane_int, 0, image_pixel)
        dL_dweight = gather(scene.adjoints.opacity, image_pixel)
        for c in range(0, stride, LANES):
            row = advance(scratch.hit_feature, h * stride + c)
            products = transpose((
                load(row, 0) * _adjoint(scene, scratch, 0, c),
                load(row, stride) * _adjoint(scene, scratch, 1, c),
                load(row, 2 * stride) * _adjoint(scene, scratch, 2, c),
                load(row, 3 * stride) * _adjoint(scene, scratch, 3, c),
                load(row, 4 * stride) * _adjoint(scene, scratch, 4, c),
                load(row, 5 * stride) * _adjoint(scene, scratch, 5, c),
                load(row, 6 * stride) * _adjoint(scene, scratch, 6, c),
                load(row, 7 * stride) * _adjoint(scene, scratch, 7, c),
            ))  # fmt: skip
            half = (products[0] + products[1]) + (products[2] + products[3])
            dL_dweight = dL_dweight + (half + ((products[4] + products[5]) + (products[6] + products[7])))
        hit = bundles * LANES + h
        store(scratch.dL_dweight, hit, dL_dweight)
        store(scratch.hit_alpha, hit, gather(scratch.alpha, lane))


@inlined
def record_pixels(scene, scratch, hits, bundle, rows_above):
    """Writes to the tape where the current billboard's hits are, bundle by bundle, and that none is blended yet.

    Args:
        bundle: number of the first on the tape; rows_above: of the tile, over the band.
    """
    zero, down = scene.lanes.zero, broadcast(np.int32(rows_above << ROW))
    for h in range(0, hits, LANES):
        at = 2 * (bundle * LANES + h)
        store(scene.tape.values, at, zero)
        store(scene.tape.values, at + LANES, zero)
        store(scene.tape.pixels, bundle * LANES + h, load(scratch.hit_pixel, h) + down)


@inlined
def differentiate(scene, scratch, bundle):
    """Writes the weights and dL/da of the band's blended hits to the tape, from the last hit to the first.

    Args:
        bundle: number of the band's first on the tape.
    """
    one = scene.constants.one
    for at in range(np.int64(get(scratch.blended_count, 0)) - 1, -1, -1):
        hit, pixel = np.int64(get(scratch.blended_hit, at)), np.int64(get(scratch.blended_pixel, at))
        transmittance = get(scratch.blended_transmittance, at)
        dL_dweight, alpha = get(scratch.dL_dweight, hit), get(scratch.hit_alpha, hit)
        suffix = get(scratch.suffix, pixel)
        value = 2 * LANES * (bundle + (hit >> SHIFT)) + (hit & LANE)
        put(scene.tape.values, value, transmittance * alpha)
        put(scene.tape.values, value + LANES, transmittance * (dL_dweight - suffix))
        put(scratch.suffix, pixel, alpha * dL_dweight + (one - alpha) * suffix)
