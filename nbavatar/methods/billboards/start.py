"""Billboards and U-Net of another avatar in place of the initial ones, part by part."""
# pyright: reportArgumentType=false
# Lists of names are read as lists of those they begin with.

from collections.abc import Sequence

import torch

from nbavatar.methods.base import Taken
from nbavatar.methods.billboards.architecture import Architecture
from nbavatar.methods.billboards.avatar import Avatar

__all__ = ["take_over"]

_UNET = (
    "channels",
    "normals",
    "shading",
    "gloss",
    "unet_width",
    "unet_depth",
    "unet_max_width",
    "unet_convs",
    "unet_form",
)
_PLACES = ("mu", "quat", "log_scale")


@torch.no_grad()
def take_over(avatar: Avatar, other: Avatar, parts: Sequence[str]) -> Taken:
    """Give an avatar in its initial state the values of another one (`Method.take_over`): copies, bit for bit.

    Places, turns and sizes count in the frames of the faces, so they mean the same on another person's. Textures are
    taken over where they have as many texels, and channels of the same kind; the U-Net where every layer has the same
    size. What was learnt about single frames (`Refinement`) stays behind.

    Args:
        avatar: changed in place.
        other: of the same method; textures of sizes of their own count at the size that they are drawn at.
        parts: those whose faces are the same in both.
    """
    ours, theirs = avatar.architecture, other.architecture
    over, left, names = list(parts), [], list(_PLACES)
    if different := _different(ours, theirs, "texels"):
        left.append(f"textures ({different})")
    else:
        names.append("alpha_logit")
        if different := _different(ours, theirs, "deferred", "channels"):
            left.append(f"features ({different})")
        else:
            names.append("features")
    own, its = avatar.face_ranges(), other.face_ranges()
    for name in names:
        values, source = getattr(avatar.billboards, name), getattr(other.billboards, name)
        for part in parts:
            values[own[part]] = source[its[part]]
    if avatar.unet is not None and other.unet is not None:
        if different := _different(ours, theirs, *_UNET):
            left.append(f"U-Net ({different})")
        else:
            avatar.unet.load_state_dict(other.unet.state_dict())
            over.append("U-Net")
    if other.refinement is not None:
        left.append("refinement (of other frames)")
    return Taken(over, left)


def _different(ours: Architecture, theirs: Architecture, *names: str) -> str:
    """Which of these numbers differ, in words; empty for none."""
    pairs = {name: (getattr(theirs, name), getattr(ours, name)) for name in names}
    return ", ".join(f"{name} {its}, here {own}" for name, (its, own) in pairs.items() if its != own)
