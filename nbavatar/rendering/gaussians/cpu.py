"""CPU backend: Numba kernels behind a torch autograd function.

Deterministic: the same inputs give the same bytes, forward and backward, whatever the number of
threads.
"""

from dataclasses import fields
from functools import cache

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

__all__ = ["blend_cpu", "count_samples"]

_SCRATCH = 1 << 26  # bytes of notes a worker may use; fewer rows are worked on at once beyond it


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
        limits = [0, 1, max(s.alpha_min, FAINTEST), s.alpha_max, s.t_min]
        self.limits = torch.tensor(limits, dtype=self.dtype).numpy()

    def forward(self) -> tuple[Tensor, Tensor]:
        s = self.settings
        image = torch.empty(3, s.height, s.width, dtype=self.dtype)
        alpha = torch.empty(s.height, s.width, dtype=self.dtype)
        nothing = np.zeros((0, 0, 0), self.limits.dtype)
        self._traverse(image.numpy(), alpha.numpy(), nothing, nothing.reshape(-1), replay=False)
        return image, alpha

    def backward(self, grad_image: Tensor, grad_alpha: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Gradients by form, opacities and colours."""
        b = self.bins
        parts, _ = self.replay(torch.cat([grad_image, grad_alpha[None]]).to(self.dtype))
        grad_form = torch.empty(self.form.shape, dtype=torch.float64)
        grad_opacities = torch.empty(self.opacities.shape, dtype=self.dtype)
        grad_colours = torch.empty(self.colours.shape, dtype=self.dtype)
        cpu_kernels.gather_parts(
            b.sequence, b.first, b.where, parts.reshape(-1, cpu_kernels.PARTS), self.form, self.opacities,
            grad_form.numpy(), grad_opacities.numpy(), grad_colours.numpy(),
        )  # fmt: skip
        return grad_form, grad_opacities, grad_colours

    def replay(self, grads: Tensor) -> tuple[np.ndarray, int]:
        """Repeats the blending; what each tile adds to the gradients of its Gaussians, and the number of hits."""
        entries = len(self.bins.members)
        size = entries * cpu_kernels.PARTS
        binning.require_memory(size * self.limits.itemsize, f"the gradients of {entries} entries in tiles")
        parts = torch.empty(size, dtype=self.dtype).numpy()
        empty = np.zeros((0, 0, 0), self.limits.dtype)
        hits = self._traverse(empty, empty.reshape(0, 0), grads.contiguous().numpy(), parts, replay=True)
        return parts, hits

    def _traverse(
        self, image: np.ndarray, alpha: np.ndarray, grads: np.ndarray, parts: np.ndarray, *, replay: bool
    ) -> int:
        s, b = self.settings, self.bins
        across = -(-s.width // binning.TILE_WIDTH)
        lengths = np.diff(b.start)
        tiles = np.argsort(-lengths, kind="stable").astype(np.int32)  # the longest first: no worker ends late
        rows, chunks = binning.TILE_HEIGHT, 0
        if replay:
            longest = int(lengths.max(initial=0))
            row = longest * cpu_kernels.CHUNKS * (2 * LANES * self.limits.itemsize + 8)
            rows = int(np.clip(_SCRATCH // max(1, row), 1, binning.TILE_HEIGHT))
            chunks = longest * cpu_kernels.CHUNKS * rows
        reals = 6 * (binning.TILE_WIDTH * rows + LANES) + 2 * LANES * chunks
        binning.require_memory(
            torch.get_num_threads() * (reals * self.limits.itemsize + 8 * chunks), f"notes of {chunks} rows of hits"
        )
        shape = np.array([s.width, s.height, across, rows, int(replay)], np.int64)
        turn = np.zeros(1, np.int64)

        def work(_: int) -> int:
            status = np.zeros(1, np.int64)
            cpu_kernels.traverse(
                turn, tiles, b.start, b.members, b.record.reshape(-1), b.box, self.colours.reshape(-1), self.limits,
                shape, image, alpha, grads, parts, torch.empty(reals, dtype=self.dtype).numpy(),
                torch.empty(2 * chunks, dtype=torch.int32).numpy(), status,
            )  # fmt: skip
            return int(status[0])

        return sum(run_workers(work))


@cache
def _prepare(dtype: torch.dtype) -> None:
    """Has every kernel compiled for a dtype."""
    real = types.float32 if dtype == torch.float32 else types.float64

    def array(kind, dimensions: int = 1):
        return types.Array(kind, dimensions, "C")

    i32, i64, f64 = types.int32, types.int64, types.float64
    prepare(
        f"gaussians-{real}",
        {
            cpu_kernels.traverse: (
                array(i64), array(i32), array(i64), array(i32), array(f64), array(i32, 2), array(real), array(real),
                array(i64), array(real, 3), array(real, 2), array(real, 3), array(real), array(real), array(i32),
                array(i64),
            ),
            cpu_kernels.gather_parts: (
                array(i32), array(i64), array(i64), array(real, 2), array(f64, 2), array(real), array(f64, 2),
                array(real), array(real, 2),
            ),
        },
    )  # fmt: skip
