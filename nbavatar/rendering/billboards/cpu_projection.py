"""Projection of billboards on the CPU and its gradients, each in one compiled pass.

The same function as in `projection.py`, which remains its definition: written as some three hundred torch operations
it takes, on one thread, a fifteenth of the time of a whole image, and its gradients as much again.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import torch
from numba import types
from torch import Tensor

from nbavatar.jit.compile import prepare
from nbavatar.jit.workers import run_workers
from nbavatar.rendering.billboards.cpu_projection_kernels import (
    Adjoints,
    Billboards,
    Camera,
    Projected,
    project,
    project_back,
)
from nbavatar.rendering.patches import ProjectedPatches
from nbavatar.rendering.scratch import array_of

__all__ = ["project_billboards_cpu"]


def project_billboards_cpu(
    means: Tensor,
    quats: Tensor,
    half_extents: Tensor,
    viewmat: Tensor,
    K: Tensor,
    *,
    near: float,
    low_pass: float,
    support: float,
) -> ProjectedPatches:
    """Projects billboards into one camera; arguments and result as `project_billboards`."""
    return ProjectedPatches(*_Project.apply(means, quats, half_extents, viewmat, K, near, low_pass, support))


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, quats, half_extents, viewmat, K, near, low_pass, support):
        ctx.save_for_backward(means, quats, half_extents, viewmat, K)
        ctx.options = (near, low_pass, support)
        count = len(means)
        shapes = ((3, 3), (), (), (), (4,))
        plane, fade, depth, nearest, bounds = (torch.empty(count, *shape, dtype=torch.float64) for shape in shapes)
        inputs = _arguments(means, quats, half_extents, viewmat, K, ctx.options)
        projected = Projected(*(tensor.numpy() for tensor in (plane, fade, depth, nearest, bounds)))
        _share(count, lambda first, end: project(first, end, *inputs, projected))
        ctx.mark_non_differentiable(depth, nearest, bounds)
        return plane, fade, depth, nearest, bounds

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_plane, grad_fade, *_):
        saved = ctx.saved_tensors
        inputs = _arguments(*saved, ctx.options)
        adjoints = Adjoints(*(grad.double().contiguous().numpy() for grad in (grad_plane, grad_fade)))
        results = [torch.empty(tensor.shape, dtype=torch.float64) for tensor in saved[:3]]
        gradients = Billboards(*(tensor.numpy() for tensor in results))
        _share(len(saved[0]), lambda first, end: project_back(first, end, *inputs, adjoints, gradients))
        return *(result.to(tensor.dtype) for result, tensor in zip(results, saved, strict=False)), *[None] * 5


def _arguments(
    means: Tensor, quats: Tensor, half_extents: Tensor, viewmat: Tensor, K: Tensor, options: tuple[float, float, float]
) -> tuple[Billboards, Camera]:
    """What both kernels take."""
    _prepare()
    wide = [tensor.detach().double().contiguous().numpy() for tensor in (means, quats, half_extents, viewmat)]
    intrinsics = K.detach().double().numpy()[[0, 0, 0, 1, 1], [0, 1, 2, 1, 2]]
    return Billboards(*wide[:3]), Camera(wide[3], intrinsics, *(float(option) for option in options))


def _share(count: int, work: Callable[[int, int], Any]) -> None:
    """Divides the billboards among the workers."""
    share = -(-count // torch.get_num_threads())
    run_workers(lambda worker: work(min(worker * share, count), min((worker + 1) * share, count)))


@cache
def _prepare() -> None:
    def group(kind: type, *dimensions: int) -> Any:
        """A named tuple's type; a member of no dimension is a number."""
        arrays = [array_of(types.float64, count) if count else types.float64 for count in dimensions]
        return types.BaseTuple.from_types(arrays, kind)

    billboards, camera = group(Billboards, 2, 2, 2), group(Camera, 2, 1, 0, 0, 0)
    prepare(
        "billboards-projection",
        {
            project: (types.int64, types.int64, billboards, camera, group(Projected, 3, 1, 1, 1, 2)),
            project_back: (types.int64, types.int64, billboards, camera, group(Adjoints, 3, 1), billboards),
        },
    )
