"""CPU backend: Numba kernels behind a torch autograd function.

Deterministic: the same inputs give the same bytes, forward and backward, whatever the number of
threads.
"""

from dataclasses import fields
from functools import cache
from typing import Any

import numpy as np
import torch
from numba import types
from torch import Tensor

from nbavatar.jit.compile import prepare
from nbavatar.jit.lanes import LANES
from nbavatar.jit.workers import run_workers
from nbavatar.rendering import binning
from nbavatar.rendering.gaussians import cpu_kernels
from nbavatar.rendering.gaussians.autograd import blend_scene
from nbavatar.rendering.gaussians.patches import patches_of
from nbavatar.rendering.gaussians.projection import FAINTEST, Projection, support_box
from nbavatar.rendering.gaussians.reference import SplatSettings
from nbavatar.rendering.scratch import array_of, scratch_bytes, scratch_type, scratch_views

__all__ = ["blend_cpu", "count_samples"]

_TAPE = 1 << 26  # bytes that the tape of a worker may use; fewer rows are worked on at once beyond it


def blend_cpu(
    projection: Projection, rank: Tensor, opacities: Tensor, colours: Tensor, settings: SplatSettings
) -> tuple[Tensor, Tensor]:
    """Blends projected Gaussians front to back; arguments and results as `blend_reference`.

    Works in the dtype of `opacities` and `colours`, float32 or float64, and returns it. Tensors on
    another device are copied to the CPU, and the results back.

    Raises:
        DeviceError: the memory needed is not there.
    """
    device = opacities.device
    if device.type != "cpu":
        host = Projection(*(getattr(projection, field.name).cpu() for field in fields(projection)))
        image, alpha = blend_cpu(host, rank.cpu(), opacities.cpu(), colours.cpu(), settings)
        return image.to(device), alpha.to(device)
    return blend_scene(_Scene, projection, rank, opacities, colours, settings)


def count_samples(
    projection: Projection, rank: Tensor, opacities: Tensor, colours: Tensor, settings: SplatSettings
) -> int:
    """Number of hits that are blended into the image."""
    scene = _Scene(projection, rank, opacities.detach().contiguous(), colours.detach().contiguous(), settings)
    return scene.replay(torch.zeros(4, settings.height, settings.width, dtype=scene.dtype))[1]


class _Scene:
    """One camera's Gaussians, binned, and the arrays that the kernels share."""

    def __init__(
        self, projection: Projection, rank: Tensor, opacities: Tensor, colours: Tensor, settings: SplatSettings
    ) -> None:
        s = self.settings = settings
        self.dtype = colours.dtype
        _prepare(self.dtype)
        self.form = projection.form.detach().numpy()
        self.opacities, self.colours = opacities.detach().numpy(), colours.detach().numpy()
        reach, box = support_box(projection, opacities.detach(), s.alpha_min)
        patches = patches_of(projection.form.detach(), opacities.detach(), reach, box)
        self.bins = binning.bin_billboards(patches, rank, 1, s.width, s.height, 1.0, torch.float64, by_nearest=False)
        self.real = np.dtype(np.float32 if self.dtype == torch.float32 else np.float64)
        numbers = (0, 1, max(s.alpha_min, FAINTEST), s.alpha_max, s.t_min)
        self.constants = cpu_kernels.Constants(*(self.real.type(number) for number in numbers))

    def forward(self) -> tuple[Tensor, Tensor]:
        s = self.settings
        image = torch.empty(3, s.height, s.width, dtype=self.dtype)
        alpha = torch.empty(s.height, s.width, dtype=self.dtype)
        nothing = np.zeros((0, 0, 0), self.real)
        self._traverse(cpu_kernels.Images(image.numpy(), alpha.numpy()), nothing, nothing.reshape(-1))
        return image, alpha

    def backward(self, grad_image: Tensor, grad_alpha: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Gradients by form, opacities and colours."""
        parts, _ = self.replay(torch.cat([grad_image, grad_alpha[None]]).to(self.dtype))
        grad_form = torch.empty(self.form.shape, dtype=torch.float64)
        grad_opacities = torch.empty(self.opacities.shape, dtype=self.dtype)
        grad_colours = torch.empty(self.colours.shape, dtype=self.dtype)
        cpu_kernels.gather_parts(
            self.bins, parts.reshape(-1, cpu_kernels.PARTS), self.form, self.opacities, grad_form.numpy(),
            grad_opacities.numpy(), grad_colours.numpy(),
        )  # fmt: skip
        return grad_form, grad_opacities, grad_colours

    def replay(self, grads: Tensor) -> tuple[np.ndarray, int]:
        """Repeats the blending; what each tile adds to the gradients of its Gaussians, and the number of hits."""
        entries = len(self.bins.members)
        size = entries * cpu_kernels.PARTS
        binning.require_memory(size * self.real.itemsize, f"the gradients of {entries} entries in tiles")
        parts = torch.empty(size, dtype=self.dtype).numpy()
        empty = np.zeros((0, 0, 0), self.real)
        hits = self._traverse(cpu_kernels.Images(empty, np.zeros((0, 0), self.real)), grads.contiguous().numpy(), parts)
        return parts, hits

    def _traverse(self, images: cpu_kernels.Images, adjoints: np.ndarray, parts: np.ndarray) -> int:
        """Runs the kernel on all threads, the replay if there are adjoints; returns the number of hits on the tape."""
        s, b, replay = self.settings, self.bins, len(adjoints) != 0
        across = -(-s.width // binning.TILE_WIDTH)
        lengths = np.diff(b.tile_start)
        tiles = np.argsort(-lengths, kind="stable").astype(np.int32)  # the longest first: no worker ends late
        rows, longest = binning.TILE_HEIGHT, int(lengths.max(initial=0))
        if replay:
            row = longest * (binning.TILE_WIDTH // LANES) * (2 * LANES * self.real.itemsize + 8)
            rows = int(np.clip(_TAPE // max(1, row), 1, binning.TILE_HEIGHT))
        sizes = cpu_kernels.Sizes(rows, longest)
        needed = scratch_bytes(cpu_kernels.BUFFERS, sizes, self.real, replay)
        binning.require_memory(torch.get_num_threads() * needed, f"a tape of {sizes.packets} packets of hits")
        shape = cpu_kernels.Shape(s.width, s.height, across, rows)
        counter = np.zeros(1, np.int64)

        def work(_: int) -> int:
            memory = torch.empty(needed, dtype=torch.uint8).numpy()
            scratch = scratch_views(cpu_kernels.Scratch, cpu_kernels.BUFFERS, sizes, self.real, replay, memory)
            return cpu_kernels.traverse(
                counter, tiles, b, self.colours.reshape(-1), self.constants, shape, images, adjoints, parts, scratch
            )

        return sum(run_workers(work))


@cache
def _prepare(dtype: torch.dtype) -> None:
    """Has every kernel compiled for a dtype."""
    real = types.float32 if dtype == torch.float32 else types.float64

    i32, i64, f64 = types.int32, types.int64, types.float64

    def group(kind: type, *members: Any) -> Any:
        return types.BaseTuple.from_types(members, kind)

    bins, shape = binning.bins_type(f64), group(cpu_kernels.Shape, *[i64] * len(cpu_kernels.Shape._fields))
    constants = group(cpu_kernels.Constants, *[real] * len(cpu_kernels.Constants._fields))
    prepare(
        f"gaussians-{real}",
        {
            cpu_kernels.traverse: (
                array_of(i64), array_of(i32), bins, array_of(real), constants, shape,
                group(cpu_kernels.Images, array_of(real, 3), array_of(real, 2)), array_of(real, 3), array_of(real),
                scratch_type(cpu_kernels.Scratch, cpu_kernels.BUFFERS, real),
            ),
            cpu_kernels.gather_parts: (
                bins, array_of(real, 2), array_of(f64, 2), array_of(real), array_of(f64, 2), array_of(real),
                array_of(real, 2),
            ),
        },
    )  # fmt: skip
