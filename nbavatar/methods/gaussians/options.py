"""Options that the methods of Gaussians share. Defaults are the published ones.

Steps are counted in published iterations. With `schedule: paper` one step of training is one of them. With `schedule:
fast` (a smaller budget of steps, or of time) the whole published schedule is passed through in the budget: iteration =
progress * iterations, so every start, stop and interval keeps its share of the training. What changes the number of
Gaussians or their opacity needs some steps to settle, so those intervals are held above `floor_steps` and
`reset_floor_steps`.
"""

from dataclasses import dataclass

from nbavatar.config.core import option

__all__ = ["BoundConfig", "BoundRates", "DensityConfig"]


@dataclass(frozen=True)
class DensityConfig:
    """When Gaussians are doubled, split and removed."""

    start: int = option(10_000, "First iteration of densification.", min=0)
    stop: int = option(600_000, "Iteration from which the number of Gaussians stays.", min=0)
    interval: int = option(2_000, "Iterations between two densifications.", min=1)
    gradient: float = option(
        2e-4, "Mean gradient by the projected centre from which a Gaussian is densified [1/half image].", min=0
    )
    dense: float = option(
        0.01, "Densified Gaussians above this share of the extent are split, those below doubled.", min=0
    )
    min_opacity: float = option(0.005, "Gaussians below this opacity are removed.", min=0, max=1)
    max_size: float = option(
        0.1, "Gaussians above this share of the extent are removed, after the first reset of the opacities.", min=0
    )
    max_radius: float = option(
        0.0,
        "Gaussians above this radius on screen are removed, likewise [px]; 0 = never. The published codes name 20, but "
        "clear the radii before they compare them.",
        min=0,
    )
    reset: int = option(60_000, "Iterations between two resets of all opacities to 0.01 at most; 0 = never.", min=0)
    max_gaussians: int | None = option(None, "Most Gaussians; none by default.", min=1)
    floor_steps: int = option(100, "Fast: fewest steps between two densifications, and after the last.", min=1)
    reset_floor_steps: int = option(
        1_000, "Fast: fewest steps between two resets of the opacities, and after the last.", min=1
    )


@dataclass(frozen=True)
class BoundRates:
    """Adam rates of Gaussians bound to triangles, GaussianAvatars' (Qian et al. 2024)."""

    position: float = option(5e-3, "Local positions, at the start; multiplied by the extent.", min=0)
    position_final: float = option(0.01, "Factor on it at the end, reached exponentially.", min=0, max=1)
    colour: float = option(2.5e-3, "Harmonics of degree 0.", min=0)
    colour_rest: float = option(1.25e-4, "Harmonics of higher degrees.", min=0)
    opacity: float = option(0.05, "Opacities before the sigmoid.", min=0)
    scale: float = option(0.017, "Logarithms of the scales.", min=0)
    rotation: float = option(1e-3, "Quaternions.", min=0)


@dataclass(frozen=True)
class BoundConfig:
    """Options of Gaussians bound to triangles, GaussianAvatars' (Qian et al. 2024)."""

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
    rates: BoundRates = option(BoundRates, "Learning rates.")
    density: DensityConfig = option(DensityConfig, "Changes of the number of Gaussians.")
