"""Gaussians of another avatar in place of the initial ones, part by part, each on the triangle that it had there."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from nbavatar.methods.base import Taken
from nbavatar.methods.gaussians.avatar import GaussianAvatar

__all__ = ["take_over"]


@torch.no_grad()
def take_over(avatar: GaussianAvatar, other: GaussianAvatar, parts: Sequence[str]) -> Taken:
    """Give an avatar in its initial state the Gaussians of another one (`Method.take_over`).

    Their number becomes what the other has on these parts, and what there was on the rest. Values are copies, but for
    those that count from the rest pose (`GaussianAvatar.adapted`). Harmonics are taken over up to this avatar's degree,
    and are in use from the first step as far as they were there.

    Args:
        avatar: changed in place.
        other: of the same method.
        parts: those whose faces are the same in both. One on which the other has no Gaussian left keeps its initial
            ones: nothing would ever grow there again.
    """
    own, its = avatar.face_ranges(), other.face_ranges()
    over: list[str] = []
    left: list[str] = []
    blocks: dict[str, list[Tensor]] = {name: [] for name in (*avatar.PARAMETERS, *avatar.BUFFERS)}
    for part in avatar.parts:
        rows = _riding(other, its[part]) if part in parts else None
        if rows is None or len(rows) == 0:
            if rows is not None:
                left.append(f"{part} (no Gaussian there)")
            rows = _riding(avatar, own[part])
            for name, block in blocks.items():
                block.append(getattr(avatar, name)[rows])
            continue
        over.append(part)
        faces = getattr(other, other.FACE)[rows] - its[part].start + own[part].start
        values = {avatar.FACE: faces, **avatar.adapted(other, rows, faces)}
        for name, block in blocks.items():
            value = values[name] if name in values else getattr(other, name)[rows]
            block.append(_harmonics(value, avatar.colour_rest.shape[1]) if name == "colour_rest" else value)
    for name, block in blocks.items():
        old = getattr(avatar, name)
        rows_of_all = torch.cat([value.to(old.dtype) for value in block])
        setattr(avatar, name, nn.Parameter(rows_of_all) if name in avatar.PARAMETERS else rows_of_all)
    avatar.degree.clamp_(min=min(int(other.degree), avatar.sh_degree))
    if other.sh_degree > avatar.sh_degree:
        left.append(f"harmonics above degree {avatar.sh_degree}")
    return Taken(over, left)


def _riding(avatar: GaussianAvatar, faces: slice) -> Tensor:
    """Gaussians on a range of faces, ascending, int64 (M,)."""
    riding = getattr(avatar, avatar.FACE)
    return ((riding >= faces.start) & (riding < faces.stop)).nonzero().squeeze(1)


def _harmonics(rest: Tensor, count: int) -> Tensor:
    """The first `count` of harmonics (N, K, 3), with zeros where there are fewer: they are ordered by degree."""
    kept = rest[:, :count]
    return torch.cat((kept, kept.new_zeros(len(kept), count - kept.shape[1], 3)), dim=1)
