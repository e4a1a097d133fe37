"""Avatars after InteractAvatar on the toy scene, with networks that say something."""

from dataclasses import replace

import torch
from torch import Tensor

from nbavatar.config.training import TrainConfig
from nbavatar.data.sequences import MeshSequence, Part
from nbavatar.data.views import View
from nbavatar.methods.base import Method
from nbavatar.methods.create import create_method
from nbavatar.methods.interact_avatar.options import InteractAvatarConfig
from tests.scenes.toy import camera, sequence

CONFIG = TrainConfig(
    method="interact_avatar",
    interact_avatar=InteractAvatarConfig(hand_components=3, head_components=2, width=8, features=4, points=4),
)


def views(rows: int = 4) -> list[View]:
    """A view of each of the first frames."""
    viewmat = torch.from_numpy(camera(1)).float()
    return [View(0, "cam1", f"f{row}", row, 32, 32, torch.eye(3), viewmat) for row in range(rows)]


def made(meshes: MeshSequence, method: str = "interact_avatar") -> Method:
    """A method on meshes, in its initial state."""
    return create_method(meshes, {}, views(len(meshes.frames)), replace(CONFIG, method=method))


def stirred(method: Method, *, networks: bool = True, seed: int = 0) -> Method:
    """The method with its Gaussians, and its networks if asked, moved away from the start."""
    random, avatar = torch.Generator().manual_seed(seed), method.avatar
    with torch.no_grad():
        for name in avatar.PARAMETERS:
            values = getattr(avatar, name)
            values.add_(0.2 * torch.randn(values.shape, generator=random))
        avatar.degree.fill_(avatar.sh_degree)
        for weights in avatar.networks() if networks else []:
            weights.add_(0.2 * torch.randn(weights.shape, generator=random))
    return method


def verts_of(meshes: MeshSequence, row: int) -> dict[str, Tensor]:
    """Vertices of one frame by part."""
    return {name: torch.from_numpy(part.verts[row].copy()) for name, part in meshes.parts.items()}


def only(*names: str) -> MeshSequence:
    """The toy with some of its parts."""
    whole = two_hands()
    return MeshSequence(whole.frames, {name: whole.parts[name] for name in names}, {})


def two_hands() -> MeshSequence:
    """The toy with a left hand on the other side, whose fingers spread from frame to frame."""
    whole = sequence()
    right = whole.parts["right_hand"]
    flip = torch.tensor([-1.0, 1.0, 1.0]).numpy()
    posed = right.verts * flip
    for row in range(len(posed)):
        posed[row, 0] += 0.01 * row
    return MeshSequence(
        whole.frames, {**whole.parts, "left_hand": Part(right.faces[:, ::-1].copy(), right.rest * flip, posed)}, {}
    )
