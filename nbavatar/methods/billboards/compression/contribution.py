"""How much each billboard adds to pictures.

A billboard's contribution to a picture is sum over pixels of T_k a_k, what it adds to the alpha image [px]. It is the
gradient of the summed picture by a feature that is the same all over the billboard, so one backward pass of the
rasterizer gives it for all.
"""

from collections.abc import Iterable

import torch
from torch import Tensor

from nbavatar.methods.billboards.billboards import Posed
from nbavatar.rendering.billboards.functional import render_billboards

__all__ = ["contributions", "most_contributing"]


def contributions(
    posed: Posed, alpha: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int, *, order: str = "ray"
) -> Tensor:
    """What every billboard adds to the alpha image of one view [px], float (F,), at least 0.

    Args:
        posed: F billboards in world space.
        alpha: opacity textures (F, T, T) in [0, 1].
        viewmat: world to camera (4, 4); K: intrinsics (3, 3) [px]; width, height: picture [px].
        order: compositing order.
    """
    ones = torch.ones(len(alpha), 1, dtype=alpha.dtype, device=alpha.device, requires_grad=True)
    tensors = [tensor.detach() for tensor in (*posed.planes, alpha, viewmat, K)]
    means, quats, half_extents, alpha, viewmat, K = tensors
    with torch.enable_grad():
        image, _ = render_billboards(
            means, quats, half_extents, None, alpha, viewmat, K, width, height, order=order, uniform=ones
        )
        (gradient,) = torch.autograd.grad(image.sum(), ones)
    return gradient[:, 0]


def most_contributing(views: Iterable[Tensor], share: float) -> Tensor:
    """Indices, ascending, of the share of the billboards with the largest contribution in any view.

    Args:
        views: contributions (F,) of each view.
        share: of all billboards, in (0, 1]; at least one is kept. Ties go to the lower index.
    """
    largest = torch.stack(list(views)).amax(0)
    count = max(1, round(share * len(largest)))
    order = torch.sort(largest, descending=True, stable=True).indices
    return order[:count].sort().values
