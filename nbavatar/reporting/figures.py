"""Figures for print, PNG and PDF, by matplotlib (imported where a figure is drawn)."""

import math
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nbavatar.reporting.curves import PALETTE, Curve, ticks

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["curves_figure", "label_figure", "save_figure", "sensitivity_figure"]

_LINE, _LETTERS = 0.14, 16.0  # of a label: height of a line [in], letters an inch
_AXES = (
    ("psnr", "PSNR [dB]"),
    ("ssim", "SSIM [1]"),
    ("lpips_alex", "LPIPS, AlexNet [1]"),
    ("lpips_vgg", "LPIPS, VGG16 [1]"),
)


def sensitivity_figure(rows: Sequence[Mapping[str, Any]]) -> "Figure":
    """One panel a metric, one dot a protocol setting, a line at the base.

    Args:
        rows: result of ``nbavatar.evaluation.sensitivity.sweep``, the base first.
    """
    from matplotlib.figure import Figure

    metrics = [(key, label) for key, label in _AXES if key in rows[0]]
    figure = Figure(figsize=(2.2 + 2.3 * len(metrics), 0.8 + 0.26 * len(rows)), layout="constrained")
    axes = figure.subplots(1, len(metrics), sharey=True, squeeze=False)[0]
    factors = list(dict.fromkeys(str(row["factor"]) for row in rows))
    colours = {factor: "#444444" if factor == "base" else PALETTE[i % len(PALETTE)] for i, factor in enumerate(factors)}
    positions = np.arange(len(rows))[::-1]
    for axis, (key, label) in zip(axes, metrics, strict=True):
        values = [row[key] for row in rows]
        axis.axvline(values[0], color="#444444", linewidth=0.8, linestyle=":")
        axis.hlines(positions, values[0], values, color=[colours[row["factor"]] for row in rows], linewidth=1.5)
        axis.scatter(values, positions, color=[colours[row["factor"]] for row in rows], s=28, zorder=3)
        axis.set_xlabel(label)
        axis.grid(axis="x", linewidth=0.4, alpha=0.6)
        axis.margins(x=0.12)
        axis.spines[["top", "right"]].set_visible(False)
    names = [str(r["setting"]) if r["factor"] == "base" else f"{r['factor']}: {r['setting']}" for r in rows]
    axes[0].set_yticks(positions, names)
    return figure


def curves_figure(curves: Sequence[Curve]) -> "Figure":
    """Training curves: one panel a quantity, one line an avatar, a common legend."""
    from matplotlib.figure import Figure

    # Places in inches, by hand: matplotlib's own layout measures every label several times, which takes seconds.
    across = min(3, len(curves))
    down = -(-len(curves) // across)
    names = list(dict.fromkeys(name for curve in curves for name in curve.series))
    foot = 0.2 * math.ceil(len(names) / 5) + 0.15
    width, height = 3.3 * across, 2.4 * down + foot
    figure = Figure(figsize=(width, height), dpi=150)
    axes = figure.subplots(down, across, squeeze=False).ravel()
    figure.subplots_adjust(
        left=0.75 / width, right=1 - 0.12 / width, top=1 - 0.3 / height, bottom=(foot + 0.5) / height,
        wspace=0.85 / 2.45, hspace=0.85 / 1.55,
    )  # fmt: skip
    for axis in axes[len(curves) :]:
        axis.axis("off")
    for axis, curve in zip(axes, curves, strict=False):
        for number, (name, points) in enumerate(curve.series.items()):
            style = ("-", "--", ":", "-.")[number // len(PALETTE) % 4]
            colour = PALETTE[number % len(PALETTE)]
            shown = [(x, y) for x, y in points if y > 0 or not curve.log_y]
            if shown:
                xs, ys = zip(*shown, strict=True)
                axis.plot(
                    xs,
                    ys,
                    style,
                    color=colour,
                    linewidth=1.2,
                    marker="o" if len(shown) == 1 else "",
                    markersize=3,
                    label=name,
                )
        if curve.log_y and axis.has_data():
            _label_decades(axis)
        axis.set_title(curve.title, fontsize=9)
        axis.set_xlabel("step", fontsize=8)
        axis.set_ylabel(curve.y_label, fontsize=8)
        axis.tick_params(which="both", labelsize=7)
        axis.grid(linewidth=0.4, alpha=0.6)
        axis.spines[["top", "right"]].set_visible(False)
    handles, labels = axes[0].get_legend_handles_labels()
    if labels:
        figure.legend(handles, labels, loc="lower center", ncols=min(5, len(labels)), fontsize=7, frameon=False)
    return figure


def _label_decades(axis: "Axes") -> None:
    """A logarithmic vertical axis with few, short labels: those of the page's charts."""
    axis.set_yscale("log")
    low, high = (math.log10(value) for value in axis.get_ylim())
    places = ticks(low, high, True)
    axis.set_yticks([10**place for place, _ in places], [label for _, label in places])
    axis.set_yticks([], minor=True)


def label_figure(figure: "Figure", label: str) -> None:
    """Writes below a figure, which grows by a strip, why it does not show what the paper's does; nothing if empty."""
    if not label:
        return
    width, height = figure.get_size_inches()
    lines = textwrap.wrap(label, max(20, int(_LETTERS * width)))
    strip = _LINE * len(lines) + 0.1
    share, foot = height / (height + strip), strip / (height + strip)
    for axes in figure.axes:
        x, y, across, up = axes.get_position(original=True).bounds
        axes.set_position((x, foot + share * y, across, share * up))
    for text in figure.texts:
        text.set_y(foot + share * text.get_position()[1])
    for legend in figure.legends:
        legend.set_bbox_to_anchor((0.0, foot, 1.0, share), transform=figure.transFigure)
    figure.set_size_inches(width, height + strip)
    written = "\n".join(lines).replace("$", r"\$")
    figure.text(0.05 / width, foot - 0.05 / (height + strip), written, fontsize=7, color="0.35", ha="left", va="top")


def save_figure(figure: "Figure", path: Path) -> None:
    """Writes a figure in the format of the path's suffix, without time stamps: equal figures are equal files."""
    none = {"png": {"Software": None}, "pdf": {"CreationDate": None, "Producer": None, "Creator": None}}
    kind = path.suffix.lstrip(".")
    figure.savefig(path, format=kind, metadata=none.get(kind))
