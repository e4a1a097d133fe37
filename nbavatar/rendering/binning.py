"""Which billboards touch which tiles of the image.

Bounds are conservative and tight: the projected corners of the texture's whole support, clipped
at the near plane where the patch crosses it (`projection.py`), then, tile by tile, the four
edges of the patch themselves, so a thin diagonal billboard enters only the tiles it runs through.
"""

from dataclasses import dataclass

import numba
import numpy as np
import torch
from numpy.typing import NDArray

from nbavatar.errors import DeviceError
from nbavatar.jit.compile import inlined, kernel
from nbavatar.jit.lanes import LANES
from nbavatar.jit.memory import fetch_add
from nbavatar.jit.workers import run_workers
from nbavatar.rendering.patches import ProjectedPatches

__all__ = ["RECORD", "TILE_HEIGHT", "TILE_WIDTH", "Bins", "bin_billboards", "require_memory", "tile_bounds"]

TILE_WIDTH = 32  # pixels
TILE_HEIGHT = 32
RECORD = 16  # numbers in a billboard's record; see `pack`
_CHUNK = 256  # billboards that a worker bins at a time
_SLACK = 1e-3  # pixels by which bounds are widened, far more than rounding can move a corner


@dataclass(frozen=True)
class Bins:
    """Billboards prepared for the kernels, and their entries in the tiles' lists.

    Attributes:
        record: (F, RECORD) see `pack`.
        box: (F, 4) int32, pixels `x0, y0, x1, y1` that a billboard may touch, the last two excluded.
        sequence: (F,) int32, billboards in the order in which tiles take them.
        place: (F,) int32, rank of each billboard, which settles equal depths.
        first: (F + 1,) int64, entries of `sequence[i]` are `first[i] ... first[i + 1]`.
        tile: (E,) int32, tile of each entry, in that numbering.
        where: (E,) int64, its position in the tile-major lists.
        start: (tiles + 1,) int64, list of each tile.
        members: (E,) int32, the tile-major lists: billboards.
        room: (tiles,) int64, most groups of `LANES` neighbouring pixels that the billboards of a tile can fill.
    """

    record: NDArray
    box: NDArray[np.int32]
    sequence: NDArray[np.int32]
    place: NDArray[np.int32]
    first: NDArray[np.int64]
    tile: NDArray[np.int32]
    where: NDArray[np.int64]
    start: NDArray[np.int64]
    members: NDArray[np.int32]
    room: NDArray[np.int64]


@kernel
def pack(plane, fade, nearest, bounds, texels, width, height, reference, record, box):
    """Writes the records and pixel boxes of all billboards.

    A record holds, relative to the centre of pixel ((x0 + x1) // 2, (y0 + y1) // 2) of the box, the
    affine functions of the texel coordinates s (0-2) and t (3-5) times inverse depth and of inverse
    depth (6-8); inverse depth less `reference` at the origin (9); the fade (10); the largest inverse
    depth less `reference` that any hit can have (11). The shift of the origin is made in float64:
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
            k = plane[i, row, 0] * x + plane[i, row, 1] * y + plane[i, row, 2]
            w = plane[i, 2, 0] * x + plane[i, 2, 1] * y + plane[i, 2, 2]
            if row == 2:
                record[i, 8] = w
                record[i, 9] = w - reference
            else:
                record[i, 3 * row + 2] = scale * k + shift * w
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
def list_tiles(turn, chunk, plane, box, sequence, support, tiles_across, first, tile, groups):
    """Lists the tiles that the billboards touch, or, where `tile` is empty, counts them.

    Args:
        turn: (1,) int64, next place in `sequence`, shared by all workers; `chunk` are taken at a time.
        first, tile: see Bins. While counting, first[k + 1] becomes the number of tiles of sequence[k].
        groups: (E,) int32, groups of `LANES` neighbouring pixels that the billboard can fill in the tile.
    """
    counting = len(tile) == 0
    while True:
        begin = fetch_add(turn, chunk)
        if begin >= len(sequence):
            break
        for k in range(begin, min(begin + chunk, len(sequence))):
            i = sequence[k]
            if counting:
                first[k + 1] = 0
            elif first[k] == first[k + 1]:
                continue
            if box[i, 2] <= box[i, 0]:
                continue
            entry = 0 if counting else first[k]
            for row in range(box[i, 1] // TILE_HEIGHT, (box[i, 3] - 1) // TILE_HEIGHT + 1):
                y0, y1 = max(row * TILE_HEIGHT, box[i, 1]), min((row + 1) * TILE_HEIGHT, box[i, 3])
                for column in range(box[i, 0] // TILE_WIDTH, (box[i, 2] - 1) // TILE_WIDTH + 1):
                    x0, x1 = max(column * TILE_WIDTH, box[i, 0]), min((column + 1) * TILE_WIDTH, box[i, 2])
                    if _touches(plane, i, support, x0, y0, x1, y1):
                        if not counting:
                            tile[entry] = row * tiles_across + column
                            groups[entry] = (x1 - x0 + LANES - 1) // LANES * (y1 - y0)
                        entry += 1
            if counting:
                first[k + 1] = entry


@kernel
def sort_entries(sequence, first, tile, groups, where, start, members, room):
    """Fills the tile-major lists from `tile` and `groups`; see `Bins` and `list_tiles`."""
    start[:] = 0
    room[:] = 0
    for entry in range(len(tile)):
        start[tile[entry] + 1] += 1
    for t in range(len(start) - 1):
        start[t + 1] += start[t]
    for k in range(len(sequence)):
        for entry in range(first[k], first[k + 1]):
            t = tile[entry]
            where[entry] = start[t]
            members[start[t]] = sequence[k]
            start[t] += 1
            room[t] += groups[entry]
    for t in range(len(start) - 1, 0, -1):
        start[t] = start[t - 1]
    start[0] = 0


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
    order = rank.numpy()
    depths = projection.depth.numpy()[order]
    depths = depths[seen[order] & (depths > 0)]
    reference = 1.0 / float(depths[len(depths) // 2]) if len(depths) else 1.0
    pack(plane, fade, nearest, bounds, texels, width, height, reference, record, box)
    place = torch.empty(count, dtype=torch.int32).numpy()
    place[order] = np.arange(count, dtype=np.int32)
    sequence = order[np.argsort(nearest[order], kind="stable")] if by_nearest else order
    sequence = sequence.astype(np.int32)
    across, down = -(-width // TILE_WIDTH), -(-height // TILE_HEIGHT)
    first = np.zeros(count + 1, np.int64)

    def list_all(tile: NDArray[np.int32], groups: NDArray[np.int32]) -> None:
        turn = np.zeros(1, np.int64)
        run_workers(lambda _: list_tiles(turn, _CHUNK, plane, box, sequence, support, across, first, tile, groups))

    list_all(np.zeros(0, np.int32), np.zeros(0, np.int32))
    np.cumsum(first, out=first)
    entries = int(first[-1])
    require_memory(entries * 20 + across * down * 8, f"the tile lists of {count} billboards ({entries} entries)")
    tile, groups, members = (np.zeros(entries, np.int32) for _ in range(3))
    where = np.zeros(entries, np.int64)
    start, room = np.zeros(across * down + 1, np.int64), np.zeros(across * down, np.int64)
    if entries:
        list_all(tile, groups)
    sort_entries(sequence, first, tile, groups, where, start, members, room)
    return Bins(record, box, sequence, place, first, tile, where, start, members, room)


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
