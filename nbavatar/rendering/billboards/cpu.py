"""CPU backend: Numba kernels behind a torch autograd function.

Deterministic: the same inputs give the same bytes, forward and backward, whatever the number of
threads.
"""

from dataclasses import dataclass

import numpy as np
import torch
from numba import types
from torch import Tensor

from nbavatar.jit.compile import prepare
from nbavatar.jit.lanes import LANES
from nbavatar.jit.workers import run_workers
from nbavatar.rendering import binning, workspace
from nbavatar.rendering.billboards import cpu_blend, cpu_gather, cpu_scratch
from nbavatar.rendering.billboards.cpu_hits import write_limits
from nbavatar.rendering.billboards.reference import BlendSettings
from nbavatar.rendering.binning import bin_billboards, require_memory
from nbavatar.rendering.patches import ProjectedPatches

__all__ = ["blend_cpu", "count_samples"]

_QUEUE = 64  # hits that may wait at a pixel; where half of them have to stay, a tile is done again with room for all
_NOTES = 6 << 20  # bundles of hits noted at once in the backward pass: 576 MiB in float32
_SCRATCH = 1 << 26  # bytes that a worker may use; fewer rows are worked on at once beyond it


def blend_cpu(
    projection: ProjectedPatches, rank: Tensor, features: Tensor, alpha: Tensor, settings: BlendSettings
) -> tuple[Tensor, Tensor]:
    """Blends projected billboards front to back; arguments and results as `blend_reference`.

    Works in the wider dtype of `features` and `alpha`, float32 or float64 (half precision is
    widened, which copies the textures), and returns that dtype.

    Raises:
        DataError: an alpha texture holds NaN.
        DeviceError: the memory needed is not there.
    """
    dtype = torch.float64 if torch.float64 in (features.dtype, alpha.dtype) else torch.float32
    inputs = (projection.plane, projection.fade, features.to(dtype).contiguous(), alpha.to(dtype).contiguous())
    return _Blend.apply(*inputs, projection, rank, settings)


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, plane, fade, features, alpha, projection, rank, settings):
        scene = _Scene(projection, rank, features, alpha, settings)
        result = scene.forward()
        ctx.scene = scene
        ctx.save_for_backward(features, alpha)
        return result

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *grads):
        _ = ctx.saved_tensors  # raises if a texture was changed in place since the forward pass
        grad_features, grad_alpha, grad_plane, grad_fade = ctx.scene.backward(*grads)
        return grad_plane, grad_fade, grad_features, grad_alpha, None, None, None


def count_samples(
    projection: ProjectedPatches, rank: Tensor, features: Tensor, alpha: Tensor, settings: BlendSettings
) -> int:
    """Number of hits that are blended into the image."""
    scene = _Scene(projection, rank, features.detach(), alpha.detach(), settings)
    scene.forward()
    return scene.samples


@dataclass(frozen=True)
class _Pass:
    """Tiles that are worked on with queues of the same capacity, `rows` rows at once."""

    tiles: np.ndarray
    capacity: int
    rows: int
    bundles: int


class _Scene:
    """One camera's billboards, binned, and the arrays that the kernels share."""

    def __init__(
        self, projection: ProjectedPatches, rank: Tensor, features: Tensor, alpha: Tensor, settings: BlendSettings
    ) -> None:
        s = self.settings = settings
        self.dtype = alpha.dtype
        self.texels, self.channels, self.count = alpha.shape[-1], features.shape[-1], len(alpha)
        self.stride = -(-self.channels // LANES) * LANES
        _prepare(self.dtype)
        self.features, self.alpha = features.detach().view(-1).numpy(), alpha.detach().view(-1).numpy()
        self.bins = bin_billboards(
            projection, rank, self.texels, s.width, s.height, s.support, self.dtype, by_nearest=s.queue < 0
        )
        real = np.float32 if self.dtype == torch.float32 else np.float64
        self.limits = write_limits(self.texels, s.near, s.alpha_min, s.t_min, s.alpha_max, real)
        self.across = -(-s.width // binning.TILE_WIDTH)
        self.lengths = np.diff(self.bins.start)
        self.made = np.zeros(len(self.lengths) + 1, np.int64)
        self.passes: list[_Pass] = []
        self.samples = 0

    def forward(self) -> tuple[Tensor, Tensor]:
        """Blends all tiles, those whose queues were too short a second time."""
        s = self.settings
        pixels = s.width * s.height
        require_memory(pixels * (self.channels + 1) * self.limits.itemsize, f"an image of {s.width}x{s.height} pixels")
        real = self.limits.dtype
        image = torch.from_numpy(workspace.empty((self.channels, s.height, s.width), real))
        opacity = torch.from_numpy(workspace.empty((s.height, s.width), real))
        nothing = np.zeros(0, self.limits.dtype)
        results = (image.view(-1).numpy(), opacity.view(-1).numpy())
        whole = np.zeros(0, np.int32)
        tiles = np.arange(len(self.lengths), dtype=np.int32)
        longest = int(self.lengths.max(initial=1))
        capacity = min(longest, _QUEUE if s.queue < 0 else s.queue + 1)
        while len(tiles):
            plan = self._plan(tiles, capacity)
            states = self._run(plan, False, *results, nothing, nothing, nothing, whole, whole, 0)
            broken = max((int(state[1]) for state in states), default=0)
            if broken:
                _complain(broken - 1)
            self.samples += sum(int(state[2]) for state in states)
            again = np.sort(np.concatenate([state[3 : 3 + state[0]] for state in states])).astype(np.int32)
            self.passes.append(_Pass(np.setdiff1d(tiles, again), plan.capacity, plan.rows, plan.bundles))
            tiles = again
            capacity = int(self.lengths[tiles].max(initial=1))
        return image, opacity

    def backward(self, grad_image: Tensor, grad_opacity: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Gradients by features, alpha, plane and fade."""
        s = self.settings
        size = self.limits.itemsize
        texels = self.count * self.texels**2
        require_memory(
            texels * (self.channels + 1) * size + s.width * s.height * (self.stride + 1) * size,
            f"the gradients of {self.count} billboards",
        )
        grad_alpha = torch.from_numpy(workspace.empty((self.count, self.texels, self.texels), self.limits.dtype))
        shape = (*grad_alpha.shape, self.channels)
        grad_features = torch.from_numpy(workspace.empty(shape, self.limits.dtype))
        grad_plane = torch.empty(self.count, 3, 3, dtype=torch.float64)
        grad_fade = torch.empty(self.count, dtype=torch.float64)
        covers = grad_opacity.to(self.dtype).contiguous().view(-1).numpy()
        outputs = (grad_features.view(-1).numpy(), grad_alpha.view(-1).numpy(), grad_plane.numpy(), grad_fade.numpy())
        self._replay(self._rows(grad_image), covers, outputs)
        return grad_features, grad_alpha, grad_plane, grad_fade

    def _rows(self, image: Tensor) -> np.ndarray:
        """An image (C, H, W) as (H, W, stride), flat."""
        pixels = self.settings.width * self.settings.height
        planes = image.to(self.dtype).contiguous().view(-1).numpy()
        rows = workspace.empty(((pixels + LANES) * self.stride,), self.limits.dtype)
        turn = np.zeros(1, np.int64)
        run_workers(lambda _: cpu_gather.interleave(turn, 1 << 14, planes, rows, self.channels, pixels))
        return rows

    def _replay(self, grads: np.ndarray, covers: np.ndarray, outputs: tuple[np.ndarray, ...]) -> None:
        """Repeats the blending, range of tiles by range of tiles, and fills the gradients `outputs`."""
        b = self.bins
        first_bundle = np.concatenate([[0], np.cumsum(self.made[:-1])])
        parts = _divide(first_bundle)
        largest = max((int(first_bundle[end] - first_bundle[first]) for first, end in parts), default=0)
        bands = max((-(-binning.TILE_HEIGHT // plan.rows) for plan in self.passes), default=1)
        entries = len(b.members)
        require_memory(
            largest * LANES * (2 * self.limits.itemsize + 4) + bands * entries * 8,
            f"the notes of {largest * LANES} hits in the backward pass",
        )
        notes = workspace.empty((2 * LANES * largest,), self.limits.dtype)
        spots = workspace.empty((LANES * largest,), np.dtype(np.int32))
        nothing = np.zeros(0, self.limits.dtype)
        shape = np.array([self.texels, self.channels, self.settings.width, self.across], np.int64)
        for number, (first, end) in enumerate(parts):
            ranges = np.zeros(2 * bands * entries, np.int32)
            base = int(first_bundle[first])
            for plan in self.passes:
                chosen = plan.tiles[(plan.tiles >= first) & (plan.tiles < end)]
                part = _Pass(chosen, plan.capacity, plan.rows, plan.bundles)
                states = self._run(
                    part, True, nothing, nothing, grads, covers, notes, spots, ranges, base, first_bundle
                )
                if any(state[0] for state in states):
                    raise RuntimeError("render_billboards: the backward pass finds other hits than the forward pass")
            turn = np.zeros(1, np.int64)

            def work(_: int, first=first, end=end, base=base, fresh=number == 0, turn=turn, ranges=ranges) -> None:
                cpu_gather.gather_gradients(
                    turn, 16, first, end, bands, b.sequence, b.first, b.tile, b.where, ranges, first_bundle, notes,
                    spots, base, b.record.reshape(-1), b.box, self.features, self.alpha, self.limits, shape, grads,
                    fresh, *outputs,
                    torch.empty(cpu_gather.scratch_size(self.texels, self.channels), dtype=self.dtype).numpy(),
                )  # fmt: skip

            run_workers(work)

    def _plan(self, tiles: np.ndarray, capacity: int) -> _Pass:
        """How many rows to work on at once."""
        longest = int(self.lengths[tiles].max(initial=0))
        most = int(self.bins.room[tiles].max(initial=0))
        rows = binning.TILE_HEIGHT
        while True:
            bundles = min(most, longest * rows * (binning.TILE_WIDTH // LANES))
            if rows == 1 or self._bytes(rows, capacity, bundles) <= _SCRATCH:
                return _Pass(tiles, capacity, rows, bundles)
            rows //= 2

    def _bytes(self, rows: int, capacity: int, bundles: int) -> int:
        reals, wholes = cpu_scratch.scratch_sizes(rows, capacity, self.channels, bundles, True)
        return reals * self.limits.itemsize + wholes * 4

    def _run(
        self, plan: _Pass, replay: bool, image: np.ndarray, opacity: np.ndarray, grads: np.ndarray, covers: np.ndarray,
        notes: np.ndarray, spots: np.ndarray, ranges: np.ndarray, base: int, made: np.ndarray | None = None,
    ) -> list[np.ndarray]:  # fmt: skip
        """Runs the blending kernel on all threads; returns each one's status."""
        s, b = self.settings, self.bins
        workers = torch.get_num_threads()
        require_memory(
            workers * self._bytes(plan.rows, plan.capacity, plan.bundles), f"queues of {plan.capacity} hits a pixel"
        )
        reals, wholes = cpu_scratch.scratch_sizes(plan.rows, plan.capacity, self.channels, plan.bundles, replay)
        values = [
            self.texels, self.channels, s.width, s.height, self.across, s.queue, plan.capacity, plan.rows, plan.bundles,
        ]  # fmt: skip
        shape = np.array(values, np.int64)
        turn = np.zeros(1, np.int64)

        def work(_: int) -> np.ndarray:
            status = np.zeros(3 + len(plan.tiles), np.int64)
            (cpu_blend.note_tiles if replay else cpu_blend.blend_tiles)(
                turn, plan.tiles, b.start, b.members, b.record.reshape(-1), b.box, b.place, self.features,
                self.alpha, self.limits, shape, image, opacity, grads, covers, notes, spots, ranges,
                self.made if made is None else made, base, workspace.empty((reals,), self.limits.dtype),
                workspace.empty((wholes,), np.dtype(np.int32)), status,
            )  # fmt: skip
            return status

        return run_workers(work)


def _divide(first_bundle: np.ndarray) -> list[tuple[int, int]]:
    """Consecutive tiles whose hits can be noted together."""
    parts, first = [], 0
    for tile in range(1, len(first_bundle)):
        if tile > first and first_bundle[tile] - first_bundle[first] > _NOTES and tile - first > 1:
            parts.append((first, tile - 1))
            first = tile - 1
    parts.append((first, len(first_bundle) - 1))
    return parts


def _complain(billboard: int) -> None:
    from nbavatar.errors import DataError

    raise DataError.of(
        "render_billboards", "alpha", expected="numbers in [0, 1]", found=f"NaN in the texture of billboard {billboard}"
    )


def _prepare(dtype: torch.dtype) -> None:
    """Has every kernel compiled for a dtype."""
    real = types.float32 if dtype == torch.float32 else types.float64

    def array(kind, dimensions: int = 1):
        return types.Array(kind, dimensions, "C")

    i32, i64, f64 = types.int32, types.int64, types.float64
    prepare(
        f"billboards-{real}",
        {
            binning.pack: (
                array(f64, 3), array(f64), array(f64), array(f64, 2), i64, i64, i64, f64, array(real, 2), array(i32, 2),
            ),
            binning.list_tiles: (
                array(i64), i64, array(f64, 3), array(i32, 2), array(i32), f64, i64, array(i64), array(i32), array(i32),
            ),
            binning.sort_entries: (
                array(i32), array(i64), array(i32), array(i32), array(i64), array(i64), array(i32), array(i64),
            ),
            cpu_blend.blend_tiles: (
                array(i64), array(i32), array(i64), array(i32), array(real), array(i32, 2), array(i32), array(real),
                array(real), array(real), array(i64), *[array(real)] * 5, *[array(i32)] * 2, array(i64), i64,
                array(real), array(i32), array(i64),
            ),
            cpu_blend.note_tiles: (
                array(i64), array(i32), array(i64), array(i32), array(real), array(i32, 2), array(i32), array(real),
                array(real), array(real), array(i64), *[array(real)] * 5, *[array(i32)] * 2, array(i64), i64,
                array(real), array(i32), array(i64),
            ),
            cpu_gather.interleave: (array(i64), i64, array(real), array(real), i64, i64),
            cpu_gather.gather_gradients: (
                array(i64), i64, i64, i64, i64, array(i32), array(i64), array(i32), array(i64), array(i32), array(i64),
                array(real), array(i32), i64, array(real), array(i32, 2), array(real), array(real), array(real),
                array(i64), array(real), types.boolean, array(real), array(real), array(f64, 3), array(f64),
                array(real),
            ),
        },
    )  # fmt: skip
