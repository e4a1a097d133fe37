"""CPU backend: Numba kernels behind a torch autograd function.

Deterministic: the same inputs give the same bytes, forward and backward, whatever the number of
threads.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numba import types
from torch import Tensor

from nbavatar.jit.compile import prepare
from nbavatar.jit.lanes import LANES
from nbavatar.jit.workers import run_workers
from nbavatar.rendering import binning, workspace
from nbavatar.rendering.billboards import cpu_gather, cpu_tiles
from nbavatar.rendering.billboards.cpu_gather import GATHER_BUFFERS, GatherScratch, Gradients, Part
from nbavatar.rendering.billboards.cpu_intersection import constants_of, constants_type
from nbavatar.rendering.billboards.cpu_scratch import (
    BROKEN,
    BUFFERS,
    GIVEN_UP,
    HITS,
    LIST,
    Adjoints,
    Images,
    Scratch,
    Shape,
    Sizes,
    Tape,
    Textures,
)
from nbavatar.rendering.billboards.reference import BlendSettings
from nbavatar.rendering.binning import bin_billboards, bins_type, require_memory
from nbavatar.rendering.patches import ProjectedPatches
from nbavatar.rendering.scratch import array_of, scratch_bytes, scratch_type, scratch_views

__all__ = ["blend_cpu", "count_samples", "prepare_kernels"]

_QUEUE = 64  # hits that may wait at a pixel; where half of them have to stay, a tile is done again with room for all
_TAPE = 6 << 20  # bundles of hits on the tape at once: 576 MiB in float32
_SCRATCH = 1 << 26  # bytes that a worker may use; fewer rows are worked on at once beyond it


def blend_cpu(
    projection: ProjectedPatches,
    rank: Tensor,
    features: Tensor,
    alpha: Tensor,
    settings: BlendSettings,
    uniform: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Blends projected billboards front to back; arguments and results as `blend_reference`.

    `uniform` (F, D): further channels, which all texels of a billboard have in common. They are not written to every
    texel first: of thirteen channels of which seven are uniform a training step then copies half as much.

    Works in the widest dtype of `features`, `alpha` and `uniform`, float32 or float64 (half precision is
    widened, which copies the textures), and returns that dtype.

    Raises:
        DataError: an alpha texture holds NaN.
        DeviceError: the memory needed is not there.
    """
    uniform = alpha.new_zeros((len(alpha), 0)) if uniform is None else uniform
    textures = features, alpha, uniform
    dtype = torch.float64 if torch.float64 in {values.dtype for values in textures} else torch.float32
    inputs = (projection.plane, projection.fade, *(values.to(dtype).contiguous() for values in textures))
    return _Blend.apply(*inputs, projection, rank, settings)


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, plane, fade, features, alpha, uniform, projection, rank, settings):
        scene = _Scene(projection, rank, features, alpha, uniform, settings)
        result = scene.forward()
        ctx.scene = scene
        ctx.save_for_backward(features, alpha)
        return result

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *grads):
        _ = ctx.saved_tensors  # raises if a texture was changed in place since the forward pass
        grad_features, grad_alpha, grad_uniform, grad_plane, grad_fade = ctx.scene.backward(*grads)
        return grad_plane, grad_fade, grad_features, grad_alpha, grad_uniform, None, None, None


def count_samples(
    projection: ProjectedPatches, rank: Tensor, features: Tensor, alpha: Tensor, settings: BlendSettings
) -> int:
    """Number of hits that are blended into the image."""
    scene = _Scene(projection, rank, features.detach(), alpha.detach(), alpha.new_zeros((len(alpha), 0)), settings)
    scene.forward()
    return scene.samples


@dataclass(frozen=True)
class _Pass:
    """Tiles that are worked on with scratch of the same sizes."""

    tiles: np.ndarray
    sizes: Sizes


class _Scene:
    """One camera's billboards, binned, and the arrays that the kernels share."""

    def __init__(
        self, projection: ProjectedPatches, rank: Tensor, features: Tensor, alpha: Tensor, uniform: Tensor,
        settings: BlendSettings,
    ) -> None:  # fmt: skip
        s = self.settings = settings
        self.dtype = alpha.dtype
        self.texels, self.texture_channels, self.count = alpha.shape[-1], features.shape[-1], len(alpha)
        self.uniform_channels = uniform.shape[-1]
        self.channels = self.texture_channels + self.uniform_channels
        self.stride = -(-self.channels // LANES) * LANES
        prepare_kernels(self.dtype)
        rows = uniform.new_zeros((self.count, self.stride if self.uniform_channels else 0))
        rows[:, self.texture_channels : self.channels] = uniform.detach()
        self.textures = Textures(*(values.detach().view(-1).numpy() for values in (features, alpha, rows)))
        self.bins = bin_billboards(
            projection, rank, self.texels, s.width, s.height, s.support, self.dtype, by_nearest=s.queue < 0
        )
        self.real = np.dtype(np.float32 if self.dtype == torch.float32 else np.float64)
        self.constants = constants_of(self.texels, s.near, s.alpha_min, s.t_min, s.alpha_max, self.real.type)
        self.lengths = np.diff(self.bins.tile_start)
        self.bundles = np.zeros(len(self.lengths) + 1, np.int64)  # of each tile, as the forward pass finds them
        self.passes: list[_Pass] = []
        self.samples = 0

    def _empty(self, *shape: int) -> np.ndarray:
        return workspace.empty(shape, self.real)

    def forward(self) -> tuple[Tensor, Tensor]:
        """Blends all tiles, those whose queues were too short a second time."""
        s = self.settings
        pixels = s.width * s.height
        require_memory(pixels * (self.channels + 1) * self.real.itemsize, f"an image of {s.width}x{s.height} pixels")
        image = torch.from_numpy(self._empty(self.channels, s.height, s.width))
        opacity = torch.from_numpy(self._empty(s.height, s.width))
        images = Images(image.view(-1).numpy(), opacity.view(-1).numpy(), self.bundles)
        tiles = np.arange(len(self.lengths), dtype=np.int32)
        longest = int(self.lengths.max(initial=1))
        capacity = min(longest, _QUEUE if s.queue < 0 else s.queue + 1)
        while len(tiles):
            plan = self._plan(tiles, capacity)
            states = self._run(plan, images, None)
            broken = max((int(state[BROKEN]) for state in states), default=0)
            if broken:
                _complain(broken - 1)
            self.samples += sum(int(state[HITS]) for state in states)
            again = np.concatenate([state[LIST : LIST + state[GIVEN_UP]] for state in states])
            again = np.sort(again).astype(np.int32)
            self.passes.append(_Pass(np.setdiff1d(tiles, again), plan.sizes))
            tiles = again
            capacity = int(self.lengths[tiles].max(initial=1))
        return image, opacity

    def backward(self, grad_image: Tensor, grad_opacity: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Gradients by features, alpha, the uniform channels, plane and fade."""
        s = self.settings
        size = self.real.itemsize
        texels = self.count * self.texels**2
        require_memory(
            (texels * (self.texture_channels + 1) + self.count * self.stride) * size
            + s.width * s.height * (self.stride + 1) * size,
            f"the gradients of {self.count} billboards",
        )
        grad_alpha = torch.from_numpy(self._empty(self.count, self.texels, self.texels))
        grad_features = torch.from_numpy(self._empty(*grad_alpha.shape, self.texture_channels))
        grad_uniform = torch.from_numpy(self._empty(self.count, self.stride if self.uniform_channels else 0))
        grad_plane = torch.empty(self.count, 3, 3, dtype=torch.float64)
        grad_fade = torch.empty(self.count, dtype=torch.float64)
        adjoints = Adjoints(self._rows(grad_image), grad_opacity.to(self.dtype).contiguous().view(-1).numpy())
        flat = (values.view(-1).numpy() for values in (grad_features, grad_alpha, grad_uniform))
        self._replay(adjoints, Gradients(*flat, grad_plane.numpy(), grad_fade.numpy()))
        return grad_features, grad_alpha, grad_uniform[:, self.texture_channels : self.channels], grad_plane, grad_fade

    def _rows(self, image: Tensor) -> np.ndarray:
        """An image (C, H, W) as (H, W, stride), flat."""
        pixels = self.settings.width * self.settings.height
        planes = image.to(self.dtype).contiguous().view(-1).numpy()
        rows = self._empty((pixels + LANES) * self.stride)
        counter = np.zeros(1, np.int64)
        run_workers(lambda _: cpu_gather.interleave(counter, 1 << 14, planes, rows, self.channels, pixels))
        return rows

    def _replay(self, adjoints: Adjoints, gradients: Gradients) -> None:
        """Repeats the blending, range of tiles by range of tiles, and fills the gradients."""
        tile_bundle = np.concatenate([[0], np.cumsum(self.bundles[:-1])])
        parts = _divide(tile_bundle)
        largest = max((int(tile_bundle[end] - tile_bundle[first]) for first, end in parts), default=0)
        bands = max((-(-binning.TILE_HEIGHT // plan.sizes.rows) for plan in self.passes), default=1)
        entries = len(self.bins.members)
        require_memory(
            largest * LANES * (2 * self.real.itemsize + 4) + bands * entries * 8,
            f"the tape of {largest * LANES} hits in the backward pass",
        )
        values = self._empty(2 * LANES * largest)
        pixels = workspace.empty((LANES * largest,), np.dtype(np.int32))
        for number, (first, end) in enumerate(parts):
            ranges = np.zeros(2 * bands * entries, np.int32)
            tape = Tape(values, pixels, ranges, tile_bundle, int(tile_bundle[first]))
            for plan in self.passes:
                chosen = plan.tiles[(plan.tiles >= first) & (plan.tiles < end)]
                states = self._run(_Pass(chosen, plan.sizes), None, (adjoints, tape))
                if any(state[GIVEN_UP] for state in states):
                    raise RuntimeError("render_billboards: the backward pass finds other hits than the forward pass")
            self._gather(Part(16, first, end, bands, number == 0), adjoints, tape, gradients)

    def _gather(self, part: Part, adjoints: Adjoints, tape: Tape, gradients: Gradients) -> None:
        """Adds what is on the tape to the gradients."""
        sizes = Sizes(1, 1, self.channels, 0, self.texels)
        counter = np.zeros(1, np.int64)

        def work(_: int) -> None:
            memory = workspace.empty((scratch_bytes(GATHER_BUFFERS, sizes, self.real, True),), np.dtype(np.uint8))
            cpu_gather.gather_gradients(
                counter, part, self.bins, self.textures, self.constants, self._shape(sizes), adjoints, tape, gradients,
                scratch_views(GatherScratch, GATHER_BUFFERS, sizes, self.real, True, memory),
            )  # fmt: skip

        run_workers(work)

    def _plan(self, tiles: np.ndarray, capacity: int) -> _Pass:
        """How many rows to work on at once."""
        longest = int(self.lengths[tiles].max(initial=0))
        most = int(self.bins.packets[tiles].max(initial=0))
        rows = binning.TILE_HEIGHT
        while True:
            bundles = min(most, longest * rows * (binning.TILE_WIDTH // LANES))
            sizes = Sizes(rows, capacity, self.channels, bundles, self.texels)
            if rows == 1 or scratch_bytes(BUFFERS, sizes, self.real, True) <= _SCRATCH:
                return _Pass(tiles, sizes)
            rows //= 2

    def _shape(self, sizes: Sizes) -> Shape:
        s = self.settings
        across = -(-s.width // binning.TILE_WIDTH)
        return Shape(
            self.texels, self.texture_channels, self.uniform_channels, s.width, s.height, across, s.queue,
            sizes.capacity, sizes.rows, sizes.bundles,
        )  # fmt: skip

    def _run(self, plan: _Pass, images: Images | None, backward: tuple[Adjoints, Tape] | None) -> list[np.ndarray]:
        """Runs the forward kernel, or with `backward` that of the replay, on all threads; returns each one's status."""
        workers, replay = torch.get_num_threads(), backward is not None
        needed = scratch_bytes(BUFFERS, plan.sizes, self.real, replay)
        require_memory(workers * needed, f"queues of {plan.sizes.capacity} hits a pixel")
        reals, i32, i64 = (np.zeros(0, dtype) for dtype in (self.real, np.int32, np.int64))
        images = images or Images(reals, reals, i64)
        adjoints, tape = backward or (Adjoints(reals, reals), Tape(reals, i32, i32, i64, 0))
        work_tiles = cpu_tiles.replay_tiles if replay else cpu_tiles.blend_tiles
        counter = np.zeros(1, np.int64)

        def work(_: int) -> np.ndarray:
            status = np.zeros(LIST + len(plan.tiles), np.int64)
            memory = workspace.empty((needed,), np.dtype(np.uint8))
            scratch = scratch_views(Scratch, BUFFERS, plan.sizes, self.real, replay, memory)
            work_tiles(
                counter, plan.tiles, self.bins, self.textures, self.constants, self._shape(plan.sizes), images,
                adjoints, tape, scratch, status,
            )  # fmt: skip
            return status

        return run_workers(work)


def _divide(tile_bundle: np.ndarray) -> list[tuple[int, int]]:
    """Consecutive tiles whose hits fit on the tape together."""
    parts, first = [], 0
    for tile in range(1, len(tile_bundle)):
        if tile > first and tile_bundle[tile] - tile_bundle[first] > _TAPE and tile - first > 1:
            parts.append((first, tile - 1))
            first = tile - 1
    parts.append((first, len(tile_bundle) - 1))
    return parts


def _complain(billboard: int) -> None:
    from nbavatar.errors import DataError

    raise DataError.of(
        "render_billboards", "alpha", expected="numbers in [0, 1]", found=f"NaN in the texture of billboard {billboard}"
    )


def prepare_kernels(dtype: torch.dtype) -> None:
    """Has every kernel compiled for a dtype, float32 or float64."""
    real = types.float32 if dtype == torch.float32 else types.float64
    boolean, i32, i64, f64 = types.boolean, types.int32, types.int64, types.float64
    reals, i32s, i64s = array_of(real), array_of(i32), array_of(i64)

    def group(kind: type, *members: Any) -> Any:
        return types.BaseTuple.from_types(members, kind)

    bins, constants = bins_type(real), constants_type(real)
    shape = group(Shape, *[i64] * len(Shape._fields))
    textures, adjoints = group(Textures, reals, reals, reals), group(Adjoints, reals, reals)
    tape = group(Tape, reals, i32s, i32s, i64s, i64)
    tiles = (
        i64s, i32s, bins, textures, constants, shape, group(Images, reals, reals, i64s), adjoints, tape,
        scratch_type(Scratch, BUFFERS, real), i64s,
    )  # fmt: skip
    prepare(
        f"billboards-{real}",
        {
            binning.pack: (
                array_of(f64, 3), array_of(f64), array_of(f64), array_of(f64, 2), i64, i64, i64, f64,
                array_of(real, 2), array_of(i32, 2),
            ),
            binning.list_tiles: (i64s, i64, array_of(f64, 3), array_of(i32, 2), i32s, f64, i64, i64s, i32s, i32s),
            binning.sort_entries: (i32s, i64s, i32s, i32s, i64s, i64s, i32s, i64s),
            cpu_tiles.blend_tiles: tiles,
            cpu_tiles.replay_tiles: tiles,
            cpu_gather.interleave: (i64s, i64, reals, reals, i64, i64),
            cpu_gather.gather_gradients: (
                i64s, group(Part, i64, i64, i64, i64, boolean), bins, textures, constants, shape, adjoints, tape,
                group(Gradients, reals, reals, reals, array_of(f64, 3), array_of(f64)),
                scratch_type(GatherScratch, GATHER_BUFFERS, real),
            ),
        },
    )  # fmt: skip
