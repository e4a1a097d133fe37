"""Alpha blending: what is done with a hit whose turn has come, and with a band's pixels at its end.

The weight of a hit is its alpha times the transmittance T in front of it: colour += T a f, T *= 1 - a. In the replay a
hit is recorded instead, with the transmittance in front of it (`cpu_replay.py`).
"""

import numpy as np

from nbavatar.jit.compile import inlined
from nbavatar.jit.lane_memory import load, masked_store, store, stream
from nbavatar.jit.lanes import (
    LANES,
    broadcast,
    count_bits,
    count_trailing_zeros,
    first_lanes,
    mask_bits,
    select,
    transpose,
)
from nbavatar.jit.memory import advance, get, put
from nbavatar.rendering.billboards.cpu_rasterize import feature_of
from nbavatar.rendering.billboards.cpu_replay import record_hit, reserve
from nbavatar.rendering.billboards.cpu_scratch import HITS
from nbavatar.rendering.binning import TILE_WIDTH

__all__ = ["LARGE", "blend", "blend_one", "blend_unsorted", "finish", "write_band"]

LARGE = 1 << 22  # numbers of an image that the caches do not hold


@inlined
def _count(scene, hits):
    """Adds to the number of hits blended."""
    put(scene.status, HITS, get(scene.status, HITS) + hits)


@inlined
def blend_one(scene, scratch, replay, pixel, hit, transmittance, alpha):
    """Blends a hit that has waited at a pixel of the band, in front of which the transmittance is given."""
    _count(scene, 1)
    if replay:
        record_hit(scratch, reserve(scratch, 1), pixel, hit, transmittance)
    else:
        stride = scene.layout.stride
        weight, colour = broadcast(transmittance * alpha), advance(scratch.colour, pixel * stride)
        feature = advance(scratch.feature, hit * stride)
        for c in range(0, stride, LANES):
            store(colour, c, load(colour, c) + weight * load(feature, c))


@inlined
def _add_features(scratch, first, stride, c):
    """Adds to the pixels `first + lane` the features of the hits in `lane_int`, weighted by `lane_real`."""
    for lane in range(LANES):
        at = (first + lane) * stride + c
        feature = load(scratch.feature, np.int64(get(scratch.lane_int, lane)) * stride + c)
        store(scratch.colour, at, load(scratch.colour, at) + feature * broadcast(get(scratch.lane_real, lane)))


@inlined
def blend(scene, scratch, replay, mask, first, transmittance, weight, hits):
    """Blends one hit at each of the pixels `first + lane` in the mask, or, in the replay, records it.

    Args:
        first: place of lane 0 in the band.
        transmittance: in front of the hits; `weight`: it times their alphas; `hits`: their numbers.
    """
    word = mask_bits(mask)
    _count(scene, count_bits(word))
    if replay:
        store(scratch.lane_int, 0, hits)
        store(scratch.lane_real, 0, transmittance)
        at = reserve(scratch, count_bits(word))
        while word != 0:
            lane = count_trailing_zeros(word)
            word &= word - 1
            record_hit(scratch, at, first + lane, get(scratch.lane_int, lane), get(scratch.lane_real, lane))
            at += 1
    else:  # other lanes add a row of zeros
        store(scratch.lane_int, 0, select(mask, hits, broadcast(np.int32(scene.padding))))
        store(scratch.lane_real, 0, select(mask, weight, scene.lanes.zero))
        if scene.layout.stride == LANES:
            _add_features(scratch, first, LANES, 0)
        else:
            for c in range(0, scene.layout.stride, LANES):
                _add_features(scratch, first, scene.layout.stride, c)


@inlined
def _add_current(scene, scratch, hits, features, uniform):
    """Adds the hits of the current billboard to their pixels, each with its weight."""
    stride = scene.layout.stride
    for h in range(hits):
        lane, pixel = np.int64(get(scratch.hit_lane, h)), np.int64(get(scratch.hit_pixel, h))
        weight, colour = broadcast(get(scratch.weight, lane)), advance(scratch.colour, pixel * stride)
        if stride == LANES:  # the usual case: no loop
            store(colour, 0, load(colour, 0) + weight * feature_of(scene, scratch, features, uniform, lane, 0))
        else:
            for c in range(0, stride, LANES):
                store(colour, c, load(colour, c) + weight * feature_of(scene, scratch, features, uniform, lane, c))


@inlined
def blend_unsorted(scene, scratch, replay, count, hits, features, uniform, bundles):
    """Blends the hits of the current billboard at once; returns the number of pixels that this has finished.

    Args:
        count: of the billboard's packets; features, uniform: pointers to its own; bundles: that the band had before.
    """
    one, empty_key, finished = scene.lanes.one, scene.lanes.empty_key, 0
    for j in range(count):
        first, at = np.int64(get(scratch.packet_pixel, j)), j * LANES
        hit_mask, alpha = load(scratch.key, at) > empty_key, load(scratch.alpha, at)
        transmittance = load(scratch.transmittance, first)
        store(scratch.weight, at, transmittance if replay else transmittance * alpha)
        transmittance = select(hit_mask, transmittance * (one - alpha), transmittance)
        store(scratch.transmittance, first, transmittance)
        _, closed = finish(scene, scratch, first, transmittance)
        finished += closed
    _count(scene, hits)
    if replay:
        at = reserve(scratch, hits)
        for h in range(hits):
            transmittance = get(scratch.weight, np.int64(get(scratch.hit_lane, h)))
            record_hit(scratch, at + h, get(scratch.hit_pixel, h), bundles * LANES + h, transmittance)
    else:
        _add_current(scene, scratch, hits, features, uniform)
    return finished


@inlined
def finish(scene, scratch, first, transmittance):
    """Closes the opaque ones of the pixels `first + lane`; returns their mask and how many have just become so."""
    infinite_key = scene.lanes.infinite_key
    cutoff = load(scratch.cutoff, first)
    opaque = transmittance < scene.lanes.t_min
    store(scratch.cutoff, first, select(opaque, infinite_key, cutoff))
    return opaque, count_bits(mask_bits(opaque & (cutoff < infinite_key)))


@inlined
def _channels(scratch, at, stride):
    """Colours of eight neighbouring pixels, channel by channel, from `at` on."""
    colour = scratch.colour
    return transpose((
        load(colour, at), load(colour, at + stride), load(colour, at + 2 * stride), load(colour, at + 3 * stride),
        load(colour, at + 4 * stride), load(colour, at + 5 * stride), load(colour, at + 6 * stride),
        load(colour, at + 7 * stride),
    ))  # fmt: skip


@inlined
def write_band(scene, scratch, images, band, width, height):
    """Writes a band's pixels into the results, which begin at multiples of 64 bytes.

    Args:
        images, band: see `cpu_scratch`; width, height: of the image [px].
    """
    one, left, right = scene.lanes.one, band.left, band.right
    image, opacity = images.features, images.opacity
    area, stride = np.int64(width) * height, scene.layout.stride
    if width % (2 * LANES) == 0 and area * scene.layout.image_channels >= LARGE:
        # A large image is not in the caches when it is read: writing past them saves reading the memory first. The
        # second half of a line follows the first at once: few lines can be under way.
        for y in range(band.top, band.bottom):
            for x in range(left, right, 2 * LANES):
                first = (y - band.top) * TILE_WIDTH + x - left
                pixel = np.int64(y) * width + x
                stream(opacity, pixel, one - load(scratch.transmittance, first))
                stream(opacity, pixel + LANES, one - load(scratch.transmittance, first + LANES))
                for c in range(0, scene.layout.image_channels, LANES):
                    here = _channels(scratch, first * stride + c, stride)
                    beside = _channels(scratch, (first + LANES) * stride + c, stride)
                    for lane in range(min(LANES, scene.layout.image_channels - c)):
                        stream(image, (c + lane) * area + pixel, here[lane])
                        stream(image, (c + lane) * area + pixel + LANES, beside[lane])
        return
    for y in range(band.top, band.bottom):
        for x in range(left, right, LANES):
            used = first_lanes(right - x)
            first = (y - band.top) * TILE_WIDTH + x - left
            pixel = np.int64(y) * width + x
            masked_store(opacity, pixel, one - load(scratch.transmittance, first), used)
            for c in range(0, scene.layout.image_channels, LANES):
                channels = _channels(scratch, first * stride + c, stride)
                for lane in range(min(LANES, scene.layout.image_channels - c)):
                    masked_store(image, (c + lane) * area + pixel, channels[lane], used)
