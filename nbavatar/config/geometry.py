"""Options of the geometry stages: refit, spectral coordinates, contact deformation."""

import dataclasses

from nbavatar.config.core import option

__all__ = ["DeformConfig", "FitConfig", "SpectralConfig"]


@dataclasses.dataclass(frozen=True)
class FitConfig:
    """Multi-view refit of the head and hand models."""

    iterations: int = option(200, "Optimisation steps over all frames at once.", min=0)


@dataclasses.dataclass(frozen=True)
class SpectralConfig:
    """Spectral coordinates of the meshes."""

    modes: int = option(24, "Number of non-constant eigenvectors kept per part.", min=1, max=512)


@dataclasses.dataclass(frozen=True)
class DeformConfig:
    """Contact deformation of the head by the hand (XPBD)."""

    substeps: int = option(8, "Sub-steps per frame.", min=1)
