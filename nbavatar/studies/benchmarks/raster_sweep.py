"""How the cost of the billboard rasterizer grows with the scene: a table and plots."""

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

from nbavatar.io.atomic import atomic_write
from nbavatar.studies.benchmarks.raster_scene import RasterScene, make_scene

__all__ = ["RANGES", "sweep"]

RANGES: dict[str, list[int]] = {
    "billboards": [1000, 3000, 10000, 30000, 100000],
    "channels": [3, 6, 12, 24, 32],
    "texels": [4, 8, 16, 32],
    "size": [256, 512, 1024, 2048],
}
"""What is swept, and through which values; the others stay as in `make_scene`."""


def sweep(
    folder: Path,
    order: str,
    state: str,
    repeats: int,
    device: str,
    measure: Callable[[RasterScene, str, int], dict[str, Any]],
    ranges: dict[str, list[int]] = RANGES,
) -> list[dict[str, Any]]:
    """Writes `raster_sweep.csv` and `raster_sweep.png` into a folder.

    Args:
        folder: made if it is not there.
        order, state, device: of all scenes; see `make_scene`.
        repeats: runs of each scene.
        measure: gives a scene's figures.
        ranges: name of a setting of `make_scene` -> its values.

    Returns:
        Rows of the table: `swept`, `value` and the figures.
    """
    rows = []
    for name, values in ranges.items():
        for value in values:
            settings: dict[str, Any] = {name: value}
            figures = measure(make_scene(state=state, **settings).to(device), order, repeats)
            rows.append({"swept": name, "value": value, **figures})
    with atomic_write(folder / "raster_sweep.csv") as temporary, open(temporary, "w", newline="") as handle:
        writer = csv.DictWriter(handle, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    _plot(folder / "raster_sweep.png", rows, ranges)
    return rows


def _plot(path: Path, rows: list[dict[str, Any]], ranges: dict[str, list[int]]) -> None:
    """Time above, memory and hits below, against each setting."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import FixedLocator, NullLocator

    figure, axes = plt.subplots(
        2, len(ranges), figsize=(3.6 * len(ranges), 5.6), sharey="row", squeeze=False, constrained_layout=True
    )
    for column, (name, values) in enumerate(ranges.items()):
        chosen = [row for row in rows if row["swept"] == name]
        above, below = axes[:, column]
        for key, label in (("forward_ms", "forward"), ("backward_ms", "backward")):
            above.loglog(values, [row[key] for row in chosen], "o-", label=label)
        below.loglog(values, [row["peak_mb"] for row in chosen], "s-", color="C2", label="memory [MiB]")
        below.loglog(values, [row["samples"] / 1e4 for row in chosen], "^-", color="C3", label="hits blended [10,000]")
        for axis in (above, below):
            axis.xaxis.set_major_locator(FixedLocator(values))
            axis.xaxis.set_minor_locator(NullLocator())
            axis.set_xticklabels([f"{value:,}" for value in values], rotation=30)
            axis.grid(True, which="both", alpha=0.3)
        below.set_xlabel({"size": "image side [px]", "texels": "texels a side"}.get(name, name))
    axes[0, 0].set_ylabel("time [ms]")
    axes[0, 0].legend()
    axes[1, 0].legend()
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=120)
    plt.close(figure)
