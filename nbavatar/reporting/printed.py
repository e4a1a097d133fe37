"""The numbers that the paper prints, and whether they agree with one another.

Values stay text: "0.9711" and "0.976" have different precisions, and both are shown as printed.
"""

import csv
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal

from nbavatar.errors import DataError, describe
from nbavatar.reporting.ranks import rank_marks

__all__ = ["Printed", "deviating_marks", "deviating_means", "read_printed", "recomputed_mean"]

_COLUMNS = ["table", "row", "column", "value", "mark", "note"]
_NUMBER = re.compile(r"-?[0-9]{1,12}(\.[0-9]{1,12})?")
_HIGHER_IS_BETTER = {"psnr": True, "ssim": True, "lpips": False, "fps": True, "ms": False}


@dataclass(frozen=True)
class Printed:
    """One printed number: its text, how the paper marks it (best, second or nothing), and a remark."""

    text: str
    mark: str = ""
    note: str = ""


def read_printed(lines: Iterable[str], where: str) -> dict[tuple[str, str, str], Printed]:
    """Reads the sheet of printed numbers.

    Args:
        lines: lines of the csv ``table,row,column,value,mark,note``; those that begin with # are remarks.
        where: name of the file, for error lines.

    Returns:
        (table, row, column) -> number; columns are named ``<subject>.<metric>`` where there are subjects.

    Raises:
        DataError: another header, an unknown mark, or the same cell twice.
    """
    reader = csv.DictReader(line for line in lines if not line.startswith("#"))
    if reader.fieldnames != _COLUMNS:
        found = ", ".join(reader.fieldnames or ()) or "nothing"
        raise DataError.of(where, "header", expected=", ".join(_COLUMNS), found=found)
    cells: dict[tuple[str, str, str], Printed] = {}
    for row in reader:
        if None in row or any(value is None for value in row.values()):
            raise DataError.of(where, f"line {reader.line_num}", expected=f"{len(_COLUMNS)} columns", found="others")
        key = (row["table"], row["row"], row["column"])
        if key in cells:
            raise DataError.of(where, "/".join(key), expected="each cell once", found="it twice")
        if row["mark"] not in ("", "best", "second"):
            raise DataError.of(where, "/".join(key), expected="mark best, second or nothing", found=repr(row["mark"]))
        if row["column"].rpartition(".")[2] in _HIGHER_IS_BETTER and not _NUMBER.fullmatch(row["value"]):
            raise DataError.of(where, "/".join(key), expected="a number as printed", found=describe(row["value"]))
        cells[key] = Printed(row["value"], row["mark"], row["note"] or "")
    return cells


def recomputed_mean(texts: Sequence[str]) -> Decimal:
    """Exact mean of printed numbers."""
    return sum((Decimal(text) for text in texts), Decimal(0)) / len(texts)


def deviating_means(
    cells: Mapping[tuple[str, str, str], Printed], table: str, subjects: Sequence[str]
) -> list[tuple[str, str, str, Decimal]]:
    """Printed means that the table's own printed cells do not give.

    A mean agrees if it lies within half a unit of its last digit of the exact mean (either way of rounding a half is
    accepted).

    Returns:
        (row, metric, printed mean, exact mean of the printed cells) of each that does not agree.
    """
    found = []
    for (name, row, column), cell in cells.items():
        subject, _, metric = column.partition(".")
        if name != table or subject != "mean":
            continue
        parts = [cells.get((table, row, f"{s}.{metric}")) for s in subjects]
        texts = [part.text for part in parts if part is not None]
        if len(texts) != len(subjects):
            continue
        mean = recomputed_mean(texts)
        half_unit = Decimal(1).scaleb(-len(cell.text.partition(".")[2])) / 2
        if abs(mean - Decimal(cell.text)) > half_unit:
            found.append((row, metric, cell.text, mean))
    return found


def deviating_marks(
    cells: Mapping[tuple[str, str, str], Printed], table: str, *, second: bool
) -> list[tuple[str, str, str, str]]:
    """Marks of the paper that its own printed cells do not give.

    Returns:
        (row, column, mark in the paper, mark by the rule of ``rank_marks``); a mark may be empty.
    """
    columns: dict[str, dict[str, Printed]] = {}
    for (name, row, column), cell in cells.items():
        if name == table and column.rpartition(".")[2] in _HIGHER_IS_BETTER:
            columns.setdefault(column, {})[row] = cell
    found = []
    for column, by_row in columns.items():
        higher = _HIGHER_IS_BETTER[column.rpartition(".")[2]]
        marks = rank_marks([cell.text for cell in by_row.values()], higher_is_better=higher, second=second)
        for (row, cell), mark in zip(by_row.items(), marks, strict=True):
            if cell.mark != mark:
                found.append((row, column, cell.mark, mark))
    return found
