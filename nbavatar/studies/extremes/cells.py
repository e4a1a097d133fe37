"""What a cell of the table is, and the registry of all of them.

A cell is one kernel under one condition: a list of levels, from harmless to the limit, and a function that runs the
kernel and its oracle at one level. What counts as exact, and which error is allowed where a level is degenerate,
is declared with the cell, before anything is measured.
"""

import dataclasses
from collections.abc import Callable

__all__ = ["DOUBLE", "FAMILIES", "SINGLE", "Cell", "Level", "Limit", "Refusal", "Sample", "Tolerance", "cell", "cells"]

Level = float | str

# Families in the order of tables and pictures, each with its module. They import this one, so they are imported late.
_MODULES = {
    "raster": "nbavatar.studies.extremes.raster",
    "projection": "nbavatar.studies.extremes.projection",
    "splat": "nbavatar.studies.extremes.splat",
    "rotations": "nbavatar.studies.extremes.rotations",
    "frames": "nbavatar.studies.extremes.frames",
    "laplacian": "nbavatar.studies.extremes.laplacian",
    "distance": "nbavatar.studies.extremes.distance",
    "walking": "nbavatar.studies.extremes.walking",
    "physics": "nbavatar.studies.extremes.physics",
    "skinning": "nbavatar.studies.extremes.skinning",
    "triangulation": "nbavatar.studies.extremes.triangulation",
    "refit": "nbavatar.studies.extremes.refit",
    "distortion": "nbavatar.studies.extremes.distortion",
    "image": "nbavatar.studies.extremes.image",
    "metrics": "nbavatar.studies.extremes.metrics",
    "losses": "nbavatar.studies.extremes.losses",
    "halfprecision": "nbavatar.studies.extremes.halfprecision",
}
FAMILIES = tuple(_MODULES)


@dataclasses.dataclass(frozen=True)
class Tolerance:
    """Errors up to which an answer counts as exact, relative unless the cell says otherwise."""

    forward: float
    gradient: float


SINGLE = Tolerance(1e-5, 1e-4)
DOUBLE = Tolerance(1e-9, 1e-8)


@dataclasses.dataclass(frozen=True)
class Limit:
    """Errors that are allowed where a condition is degenerate.

    Attributes:
        at: whether a level is meant.
        forward, gradient: largest errors.
        why: what is lost there, in a few words.
    """

    at: Callable[[Level], bool]
    forward: float
    gradient: float
    why: str


@dataclasses.dataclass(frozen=True)
class Sample:
    """What was measured at one level.

    Attributes:
        forward: error of the result; NaN where the result is not finite although the oracle's is.
        gradient: error of the gradient, None where there is none to take.
    """

    forward: float
    gradient: float | None = None


@dataclasses.dataclass(frozen=True)
class Refusal:
    """A documented answer that says 'none', such as NaN for a point that no two views agree on."""

    message: str


@dataclasses.dataclass(frozen=True)
class Cell:
    """One kernel under one condition.

    Attributes:
        family, kernel, condition: its place in the table.
        axis: what the levels are, with unit in brackets.
        levels: from harmless to the limit; `quick`: those of a short run.
        oracle: what the kernel is measured against.
        measure: runs one level.
        exact: errors that count as exact.
        unit: of the forward error; `rel. L2` where it has none.
        limits: what is allowed at degenerate levels.
        refuses: levels at which a refusal is right; a refusal elsewhere is a defect.
    """

    family: str
    kernel: str
    condition: str
    axis: str
    levels: tuple[Level, ...]
    quick: tuple[Level, ...]
    oracle: str
    measure: Callable[[Level], Sample | Refusal]
    exact: Tolerance
    unit: str
    limits: tuple[Limit, ...]
    refuses: Callable[[Level], bool]

    @property
    def name(self) -> str:
        """`family/kernel: condition`, unique."""
        return f"{self.family}/{self.kernel}: {self.condition}"

    def limit(self, level: Level) -> Limit | None:
        """What is allowed at a level beyond exactness, if anything."""
        return next((limit for limit in self.limits if limit.at(level)), None)


_CELLS: dict[str, Cell] = {}


def cell(
    family: str,
    kernel: str,
    condition: str,
    axis: str,
    levels: tuple[Level, ...],
    *,
    oracle: str,
    quick: tuple[Level, ...] | None = None,
    exact: Tolerance = SINGLE,
    unit: str = "rel. L2",
    limits: tuple[Limit, ...] = (),
    refuses: Callable[[Level], bool] = lambda level: False,
) -> Callable[[Callable[..., Sample | Refusal]], Callable[..., Sample | Refusal]]:
    """Registers a function of the level as a cell; see `Cell`. `quick` is by default the first and the last level."""

    def register(measure: Callable[..., Sample | Refusal]) -> Callable[..., Sample | Refusal]:
        chosen = quick if quick is not None else tuple(dict.fromkeys((levels[0], levels[-1])))
        made = Cell(family, kernel, condition, axis, levels, chosen, oracle, measure, exact, unit, limits, refuses)
        if made.name in _CELLS or family not in FAMILIES:
            raise ValueError(f"cell {made.name}: registered twice, or of an unknown family")
        _CELLS[made.name] = made
        return measure

    return register


def cells(families: tuple[str, ...] = FAMILIES) -> list[Cell]:
    """All registered cells of some families, in the order of the table; imports the families' modules."""
    import importlib

    for family in families:
        importlib.import_module(_MODULES[family])
    return [one for family in families for one in _CELLS.values() if one.family == family]
