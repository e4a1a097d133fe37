"""Options of SplattingAvatar. Defaults are the published ones; steps are counted as in `gaussians/options.py`."""

from dataclasses import dataclass

from nbavatar.config.core import option
from nbavatar.methods.gaussians.options import DensityConfig

__all__ = ["SplattingAvatarConfig", "SplattingAvatarRates", "SplattingDensityConfig"]


@dataclass(frozen=True)
class SplattingDensityConfig(DensityConfig):
    """When Gaussians are doubled, split and removed (SplattingAvatar)."""

    start: int = option(600, "First iteration of densification.", min=0)
    stop: int = option(29_000, "Iteration from which the number of Gaussians stays.", min=0)
    interval: int = option(100, "Iterations between two densifications.", min=1)
    reset: int = option(3_000, "Iterations between two resets of all opacities to 0.01 at most; 0 = never.", min=0)


@dataclass(frozen=True)
class SplattingAvatarRates:
    """Adam rates of SplattingAvatar."""

    embedding: float = option(1.6e-4, "Steps u, v [barycentric] and heights d [m], at the start.", min=0)
    embedding_final: float = option(0.01, "Factor on it at the end, reached exponentially.", min=0, max=1)
    colour: float = option(2.5e-3, "Harmonics.", min=0)
    opacity: float = option(0.05, "Opacities before the sigmoid.", min=0)
    scale: float = option(5e-3, "Logarithms of the scales.", min=0)
    rotation: float = option(1e-3, "Quaternions.", min=0)


@dataclass(frozen=True)
class SplattingAvatarConfig:
    """SplattingAvatar (Shao et al. 2024): Gaussians embedded in the surface."""

    mode: str = option(
        "paper",
        "paper: as described, the embedding moves on the surface by its gradient; released: as the public code "
        "behaves, where it does not, and heights are trained only up to the first walk.",
        choices=("paper", "released"),
    )
    iterations: int = option(30_000, "Length of the published training; all iterations below are counted in it.", min=1)
    samples: int = option(10_000, "Gaussians at the start.", min=1)
    sh_degree: int = option(0, "Degree of the spherical harmonics.", min=0, max=3)
    opacity: float = option(0.1, "Opacity at the start.", min=1e-4, max=0.999)
    walk_interval: int = option(100, "Iterations between two walks on the triangles.", min=1)
    extent: float = option(2.0, "Size of the scene that density is controlled with [m].", min=0)
    background: str = option("random", "Behind picture and truth in training.", choices=("white", "random"))
    weight_mse: float = option(10.0, "Weight of the squared error beside L1.", min=0)
    weight_lpips: float = option(
        0.01, "Weight of LPIPS inside the true silhouette; backbone and rhythm are the training's.", min=0
    )
    weight_scale: float = option(1.0, "Weight of the size of Gaussians that are large and stretched.", min=0)
    threshold_scale: float = option(0.008, "Size from which a Gaussian is large [m].", min=0)
    threshold_ratio: float = option(10.0, "Longest to shortest axis from which it is stretched.", min=1)
    rates: SplattingAvatarRates = option(SplattingAvatarRates, "Learning rates.")
    density: SplattingDensityConfig = option(SplattingDensityConfig, "Changes of the number of Gaussians.")
