"""CUDA backend: a Numba-CUDA kernel on the lists and the launcher of the billboards' backend.

What the billboards' backend says of streams, of waits and of the order of sums holds here too. Records are in the
dtype of the colours: in float32, u of a long thin Gaussian is off by up to 6e-8 of its reach in pixels over its width.
"""

import torch
from torch import Tensor

from nbavatar.rendering.billboards import cuda as raster_cuda
from nbavatar.rendering.billboards.cuda_arguments import Images, Shape, Tape
from nbavatar.rendering.billboards.cuda_kernels import CENTER
from nbavatar.rendering.billboards.reference import BlendSettings
from nbavatar.rendering.gaussians import cuda_kernels
from nbavatar.rendering.gaussians.autograd import blend_scene
from nbavatar.rendering.gaussians.patches import patches_of
from nbavatar.rendering.gaussians.projection import FAINTEST, Projection, support_box
from nbavatar.rendering.gaussians.reference import SplatSettings

__all__ = ["blend_cuda"]


def blend_cuda(
    projection: Projection, rank: Tensor, opacities: Tensor, colours: Tensor, settings: SplatSettings
) -> tuple[Tensor, Tensor]:
    """Blends projected Gaussians front to back; arguments and results as `blend_reference`.

    Works in the dtype of `opacities` and `colours`, float32 or float64, and returns it.

    Raises:
        DeviceError: the memory needed is not there.
        DependencyError: the package numba-cuda, or a CUDA driver, is missing.
    """
    return blend_scene(_Scene, projection, rank, opacities, colours, settings)


class _Scene(raster_cuda._Scene):
    """One camera's Gaussians, binned as flat patches."""

    def __init__(
        self, projection: Projection, rank: Tensor, opacities: Tensor, colours: Tensor, settings: SplatSettings
    ) -> None:
        s = settings
        reach, box = support_box(projection, opacities.detach(), s.alpha_min)
        patches = patches_of(projection.form.detach(), opacities.detach(), reach, box)
        flat = BlendSettings(s.width, s.height, 0, 1.0, s.alpha_min, s.alpha_max, s.t_min, 1.0)
        texture = opacities.detach().reshape(-1, 1, 1)
        super().__init__(patches, rank, texture.new_zeros(len(texture), 1, 1, 0), texture, flat)
        assert self.mode == CENTER or self.count == 0
        self.form, self.opacities, self.colours = projection.form.detach(), opacities.detach(), colours.detach()
        numbers = (0, 1, -0.5, max(s.alpha_min, FAINTEST), s.alpha_max, s.t_min)
        self.numbers = cuda_kernels.Constants(*(self.real(number) for number in numbers))

    def _blend(self, replay: bool, first: int, tiles: int, images: Images, tape: Tape, sums: Tensor) -> None:
        s = self.settings
        kernel = cuda_kernels.traverse(self.real, replay)
        shape = Shape(1, s.width, s.height, self.across, s.queue)
        flat = Images(*(tensor.reshape(-1) for tensor in images))
        with self._launcher() as launch:
            launch(kernel, tiles, cuda_kernels.THREADS, first, self.bins, self.colours.reshape(-1), self.numbers,
                   shape, flat, tape, sums, self.status)  # fmt: skip

    def forward(self) -> tuple[Tensor, Tensor]:
        s = self.settings
        image, alpha = self._zeros(3, s.height, s.width), self._zeros(s.height, s.width)
        self.hits = self._zeros(s.height * s.width, dtype=torch.int32)
        if self.count:
            i32, sums = self._zeros(1, dtype=torch.int32), self._zeros(1, dtype=torch.float64)
            tape = Tape(self._zeros(1, dtype=torch.int64), 0, self._zeros(1), i32)
            self._blend(False, 0, self.across * self.down, Images(image, alpha, self.hits), tape, sums)
        return image, alpha

    def backward(self, grad_image: Tensor, grad_alpha: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Gradients by form, opacities and colours."""
        sums = self._zeros(self.count * cuda_kernels.SUMS, dtype=torch.float64)
        if self.count:
            ends = self.hits.cumsum(0, dtype=torch.int64)
            adjoints = Images(*(grad.to(self.dtype).contiguous() for grad in (grad_image, grad_alpha)), self.hits)
            groups = self._groups(ends)
            largest = max(1, *(hits for _, _, _, hits in groups))
            self._require_memory(largest * (8 * (1 + self.double) + 4), f"{largest} hits in the backward pass")
            values, primitives = self._zeros(2 * largest), self._zeros(largest, dtype=torch.int32)
            for first, rows, base, _ in groups:
                tape = Tape(ends, base, values, primitives)
                self._blend(True, first * self.across, rows * self.across, adjoints, tape, sums)
        hu, hv, huu, huv, hvv, h, *dL_dcolour = sums.reshape(-1, cuda_kernels.SUMS).unbind(-1)
        # dL/du = -h u and dL/dv = -h v; the offsets from the mean are dy = v / k and dx = (u - s dy) / p
        p, s, k = self.form[:, 0], self.form[:, 1], self.form[:, 2]
        dL_dform = torch.stack([-(huu - s / k * huv) / p, -huv / k, -hvv / k, p * hu, s * hu + k * hv], -1)
        opacities = self.opacities.double()
        dL_dopacities = torch.where(opacities > 0, h / torch.where(opacities > 0, opacities, 1.0), 0.0)
        return dL_dform, dL_dopacities.to(self.dtype), torch.stack(dL_dcolour, -1).to(self.dtype)
