"""The methods that avatars can be made by. Nothing else in the package lists them.

Standard library only: the Snakefile imports this on every call. A further method is a folder beside this file and an
entry here; its avatar derives from `MeshAvatar`, its training from `Method` (`nbavatar.methods.base`).
"""
# provenance: neutral, because another method changes nothing about those that are there. `nbavatar.provenance` follows
# the entries of the methods that a job can reach.

import importlib
from typing import Any, NamedTuple

__all__ = ["METHODS", "MethodEntry", "resolve"]


class MethodEntry(NamedTuple):
    """Where a method lives and what it is called.

    Attributes:
        avatar, training: its classes, `module:class`.
        primitives: what its avatar is made of, in the plural.
    """

    avatar: str
    training: str
    primitives: str

    def places(self) -> tuple[str, ...]:
        """Its classes."""
        return self.avatar, self.training


METHODS: dict[str, MethodEntry] = {
    "billboards": MethodEntry(
        avatar="nbavatar.methods.billboards.avatar:Avatar",
        training="nbavatar.methods.billboards.training:BillboardTraining",
        primitives="billboards",
    ),
    "gaussian_avatars": MethodEntry(
        avatar="nbavatar.methods.gaussian_avatars.avatar:GaussianAvatars",
        training="nbavatar.methods.gaussian_avatars.training:GaussianAvatarsTraining",
        primitives="Gaussians",
    ),
    "splatting_avatar": MethodEntry(
        avatar="nbavatar.methods.splatting_avatar.avatar:SplattingAvatar",
        training="nbavatar.methods.splatting_avatar.training:SplattingAvatarTraining",
        primitives="Gaussians",
    ),
}


def resolve(place: str) -> Any:
    """The class at `module:class`."""
    module, _, name = place.partition(":")
    return getattr(importlib.import_module(module), name)
