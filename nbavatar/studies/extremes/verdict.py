"""From measurements to verdicts: exact, degrades, refuses, or a defect.

exact      both errors within the cell's tolerance
degrades   above it, but within the bound declared for degenerate levels
refuses    an error of one line that names the cause, where a refusal is right
defect     NaN, infinity, a crash, an error beyond every bound, a refusal where an answer is due
"""

import dataclasses
import math
import time
import warnings
from collections.abc import Iterable, Sequence

from nbavatar.errors import NBAvatarError
from nbavatar.studies.extremes.cells import Cell, Level, Refusal, Sample

__all__ = ["ORDER", "Row", "by_cell", "judge", "measure", "worst"]

ORDER = ("exact", "degrades", "refuses", "defect")


@dataclasses.dataclass(frozen=True)
class Row:
    """One level of one cell: a line of the table.

    Attributes:
        level: number, or the name of a case.
        verdict: one of ORDER.
        forward, gradient: errors; None where none was measured. NaN and infinity are spelled out in `message`.
        forward_bound, gradient_bound: the largest that are allowed at this level.
        message: why it degrades, the refusal's text, or what is wrong.
        seconds: processor time, oracle included.
    """

    family: str
    kernel: str
    condition: str
    axis: str
    level: Level
    oracle: str
    unit: str
    verdict: str
    forward: float | None
    gradient: float | None
    forward_bound: float
    gradient_bound: float
    message: str
    seconds: float


def judge(cell: Cell, level: Level, outcome: Sample | Refusal | Exception) -> tuple[str, str]:
    """Verdict and message of one outcome."""
    limit = cell.limit(level)
    if isinstance(outcome, (Refusal, Exception)):
        message = outcome.message if isinstance(outcome, Refusal) else str(outcome)
        if isinstance(outcome, Exception) and not isinstance(outcome, (NBAvatarError, ValueError)):
            return "defect", f"crash: {type(outcome).__name__}: {' '.join(message.split())}"
        if not cell.refuses(level):
            return "defect", f"refused without need: {' '.join(message.split())}"
        if not message or "\n" in message:
            return "defect", f"a refusal of {len(message.splitlines())} lines"
        return "refuses", message
    forward, gradient = outcome.forward, outcome.gradient
    if not math.isfinite(forward):
        return "defect", "the result is not finite"
    if gradient is not None and not math.isfinite(gradient):
        return "defect", "the gradient is not finite"
    if forward <= cell.exact.forward and (gradient is None or gradient <= cell.exact.gradient):
        return "exact", ""
    if limit is None:
        return "defect", "an error where none is expected"
    if forward <= limit.forward and (gradient is None or gradient <= limit.gradient):
        return "degrades", limit.why
    return "defect", "an error beyond its bound"


def measure(cell: Cell, level: Level) -> Row:
    """Runs one level; nothing that the kernel does, short of ending the process, ends the sweep."""
    outcome: Sample | Refusal | Exception
    start = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            outcome = cell.measure(level)
        except Exception as error:  # a crash is a finding, to be written down like every other
            outcome = error
    seconds = time.process_time() - start
    verdict, message = judge(cell, level, outcome)
    limit = cell.limit(level)
    sample = outcome if isinstance(outcome, Sample) else None
    return Row(
        cell.family,
        cell.kernel,
        cell.condition,
        cell.axis,
        level,
        cell.oracle,
        cell.unit,
        verdict,
        _finite(sample.forward if sample else None),
        _finite(sample.gradient if sample else None),
        max(cell.exact.forward, limit.forward if limit else 0.0),
        max(cell.exact.gradient, limit.gradient if limit else 0.0),
        message,
        seconds,
    )


def worst(rows: Sequence[Row]) -> str:
    """The gravest verdict of some rows: a defect before a refusal, before a loss."""
    return max((row.verdict for row in rows), key=ORDER.index)


def by_cell(rows: Iterable[Row]) -> dict[tuple[str, str, str], list[Row]]:
    """Rows grouped by family, kernel and condition, in their order."""
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.family, row.kernel, row.condition), []).append(row)
    return groups


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
