"""The sweep over the cells, and its tables."""

import csv
import dataclasses
import io
from collections.abc import Callable, Iterable, Sequence

from nbavatar.studies.extremes.cells import FAMILIES, Cell, cells
from nbavatar.studies.extremes.verdict import ORDER, Row, measure

__all__ = ["count_verdicts", "csv_text", "sweep"]

Progress = Callable[[Sequence[Cell]], Iterable[Cell]]


def sweep(families: Sequence[str] = FAMILIES, *, quick: bool = False, progress: Progress = iter) -> list[Row]:
    """Measures cells, in the order of the table.

    Args:
        families: which.
        quick: only the levels of a short run.
        progress: wraps the list of cells, for a progress bar.
    """
    chosen = [cell for cell in cells(tuple(families)) if cell.quick or not quick]
    return [measure(cell, level) for cell in progress(chosen) for level in (cell.quick if quick else cell.levels)]


def csv_text(rows: Sequence[Row]) -> str:
    """One line a measurement, one column a field of `Row`."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, [field.name for field in dataclasses.fields(Row)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(dataclasses.asdict(row) for row in rows)
    return stream.getvalue()


def count_verdicts(rows: Sequence[Row]) -> dict[str, int]:
    """Number of measurements of each verdict."""
    return {verdict: sum(row.verdict == verdict for row in rows) for verdict in ORDER}
