"""The numbers that the paper prints, and whether they agree with one another.

Values stay text: "0.9711" and "0.976" have different precisions, and both are shown as printed.
"""
# pyright: reportArgumentType=false, reportReturnType=false
# The stubs of pandas take a column for a table and know one kind of key.

import csv
import re
from collections.abc import Iterable, Sequence
from decimal import Decimal

import pandas as pd

from nbavatar.errors import DataError, describe
from nbavatar.reporting.ranks import rank_marks

__all__ = ["deviating_marks", "deviating_means", "read_printed", "recomputed_mean"]

_COLUMNS = ["table", "row", "column", "value", "mark", "note"]
_NUMBER = re.compile(r"-?[0-9]{1,12}(\.[0-9]{1,12})?")
_HIGHER_IS_BETTER = {"psnr": True, "ssim": True, "lpips": False, "fps": True, "ms": False}


def read_printed(lines: Iterable[str], where: str) -> pd.DataFrame:
    """Reads the sheet of printed numbers.

    Args:
        lines: lines of the csv ``table,row,column,value,mark,note``; those that begin with # are remarks.
        where: name of the file, for error lines.

    Returns:
        One row a number, all text: its table, row and column (``<subject>.<metric>`` where there are subjects), the
        value as printed, how the paper marks it (best, second or nothing), and a remark.

    Raises:
        DataError: another header, an unknown mark, or the same cell twice.
    """
    reader = csv.DictReader(line for line in lines if not line.startswith("#"))
    if reader.fieldnames != _COLUMNS:
        found = ", ".join(reader.fieldnames or ()) or "nothing"
        raise DataError.of(where, "header", expected=", ".join(_COLUMNS), found=found)
    rows = []
    for row in reader:
        if None in row or any(value is None for value in row.values()):
            raise DataError.of(where, f"line {reader.line_num}", expected=f"{len(_COLUMNS)} columns", found="others")
        name = f"{row['table']}/{row['row']}/{row['column']}"
        if row["mark"] not in ("", "best", "second"):
            raise DataError.of(where, name, expected="mark best, second or nothing", found=repr(row["mark"]))
        if row["column"].rpartition(".")[2] in _HIGHER_IS_BETTER and not _NUMBER.fullmatch(row["value"]):
            raise DataError.of(where, name, expected="a number as printed", found=describe(row["value"]))
        rows.append(row)
    printed = pd.DataFrame(rows, columns=_COLUMNS, dtype=object)
    for row in printed[printed.duplicated(["table", "row", "column"])].itertuples():
        raise DataError.of(where, f"{row.table}/{row.row}/{row.column}", expected="each cell once", found="it twice")
    return printed


def recomputed_mean(texts: Sequence[str]) -> Decimal:
    """Exact mean of printed numbers."""
    return sum((Decimal(text) for text in texts), Decimal(0)) / len(texts)


def _numbers(printed: pd.DataFrame, table: str) -> pd.DataFrame:
    """The cells of one table that are numbers, with their subject (empty where there is none) and metric."""
    cells = printed[printed["table"] == table]
    cells = cells.assign(
        subject=[column.rpartition(".")[0] for column in cells["column"]],
        metric=[column.rpartition(".")[2] for column in cells["column"]],
    )
    return cells[cells["metric"].isin(list(_HIGHER_IS_BETTER))]


def deviating_means(printed: pd.DataFrame, table: str, subjects: Sequence[str]) -> list[tuple[str, str, str, Decimal]]:
    """Printed means that the table's own printed cells do not give.

    A mean agrees if it lies within half a unit of its last digit of the exact mean (either way of rounding a half is
    accepted).

    Args:
        printed: result of ``read_printed``.
        table: name of the table.
        subjects: its subjects; a mean is compared where all of them have a printed number.

    Returns:
        (row, metric, printed mean, exact mean of the printed cells) of each that does not agree.
    """
    cells = _numbers(printed, table)
    parts = cells[cells["subject"].isin(list(subjects))].groupby(["row", "metric"])["value"].agg(list).rename("parts")
    means = cells[cells["subject"] == "mean"].join(parts, on=["row", "metric"], how="inner").sort_index()
    found = []
    for cell in means[means["parts"].map(len) == len(subjects)].itertuples():
        mean = recomputed_mean(cell.parts)
        half_unit = Decimal(1).scaleb(-len(cell.value.partition(".")[2])) / 2
        if abs(mean - Decimal(cell.value)) > half_unit:
            found.append((cell.row, cell.metric, cell.value, mean))
    return found


def deviating_marks(printed: pd.DataFrame, table: str, *, second: bool) -> list[tuple[str, str, str, str]]:
    """Marks of the paper that its own printed cells do not give.

    Args:
        printed: result of ``read_printed``.
        table: name of the table.
        second: whether the table marks the second best too.

    Returns:
        (row, column, mark in the paper, mark by the rule of ``rank_marks``); a mark may be empty.
    """
    cells = _numbers(printed, table)
    found = []
    for column, group in cells.groupby("column", sort=False):
        higher = _HIGHER_IS_BETTER[group["metric"].iloc[0]]
        marks = rank_marks(group["value"], higher_is_better=higher, second=second)
        differs = group["mark"] != marks
        rows = zip(group["row"][differs], group["mark"][differs], marks[differs], strict=True)
        found += [(row, column, theirs, ours) for row, theirs, ours in rows]
    return found
