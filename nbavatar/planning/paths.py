"""Patterns of paths, as the outputs of rules are: `results/{run}/spectral/{subject}.npz`."""

import dataclasses
import re
from collections.abc import Iterable
from typing import Any

from nbavatar.planning.run import Plan

__all__ = ["constraints", "fill"]


def fill(patterns: str | Iterable[str], units: Iterable[Any], **fixed: str) -> list[str]:
    """Paths of units of work.

    Args:
        patterns: one or more, with a wildcard in braces for each field that they take from a unit.
        units: dataclasses whose fields are wildcards (`nbavatar.planning.units`).
        fixed: wildcards that are the same for all of them.

    Returns:
        all patterns of the first unit, then of the second, and so on.
    """
    texts = [str(patterns)] if isinstance(patterns, str) else [str(pattern) for pattern in patterns]
    named = [fixed | {field.name: getattr(unit, field.name) for field in dataclasses.fields(unit)} for unit in units]
    return [text.format(**wildcards) for wildcards in named for text in texts]


def constraints(plan: Plan) -> dict[str, str]:
    """Wildcard -> regular expression of the names it stands for: one that is not known fails before any job."""
    run, subjects = plan.run, _one_of(plan.subjects)
    return {
        "run": _one_of([run.run]),
        "subject": subjects,
        "source": subjects,
        "target": subjects,
        "camera": _one_of({camera for subject in plan.subjects.values() for camera in subject.cameras}),
        "crop": _one_of(run.crops),
        "variant": _one_of(run.variants),
        "protocol": _one_of(run.protocols),
        "table": _one_of(plan.tables),
        "figure": _one_of(plan.figures),
        "kind": "driven|turntable",
    }


def _one_of(names: Iterable[str]) -> str:
    return "|".join(map(re.escape, sorted(names)))
