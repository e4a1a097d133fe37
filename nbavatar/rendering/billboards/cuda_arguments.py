"""Named tuples that the CUDA kernels take and pass on."""

from typing import Any, NamedTuple

__all__ = ["Bins", "Constants", "Footprint", "Gradients", "Images", "Queue", "Scene", "Shape", "Tape", "Textures"]


class Bins(NamedTuple):
    """The tiles' lists, and the billboards in them.

    `start` (tiles + 1,), `members` (E,) int32; `record` (RECORD F,) flat, `box` (F, 4), `rank` (F,) int32.
    """

    start: Any
    members: Any
    record: Any
    box: Any
    rank: Any


class Textures(NamedTuple):
    """Textures of all billboards, flat, of any floating type."""

    features: Any
    alpha: Any


class Constants(NamedTuple):
    """Numbers that steer the kernels, of the type of all arithmetic."""

    zero: Any
    one: Any
    size: Any  # texels a side
    step: Any  # min(1, texels - 1): from a texel to the next
    inverse_near: Any
    alpha_min: Any
    t_min: Any
    alpha_max: Any


class Shape(NamedTuple):
    """Whole numbers that steer the kernels."""

    texels: Any  # a side
    width: Any  # of the image [px]
    height: Any
    across: Any  # tiles side by side
    queue: Any  # see `BlendSettings`


class Images(NamedTuple):
    """(C H W,), (H W,) and (H W,) int32: features, accumulated alpha and number of hits.

    The results, or in the replay the adjoints of the first two and what was counted.
    """

    features: Any
    opacity: Any
    hits: Any


class Tape(NamedTuple):
    """What the replay keeps of its hits, pixel by pixel.

    `ends` (H W,) int64, running number of hits, `base` those before the tape begins; of each hit three `values`, the
    adjoint of its weight, its alpha and the transmittance in front of it (of a Gaussian's two: transmittance, and alpha
    before the cap), and its `primitives` int32 (billboard or Gaussian).
    """

    ends: Any
    base: Any
    values: Any
    primitives: Any


class Gradients(NamedTuple):
    """By `Textures`, flat, and `sums` (SUMS F,) float64; `status` (1,) int32, set to 1 where the tape is too short."""

    features: Any
    alpha: Any
    sums: Any
    status: Any


class Queue(NamedTuple):
    """Hits that wait at a pixel: texel coordinates, key, alpha before the cap, billboard."""

    s: Any
    t: Any
    key: Any
    alpha: Any
    billboard: Any


class Scene(NamedTuple):
    """What all pixels share."""

    bins: Any
    textures: Any
    constants: Any
    shape: Any
    images: Any
    tape: Any
    gradients: Any


class Footprint(NamedTuple):
    """First of the four texels about a hit, and the weights of columns and rows."""

    column: Any
    row: Any
    x0: Any
    x1: Any
    y0: Any
    y1: Any
