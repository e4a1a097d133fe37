"""An avatar that begins with the values of another one: of an earlier training, of another subject.

A part is the same in both where its faces are the same, vertex by vertex: so are the parts of all subjects of one body
model. Of another mesh (scans, and any two shells) nothing would fall into place, and nothing is taken over.
"""

import torch

from nbavatar.errors import DataError
from nbavatar.methods.base import MeshAvatar, Method, Taken

__all__ = ["start_from"]


def start_from(method: Method, other: MeshAvatar, where: object) -> Taken:
    """Take over what fits, before the first step; the optimizer starts as always.

    Args:
        method: with its avatar in its initial state, which is changed.
        other: the avatar to start from, on the same device.
        where: its file, for error lines.

    Returns:
        what was taken over and what was not, the parts first.

    Raises:
        DataError: of another method, with values that are not finite, or without a part in common.
    """
    avatar = method.avatar
    if other.method != avatar.method:
        fix = "start from an avatar of the same method"
        raise DataError.of(where, "method", expected=avatar.method, found=other.method, fix=fix)
    for name, value in other.state_dict().items():
        if not torch.isfinite(value).all():
            raise DataError.of(where, name, expected="finite numbers", found="NaN or infinity")
    ours, theirs = avatar.part_faces(), other.part_faces()
    parts, left = [], []
    for part in dict.fromkeys([*ours, *theirs]):
        if part not in theirs:
            left.append(f"{part} (not there)")
        elif part not in ours:
            left.append(f"{part} (only there)")
        elif avatar.vertex_counts[part] == other.vertex_counts[part] and torch.equal(ours[part], theirs[part]):
            parts.append(part)
        else:
            left.append(f"{part} (another mesh)")
    if not parts:
        own, its = (", ".join(f"{part} ({len(faces)} faces)" for part, faces in of.items()) for of in (ours, theirs))
        raise DataError.of(
            where, "parts", expected=f"one with the faces that it has here: {own}", found=its,
            fix="start from an avatar on meshes of the same topology",
        )  # fmt: skip
    taken = method.take_over(other, parts)
    return Taken(taken.over, [*left, *taken.left])
