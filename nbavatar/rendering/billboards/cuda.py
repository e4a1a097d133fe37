"""CUDA backend: Numba-CUDA kernels behind a torch autograd function.

Kernels run on torch's current stream. The host waits for the device once in the forward pass (how
many entries the tiles' lists have) and once in the backward pass (how many hits it has to record);
the exact order itself needs no such wait. Forward results are the same on every run; gradients are
summed by atomic additions, whose order is not fixed, and differ from run to run by rounding.

CUDA graphs. `blend_cuda`, forward and backward, may be captured after the same scene was rendered
(and, for the backward pass, differentiated) at least once outside a capture: the sizes found there,
and a quarter more, then bound the lists, and the host does not wait. Should a replay need more, what
does not fit is left out and `overflowed` says so; ask it after replays. Not capturable is the work
before the blending: `canonical_rank` asks the device whether depths are tied, and the projection
copies a constant from the host.

A NaN in an alpha texture is a sample that is skipped: looking for it would make the host wait.
"""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nbavatar.errors import DependencyError, DeviceError, require
from nbavatar.packages import install_line
from nbavatar.rendering.billboards.cuda_arguments import Bins, Constants, Gradients, Images, Shape, Tape, Textures
from nbavatar.rendering.billboards.reference import BlendSettings
from nbavatar.rendering.patches import ProjectedPatches

cuda: Any = require("numba.cuda", "numba-cuda", "rendering on a GPU")
if not cuda.is_available():
    raise DependencyError(
        "package 'numba-cuda' finds no CUDA driver, or no compiler for it; it is needed for rendering on a GPU; "
        f"install NVIDIA's driver for CUDA 13 and run: {install_line('numba-cuda')}"
    )

from nbavatar.rendering.billboards import cuda_kernels as kernels  # noqa: E402  (needs the package that was just looked for)
from nbavatar.rendering.binning import RECORD  # noqa: E402
from nbavatar.rendering.cuda_binning import TILE, count_tiles, fill_tiles  # noqa: E402

__all__ = ["blend_cuda", "overflowed"]

_QUEUE = 16  # hits that may wait at a pixel in `ray` order; more cost further rounds
_LONGEST = 255  # longest queue of `kbuffer(n)`: it lives in a thread's local memory
_TAPE = 1 << 27  # hits on the tape at once: 2 GiB in float32

_Size = tuple[str, torch.device, int, int, int]  # what is counted, device, billboards, width, height
_SIZES: dict[_Size, int] = {}  # largest number seen outside a capture
_STATUS: dict[torch.device, Tensor] = {}


def blend_cuda(
    projection: ProjectedPatches, rank: Tensor, features: Tensor, alpha: Tensor, settings: BlendSettings
) -> tuple[Tensor, Tensor]:
    """Blends projected billboards front to back; arguments and results as `blend_reference`.

    Works in float32, or float64 where a texture is that. Half-precision textures are read as they
    are and summed in float32 (bfloat16 is widened first, which copies); results are then float32.

    Raises:
        DeviceError: the memory needed is not there; the queue of `kbuffer(n)` is too long; a capture
            began before sizes were known.
    """
    if features.dtype == torch.bfloat16 or alpha.dtype == torch.bfloat16:
        features, alpha = features.float(), alpha.float()
    return _Blend.apply(
        projection.plane, projection.fade, features.contiguous(), alpha.contiguous(), projection, rank, settings
    )


def overflowed(device: torch.device | str = "cuda") -> bool:
    """Whether a replayed CUDA graph met more entries or hits than it was captured for; waits for the device."""
    status = _STATUS.get(torch.empty(0, device=device).device)
    if status is None:
        return False
    found = bool(status.item())
    status.zero_()
    return found


def _views(argument: Any, view: Callable[[Tensor], Any]) -> Any:
    """An argument of a kernel with a view in place of each tensor, in named tuples too."""
    if isinstance(argument, tuple):
        return type(argument)(*(_views(member, view) for member in argument))
    return view(argument) if isinstance(argument, Tensor) else argument


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, plane, fade, features, alpha, projection, rank, settings):
        scene = _Scene(projection, rank, features, alpha, settings)
        image, opacity = scene.forward()
        ctx.scene = scene
        ctx.save_for_backward(features, alpha)
        return image, opacity

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *grads):
        _ = ctx.saved_tensors  # raises if a texture was changed in place since the forward pass
        grad_features, grad_alpha, grad_plane, grad_fade = ctx.scene.backward(*grads)
        return grad_plane, grad_fade, grad_features, grad_alpha, None, None, None


class _Scene:
    """One camera's billboards, binned, and the arrays that the kernels share."""

    def __init__(
        self, projection: ProjectedPatches, rank: Tensor, features: Tensor, alpha: Tensor, settings: BlendSettings
    ) -> None:
        s = self.settings = settings
        self.device = alpha.device
        self.double = torch.float64 in (features.dtype, alpha.dtype)
        self.dtype = torch.float64 if self.double else torch.float32
        self.texels, self.channels, self.count = alpha.shape[-1], features.shape[-1], len(alpha)
        self.features, self.alpha = features.detach(), alpha.detach()
        self.across, self.down = -(-s.width // TILE), -(-s.height // TILE)
        self.mode, self.capacity = self._order()
        numbers = (0, 1, self.texels, min(1, self.texels - 1), 1 / s.near, s.alpha_min, s.t_min, s.alpha_max)
        self.real: Any = np.float64 if self.double else np.float32
        self.constants = Constants(*(self.real(number) for number in numbers))
        self.status = _STATUS.get(self.device)
        if self.status is None:
            self.status = _STATUS[self.device] = self._zeros(1, dtype=torch.int32)
        if self.count:
            self._bin(projection, rank)

    def _order(self) -> tuple[int, int]:
        """Mode of the kernels and capacity of their queues."""
        queue = self.settings.queue
        if queue < 0 or queue >= self.count:
            return kernels.RAY, _QUEUE
        if queue > _LONGEST:
            raise DeviceError.of("render_billboards", "order", expected=f"kbuffer(n) with n <= {_LONGEST} on a GPU",
                                 found=f"kbuffer({queue})", fix="use order='ray', which is exact")  # fmt: skip
        return (kernels.KBUFFER if queue else kernels.CENTER), 1 << queue.bit_length()

    def _zeros(self, *shape: int, dtype: torch.dtype | None = None) -> Tensor:
        return torch.zeros(*shape, dtype=dtype or self.dtype, device=self.device)

    def _bounded(self, what: str, total: Tensor) -> int:
        """A number that the device holds; in a capture the bound known from earlier runs."""
        key = (what, self.device, self.count, self.settings.width, self.settings.height)
        if self.device.type == "cuda" and torch.cuda.is_current_stream_capturing():
            if key not in _SIZES:
                raise DeviceError.of("render_billboards", "CUDA graph", expected="a scene rendered before the capture",
                                     found=f"no number of {what} known", fix="run it once outside")  # fmt: skip
            return _SIZES[key] + _SIZES[key] // 4
        number = int(total)
        _SIZES[key] = max(number, _SIZES.get(key, 0))
        return number

    def _bin(self, projection: ProjectedPatches, rank: Tensor) -> None:
        """Writes the billboards' records and the tiles' lists; see `cuda_arguments.Bins`."""
        s, count = self.settings, self.count
        plane, fade = projection.plane.detach().contiguous(), projection.fade.detach().contiguous()
        nearest, bounds = projection.nearest.contiguous(), projection.bounds.contiguous()
        seen = (bounds[:, 0] <= bounds[:, 2]) & (projection.depth > 0)
        median = torch.where(seen, projection.depth, torch.nan).nanmedian().nan_to_num(nan=1.0)
        reference = median.reciprocal().reshape(1)
        record = self._zeros(count * RECORD)
        box = self._zeros(count, 4, dtype=torch.int32)
        counts = self._zeros(count, dtype=torch.int64)
        blocks = -(-count // 128)
        with self._launcher() as launch:
            launch(count_tiles, blocks, 128, plane, fade, nearest, bounds, reference, self.texels, s.width,
                   s.height, s.support, record, box, counts)  # fmt: skip
        ranks = self._zeros(count, dtype=torch.int32)
        ranks[rank] = torch.arange(count, dtype=torch.int32, device=self.device)
        by_nearest = self.mode == kernels.RAY
        order = rank[torch.sort(nearest[rank], stable=True).indices] if by_nearest else rank.contiguous()
        ends = counts[order].cumsum(0)
        entries = self._bounded("tile entries", ends[-1])
        self._require_memory(64 * entries, f"the tile lists of {count} billboards ({entries} entries)")
        tiles = torch.full((max(entries, 1),), self.across * self.down, dtype=torch.int32, device=self.device)
        members = self._zeros(max(entries, 1), dtype=torch.int32)
        with self._launcher() as launch:
            launch(fill_tiles, blocks, 128, plane, box, order, ends, s.support, self.across, tiles,
                   members, self.status)  # fmt: skip
        # stable: within a tile `order` stays
        tiles, places = torch.sort(tiles, stable=True)
        edges = torch.arange(self.across * self.down + 1, dtype=torch.int32, device=self.device)
        start = torch.searchsorted(tiles, edges, out_int32=True)
        self.bins = Bins(start, members[places], record, box, ranks)

    @contextlib.contextmanager
    def _launcher(self) -> Iterator[Any]:
        """Gives `launch(kernel, blocks, threads, *arguments)` on torch's current stream and device."""

        if self.device.type != "cuda":  # numba's simulator

            def simulate(kernel: Any, blocks: int, threads: int, *arguments: Any) -> None:
                kernel[blocks, threads](*(_views(a, lambda tensor: tensor.numpy()) for a in arguments))

            yield simulate
            return
        with torch.cuda.device(self.device), cuda.gpus[self.device.index]:
            stream = cuda.external_stream(torch.cuda.current_stream().cuda_stream)

            def launch(kernel: Any, blocks: int, threads: int, *arguments: Any) -> None:
                views = (_views(a, lambda tensor: cuda.as_cuda_array(tensor, sync=False)) for a in arguments)
                kernel[blocks, threads, stream](*views)

            yield launch

    def _require_memory(self, needed: int, purpose: str) -> None:
        """Refuses, before allocating, what does not fit into the device's memory."""
        if needed < 1 << 28 or self.device.type != "cuda" or torch.cuda.is_current_stream_capturing():
            return
        cached = torch.cuda.memory_reserved(self.device) - torch.cuda.memory_allocated(self.device)
        free = torch.cuda.mem_get_info(self.device)[0] + cached
        if needed > free:
            raise DeviceError.of(
                "render_billboards", "memory", expected=f"{needed / 2**30:.1f} GiB on the GPU for {purpose}",
                found=f"{free / 2**30:.1f} GiB free", fix="render fewer or smaller billboards or a smaller image",
            )  # fmt: skip

    def _traverse(
        self, replay: bool, first: int, tiles: int, images: Images, tape: Tape | None, gradients: Gradients | None
    ) -> None:
        """Runs the forward kernel or that of the replay on tiles from `first` on."""
        s = self.settings
        kernel = kernels.traverse(self.real, self.channels, self.capacity, self.mode, replay)
        textures = Textures(self._flat(self.features), self._flat(self.alpha))
        shape = Shape(self.texels, s.width, s.height, self.across, s.queue)
        images = images._replace(features=self._flat(images.features), opacity=self._flat(images.opacity))
        nothing, i32 = self._zeros(1), self._zeros(1, dtype=torch.int32)
        tape = tape or Tape(self._zeros(1, dtype=torch.int64), 0, nothing, i32)
        gradients = gradients or Gradients(nothing, nothing, self._zeros(1, dtype=torch.float64), self.status)
        with self._launcher() as launch:
            launch(kernel, tiles, kernels.THREADS, first, self.bins, textures, self.constants, shape, images, tape,
                   gradients)  # fmt: skip

    def _flat(self, tensor: Tensor) -> Tensor:
        """One dimension, and never without elements: such an array has no address."""
        return tensor.reshape(-1) if tensor.numel() else torch.zeros(1, dtype=tensor.dtype, device=self.device)

    def forward(self) -> tuple[Tensor, Tensor]:
        s = self.settings
        image, opacity = self._zeros(self.channels, s.height, s.width), self._zeros(s.height, s.width)
        self.hits = self._zeros(s.height * s.width, dtype=torch.int32)
        if self.count:
            self._traverse(False, 0, self.across * self.down, Images(image, opacity, self.hits), None, None)
        return image, opacity

    def backward(self, grad_image: Tensor, grad_opacity: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Gradients by features, alpha, plane and fade."""
        grad_features = self._zeros(*self.features.shape)
        grad_alpha = self._zeros(*self.alpha.shape)
        grad_plane = self._zeros(self.count, 3, 3, dtype=torch.float64)
        grad_fade = self._zeros(self.count, dtype=torch.float64)
        if self.count:
            ends = self.hits.cumsum(0, dtype=torch.int64)
            sums = self._zeros(self.count * kernels.SUMS, dtype=torch.float64)
            adjoints = Images(*(g.to(self.dtype).contiguous() for g in (grad_image, grad_opacity)), self.hits)
            gradients = Gradients(self._flat(grad_features), self._flat(grad_alpha), sums, self.status)
            groups = self._groups(ends)
            largest = max(1, *(hits for _, _, _, hits in groups))
            self._require_memory(largest * (12 * (1 + self.double) + 4), f"{largest} hits in the backward pass")
            values, primitives = self._zeros(3 * largest), self._zeros(largest, dtype=torch.int32)
            for first, rows, base, _ in groups:
                tape = Tape(ends, base, values, primitives)
                self._traverse(True, first * self.across, rows * self.across, adjoints, tape, gradients)
            with self._launcher() as launch:
                box = self.bins.box
                launch(kernels.finish, -(-self.count // 128), 128, sums, box, self.texels, grad_plane, grad_fade)
        return grad_features.to(self.features.dtype), grad_alpha.to(self.alpha.dtype), grad_plane, grad_fade

    def _groups(self, ends: Tensor) -> list[tuple[int, int, int, int]]:
        """Rows of tiles whose hits are recorded together: first row, rows, hits before them, hits."""
        total = self._bounded("hits", ends[-1])
        if total <= _TAPE:
            return [(0, self.down, 0, total)]
        if self.device.type == "cuda" and torch.cuda.is_current_stream_capturing():
            raise DeviceError.of("render_billboards", "CUDA graph", expected=f"at most {_TAPE} hits to record",
                                 found=f"room for {total}", fix="capture the forward pass alone")  # fmt: skip
        s = self.settings
        rows = torch.arange(1, self.down + 1, device=self.device) * TILE
        row_ends = ends[rows.clamp_max(s.height) * s.width - 1].tolist()
        groups, first, base, last = [], 0, 0, 0
        for row, end in enumerate(row_ends):
            if row > first and end - base > _TAPE:
                groups.append((first, row - first, base, last - base))
                first, base = row, last
            last = end
        groups.append((first, self.down - first, base, last - base))
        return groups
