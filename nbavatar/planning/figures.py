"""What each figure is made from."""

import dataclasses

from nbavatar.config.sheets import Row
from nbavatar.planning.run import Plan
from nbavatar.planning.units import (
    Avatar,
    Crop,
    Meshes,
    Reenactment,
    avatars,
    judged_on,
    meshes_of,
    reenactments,
    timed,
)

__all__ = ["Shown", "shown"]


@dataclasses.dataclass(frozen=True)
class Shown:
    """Results that a figure asks for, each kind in the order in which the figure shows it.

    Attributes:
        renders, evaluations: rows of the sheet.
        timings, histories, models: avatars.
        frames: crops.
        meshes, reenacted: what drives the models.
    """

    renders: list[Row] = dataclasses.field(default_factory=list)
    evaluations: list[Row] = dataclasses.field(default_factory=list)
    timings: list[Avatar] = dataclasses.field(default_factory=list)
    histories: list[Avatar] = dataclasses.field(default_factory=list)
    models: list[Avatar] = dataclasses.field(default_factory=list)
    frames: list[Crop] = dataclasses.field(default_factory=list)
    meshes: list[Meshes] = dataclasses.field(default_factory=list)
    reenacted: list[Reenactment] = dataclasses.field(default_factory=list)


def shown(plan: Plan, name: str) -> Shown:
    """What a figure needs, and nothing else: an edit of one variant makes the figures anew that show it."""
    layout = plan.figures[name]
    # The variants it names, or all of those whose avatars stand for all subjects.
    rows = [
        row
        for row in plan.rows
        if layout.shows(row.subject)
        and row.protocol == layout.protocol
        and (row.variant in layout.variants or not layout.variants)
    ]
    subjects = list(dict.fromkeys(row.subject for row in rows))

    def frames(of: list[str]) -> list[Crop]:
        return [crop for subject in of for crop in judged_on(plan, subject, layout.protocol)]

    def models(of: list[str]) -> list[Avatar]:
        return [Avatar(subject, layout.variant) for subject in of]

    if layout.kind == "comparison":
        return Shown(renders=rows, evaluations=rows, frames=frames(subjects))
    if layout.kind == "curves":
        return Shown(histories=avatars(plan))
    if layout.kind == "pareto":
        measured = set(timed(plan))
        found = [avatar for row in rows if (avatar := Avatar(row.subject, row.variant)) in measured]
        return Shown(evaluations=rows, timings=found)
    if layout.kind == "reenactment":
        pairs = reenactments(plan, layout.variant)
        sources = list(dict.fromkeys(pair.source for pair in pairs))
        both = list(dict.fromkeys(name for pair in pairs for name in (pair.source, pair.target)))
        return Shown(models=models(sources), reenacted=pairs, frames=frames(both))
    meshes = [meshes_of(plan, subject, layout.variant) for subject in subjects]
    driven = models(subjects) if layout.kind == "features" else []
    return Shown(models=driven, meshes=meshes, frames=frames(subjects))
