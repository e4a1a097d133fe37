"""Fronts of speed, memory and size against quality, for print (matplotlib, imported where a figure is drawn)."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from nbavatar.reporting.curves import PALETTE
from nbavatar.tradeoff.front import Point, pareto_front

if TYPE_CHECKING:
    from matplotlib.axes import Axes
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
    """Two panels, PSNR and LPIPS over a cost: all points, the front, the presets.

    Every avatar has its colour and every preset its own marker, so nothing is told by colour alone.

    Args:
        points: the exact point first.
        presets: by name.
        cost: a key of `COSTS`.
        caption: device, picture size, number of images.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter

    # Places by hand: matplotlib's own layout measures every label several times, which takes seconds.
    figure = Figure(figsize=(11.0, 5.0), dpi=120)
    axes = figure.subplots(1, 2)
    figure.subplots_adjust(left=0.07, right=0.985, top=0.93, bottom=0.2, wspace=0.2)
    costs = [cost_of(point, cost) for point in points]
    models = list(dict.fromkeys(point.model for point in points))
    for axis, (key, label, sign) in zip(axes, _GAINS, strict=True):
        gains = [float(point.values[key]) for point in points]
        for number, model in enumerate(models):
            own = [i for i, point in enumerate(points) if point.model == model]
            colour = _GREY if len(models) == 1 else PALETTE[number % len(PALETTE)]
            axis.scatter([costs[i] for i in own], [gains[i] for i in own], s=20, c=colour, alpha=0.75,
                         label=model if len(models) > 1 else "measured settings", zorder=2)  # fmt: skip
        front = pareto_front(costs, [sign * gain for gain in gains])
        axis.step([costs[i] for i in front], [gains[i] for i in front], where="post", color="#0072B2", lw=1.3,
                  label="front", zorder=1)  # fmt: skip
        named = {"accurate": points[0], **presets}
        for number, (name, point) in enumerate(named.items()):
            axis.scatter([cost_of(point, cost)], [point.values[key]], s=95, marker=_MARKERS[number % len(_MARKERS)],
                         facecolors="none", edgecolors=PALETTE[(number + 1) % len(PALETTE)], linewidths=1.8,
                         label=name, zorder=3)  # fmt: skip
        _label_front(axis, [points[i] for i in front], [(costs[i], gains[i]) for i in front])
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
    figure.legend(handles, labels, loc="lower center", ncols=min(6, len(labels)), frameon=False, fontsize=9)
    figure.suptitle(caption, fontsize=10)
    return figure


def offline_figure(rows: Sequence[Mapping[str, Any]]) -> "Figure":
    """Error over time of the stages before training: one panel a stage and knob, every point named by its value.

    Args:
        rows: of `nbavatar.tradeoff.offline`.
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


def _label_front(axis: "Axes", points: Sequence[Point], places: Sequence[tuple[float, float]]) -> None:
    """Names up to five points of the front, spread over it."""
    count = len(points)
    chosen = sorted({round(i * (count - 1) / 4) for i in range(5)}) if count > 1 else [0]
    for number, index in enumerate(chosen):
        above = number % 2 == 0
        axis.annotate(
            _wrapped(points[index].label), places[index], xytext=(4, 7 if above else -8), textcoords="offset points",
            fontsize=7, va="bottom" if above else "top", color="#333333",
        )  # fmt: skip


def _wrapped(label: str) -> str:
    """Two items a line."""
    items = label.split(", ")
    return ",\n".join(", ".join(items[i : i + 2]) for i in range(0, len(items), 2))
