"""Training of the method after InteractAvatar: GaussianAvatars' loss, and a price on what the networks add.

    L = L_GaussianAvatars + 0.01 mean(change^2)

The mean runs over the Gaussians that are there and their 14 numbers. Networks and Gaussians are trained together from
the first step.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from torch import Tensor

from nbavatar.config.training import TrainConfig
from nbavatar.data.lights import Light
from nbavatar.data.sequences import PARTS, MeshSequence
from nbavatar.data.views import View
from nbavatar.methods.base import MeshAvatar, Taken
from nbavatar.methods.gaussians.avatar import PosedGaussians
from nbavatar.methods.gaussians.bound_training import BoundTraining, first_gaussians
from nbavatar.methods.gaussians.training import camera_extent
from nbavatar.methods.interact_avatar.avatar import InteractAvatar
from nbavatar.methods.interact_avatar.options import InteractAvatarConfig
from nbavatar.methods.interact_avatar.posture import learn_posture

__all__ = ["InteractAvatarTraining"]


class InteractAvatarTraining(BoundTraining):
    """The method in training."""

    avatar: InteractAvatar
    options: InteractAvatarConfig

    @classmethod
    def create(
        cls,
        sequence: MeshSequence,
        coords: Mapping[str, np.ndarray],
        views: Sequence[View],
        config: TrainConfig,
        device: str,
        light: Light | None = None,
    ) -> "InteractAvatarTraining":
        """See `Method.create`; spectral coordinates are not used, poses are learnt from the frames of the views."""
        options: InteractAvatarConfig = config.own
        arguments, random = first_gaussians(sequence, config)
        frames = sorted({view.row for view in views})
        postures = {}
        for part in PARTS:
            if part in arguments["faces"]:
                components = options.head_components if part == PARTS[0] else options.hand_components
                mesh = sequence.parts[part]
                postures[part] = learn_posture(mesh.rest, mesh.verts[frames], components)
        avatar = InteractAvatar(
            **arguments,
            postures=postures,
            width=options.width,
            features=options.features,
            points=options.points,
            reach=options.reach,
            random=random,
        )
        return cls(avatar.to(device), config, options.extent or camera_extent(views))

    def take_over(self, other: MeshAvatar, parts: Sequence[str]) -> Taken:
        """See `Method.take_over`; networks only together with the components of poses that they were trained on."""
        assert isinstance(other, InteractAvatar)
        taken = super().take_over(other, parts)
        networks = self.avatar.adopt_networks(other, parts)
        return Taken([*taken.over, *networks.over], [*taken.left, *networks.left])

    def parameter_groups(self) -> list[dict[str, Any]]:
        """See `Method.parameter_groups`; one group more, of the networks."""
        rates, weights = self.options.rates, self.avatar.networks()
        group = {"name": "networks", "lr": rates.networks * self.config.rate_factor, "params": weights}
        return [*super().parameter_groups(), {**group, "final": rates.networks_final}]

    def pose_loss(self, total: Tensor, terms: dict[str, Tensor], posed: PosedGaussians) -> Tensor:
        """See `BoundTraining.pose_loss`."""
        if posed.change is None or len(posed.change) == 0 or not self.avatar.networks():
            return total
        terms["change"] = posed.change.square().mean()
        return total + self.options.weight_change * terms["change"]
