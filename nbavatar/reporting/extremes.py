"""The table of `nbavatar extremes` as Markdown: one line a cell, with its verdicts, worst errors and reasons."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

__all__ = ["extremes_markdown", "format_level"]

_ORDER = ("exact", "degrades", "refuses", "defect")


def extremes_markdown(rows: Sequence[Mapping[str, Any]], *, level: int = 2) -> str:
    """Markdown of measured rows, `rows` of record.json.

    Args:
        rows: lines with family, kernel, condition, axis, level, verdict, forward, gradient, unit, message, in order.
        level: of the headings of the families.
    """
    total = {verdict: sum(row["verdict"] == verdict for row in rows) for verdict in _ORDER}
    count = len({(row["family"], row["kernel"], row["condition"]) for row in rows})
    lines = [
        f"{len(rows)} measurements in {count} cells: "
        + ", ".join(f"{number} {_NOUNS[verdict]}" for verdict, number in total.items())
        + ".",
        "",
    ]
    for family in dict.fromkeys(row["family"] for row in rows):
        mine = [row for row in rows if row["family"] == family]
        lines += [
            f"{'#' * level} {family}",
            "",
            "| kernel | condition | levels | verdicts | worst error | worst gradient | where and why |",
            "|---|---|---|---|---|---|---|",
        ]
        for key in dict.fromkeys((row["kernel"], row["condition"]) for row in mine):
            lines.append(_line([row for row in mine if (row["kernel"], row["condition"]) == key]))
        lines.append("")
    return "\n".join(lines)


_NOUNS = {"exact": "exact", "degrades": "degraded within a stated bound", "refuses": "refused", "defect": "defects"}


def format_level(value: object) -> str:
    """A level as text: numbers in at most four digits."""
    return f"{value:.4g}" if isinstance(value, (int, float)) else str(value)


def _line(rows: Sequence[Mapping[str, Any]]) -> str:
    first = rows[0]
    levels = f"{first['axis']}: " + ", ".join(format_level(row["level"]) for row in rows)
    counts = [(verdict, sum(row["verdict"] == verdict for row in rows)) for verdict in _ORDER]
    present = [(verdict, number) for verdict, number in counts if number]
    verdicts = present[0][0] if len(present) == 1 else ", ".join(f"{verdict} {number}" for verdict, number in present)
    reasons = []
    for message in dict.fromkeys(row["message"] for row in rows if row["message"]):
        at = ", ".join(format_level(row["level"]) for row in rows if row["message"] == message)
        reasons.append(f"{at}: {message}")
    forward = _worst(row["forward"] for row in rows)
    unit = "" if first["unit"] == "rel. L2" or not forward else f" ({first['unit']})"
    cells = [
        first["kernel"], first["condition"], levels, verdicts, forward + unit,
        _worst(row["gradient"] for row in rows), "; ".join(reasons),
    ]  # fmt: skip
    return "| " + " | ".join(str(cell).replace("|", "\\|") for cell in cells) + " |"


def _worst(values: Iterable[float | None]) -> str:
    known = [value for value in values if value is not None]
    return f"{max(known):.1e}" if known else ""
