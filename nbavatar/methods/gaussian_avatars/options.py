"""Options of GaussianAvatars: those of all Gaussians that are bound to triangles, at the published values."""

from dataclasses import dataclass

from nbavatar.methods.gaussians.options import BoundConfig

__all__ = ["GaussianAvatarsConfig"]


@dataclass(frozen=True)
class GaussianAvatarsConfig(BoundConfig):
    """GaussianAvatars (Qian et al. 2024): Gaussians bound to triangles."""
