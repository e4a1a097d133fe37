"""The method that the options name, ready to be trained."""

from collections.abc import Mapping, Sequence

import numpy as np

from nbavatar.config.training import TrainConfig
from nbavatar.data.lights import Light
from nbavatar.data.sequences import MeshSequence
from nbavatar.data.views import View
from nbavatar.methods.base import Method
from nbavatar.methods.registry import training_class

__all__ = ["create_method"]


def create_method(
    sequence: MeshSequence,
    coords: Mapping[str, np.ndarray],
    views: Sequence[View],
    config: TrainConfig,
    device: str = "cpu",
    light: Light | None = None,
) -> Method:
    """The method that `config.method` names, in its initial state; arguments as in `Method.create`."""
    training: type[Method] = training_class(config.method)
    return training.create(sequence, coords, views, config, device, light)
