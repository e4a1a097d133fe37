"""Table and plots of `nbavatar bench scaling`."""

import csv
import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from nbavatar.io.atomic import atomic_write

if TYPE_CHECKING:
    from nbavatar.studies.benchmarks.scaling import Point

__all__ = ["write_sheet"]


def write_sheet(folder: str, points: Sequence["Point"], units: Mapping[str, str]) -> None:
    """Writes `scaling.csv` and `scaling.png` into a folder, which is made if it is not there.

    Args:
        points: all points.
        units: what sizes count, by kind of work.
    """
    with atomic_write(os.path.join(folder, "scaling.csv")) as temporary, open(temporary, "w", newline="") as handle:
        writer = csv.writer(handle)
        writer.writerow(("work", "unit", "size", "ms", "memory_mb"))
        writer.writerows((p.work, units[p.work], p.size, p.ms, p.memory_mb) for p in points)
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.4 * len(units), 5.4), dpi=120, layout="constrained")
    axes = figure.subplots(2, len(units), squeeze=False)
    for column, (work, unit) in enumerate(units.items()):
        own = [point for point in points if point.work == work]
        sizes = [point.size for point in own]
        for axis, label, values in (
            (axes[0, column], "processor time [ms]", [point.ms for point in own]),
            (axes[1, column], "memory added [MB]", [max(point.memory_mb, 0.1) for point in own]),
        ):
            axis.loglog(sizes, values, "o-", color="#0072B2")
            linear = [values[-1] * size / sizes[-1] for size in sizes]
            axis.loglog(sizes, linear, "--", color="#777777", linewidth=1, label="linear")
            axis.grid(True, which="major", alpha=0.3)
            if column == 0:
                axis.set_ylabel(label)
        axes[0, column].set_title(work)
        axes[1, column].set_xlabel(unit)
    axes[0, 0].legend()
    with atomic_write(os.path.join(folder, "scaling.png")) as temporary:
        figure.savefig(temporary, format="png")
