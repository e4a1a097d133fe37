"""The methods that avatars can be made by. Nothing else in the package lists them.

Standard library only: the Snakefile imports this on every call. A further method is a folder beside this file and an
entry here; its avatar derives from `MeshAvatar`, its training from `Method` (`nbavatar.methods.base`).
"""
# provenance: neutral, because another method changes nothing about those that are there. `nbavatar.provenance` follows
# the entries of the methods that a job can reach.

import importlib
from typing import Any, NamedTuple

__all__ = ["METHODS", "MethodEntry", "avatar_class", "options_class", "training_class"]


class MethodEntry(NamedTuple):
    """Where a method lives and what it is called.

    Attributes:
        avatar: class derived from `MeshAvatar`, `module:class`.
        training: class derived from `Method`, likewise.
        options: frozen dataclass of its options (`nbavatar.config.core`), likewise; standard library only.
        title: its name in texts.
        primitives: what its avatar is made of, in the plural.
    """

    avatar: str
    training: str
    options: str
    title: str
    primitives: str


METHODS: dict[str, MethodEntry] = {
    "billboards": MethodEntry(
        avatar="nbavatar.methods.billboards.avatar:Avatar",
        training="nbavatar.methods.billboards.training:BillboardTraining",
        options="nbavatar.methods.billboards.options:BillboardsConfig",
        title="NBAvatar, the paper's method",
        primitives="billboards",
    ),
    "gaussian_avatars": MethodEntry(
        avatar="nbavatar.methods.gaussian_avatars.avatar:GaussianAvatars",
        training="nbavatar.methods.gaussian_avatars.training:GaussianAvatarsTraining",
        options="nbavatar.methods.gaussian_avatars.options:GaussianAvatarsConfig",
        title="GaussianAvatars",
        primitives="Gaussians",
    ),
    "interact_avatar": MethodEntry(
        avatar="nbavatar.methods.interact_avatar.avatar:InteractAvatar",
        training="nbavatar.methods.interact_avatar.training:InteractAvatarTraining",
        options="nbavatar.methods.interact_avatar.options:InteractAvatarConfig",
        title="after InteractAvatar",
        primitives="Gaussians",
    ),
    "splatting_avatar": MethodEntry(
        avatar="nbavatar.methods.splatting_avatar.avatar:SplattingAvatar",
        training="nbavatar.methods.splatting_avatar.training:SplattingAvatarTraining",
        options="nbavatar.methods.splatting_avatar.options:SplattingAvatarConfig",
        title="SplattingAvatar",
        primitives="Gaussians",
    ),
}


def avatar_class(method: str) -> Any:
    """Class of a method's avatars."""
    return _resolve(METHODS[method].avatar)


def training_class(method: str) -> Any:
    """Class of a method's training."""
    return _resolve(METHODS[method].training)


def options_class(method: str) -> Any:
    """Class of a method's options."""
    return _resolve(METHODS[method].options)


def _resolve(place: str) -> Any:
    module, _, name = place.partition(":")
    return getattr(importlib.import_module(module), name)
