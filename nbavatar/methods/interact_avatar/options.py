"""Options of the method after InteractAvatar: those of GaussianAvatars, and its networks'.

Numbers of the networks are ours: none was in what we could read (docs/decisions/010-after-interactavatar.md).
"""

from dataclasses import dataclass

from nbavatar.config.core import option
from nbavatar.methods.gaussians.options import BoundConfig, BoundRates

__all__ = ["InteractAvatarConfig", "InteractAvatarRates"]


@dataclass(frozen=True)
class InteractAvatarRates(BoundRates):
    """Adam rates of GaussianAvatars, and of the networks."""

    networks: float = option(1e-3, "Weights of all networks, at the start.", min=0)
    networks_final: float = option(0.1, "Factor on it at the end, reached exponentially.", min=0, max=1)


@dataclass(frozen=True)
class InteractAvatarConfig(BoundConfig):
    """After InteractAvatar (Chen et al. 2025): bound Gaussians, changed by networks on the hand's pose and touch."""

    rates: InteractAvatarRates = option(InteractAvatarRates, "Learning rates.")
    hand_components: int = option(24, "Numbers that describe the pose of a hand.", min=1, max=256)
    head_components: int = option(16, "Numbers that describe the expression of the head.", min=1, max=256)
    width: int = option(64, "Units of each of the two hidden layers of a network.", min=1, max=1024)
    features: int = option(32, "Features of the points of hands near the face.", min=1, max=1024)
    points: int = option(64, "Such points of each hand.", min=1, max=1024)
    reach: float = option(0.1, "Distance of a hand from which it does nothing to the face [m].", min=1e-4)
    weight_change: float = option(0.01, "Weight of the mean square of all that the networks add.", min=0)
