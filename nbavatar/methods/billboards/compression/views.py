"""The avatar posed for views of a set: what a look at all training pictures starts from."""

from collections.abc import Iterator, Mapping, Sequence

from torch import Tensor

from nbavatar.data.views import View
from nbavatar.methods.billboards.avatar import Avatar
from nbavatar.methods.billboards.billboards import Posed

__all__ = ["posed_views"]


def posed_views(
    avatar: Avatar, meshes: Mapping[str, Tensor], views: Sequence[View], most: int
) -> Iterator[tuple[View, Posed, Tensor | slice]]:
    """Views with the billboards that are there, and which of the avatar's those are; to be run without gradients.

    Args:
        avatar: trained.
        meshes: vertices per part over all frames, float (N, V, 3) [m].
        views: to look from; `View.row` counts in the meshes.
        most: at most this many of the views, evenly spread, the first always.
    """
    device = avatar.faces.device
    count = min(most, len(views))
    for i in range(count):
        view = views[round(i * (len(views) - 1) / max(1, count - 1))]
        verts = {part: meshes[part][view.row].to(device) for part in avatar.parts}
        posed, keep = avatar.pose(verts, view.frame)
        yield view, posed, slice(None) if keep is None else keep
