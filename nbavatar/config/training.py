"""Options of training: what all methods share, and a block for each method (`nbavatar.methods.registry`)."""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from nbavatar.config.core import option
from nbavatar.methods.registry import METHODS, options_class

__all__ = ["STEPS", "TrainConfig", "own_options"]

STEPS = {"paper": 400_000, "fast": 40_000}
"""Steps of the two schedules, where neither the options nor the method name another number."""

_PARTS = ("head", "right_hand", "left_hand", "shell")


@dataclasses.dataclass(frozen=True)
class _Shared:
    """Training of one avatar."""

    method: str = option("billboards", "The method that is trained.", choices=tuple(METHODS))
    parts: list[str] | None = option(None, "Parts to model; all that the meshes have by default.", choices=_PARTS)
    start: str = option(
        "",
        "Another avatar of the same method (model.pt), whose values are taken over where they fit; empty for none. In "
        "a run also `subject/variant` of the same run.",
    )
    schedule: str = option(
        "fast", "fast: coarse to fine with a final decay; paper: 400,000 plain steps.", choices=("fast", "paper")
    )
    steps: int | None = option(None, "Optimization steps; 40,000 (fast) or 400,000 (paper) by default.", min=1)
    max_minutes: float | None = option(
        None, "Time budget instead of steps; the schedule follows the clock [min].", min=0
    )
    lpips_net: str = option("alex", "Backbone of the training LPIPS.", choices=("alex", "vgg"))
    lpips_every: int = option(1, "LPIPS in every n-th step only, n times as heavy (it is dear on a CPU).", min=1)
    lpips_from: float = option(0.0, "Share of training without LPIPS at the start.", min=0, max=1)
    lpips_full_until: float = option(0.1, "Share of training with LPIPS on the whole image, then crops.", min=0, max=1)
    lpips_crop: int = option(256, "Side of the random LPIPS crops [px].", min=32)
    coarse_until: list[float] = option(
        [0.1, 0.35], "Fast: shares of training after which the resolution doubles, up to full.", min=0, max=1
    )
    coarse_side: int = option(64, "Fast: no stage is coarser than this [px].", min=16)
    final_rate: float = option(0.05, "Fast: factor on all rates at the end (cosine).", min=0, max=1)
    decay_from: float = option(0.4, "Fast: share of training at which that decay starts.", min=0, max=1)
    rate_factor: float = option(1.0, "Factor on every learning rate.", min=0)
    max_bad_steps: int = option(20, "Non-finite steps in a row before training stops.", min=1)
    previews: int = option(6, "Preview pictures over the whole training.", min=0)
    wandb: str = option(
        "", "Project of Weights & Biases: curves are logged to an offline run as well; needs the package wandb."
    )
    checkpoint_seconds: float = option(60.0, "Time between checkpoints [s].", min=0)
    cache_mb: int = option(2048, "Memory for decoded training frames [MB].", min=0)
    prefetch: int = option(4, "Frames decoded ahead.", min=0)
    seed: int = option(0, "Seed of all random numbers.", min=0)

    @property
    def own(self) -> Any:
        """The options of the method that is trained."""
        return getattr(self, self.method)


if TYPE_CHECKING:

    class TrainConfig(_Shared):
        """What type checkers see: the fields below are made while the program runs."""

else:
    # A field for each method, so that another method needs no line here.
    TrainConfig = dataclasses.make_dataclass(
        "TrainConfig",
        [
            (name, options_class(name), option(options_class(name), f"{entry.title}; read where it is the `method`."))
            for name, entry in METHODS.items()
        ],
        bases=(_Shared,),
        namespace={"__doc__": _Shared.__doc__, "__module__": __name__},
        frozen=True,
    )


def own_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Training options without the blocks of methods that are not trained, so that theirs change nothing here."""
    return {key: value for key, value in options.items() if key not in METHODS or key == options["method"]}
