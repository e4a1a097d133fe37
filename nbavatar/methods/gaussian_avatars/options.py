"""Options of GaussianAvatars. Defaults are the published ones; steps are counted as in `gaussians/options.py`."""

from dataclasses import dataclass

from nbavatar.config.core import option
from nbavatar.methods.gaussians.options import DensityConfig

__all__ = ["GaussianAvatarsConfig", "GaussianAvatarsRates"]


@dataclass(frozen=True)
class GaussianAvatarsRates:
    """Adam rates of GaussianAvatars."""

    position: float = option(5e-3, "Local positions, at the start; multiplied by the extent.", min=0)
    position_final: float = option(0.01, "Factor on it at the end, reached exponentially.", min=0, max=1)
    colour: float = option(2.5e-3, "Harmonics of degree 0.", min=0)
    colour_rest: float = option(1.25e-4, "Harmonics of higher degrees.", min=0)
    opacity: float = option(0.05, "Opacities before the sigmoid.", min=0)
    scale: float = option(0.017, "Logarithms of the scales.", min=0)
    rotation: float = option(1e-3, "Quaternions.", min=0)


@dataclass(frozen=True)
class GaussianAvatarsConfig:
    """GaussianAvatars (Qian et al. 2024): Gaussians bound to triangles."""

    iterations: int = option(
        600_000, "Length of the published training; all iterations below are counted in it.", min=1
    )
    sh_degree: int = option(3, "Highest degree of the spherical harmonics.", min=0, max=3)
    sh_interval: int = option(1_000, "Iterations after which one more degree is used.", min=1)
    opacity: float = option(0.1, "Opacity at the start.", min=1e-4, max=0.999)
    extent: float | None = option(
        None, "Size of the scene [m]; by default 1.1 times the largest distance of a camera from their mean.", min=0
    )
    background: str = option("white", "Behind picture and truth in training.", choices=("white", "random"))
    weight_ssim: float = option(0.2, "Share of 1 - SSIM in the loss; the rest is L1.", min=0, max=1)
    weight_position: float = option(0.01, "Weight of local positions beyond `threshold_position`.", min=0)
    threshold_position: float = option(1.0, "Free distance from the triangle's centre [its size k].", min=0)
    weight_scale: float = option(1.0, "Weight of local scales beyond `threshold_scale`.", min=0)
    threshold_scale: float = option(0.6, "Free scale [k].", min=0)
    rates: GaussianAvatarsRates = option(GaussianAvatarsRates, "Learning rates.")
    density: DensityConfig = option(DensityConfig, "Changes of the number of Gaussians.")
