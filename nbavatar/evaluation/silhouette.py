"""How much an avatar covers that it should not, and how much it leaves uncovered."""

import numpy as np

__all__ = ["silhouette_error"]


def silhouette_error(predicted: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """Excess and lack of coverage, as shares of the true area: sum max(p - t, 0) / sum t, sum max(t - p, 0) / sum t.

    Args:
        predicted, true: coverage, uint8 (H, W), 255 = full.

    Returns:
        over, under [1]; infinite where nothing is there to be covered and something is, 0 where neither is.
    """
    p, t = predicted.astype(np.int64), true.astype(np.int64)
    over, under, area = int(np.maximum(p - t, 0).sum()), int(np.maximum(t - p, 0).sum()), int(t.sum())
    if area == 0:
        return (float("inf") if over else 0.0), 0.0
    return over / area, under / area
