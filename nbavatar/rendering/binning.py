"""Which billboards touch which tiles of the image.

Bounds are conservative and tight: the projected corners of the texture's whole support, clipped
at the near plane where the patch crosses it (`projection.py`), then, tile by tile, the four
edges of the patch themselves, so a thin diagonal billboard enters only the tiles it runs through.
"""

from typing import Any, NamedTuple

import numba
import numpy as np
import torch
from numba import types
from numpy.typing import NDArray

from nbavatar.errors import DeviceError
from nbavatar.jit.compile import inlined, kernel
from nbavatar.jit.lanes import LANES
from nbavatar.jit.memory import fetch_add
from nbavatar.jit.workers import run_workers
from nbavatar.rendering.patches import ProjectedPatches
from nbavatar.rendering.scratch import array_of

__all__ = [
    "RECORD", "TILE_HEIGHT", "TILE_WIDTH", "Bins", "bin_billboards", "bins_type", "require_memory", "tile_bounds",
]  # fmt: skip

TILE_WIDTH = 32  # pixels
TILE_HEIGHT = 32
RECORD = 16  # numbers in a billboard's record; see `pack`
_CHUNK = 256  # billboards that a worker bins at a time
_SLACK = 1e-3  # pixels by which bounds are widened, far more than rounding can move a corner


class Bins(NamedTuple):
    """Billboards prepared for the kernels, and their entries in the tiles' lists, the bins.

    Attributes:
        record: (F, RECORD) see `pack`.
        box: (F, 4) int32, pixels `x0, y0, x1, y1` that a billboard may touch, the last two excluded.
        order: (F,) int32, billboards in the order in which tiles take them.
        rank: (F,) int32, of each billboard, which settles equal depths.
        entry_start: (F + 1,) int64, entries of `order[k]` are `entry_start[k] ... entry_start[k + 1]`.
        entry_tile: (E,) int32, tile of each entry, in that numbering.
        position: (E,) int64, its position in the tile-major lists.
        tile_start: (tiles + 1,) int64, list of each tile.
        members: (E,) int32, the tile-major lists: billboards.
        packets: (tiles,) int64, most packets of `LANES` neighbouring pixels that the billboards of a tile can fill.
    """

    record: NDArray
    box: NDArray[np.int32]
    order: NDArray[np.int32]
    rank: NDArray[np.int32]
    entry_start: NDArray[np.int64]
    entry_tile: NDArray[np.int32]
    position: NDArray[np.int64]
    tile_start: NDArray[np.int64]
    members: NDArray[np.int32]
    packets: NDArray[np.int64]


def bins_type(real: Any) -> Any:
    """Numba's type of `Bins` whose records are of its type `real`."""
    i32, i64 = array_of(types.int32), array_of(types.int64)
    kinds = (array_of(real, 2), array_of(types.int32, 2), i32, i32, i64, i32, i64, i64, i32, i64)
    return types.BaseTuple.from_types(kinds, Bins)


@kernel
def pack(plane, fade, nearest, bounds, texels, width, height, reference, record, box):
    """Writes the records and pixel boxes of all billboards.

    A record holds, relative to the centre of pixel ((x0 + x1) // 2, (y0 + y1) // 2) of the box, the
    affine functions of the texel coordinates s (0-2) and t (3-5) times inverse depth and of inverse
    depth (6-8); the key, inverse depth less `reference`, at the origin (9); the fade (10); the key that no
    hit exceeds (11). The shift of the origin is made in float64:
    what is left has small numbers, which float32 holds well.
    """
    scale = 0.5 * (texels - 1) if texels > 1 else 1.0
    shift = 0.5 * (texels - 1)
    for i in range(len(plane)):
        x0, y0 = bounds[i, 0] - 0.5 - _SLACK, bounds[i, 1] - 0.5 - _SLACK
        x1, y1 = bounds[i, 2] - 0.5 + _SLACK, bounds[i, 3] - 0.5 + _SLACK
        for j in range(4):
            box[i, j] = 0
        for j in range(RECORD):
            record[i, j] = 0
        if not (x0 <= x1 and y0 <= y1 and x1 >= 0 and y1 >= 0 and x0 < width and y0 < height):
            continue
        left, top = int(np.ceil(max(x0, 0.0))), int(np.ceil(max(y0, 0.0)))
        right, bottom = int(np.floor(min(x1, width - 1.0))) + 1, int(np.floor(min(y1, height - 1.0))) + 1
        if left >= right or top >= bottom:
            continue
        box[i, 0], box[i, 1], box[i, 2], box[i, 3] = left, top, right, bottom
        x, y = (left + right) // 2 + 0.5, (top + bottom) // 2 + 0.5
        for j in range(3):
            w = plane[i, 2, j]
            record[i, j] = scale * plane[i, 0, j] + shift * w
            record[i, 3 + j] = scale * plane[i, 1, j] + shift * w
            record[i, 6 + j] = w
        for row in range(3):
            value = plane[i, row, 0] * x + plane[i, row, 1] * y + plane[i, row, 2]
            w = plane[i, 2, 0] * x + plane[i, 2, 1] * y + plane[i, 2, 2]
            if row == 2:
                record[i, 8] = w
                record[i, 9] = w - reference
            else:
                record[i, 3 * row + 2] = scale * value + shift * w
        record[i, 10] = fade[i]
        record[i, 11] = (1.0 + 1e-5) / nearest[i] - reference


@numba.njit(nogil=True, inline="always")
def _touches(plane, i, support, x0, y0, x1, y1):
    """Whether the patch may have a point over the pixel centres x0 + 0.5 ... x1 - 0.5 (likewise y)."""
    ax, ay, bx, by = x0 + 0.5 - _SLACK, y0 + 0.5 - _SLACK, x1 - 0.5 + _SLACK, y1 - 0.5 + _SLACK
    for edge in range(4):
        row = edge // 2
        sign = 1.0 if edge % 2 == 0 else -1.0
        # support p_w + sign p_u >= 0 inside; its largest value over the tile is at a corner
        cx = support * plane[i, 2, 0] + sign * plane[i, row, 0]
        cy = support * plane[i, 2, 1] + sign * plane[i, row, 1]
        c = support * plane[i, 2, 2] + sign * plane[i, row, 2]
        if max(cx * ax, cx * bx) + max(cy * ay, cy * by) + c < 0.0:
            return False
    return True


@inlined
def tile_bounds(tile, across, width, height):
    """Pixels `x0, y0, x1, y1` of a tile, the last two excluded; `across` tiles lie side by side."""
    left, top = tile % across * TILE_WIDTH, tile // across * TILE_HEIGHT
    return left, top, min(left + TILE_WIDTH, width), min(top + TILE_HEIGHT, height)


@kernel
def list_tiles(counter, chunk, plane, box, order, support, across, entry_start, entry_tile, entry_packets):
    """Lists the tiles that the billboards touch, or, where `entry_tile` is empty, counts them.

    Args:
        counter: (1,) int64, next place in `order`, shared by all workers; `chunk` are taken at a time.
        across: tiles side by side.
        entry_start, entry_tile: see Bins. While counting, entry_start[k + 1] becomes the number of tiles of order[k].
        entry_packets: (E,) int32, packets of `LANES` neighbouring pixels that the billboard can fill in the tile.
    """
    counting = len(entry_tile) == 0
    while True:
        begin = fetch_add(counter, chunk)
        if begin >= len(order):
            break
        for k in range(begin, min(begin + chunk, len(order))):
            i = order[k]
            if counting:
                entry_start[k + 1] = 0
            elif entry_start[k] == entry_start[k + 1]:
                continue
            if box[i, 2] <= box[i, 0]:
                continue
            entry = 0 if counting else entry_start[k]
            for row in range(box[i, 1] // TILE_HEIGHT, (box[i, 3] - 1) // TILE_HEIGHT + 1):
                y0, y1 = max(row * TILE_HEIGHT, box[i, 1]), min((row + 1) * TILE_HEIGHT, box[i, 3])
                for column in range(box[i, 0] // TILE_WIDTH, (box[i, 2] - 1) // TILE_WIDTH + 1):
                    x0, x1 = max(column * TILE_WIDTH, box[i, 0]), min((column + 1) * TILE_WIDTH, box[i, 2])
                    if _touches(plane, i, support, x0, y0, x1, y1):
                        if not counting:
                            entry_tile[entry] = row * across + column
                            entry_packets[entry] = (x1 - x0 + LANES - 1) // LANES * (y1 - y0)
                        entry += 1
            if counting:
                entry_start[k + 1] = entry


@kernel
def sort_entries(order, entry_start, entry_tile, entry_packets, position, tile_start, members, packets):
    """Fills the tile-major lists from `entry_tile` and `entry_packets`; see `Bins` and `list_tiles`."""
    tile_start[:] = 0
    packets[:] = 0
    for entry in range(len(entry_tile)):
        tile_start[entry_tile[entry] + 1] += 1
    for t in range(len(tile_start) - 1):
        tile_start[t + 1] += tile_start[t]
    for k in range(len(order)):
        for entry in range(entry_start[k], entry_start[k + 1]):
            t = entry_tile[entry]
            position[entry] = tile_start[t]
            members[tile_start[t]] = order[k]
            tile_start[t] += 1
            packets[t] += entry_packets[entry]
    for t in range(len(tile_start) - 1, 0, -1):
        tile_start[t] = tile_start[t - 1]
    tile_start[0] = 0


def bin_billboards(
    projection: ProjectedPatches,
    rank: torch.Tensor,
    texels: int,
    width: int,
    height: int,
    support: float,
    dtype: torch.dtype,
    by_nearest: bool,
) -> Bins:
    """Prepares projected billboards for the tiles.

    Args:
        projection: F billboards in one camera, on the CPU.
        rank: (F,) int64, billboards in rank order.
        texels: texture side.
        width, height: image [px].
        support: `texture_support(texels)`.
        dtype: of the records.
        by_nearest: take billboards by the least depth that they reach rather than by rank.

    Raises:
        DeviceError: the lists would not fit into memory.
    """
    count = len(rank)
    plane, fade = projection.plane.detach().numpy(), projection.fade.detach().numpy()
    nearest, bounds = projection.nearest.numpy(), projection.bounds.numpy()
    record = torch.empty(count, RECORD, dtype=dtype).numpy()
    box = torch.empty(count, 4, dtype=torch.int32).numpy()
    seen = bounds[:, 0] <= bounds[:, 2]
    ranked = rank.numpy()
    depths = projection.depth.numpy()[ranked]
    depths = depths[seen[ranked] & (depths > 0)]
    reference = 1.0 / float(depths[len(depths) // 2]) if len(depths) else 1.0
    pack(plane, fade, nearest, bounds, texels, width, height, reference, record, box)
    ranks = torch.empty(count, dtype=torch.int32).numpy()
    ranks[ranked] = np.arange(count, dtype=np.int32)
    order = ranked[np.argsort(nearest[ranked], kind="stable")] if by_nearest else ranked
    order = order.astype(np.int32)
    across, down = -(-width // TILE_WIDTH), -(-height // TILE_HEIGHT)
    start = np.zeros(count + 1, np.int64)

    def list_all(tile: NDArray[np.int32], packets: NDArray[np.int32]) -> None:
        counter = np.zeros(1, np.int64)
        run_workers(lambda _: list_tiles(counter, _CHUNK, plane, box, order, support, across, start, tile, packets))

    list_all(np.zeros(0, np.int32), np.zeros(0, np.int32))
    np.cumsum(start, out=start)
    entries = int(start[-1])
    require_memory(entries * 20 + across * down * 8, f"the tile lists of {count} billboards ({entries} entries)")
    tile, entry_packets, members = (np.zeros(entries, np.int32) for _ in range(3))
    position = np.zeros(entries, np.int64)
    tile_start, packets = np.zeros(across * down + 1, np.int64), np.zeros(across * down, np.int64)
    if entries:
        list_all(tile, entry_packets)
    sort_entries(order, start, tile, entry_packets, position, tile_start, members, packets)
    return Bins(record, box, order, ranks, start, tile, position, tile_start, members, packets)


def available_memory() -> int:
    """Bytes that can still be allocated without swapping; a large number where the system does not say."""
    try:
        with open("/proc/meminfo") as handle:
            for line in handle:
                if line.startswith("MemAvailable:"):
                    return int(line.split()[1]) * 1024
    except OSError:
        pass
    return 1 << 62


def require_memory(needed: int, purpose: str) -> None:
    """Refuses work whose memory is not there, before any of it is allocated.

    Raises:
        DeviceError: one line that says what is needed and what there is.
    """
    if needed < 1 << 26:
        return
    free = available_memory()
    if needed > free:
        raise DeviceError.of(
            "render_billboards", "memory", expected=f"{needed / 2**30:.1f} GiB for {purpose}",
            found=f"{free / 2**30:.1f} GiB free", fix="render fewer or smaller billboards or a smaller image",
        )  # fmt: skip
