"""Training of GaussianAvatars; loss, rates and calendar are in `nbavatar.methods.gaussians.bound_training`."""

from collections.abc import Mapping, Sequence

import numpy as np

from nbavatar.config.training import TrainConfig
from nbavatar.data.lights import Light
from nbavatar.data.sequences import MeshSequence
from nbavatar.data.views import View
from nbavatar.methods.gaussian_avatars.avatar import GaussianAvatars
from nbavatar.methods.gaussians.bound_training import BoundTraining, first_gaussians
from nbavatar.methods.gaussians.training import camera_extent

__all__ = ["GaussianAvatarsTraining"]


class GaussianAvatarsTraining(BoundTraining):
    """GaussianAvatars in training."""

    @classmethod
    def create(
        cls,
        sequence: MeshSequence,
        coords: Mapping[str, np.ndarray],
        views: Sequence[View],
        config: TrainConfig,
        device: str,
        light: Light | None = None,
    ) -> "GaussianAvatarsTraining":
        """See `Method.create`; spectral coordinates are not used."""
        arguments, _ = first_gaussians(sequence, config)
        return cls(GaussianAvatars(**arguments).to(device), config, config.own.extent or camera_extent(views))
