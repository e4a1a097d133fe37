"""A separable symmetric window over pictures, differentiable: what D-SSIM weighs its moments by."""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from nbavatar.jit.workers import run_workers

__all__ = ["blur"]


def blur(planes: Tensor, taps: Tensor) -> Tensor:
    """The window laid over every pixel of every plane; beyond the planes lie zeros.

    On a CPU by a compiled kernel, since torch's convolutions of single planes are slow there; they serve other devices.
    The gradient is the window again, for it is symmetric.

    Args:
        planes: float32 or float64 [N, H, W].
        taps: of the same type [K], K odd, symmetric: the window is their product with themselves.

    Returns:
        [N, H, W]; on a CPU the same bits for any number of threads.
    """
    result: Tensor = _Blur.apply(planes, taps)
    return result


class _Blur(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, planes: Tensor, taps: Tensor) -> Tensor:
        ctx.save_for_backward(taps)
        return _blurred(planes, taps)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        (taps,) = ctx.saved_tensors
        return _blurred(gradients[0], taps), None


def _blurred(planes: Tensor, taps: Tensor) -> Tensor:
    half = len(taps) // 2
    if planes.device.type != "cpu":
        # One group a plane: torch has a fast kernel for that, and none for one channel in a batch.
        count, windows = len(planes), taps.expand(len(planes), 1, -1)
        rows = F.conv2d(planes[None], windows[..., None], padding=(half, 0), groups=count)
        return F.conv2d(rows, windows[:, :, None], padding=(0, half), groups=count)[0]
    from nbavatar.math.blur_kernels import blur_rows, prepare_kernels  # Numba is loaded only when it is needed

    prepare_kernels(planes.dtype)
    padded, window = F.pad(planes, (half, half, half, half)).contiguous().numpy(), taps.contiguous().numpy()
    result = np.zeros(tuple(planes.shape), padded.dtype)
    height, threads = planes.shape[1], torch.get_num_threads()
    run_workers(
        lambda worker: blur_rows(padded, window, height * worker // threads, height * (worker + 1) // threads, result)
    )
    return torch.from_numpy(result)
