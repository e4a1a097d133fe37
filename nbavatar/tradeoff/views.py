"""The avatar posed for views of a set: what a look at all training pictures starts from."""

from collections.abc import Iterator, Mapping, Sequence

import torch
from torch import Tensor

from nbavatar.avatar.billboards import Posed
from nbavatar.avatar.model import Avatar
from nbavatar.data.views import View
from nbavatar.reporting.pictures import spread

__all__ = ["posed_views"]


def posed_views(
    avatar: Avatar, meshes: Mapping[str, Tensor], views: Sequence[View], most: int
) -> Iterator[tuple[View, Posed, Tensor]]:
    """Views with the billboards that are there, and the indices of those, int64 (F',); to be run without gradients.

    Args:
        avatar: trained.
        meshes: vertices per part over all frames, float (N, V, 3) [m].
        views: to look from; `View.row` counts in the meshes.
        most: at most this many of the views, evenly spread.
    """
    device = avatar.faces.device
    for view in spread(views, most):
        verts = {part: meshes[part][view.row].to(device) for part in avatar.parts}
        posed, keep = avatar.pose(verts, view.frame)
        yield view, posed, torch.arange(len(avatar.faces), device=device) if keep is None else keep
