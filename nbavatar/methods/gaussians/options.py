"""Options that the methods of Gaussians share. Defaults are the published ones.

Steps are counted in published iterations. With `schedule: paper` one step of training is one of them. With `schedule:
fast` (a smaller budget of steps, or of time) the whole published schedule is passed through in the budget: iteration =
progress * iterations, so every start, stop and interval keeps its share of the training. What changes the number of
Gaussians or their opacity needs some steps to settle, so those intervals are held above `floor_steps` and
`reset_floor_steps`.
"""

from dataclasses import dataclass

from nbavatar.config.core import option

__all__ = ["DensityConfig"]


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
    floor_steps: int = option(100, "Fast: fewest steps between two densifications.", min=1)
    reset_floor_steps: int = option(1_000, "Fast: fewest steps between two resets of the opacities.", min=1)
