"""Gaussians as the flat patches that the billboards' tile lists are made of."""

import torch
from torch import Tensor

from nbavatar.rendering.patches import ProjectedPatches

__all__ = ["patches_of"]


def patches_of(form: Tensor, opacities: Tensor, reach: Tensor, box: Tensor) -> ProjectedPatches:
    """The patches |u|, |v| <= reach, which enclose where Gaussians are seen.

    Their "inverse depth" is `reach` everywhere, so a patch of one texel ends where its texture coordinates are 1.
    A record (`rendering.binning.pack`) then holds u (0-2), v (3-5), reach (8) and opacity (10).

    Args:
        form: (N, 5) float64, see `nbavatar.rendering.gaussians.projection.Projection`.
        opacities: (N,).
        reach, box: (N,), (N, 4) of `support_box`.
    """
    p, s, k, x, y = form.unbind(-1)
    zero, ones = torch.zeros_like(p), torch.ones_like(p)
    plane = torch.stack([p, s, -(p * x + s * y), zero, k, -k * y, zero, zero, reach], -1).reshape(-1, 3, 3)
    return ProjectedPatches(plane, opacities.double(), ones, ones, box)
