"""Projection and harmonics of Gaussians on the CPU, one compiled pass forward and one backward.

The same functions as in `projection.py` and `spherical_harmonics.py`, which remain their definition; written
as torch operations they cost more than the blending of a small image.
"""

from functools import cache

import numpy as np
import torch
from numba import types
from torch import Tensor

from nbavatar.jit.compile import prepare
from nbavatar.rendering.gaussians import geometry_kernels
from nbavatar.rendering.gaussians.projection import Projection
from nbavatar.rendering.gaussians.spherical_harmonics import harmonic_count

__all__ = ["harmonic_colours_cpu", "project_gaussians_cpu"]


def project_gaussians_cpu(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    *,
    near: float,
    low_pass: float,
    screen_offsets: Tensor | None = None,
) -> Projection:
    """Projects Gaussians into one camera; arguments and result as `project_gaussians`, tensors on the CPU."""
    camera = np.zeros(21)
    camera[:12] = viewmat.detach().double().numpy()[:3].ravel()
    camera[12:17] = K.detach().double().numpy()[[0, 0, 0, 1, 1], [0, 1, 2, 1, 2]]
    camera[17:] = width, height, near, low_pass
    wide = [tensor.double().contiguous() for tensor in (means, quats, scales)]
    offsets = torch.zeros(len(means), 2, dtype=torch.float64) if screen_offsets is None else screen_offsets.double()
    return Projection(*_Project.apply(*wide, offsets.contiguous(), camera))


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, quats, scales, offsets, camera):
        _prepare_projection()
        count = len(means)
        form, variances = torch.empty(count, 5, dtype=torch.float64), torch.empty(count, 2, dtype=torch.float64)
        depth, radii = torch.empty(count, dtype=torch.float64), torch.empty(count, dtype=torch.float64)
        visible = torch.empty(count, dtype=torch.bool)
        inputs = [tensor.detach().numpy() for tensor in (means, quats, scales, offsets)]
        results = [tensor.numpy() for tensor in (form, variances, depth, visible, radii)]
        geometry_kernels.project(*inputs, camera, *results)
        ctx.save_for_backward(means, quats, scales, form, visible)
        ctx.camera = camera
        ctx.mark_non_differentiable(variances, depth, visible, radii)
        return form, variances, depth, visible, radii

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *grads):
        means, quats, scales, form, visible = ctx.saved_tensors
        results = [torch.empty_like(tensor) for tensor in (means, quats, scales)]
        grad_form = grads[0].contiguous()
        geometry_kernels.project_back(
            means.numpy(), quats.numpy(), scales.numpy(), form.numpy(), visible.numpy(), ctx.camera,
            grad_form.numpy(), *(tensor.numpy() for tensor in results),
        )  # fmt: skip
        return *results, grad_form[:, 3:], None


def harmonic_colours_cpu(coefficients: Tensor, offsets: Tensor, degree: int) -> Tensor:
    """Colours seen from a point; arguments and result as `harmonic_colours`, tensors on the CPU."""
    return _Harmonics.apply(coefficients.contiguous(), offsets.contiguous(), degree)


class _Harmonics(torch.autograd.Function):
    @staticmethod
    def forward(ctx, coefficients, offsets, degree):
        _prepare_harmonics(coefficients.dtype)
        colours = torch.empty(len(offsets), 3, dtype=coefficients.dtype)
        count = harmonic_count(degree)
        geometry_kernels.shade(coefficients.detach().numpy(), offsets.detach().double().numpy(), count, colours.numpy())
        ctx.save_for_backward(coefficients, offsets, colours)
        ctx.count = count
        return colours

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *grads):
        coefficients, offsets, colours = ctx.saved_tensors
        grad_coefficients, grad_offsets = torch.empty_like(coefficients), torch.empty(len(offsets), 3).double()
        geometry_kernels.shade_back(
            coefficients.numpy(), offsets.double().numpy(), ctx.count, colours.numpy(),
            grads[0].to(colours.dtype).contiguous().numpy(), grad_coefficients.numpy(), grad_offsets.numpy(),
        )  # fmt: skip
        return grad_coefficients, grad_offsets.to(offsets.dtype), None


def _array(kind, dimensions: int):
    return types.Array(kind, dimensions, "C")


@cache
def _prepare_projection() -> None:
    flat, rows, seen = _array(types.float64, 1), _array(types.float64, 2), _array(types.boolean, 1)
    prepare(
        "gaussians-projection",
        {
            geometry_kernels.project: (rows, rows, rows, rows, flat, rows, rows, flat, seen, flat),
            geometry_kernels.project_back: (rows, rows, rows, rows, seen, flat, rows, rows, rows, rows),
        },
    )


@cache
def _prepare_harmonics(dtype: torch.dtype) -> None:
    real = types.float32 if dtype == torch.float32 else types.float64
    colours, terms, rows = _array(real, 2), _array(real, 3), _array(types.float64, 2)
    prepare(
        f"gaussians-harmonics-{real}",
        {
            geometry_kernels.shade: (terms, rows, types.int64, colours),
            geometry_kernels.shade_back: (terms, rows, types.int64, colours, colours, terms, rows),
        },
    )
