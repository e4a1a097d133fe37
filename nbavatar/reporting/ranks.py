"""Best and second-best marks of a column, from the digits that are shown.

Equal digits get equal marks, and two best leave no second: a reader can check every mark from the table alone.
"""
# pyright: reportArgumentType=false, reportReturnType=false
# The stubs of pandas take a column for a table and know one kind of key.

import numpy as np
import pandas as pd

__all__ = ["rank_marks"]


def rank_marks(texts: pd.Series, *, higher_is_better: bool, second: bool = True) -> pd.Series:
    """Marks of the cells of one column.

    Args:
        texts: the cells as shown; what is not a number (a missing cell) takes no part.
        higher_is_better: direction of the metric.
        second: also mark the second best.

    Returns:
        ``best``, ``second`` or ``""`` for each cell, with the same index. Nothing is marked unless two cells hold
        numbers.
    """
    values = pd.to_numeric(texts, errors="coerce").replace([np.inf, -np.inf], np.nan)
    places = values.rank(method="min", ascending=not higher_is_better)
    marks = {1.0: "best", 2.0: "second"} if second else {1.0: "best"}
    return places.map(marks if values.count() > 1 else {}).fillna("").astype(object)
