"""CPU backend: Numba kernels behind a torch autograd function.

Deterministic: the same inputs give the same bytes, forward and backward, whatever the number of
threads.
"""

import numpy as np
import torch
from numba import types
from torch import Tensor

from nbavatar.raster import binning, cpu_kernels
from nbavatar.raster.binning import bin_billboards, require_memory
from nbavatar.raster.compile import prepare, run_workers
from nbavatar.raster.projection import Projection
from nbavatar.raster.reference import BlendSettings
from nbavatar.raster.vector import LANES

__all__ = ["blend_cpu", "count_samples"]

_QUEUE = 32  # hits that may wait at a pixel; a tile that needs more is done again with room for all
_NOTES = 1 << 26  # hits noted at once in the backward pass: 512 MiB in float32
_SCRATCH = 1 << 26  # bytes of queues a worker may use; fewer rows are worked on at once beyond it


def blend_cpu(
    projection: Projection, rank: Tensor, features: Tensor, alpha: Tensor, settings: BlendSettings
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
    projection: Projection, rank: Tensor, features: Tensor, alpha: Tensor, settings: BlendSettings
) -> int:
    """Number of hits that are blended into the image."""
    scene = _Scene(projection, rank, features.detach(), alpha.detach(), settings)
    grads = torch.zeros(settings.height, settings.width, features.shape[-1] + 1, dtype=alpha.dtype)
    return scene.replay(grads)


class _Scene:
    """One camera's billboards, binned, and the arrays that the kernels share."""

    def __init__(
        self, projection: Projection, rank: Tensor, features: Tensor, alpha: Tensor, settings: BlendSettings
    ) -> None:
        s = self.settings = settings
        self.dtype = alpha.dtype
        self.texels, self.channels, self.count = alpha.shape[-1], features.shape[-1], len(alpha)
        _prepare(self.dtype)
        self.features, self.alpha = features.detach().view(-1).numpy(), alpha.detach().view(-1).numpy()
        self.bins = bin_billboards(
            projection, rank, self.texels, s.width, s.height, s.support, self.dtype, by_nearest=s.queue < 0
        )
        limits = [0, 1, self.texels, min(1, self.texels - 1), 1 / s.near, s.alpha_min, s.t_min, s.alpha_max]
        self.limits = torch.tensor(limits, dtype=self.dtype).numpy()
        self.across = -(-s.width // binning.TILE_WIDTH)
        self.lengths = np.diff(self.bins.start)
        self.areas = np.diff(self.bins.offset[self.bins.start])

    def forward(self) -> tuple[Tensor, Tensor]:
        s = self.settings
        image = torch.empty(self.channels, s.height, s.width, dtype=self.dtype)
        opacity = torch.empty(s.height, s.width, dtype=self.dtype)
        nothing = np.zeros(0, self.limits.dtype)
        tiles = np.arange(len(self.lengths), dtype=np.int32)
        self._traverse(tiles, image.numpy(), opacity.numpy(), nothing, nothing, 0, replay=False)
        return image, opacity

    def backward(self, grad_image: Tensor, grad_opacity: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Gradients by features, alpha, plane and fade."""
        s = self.settings
        shape = (self.count, self.texels, self.texels)
        grad_features = torch.empty(*shape, self.channels, dtype=self.dtype)
        grad_alpha = torch.empty(shape, dtype=self.dtype)
        grad_plane = torch.empty(self.count, 3, 3, dtype=torch.float64)
        grad_fade = torch.empty(self.count, dtype=torch.float64)
        grads = torch.empty(s.height, s.width, self.channels + 1, dtype=self.dtype)
        grads[..., :-1] = grad_image.permute(1, 2, 0)
        grads[..., -1] = grad_opacity
        outputs = (grad_features.view(-1), grad_alpha.view(-1), grad_plane, grad_fade)
        self.replay(grads, tuple(tensor.numpy() for tensor in outputs))
        return grad_features, grad_alpha, grad_plane, grad_fade

    def replay(self, grads: Tensor, outputs: tuple[np.ndarray, ...] | None = None) -> int:
        """Repeats the blending, group of tiles by group of tiles, and fills the gradients `outputs`.

        Returns:
            Number of hits blended.
        """
        b = self.bins
        flat = grads.view(-1).numpy()
        groups = self._groups()
        largest = max((int(b.offset[b.start[end]] - b.offset[b.start[first]]) for first, end in groups), default=0)
        require_memory(2 * largest * self.limits.itemsize, f"the notes of {largest} hits in the backward pass")
        notes = torch.empty(2 * largest, dtype=self.dtype).numpy()
        no_image, no_opacity = np.zeros((0, 0, 0), self.limits.dtype), np.zeros((0, 0), self.limits.dtype)
        samples = 0
        for number, (first, end) in enumerate(groups):
            base = int(b.offset[b.start[first]])
            tiles = np.arange(first, end, dtype=np.int32)
            samples += self._traverse(tiles, no_image, no_opacity, flat, notes, base, replay=True)
            if outputs is not None:
                turn = np.zeros(1, np.int64)
                shape = self._shape(0, 0, replay=True)

                def work(_: int, first=first, end=end, base=base, fresh=number == 0, turn=turn, shape=shape) -> None:
                    cpu_kernels.collect(
                        turn, 16, first, end, b.sequence, b.first, b.tile, b.where, b.start, b.offset,
                        b.record.reshape(-1), b.box, self.features, self.alpha, self.limits, shape, flat, notes, base,
                        fresh, *outputs,
                    )  # fmt: skip

                run_workers(work)
        return samples

    def _groups(self) -> list[tuple[int, int]]:
        """Consecutive tiles whose hits can be noted together."""
        groups, first, held = [], 0, 0
        for tile, area in enumerate(self.areas.tolist()):
            if held and held + area > _NOTES:
                groups.append((first, tile))
                first, held = tile, 0
            held += area
        groups.append((first, len(self.areas)))
        return groups

    def _shape(self, capacity: int, rows: int, replay: bool) -> np.ndarray:
        s = self.settings
        values = [self.texels, self.channels, s.width, s.height, self.across, s.queue, capacity, rows, int(replay)]
        return np.array(values, np.int64)

    def _traverse(
        self, tiles: np.ndarray, image: np.ndarray, opacity: np.ndarray, grads: np.ndarray, notes: np.ndarray,
        base: int, *, replay: bool,
    ) -> int:  # fmt: skip
        """Works through tiles, those whose queues were too short a second time; returns the hits noted."""
        queue = self.settings.queue
        longest = int(self.lengths[tiles].max(initial=1))
        capacity = min(longest, _QUEUE if queue < 0 else queue + 1)
        samples = 0
        while len(tiles):
            rows = self._rows(capacity)
            states = self._run(tiles, capacity, rows, image, opacity, grads, notes, base, replay)
            broken = max((int(state[1]) for state in states), default=0)
            if broken:
                _complain(broken - 1)
            samples += sum(int(state[2]) for state in states)
            tiles = np.sort(np.concatenate([state[3 : 3 + state[0]] for state in states])).astype(np.int32)
            capacity = int(self.lengths[tiles].max(initial=1))
        return samples

    def _rows(self, capacity: int) -> int:
        row = binning.TILE_WIDTH * capacity * (4 * self.limits.itemsize + 4)
        return int(np.clip(_SCRATCH // row, 1, binning.TILE_HEIGHT))

    def _run(
        self, tiles: np.ndarray, capacity: int, rows: int, image: np.ndarray, opacity: np.ndarray, grads: np.ndarray,
        notes: np.ndarray, base: int, replay: bool,
    ) -> list[np.ndarray]:  # fmt: skip
        b = self.bins
        band = binning.TILE_WIDTH * rows
        hits = 0
        if replay:
            hits = int(min(self.areas[tiles].max(initial=0), self.lengths[tiles].max(initial=0) * band))
        reals = 5 * LANES + band * (1 + self.channels + 4 * capacity) + 3 * hits
        wholes = 3 * band + band * capacity + 1 + 2 * hits
        workers = torch.get_num_threads()
        require_memory(workers * (reals * self.limits.itemsize + wholes * 4), f"queues of {capacity} hits a pixel")
        shape = self._shape(capacity, rows, replay)
        turn = np.zeros(1, np.int64)

        def work(_: int) -> np.ndarray:
            state = np.zeros(3 + len(tiles), np.int64)
            cpu_kernels.traverse(
                turn, tiles, b.start, b.members, b.offset, b.record.reshape(-1), b.box, b.place, self.features,
                self.alpha, self.limits, shape, image, opacity, grads, notes, base,
                torch.empty(reals, dtype=self.dtype).numpy(), torch.empty(wholes, dtype=torch.int32).numpy(), state,
            )  # fmt: skip
            return state

        return run_workers(work)


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
        f"{real}",
        {
            binning.pack: (
                array(f64, 3), array(f64), array(f64), array(f64, 2), i64, i64, i64, f64, array(real, 2), array(i32, 2),
            ),
            binning.count_entries: (array(f64, 3), array(i32, 2), array(i32), f64, array(i64)),
            binning.fill_entries: (
                array(f64, 3), array(i32, 2), array(i32), f64, i64, array(i64), array(i32), array(i64), array(i64),
                array(i32), array(i64),
            ),
            cpu_kernels.traverse: (
                array(i64), array(i32), array(i64), array(i32), array(i64), array(real), array(i32, 2), array(i32),
                array(real), array(real), array(real), array(i64), array(real, 3), array(real, 2), array(real),
                array(real), i64, array(real), array(i32), array(i64),
            ),
            cpu_kernels.collect: (
                array(i64), i64, i64, i64, array(i32), array(i64), array(i32), array(i64), array(i64), array(i64),
                array(real), array(i32, 2), array(real), array(real), array(real), array(i64), array(real),
                array(real), i64, types.boolean, array(real), array(real), array(f64, 3), array(f64),
            ),
        },
    )  # fmt: skip
