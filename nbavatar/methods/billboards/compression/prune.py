"""Pruning for good: billboards that no view of a set shows are left out of the avatar, file and memory.

What counts is the blended weight, so billboards inside the head, behind others, or fainter than the rasterizer draws
go; their removal changes these views by rounding only. (The window that is decoded may become smaller by whole tiles.)
A margin makes views safer that nobody looked from: each camera is also turned about the avatar, up, down, left and
right.
"""

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from nbavatar.data.views import View
from nbavatar.errors import DataError
from nbavatar.methods.billboards.avatar import Avatar
from nbavatar.methods.billboards.compression.contribution import contributions
from nbavatar.methods.billboards.compression.reduce import keep_billboards
from nbavatar.methods.billboards.compression.views import posed_views

__all__ = ["prune", "seen_billboards", "turned_cameras"]


def prune(
    avatar: Avatar, meshes: Mapping[str, Tensor], views: Sequence[View], *, margin: float, most_views: int
) -> Avatar:
    """The avatar without the billboards that `seen_billboards` finds nowhere; arguments as there.

    Raises:
        DataError: no view shows anything.
    """
    seen = seen_billboards(avatar, meshes, views, margin=margin, most_views=most_views)
    if not bool(seen.any()):
        raise DataError.of("pruning", "views", expected="a view that shows the avatar", found="none")
    return keep_billboards(avatar, seen.nonzero().squeeze(1))


def seen_billboards(
    avatar: Avatar, meshes: Mapping[str, Tensor], views: Sequence[View], *, margin: float, most_views: int
) -> Tensor:
    """Which billboards add to any picture, bool (F,).

    Args:
        avatar: trained.
        meshes: vertices per part over all frames, float (N, V, 3) [m].
        views: to look from; `View.row` counts in the meshes.
        margin: each camera is also turned by this about the avatar [degrees]; 0 leaves it at the views.
        most_views: at most this many of the views, evenly spread.
    """
    device = avatar.faces.device
    seen = torch.zeros(len(avatar.faces), dtype=torch.bool, device=device)
    with torch.no_grad():
        _, alpha = avatar.textures()
        for view, posed, rows in posed_views(avatar, meshes, views, most_views):
            if len(posed.means) == 0:
                continue
            drawn = alpha[rows]
            centre = posed.means.mean(0).cpu()
            for viewmat in turned_cameras(view.viewmat, centre, margin):
                added = contributions(
                    posed, drawn, viewmat.to(device), view.K.to(device), view.width, view.height,
                    order=avatar.architecture.order,
                )  # fmt: skip
                seen[rows] |= added > 0
    return seen


def turned_cameras(viewmat: Tensor, centre: Tensor, margin: float) -> list[Tensor]:
    """A camera, and the same one turned about a point by an angle in four directions.

    Args:
        viewmat: world to camera (4, 4).
        centre: the point, which keeps its place in all pictures (3,) [m].
        margin: the angle [degrees]; 0 gives the camera alone.
    """
    cameras = [viewmat]
    if margin > 0:
        pivot = viewmat[:3, :3] @ centre + viewmat[:3, 3]
        for axis in (0, 1):
            for angle in (-math.radians(margin), math.radians(margin)):
                turn = torch.eye(4, dtype=viewmat.dtype)
                first, second = ((1, 2), (2, 0))[axis]
                turn[first, first] = turn[second, second] = math.cos(angle)
                turn[second, first] = math.sin(angle)
                turn[first, second] = -math.sin(angle)
                turn[:3, 3] = pivot - turn[:3, :3] @ pivot
                cameras.append(turn @ viewmat)
    return cameras
