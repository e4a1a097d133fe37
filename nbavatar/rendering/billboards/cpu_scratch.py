"""What a worker of the CPU rasterizer keeps of a tile's pixels, hits and groups while it works on it."""

from typing import Any, NamedTuple

from nbavatar.jit.compile import inlined
from nbavatar.jit.lanes import LANES
from nbavatar.jit.memory import pointer
from nbavatar.rendering.binning import TILE_HEIGHT, TILE_WIDTH
from nbavatar.rendering.sorting import LONGEST

__all__ = [
    "COLUMN", "LANE", "PART", "ROW", "SHIFT", "Groups", "Layout", "Queues", "Scene", "Scratch", "divide",
    "scratch_sizes",
]  # fmt: skip

ROW, COLUMN = TILE_WIDTH.bit_length() - 1, TILE_WIDTH - 1  # a pixel's place in a band is row << ROW | column
SHIFT, LANE = 3, LANES - 1  # a hit's number is LANES * bundle + lane
_GROUPS = TILE_HEIGHT * (TILE_WIDTH // LANES) + LANES  # of one billboard in a tile; lists are filled LANES at a time
PART = LANES * _GROUPS  # numbers of a list with one for each of their lanes


class Groups(NamedTuple):
    """Lists of the billboard in hand. Whole numbers, here and below, are int32."""

    ends: Any  # columns of its rows
    # group by group
    first: Any  # place of the first pixel in the band
    rest: Any  # pixels from there to the end of the billboard's row
    # lane by lane
    key: Any  # -infinity where there is no hit
    cell: Any  # number of the first of four texels in the texture
    weights: Any  # of the four, PART apart
    alpha: Any  # opacity
    share: Any  # where a hit is blended at once: its share of the light, in the replay the light that reaches it
    # hit by hit, and LANES zeros behind them
    hit: Any  # lane of the groups
    spot: Any  # place of the pixel in the band


class Queues(NamedTuple):
    """Hits that wait, `plane` of them a slot, LONGEST slots at least."""

    keys: Any
    opacities: Any
    ids: Any  # numbers of the hits
    count: Any  # of each pixel of the band
    plane: Any


class Scratch(NamedTuple):
    """Memory of one worker; see `blend_tiles`."""

    groups: Any
    queues: Any
    # of the band's pixels
    through: Any  # transmittance
    floor: Any  # hits with a smaller key than this are of no use to the pixel
    sums: Any  # blended features, `stride` a pixel
    behind: Any  # replay: what a pixel's light is worth behind the hits settled so far
    # of the band's hits
    rank: Any  # of each bundle's billboard
    features: Any  # `stride` a hit, and a row of zeros behind them; replay: of the billboard in hand
    opacity: Any  # replay
    worth: Any  # replay: what a hit's share of its pixel changes
    # of those that have been blended, in that order: replay
    blended: Any  # number
    pixel: Any  # place in the band
    light: Any  # transmittance in front of it
    length: Any  # how many they are: one number
    # room for a row of numbers
    row: Any
    whole: Any


class Layout(NamedTuple):
    """How textures lie in memory."""

    texels: Any  # a side
    step: Any  # min(1, texels - 1): from a texel to the next
    channels: Any
    stride: Any  # numbers kept of a hit's features: the channels, filled up to whole vectors


class Scene(NamedTuple):
    """What stays the same for all tiles; see `blend_tiles`."""

    features: Any
    layout: Any
    numbers: Any  # `cpu_hits.Limits`
    limits: Any  # the same in all lanes
    room: Any  # hits that the scratch holds
    grads: Any
    grad_opacity: Any
    notes: Any
    status: Any


def scratch_sizes(rows: int, capacity: int, channels: int, bundles: int, replay: bool) -> tuple[int, int]:
    """Numbers and int32 that a worker needs for bands of `rows` rows with `bundles` of hits; see `divide`."""
    plane = TILE_WIDTH * rows + LANES
    stride = -(-channels // LANES) * LANES
    hits, slots = bundles * LANES, max(capacity, LONGEST)
    features = PART * stride + 3 * hits + plane if replay else (hits + 1) * stride
    reals = plane * (2 + stride + 2 * slots) + features + 7 * PART + LANES
    wholes = plane * (1 + slots) + bundles + 2 * TILE_HEIGHT + 2 * _GROUPS + 3 * PART + LANES
    return reals, wholes + (2 * hits + 1 if replay else 0)


@inlined
def divide(real, whole, plane, stride, capacity, bundles, replay):
    """Divides a worker's arrays as `scratch_sizes` counts."""
    hits, slots = bundles * LANES, max(capacity, LONGEST)
    floor, sums, keys = plane, 2 * plane, (2 + stride) * plane
    opacities = keys + slots * plane
    key = opacities + slots * plane
    weights, alpha, share, row = key + PART, key + 5 * PART, key + 6 * PART, key + 7 * PART
    features = row + LANES
    opacity = features + PART * stride
    worth = opacity + hits
    light = worth + hits
    behind = light + hits
    ids = plane
    rank = ids + slots * plane
    ends = rank + bundles
    first = ends + 2 * TILE_HEIGHT
    rest, cell = first + _GROUPS, first + 2 * _GROUPS
    hit, spot, line = cell + PART, cell + 2 * PART, cell + 3 * PART
    blended = line + LANES
    pixel = blended + hits
    length = pixel + hits
    if not replay:  # not used, and no room
        opacity, worth, light, behind, blended, pixel, length = 0, 0, 0, 0, 0, 0, 0
    groups = Groups(
        pointer(whole, ends), pointer(whole, first), pointer(whole, rest), pointer(real, key), pointer(whole, cell),
        pointer(real, weights), pointer(real, alpha), pointer(real, share), pointer(whole, hit), pointer(whole, spot),
    )  # fmt: skip
    queues = Queues(pointer(real, keys), pointer(real, opacities), pointer(whole, ids), pointer(whole, 0), plane)
    return Scratch(
        groups, queues, pointer(real, 0), pointer(real, floor), pointer(real, sums), pointer(real, behind),
        pointer(whole, rank), pointer(real, features), pointer(real, opacity), pointer(real, worth),
        pointer(whole, blended), pointer(whole, pixel), pointer(real, light), pointer(whole, length),
        pointer(real, row), pointer(whole, line),
    )  # fmt: skip
