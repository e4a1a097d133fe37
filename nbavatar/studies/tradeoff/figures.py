"""Fronts of speed, memory and size against quality, for print (matplotlib, imported where a figure is drawn)."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from nbavatar.reporting.curves import PALETTE
from nbavatar.studies.tradeoff.front import Point, pareto_front

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["COSTS", "front_figure", "offline_figure"]

# Cost -> axis label; each has a front against PSNR and one against LPIPS.
COSTS = {
    "ms": "time of a picture [ms]",
    "peak_memory_mb": "peak memory [MB]",
    "model_mb": "size of the avatar [MB]",
}
_GAINS = (("psnr", "PSNR [dB]", 1.0), ("lpips", "LPIPS [1]", -1.0))
_MARKERS = "sD^v<>P"
_GREY = "#777777"


def cost_of(point: Point, cost: str) -> float:
    """A cost of a point: `ms`, `peak_memory_mb` or `model_mb`."""
    return point.ms if cost == "ms" else float(point.values[cost])


def front_figure(points: Sequence[Point], presets: Mapping[str, Point], cost: str, caption: str) -> "Figure":
    """Two panels, PSNR and LPIPS over a cost: all points, the front, the presets; a key names points of the fronts.

    Every avatar has its colour and every preset its own marker, so nothing is told by colour alone.

    Args:
        points: the exact point first.
        presets: by name.
        cost: a key of `COSTS`.
        caption: device, picture size, number of images.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter

    costs = [cost_of(point, cost) for point in points]
    gains = {key: [float(point.values[key]) for point in points] for key, _, _ in _GAINS}
    fronts = {key: pareto_front(costs, [sign * gain for gain in gains[key]]) for key, _, sign in _GAINS}
    named = sorted({i for front in fronts.values() for i in _spread(front)}, key=lambda i: (costs[i], i))
    numbers = {index: str(number) for number, index in enumerate(named, start=1)}
    models = list(dict.fromkeys(point.model for point in points))
    # Places by hand [in]: matplotlib's own layout measures every label several times, which takes seconds.
    rows = -(-len(named) // 2)
    key_height = 0.17 * rows + 0.1
    height = 5.0 + key_height
    figure = Figure(figsize=(11.0, height), dpi=120)
    axes = figure.subplots(1, 2)
    bottom = (1.0 + key_height) / height
    figure.subplots_adjust(left=0.07, right=0.985, top=1 - 0.35 / height, bottom=bottom, wspace=0.2)
    for axis, (key, label, sign) in zip(axes, _GAINS, strict=True):
        for number, model in enumerate(models):
            own = [i for i, point in enumerate(points) if point.model == model]
            colour = _GREY if len(models) == 1 else PALETTE[number % len(PALETTE)]
            axis.scatter([costs[i] for i in own], [gains[key][i] for i in own], s=20, c=colour, alpha=0.75,
                         label=model if len(models) > 1 else "measured settings", zorder=2)  # fmt: skip
        front = fronts[key]
        axis.step([costs[i] for i in front], [gains[key][i] for i in front], where="post", color="#0072B2", lw=1.3,
                  label="front", zorder=1)  # fmt: skip
        for number, (name, point) in enumerate({"accurate": points[0], **presets}.items()):
            axis.scatter([cost_of(point, cost)], [point.values[key]], s=95, marker=_MARKERS[number % len(_MARKERS)],
                         facecolors="none", edgecolors=PALETTE[(number + 1) % len(PALETTE)], linewidths=1.8,
                         label=name, zorder=3)  # fmt: skip
        for index in front:
            if index in numbers:
                axis.annotate(numbers[index], (costs[index], gains[key][index]), xytext=(-7, 6), ha="center",
                              textcoords="offset points", fontsize=8, color="#222222", zorder=4)  # fmt: skip
        if max(costs) > 3 * min(costs):
            axis.set_xscale("log")
            axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.xaxis.set_major_formatter("{x:g}")
            axis.xaxis.set_minor_formatter(NullFormatter())
        if sign < 0:
            axis.invert_yaxis()
        axis.set_xlabel(COSTS[cost])
        axis.set_ylabel(label + (", better upwards" if sign < 0 else ""))
        axis.grid(linewidth=0.4, alpha=0.5)
        axis.margins(0.12)
        axis.spines[["top", "right"]].set_visible(False)
    handles, labels = axes[0].get_legend_handles_labels()
    columns = min(6, len(labels))
    figure.legend(handles, labels, loc="lower center", bbox_to_anchor=(0.5, (0.05 + key_height) / height),
                  ncols=columns, frameon=False, fontsize=9)  # fmt: skip
    several = len(models) > 1
    for place, index in enumerate(named):
        name = f"{points[index].model}: {points[index].label}" if several else points[index].label
        column, row = divmod(place, rows)
        figure.text(0.03 + 0.49 * column, (key_height - 0.17 * (row + 1)) / height, f"{numbers[index]}  {name}",
                    fontsize=7.5, color="#222222")  # fmt: skip
    figure.suptitle(caption, fontsize=10, y=1 - 0.12 / height, va="center")
    return figure


def offline_figure(rows: Sequence[Mapping[str, Any]]) -> "Figure":
    """Error over time of the stages before training: one panel a stage and knob, every point named by its value.

    Args:
        rows: of `nbavatar.studies.tradeoff.offline`.
    """
    from matplotlib.figure import Figure

    groups = list(dict.fromkeys((row["stage"], row["knob"]) for row in rows))
    across, down = min(3, len(groups)), -(-len(groups) // 3)
    figure = Figure(figsize=(3.6 * across, 3.1 * down), dpi=120)
    axes = figure.subplots(down, across, squeeze=False).ravel()
    width, height = 3.6 * across, 3.1 * down
    figure.subplots_adjust(
        left=0.7 / width, right=1 - 0.15 / width, top=1 - 0.35 / height, bottom=0.55 / height, wspace=0.33, hspace=0.4
    )
    for axis in axes[len(groups) :]:
        axis.axis("off")
    for number, (axis, (stage, knob)) in enumerate(zip(axes, groups, strict=False)):
        own = [row for row in rows if (row["stage"], row["knob"]) == (stage, knob)]
        # The coarseness of a mesh costs billboards later, not time now.
        cost, label = ("faces", "faces left [1]") if stage == "decimate" else ("ms", "time [ms]")
        xs, ys = [row[cost] for row in own], [row["error_mm"] for row in own]
        axis.plot(xs, ys, "o-", color=PALETTE[number % len(PALETTE)], lw=1.0, ms=4)
        for row, x, y in zip(own, xs, ys, strict=True):
            axis.annotate(f"{row['value']:g}", (x, y), xytext=(3, 4), textcoords="offset points", fontsize=8)
        if min(ys) > 0 and max(ys) > 10 * min(ys):
            axis.set_yscale("log")
        axis.set_title(f"{stage}: {knob}", fontsize=10)
        axis.set_xlabel(label, fontsize=9)
        axis.set_ylabel("error [mm]", fontsize=9)
        axis.grid(linewidth=0.4, alpha=0.5)
        axis.margins(0.15)
        axis.spines[["top", "right"]].set_visible(False)
    return figure


def _spread(front: Sequence[int]) -> list[int]:
    """Up to six points of a front, spread over it."""
    last = len(front) - 1
    return [front[i] for i in sorted({round(n * last / 5) for n in range(6)})]
