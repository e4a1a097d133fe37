"""Best and second-best marks of a column, from the digits that are shown.

Equal digits get equal marks, and two best leave no second: a reader can check every mark from the table alone.
"""

from collections.abc import Sequence
from decimal import Decimal, InvalidOperation

__all__ = ["rank_marks"]


def rank_marks(texts: Sequence[str], *, higher_is_better: bool, second: bool = True) -> list[str]:
    """Marks of the cells of one column.

    Args:
        texts: the cells as shown; what is not a number (a missing cell) takes no part.
        higher_is_better: direction of the metric.
        second: also mark the second best.

    Returns:
        ``best``, ``second`` or ``""`` for each cell. Nothing is marked unless two cells hold numbers.
    """
    values = [_number(text) for text in texts]
    present = [value for value in values if value is not None]
    if len(present) < 2:
        return [""] * len(texts)
    if not higher_is_better:
        values = [None if value is None else -value for value in values]
        present = [-value for value in present]
    marks = []
    for value in values:
        better = sum(other > value for other in present) if value is not None else -1
        marks.append({0: "best", 1: "second" if second else ""}.get(better, ""))
    return marks


def _number(text: str) -> Decimal | None:
    try:
        value = Decimal(text)
    except InvalidOperation:
        return None
    return value if value.is_finite() else None
