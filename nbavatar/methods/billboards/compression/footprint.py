"""How large each billboard ever is on screen, and the texels that it needs there."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from nbavatar.data.views import View
from nbavatar.methods.billboards.avatar import Avatar
from nbavatar.methods.billboards.billboards import Posed
from nbavatar.methods.billboards.compression.views import posed_views

__all__ = ["footprints", "largest_footprints", "texels_of"]

_NEAR = 0.01  # billboards that are closer, or behind, are not drawn [m]


def footprints(posed: Posed, viewmat: Tensor, K: Tensor) -> Tensor:
    """From the first texel centre to the last, along the longer side, seen head on [px], float (F,); 0 behind.

    Args:
        posed: F billboards in world space.
        viewmat: world to camera (4, 4); K: intrinsics (3, 3) [px].
    """
    depth = posed.means @ viewmat[2, :3] + viewmat[2, 3]
    size = 2.0 * posed.half_extents.amax(1) / depth.clamp_min(_NEAR) * torch.maximum(K[0, 0], K[1, 1])
    return torch.where(depth > _NEAR, size, size.new_zeros(()))


def largest_footprints(
    avatar: Avatar, meshes: Mapping[str, Tensor], views: Sequence[View], *, most_views: int
) -> Tensor:
    """The largest footprint of every billboard over some views [px], float (F,).

    Args:
        avatar: trained.
        meshes: vertices per part over all frames, float (N, V, 3) [m].
        views: to look from; `View.row` counts in the meshes.
        most_views: at most this many of the views, evenly spread.
    """
    device = avatar.faces.device
    largest = torch.zeros(len(avatar.faces), device=device)
    with torch.no_grad():
        for view, posed, rows in posed_views(avatar, meshes, views, most_views):
            found = footprints(posed, view.viewmat.to(device), view.K.to(device))
            largest[rows] = torch.maximum(largest[rows], found)
    return largest


def texels_of(footprint: Tensor, density: float) -> Tensor:
    """Texels a side, int64 (F,), that give a footprint (F,) [px] so many texels a pixel."""
    return torch.ceil(density * footprint).clamp(0, 1 << 20).to(torch.int64) + 1
