"""Quality against the time that one has: which variants, budgets and seeds a run compares. Standard library only."""

import dataclasses
from typing import NamedTuple

from nbavatar.config.core import option
from nbavatar.errors import ConfigError

__all__ = ["CompareRun", "Compared", "compared"]


@dataclasses.dataclass(frozen=True)
class CompareRun:
    """Comparison of variants at several budgets and seeds (`nbavatar compare`)."""

    variants: list[str] = option([], "Variants that are compared; with any, the run makes the comparison only.")
    minutes: list[float] = option([], "Budgets of training [min]; the machine must have nothing else to do.", min=0.01)
    steps: list[int] = option([], "Budgets in steps, where minutes would not be equal.", min=1)
    seeds: list[int] = option([0, 1, 2], "Seeds of training.", min=0)
    protocols: list[str] = option(["nv", "sr"], "Protocols that judge.")


class Compared(NamedTuple):
    """One avatar of a comparison.

    Attributes:
        variant: what is compared.
        budget: minutes or steps, by `unit` (`min` or `steps`).
        seed: of its training.
    """

    variant: str
    budget: float
    unit: str
    seed: int

    @property
    def name(self) -> str:
        """The derived variant's."""
        return f"{self.variant}-{self.budget:g}{self.unit}-seed{self.seed}"

    def options(self) -> dict[str, object]:
        """Options of training in which it differs from its variant."""
        if self.unit == "min":
            return {"max_minutes": self.budget, "seed": self.seed}
        return {"steps": int(self.budget), "max_minutes": None, "seed": self.seed}


def compared(cfg: CompareRun) -> list[Compared]:
    """All avatars of a comparison, the smallest budget first, seed after seed: what is there early is a whole one.

    Raises:
        ConfigError: no budget, budgets of both kinds, or something twice.
    """
    if not cfg.variants:
        return []
    if bool(cfg.minutes) == bool(cfg.steps):
        found = "both" if cfg.minutes else "neither"
        raise ConfigError.of("compare", "minutes, steps", expected="budgets of one kind", found=found)
    for key in ("variants", "minutes", "steps", "seeds", "protocols"):
        values = getattr(cfg, key)
        if len(set(values)) < len(values) or (not values and key in ("seeds", "protocols")):
            found = "one twice" if values else "none"
            raise ConfigError.of("compare", key, expected="each once, and one at least", found=found)
    budgets = [(float(minutes), "min") for minutes in cfg.minutes] or [(float(steps), "steps") for steps in cfg.steps]
    return [
        Compared(variant, budget, unit, seed)
        for budget, unit in sorted(budgets)
        for seed in cfg.seeds
        for variant in cfg.variants
    ]
