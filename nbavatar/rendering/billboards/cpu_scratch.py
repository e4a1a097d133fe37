"""What a worker of the CPU rasterizer holds while it works on a tile, and the named tuples that its kernels pass on.

The words (packet, hit, bundle, key, cutoff, weight, suffix sum, tape) are explained in docs/rasterizer.md.
"""

from collections import namedtuple
from typing import Any, NamedTuple

import numpy as np

from nbavatar.jit.compile import inlined
from nbavatar.jit.lanes import LANES
from nbavatar.rendering.binning import TILE_HEIGHT, TILE_WIDTH
from nbavatar.rendering.scratch import FORWARD, REPLAY, Buffer
from nbavatar.rendering.sorting import LONGEST

__all__ = [
    "BROKEN", "BUFFERS", "COLUMN", "CORNER", "GIVEN_UP", "HITS", "LANE", "LIST", "ROW", "SHIFT", "Adjoints", "Band",
    "Extent", "Images", "Layout", "Scene", "Scratch", "Shape", "Sizes", "Tape", "Textures", "layout_of",
    "whole_vectors",
]  # fmt: skip

ROW, COLUMN = TILE_WIDTH.bit_length() - 1, TILE_WIDTH - 1  # a pixel's place in a band is row << ROW | column
SHIFT, LANE = 3, LANES - 1  # a hit's number is LANES * bundle + lane
# A worker's status: tiles given up, billboard with a NaN alpha + 1, hits blended, and then the tiles given up.
GIVEN_UP, BROKEN, HITS, LIST = 0, 1, 2, 3
_PACKETS = TILE_HEIGHT * (TILE_WIDTH // LANES) + LANES  # of a billboard in a tile; lists are filled LANES at a time
CORNER = LANES * _PACKETS  # elements of a list with one for each lane of the packets


class Sizes(NamedTuple):
    """What the scratch's sizes follow from."""

    rows: int  # of a band
    capacity: int  # hits that a pixel's queue holds
    channels: int  # of the image
    bundles: int  # of a band
    texels: int  # a side of a texture

    @property
    def pixels(self) -> int:
        """Of a band, and room for a vector that begins at the last."""
        return TILE_WIDTH * self.rows + LANES

    @property
    def stride(self) -> int:
        """Elements kept of a hit's or a pixel's features: the channels, filled up to whole vectors."""
        return -(-self.channels // LANES) * LANES

    @property
    def queues(self) -> int:
        """Slots of all queues: a sorting network reads and writes LONGEST of each."""
        return max(self.capacity, LONGEST) * self.pixels

    @property
    def hits(self) -> int:
        """Of a band."""
        return self.bundles * LANES


BUFFERS = (
    # of the band's pixels
    Buffer("transmittance", None, lambda n: n.pixels),
    Buffer("cutoff", None, lambda n: n.pixels),  # hits with a smaller key are of no use to the pixel
    Buffer("colour", None, lambda n: n.pixels * n.stride, only=FORWARD),  # blended features, `stride` a pixel
    Buffer("suffix", None, lambda n: n.pixels, only=REPLAY),  # suffix sum B of the hits differentiated so far
    # queues: slot 0 of all pixels, slot 1 ...
    Buffer("queue_length", np.int32, lambda n: n.pixels),
    Buffer("queue_key", None, lambda n: n.queues),
    Buffer("queue_alpha", None, lambda n: n.queues),
    Buffer("queue_hit", np.int32, lambda n: n.queues),  # numbers of the hits
    # of the current billboard
    Buffer("span", np.int32, lambda n: 2 * TILE_HEIGHT),  # first columns of its rows, then end columns
    Buffer("packet_pixel", np.int32, lambda n: _PACKETS),  # place of the packet's first pixel in the band
    Buffer("packet_width", np.int32, lambda n: _PACKETS),  # pixels from there to the end of the billboard's row
    Buffer("key", None, lambda n: CORNER),  # lane by lane; the empty key where there is no hit
    Buffer("texel", np.int32, lambda n: CORNER),  # number of the first of four texels in the texture
    Buffer("corner_weight", None, lambda n: 4 * CORNER),  # bilinear weights of the four, CORNER apart
    Buffer("alpha", None, lambda n: CORNER),
    # where a hit is blended at once: its weight, in the replay the transmittance in front of it
    Buffer("weight", None, lambda n: CORNER),
    Buffer("hit_lane", np.int32, lambda n: CORNER),  # hit by hit: lane of the packets
    Buffer("hit_pixel", np.int32, lambda n: CORNER),  # hit by hit: place of the pixel in the band
    # of the band's hits
    Buffer("bundle_rank", np.int32, lambda n: n.bundles),  # of each bundle's billboard
    Buffer("feature", None, lambda n: (n.hits + 1) * n.stride, only=FORWARD),  # `stride` a hit; then a row of zeros
    Buffer("hit_feature", None, lambda n: CORNER * n.stride, only=REPLAY),  # the same of the current billboard
    Buffer("hit_alpha", None, lambda n: n.hits, only=REPLAY),
    Buffer("dL_dweight", None, lambda n: n.hits, only=REPLAY),
    # of those that have been blended, in that order
    Buffer("blended_count", np.int32, lambda n: 1, only=REPLAY),
    Buffer("blended_hit", np.int32, lambda n: n.hits, only=REPLAY),  # number
    Buffer("blended_pixel", np.int32, lambda n: n.hits, only=REPLAY),  # place in the band
    Buffer("blended_transmittance", None, lambda n: n.hits, only=REPLAY),  # in front of it
    # one vector
    Buffer("lane_real", None, lambda n: LANES),
    Buffer("lane_int", np.int32, lambda n: LANES),
)
Scratch = namedtuple("Scratch", [buffer.name for buffer in BUFFERS])


class Shape(NamedTuple):
    """Whole numbers that the kernels of tiles take."""

    texels: Any  # a side
    channels: Any  # of a texture
    uniform: Any  # further channels, which all texels of a billboard have in common
    width: Any  # of the image [px]
    height: Any
    across: Any  # tiles side by side
    queue: Any  # see `BlendSettings`
    capacity: Any  # of a pixel's queue
    rows: Any  # of a band
    bundles: Any  # that there is room for


class Textures(NamedTuple):
    """Textures of all billboards, flat, and what their texels have in common.

    The latter lies where it is in a row of the image's channels, (F, stride), between zeros; without elements where
    there is none.
    """

    features: Any
    alpha: Any
    uniform: Any


class Images(NamedTuple):
    """What the forward pass writes: (C, H, W) and (H, W), flat, and the number of bundles of each tile."""

    features: Any
    opacity: Any
    bundles: Any


class Adjoints(NamedTuple):
    """Adjoints of the image: (H, W, stride), filled up with zeros, and (H, W), both flat."""

    features: Any
    opacity: Any


class Tape(NamedTuple):
    """What the replay leaves for `gather_gradients`.

    Per bundle the weights of its LANES hits and then the adjoints of their alphas, 0 where there is no blended hit; per
    bundle the pixels' places in the tile; per band and tile entry the first and the end of its bundles, counted from
    those of the tile; the number of bundles in front of each tile; that in front of the tape's first.
    """

    values: Any
    pixels: Any
    ranges: Any
    tile_bundle: Any
    first: Any


class Layout(NamedTuple):
    """How textures lie in memory."""

    texels: Any  # a side
    step: Any  # min(1, texels - 1): from a texel to the next
    channels: Any  # of a texture
    image_channels: Any  # those of the texture, and behind them the uniform ones
    stride: Any  # see `Sizes`


class Band(NamedTuple):
    """The current band: its pixels on the image, the last row and column excluded; `pixels` of its scratch."""

    left: Any
    right: Any
    top: Any
    bottom: Any
    pixels: Any


class Extent(NamedTuple):
    """Columns and rows of a billboard in a band, and the pixel that its record refers to, from the band's first on."""

    x_first: Any
    x_end: Any
    x_origin: Any
    y_first: Any
    y_end: Any
    y_origin: Any


class Scene(NamedTuple):
    """What stays the same for all tiles."""

    features: Any  # textures
    uniform: Any
    layout: Any
    constants: Any  # `cpu_intersection.Constants`
    lanes: Any  # the same in all lanes
    stride: Any  # of the queues: from slot to slot
    padding: Any  # number of the row of zeros behind the band's features
    adjoints: Any
    tape: Any
    status: Any


@inlined
def whole_vectors(channels):
    """Channels filled up to whole vectors."""
    return (channels + LANES - 1) // LANES * LANES


@inlined
def layout_of(shape):
    """Layout of the textures of a `Shape`."""
    image_channels = shape.channels + shape.uniform
    return Layout(shape.texels, min(1, shape.texels - 1), shape.channels, image_channels, whole_vectors(image_channels))
