"""Heat map and error curves of the sweep, by matplotlib.

Errors are drawn as log10(error / what counts as exact): 0 is the border of exactness, in every cell. Verdicts are told
apart by letters as well as by colour; the colours are those of Okabe and Ito.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from nbavatar.reporting.extremes import format_level
from nbavatar.studies.extremes.cells import cells
from nbavatar.studies.extremes.verdict import Row, by_cell

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["curves", "heat_map"]

_COLOURS = {"degrades": "#E69F00", "refuses": "#BBBBBB", "defect": "#D55E00"}
_RESULT, _GRADIENT = "#0072B2", "#D55E00"
_FLOOR = 1e-18  # of errors in the curves
_LETTERS = {"degrades": "d", "refuses": "R", "defect": "X"}
# Exact cells run from dark blue (far below the border) to pale (at it).
_DEEPEST = -10.0


def heat_map(rows: Sequence[Row]) -> "Figure":
    """One line a cell, one square a level from harmless (left) to the limit: forward error and gradient error.

    Blue is exact, the paler the nearer to the border; orange with d degrades within its bound; grey with R refuses;
    red with X is a defect; white was not measured.
    """
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    groups = by_cell(rows)
    widest = max(len(group) for group in groups.values())
    width, height = 5.5 + 0.3 * 2 * widest, 1.6 + 0.17 * len(groups)
    figure = Figure(figsize=(width, height), dpi=130)
    figure.subplots_adjust(4.4 / width, 1.2 / height, 0.99, 1 - 0.35 / height, wspace=0.03)
    axes = figure.subplots(1, 2, sharey=True)
    tolerances = _tolerances(rows)
    for axis, field, title in ((axes[0], "forward", "result"), (axes[1], "gradient", "gradient")):
        image = np.ones((len(groups), widest, 3))
        for line, (key, group) in enumerate(groups.items()):
            for column, row in enumerate(group):
                if field == "gradient" and row.gradient is None and row.verdict in ("exact", "degrades"):
                    continue
                image[line, column] = _square(row, getattr(row, field), tolerances[key][field == "gradient"])
                letter = _letter(row, getattr(row, field), tolerances[key][field == "gradient"])
                axis.text(column, line, letter, ha="center", va="center", fontsize=5.5)
        axis.imshow(image, aspect="auto", interpolation="nearest")
        axis.set_title(f"error of the {title}", fontsize=9)
        axis.set_xlabel("level (1: harmless)", fontsize=8)
        axis.set_xticks(range(widest), [str(i + 1) for i in range(widest)], fontsize=6)
        axis.set_xticks(np.arange(widest + 1) - 0.5, minor=True)
        axis.set_yticks(np.arange(len(groups) + 1) - 0.5, minor=True)
        axis.grid(which="minor", color="white", linewidth=0.6)
        axis.tick_params(which="minor", length=0)
        axis.spines[:].set_visible(False)
        families = [family for family, _, _ in groups]
        for line in range(1, len(families)):
            if families[line] != families[line - 1]:
                axis.axhline(line - 0.5, color="black", linewidth=0.7)
    names = [f"{family} / {kernel}: {condition}" for family, kernel, condition in groups]
    axes[0].set_yticks(range(len(groups)), names, fontsize=6)
    legend = [
        Patch(color=_blue(_DEEPEST), label="exact, far below the border"),
        Patch(color=_blue(0.0), label="exact, at the border"),
        *(
            Patch(color=_COLOURS[v], label=f"{_LETTERS[v]}: {text}")
            for v, text in (
                ("degrades", "degrades within its stated bound"),
                ("refuses", "refuses, with the cause"),
                ("defect", "defect"),
            )
        ),
    ]
    figure.legend(handles=legend, loc="lower center", ncols=3, fontsize=7, frameon=False)
    return figure


def curves(rows: Sequence[Row]) -> "Figure":
    """Errors over the levels, one panel a cell in which they change; dotted: the border of exactness.

    Shown are cells with a measurement that is not exact, and those whose error grows by more than a hundred. Levels
    stand side by side at equal distances, from harmless to the limit, with their values below.
    """
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    groups = {key: group for key, group in by_cell(rows).items() if _is_curve(group)}
    across = 5
    down = max(1, -(-len(groups) // across))
    height = 2.05 * down + 0.6
    figure = Figure(figsize=(2.7 * across, height), dpi=110)
    figure.subplots_adjust(0.05, 0.75 / height, 0.99, 1 - 0.4 / height, wspace=0.42, hspace=1.05)
    panels = figure.subplots(down, across, squeeze=False).ravel()
    for panel in panels[len(groups) :]:
        panel.axis("off")
    tolerances = _tolerances(rows)
    for panel, (key, group) in zip(panels, groups.items(), strict=False):
        _panel(panel, group, tolerances[key])
    legend = [
        Line2D([], [], color=_RESULT, marker="o", markersize=3, label="error of the result"),
        Line2D([], [], color=_GRADIENT, marker="s", markersize=3, linestyle="--", label="error of the gradient"),
        Line2D([], [], color="black", linestyle=":", label="border of exactness (in the colour of its curve)"),
        Line2D([], [], color="black", marker="x", linestyle="", label="refused"),
        Line2D([], [], color=_COLOURS["defect"], marker="X", linestyle="", label="defect"),
    ]
    figure.legend(handles=legend, loc="lower center", ncols=5, fontsize=8, frameon=False)
    return figure


def _panel(axis: "Axes", group: Sequence[Row], border: tuple[float, float]) -> None:
    for values, style, colour, dotted in (
        ([row.forward for row in group], "o-", _RESULT, border[0]),
        ([row.gradient for row in group], "s--", _GRADIENT, border[1]),
    ):
        shown = [(place, max(y, _FLOOR)) for place, y in enumerate(values) if y is not None]
        if shown:
            places, errors = zip(*shown, strict=True)
            axis.plot(places, errors, style, color=colour, linewidth=1, markersize=3)
            axis.axhline(max(dotted, _FLOOR), color=colour, linewidth=0.8, linestyle=":")
    for verdict, marker, colour in (("refuses", "x", "black"), ("defect", "X", _COLOURS["defect"])):
        places = [place for place, row in enumerate(group) if row.verdict == verdict]
        axis.plot(places, [1.0] * len(places), marker, color=colour, markersize=4)
    axis.set_yscale("log")
    axis.set_ylim(_FLOOR, 1e2)
    axis.set_yticks([1e-15, 1e-10, 1e-5, 1.0])
    axis.minorticks_off()
    first = group[0]
    axis.set_xlim(-0.4, len(group) - 0.6)
    axis.set_xticks(
        range(len(group)), [format_level(row.level) for row in group], rotation=45, ha="right", rotation_mode="anchor"
    )
    axis.set_title(f"{first.family}: {first.kernel}\n{first.condition}", fontsize=7)
    axis.set_xlabel(first.axis, fontsize=6.5)
    axis.set_ylabel(f"error [{first.unit}]", fontsize=6.5)
    axis.tick_params(labelsize=5.5)
    axis.grid(linewidth=0.3, alpha=0.6)
    axis.spines[["top", "right"]].set_visible(False)


def _is_curve(group: Sequence[Row]) -> bool:
    if len(group) < 3 or any(isinstance(row.level, str) for row in group):
        return False
    if any(row.verdict != "exact" for row in group):
        return any(row.forward is not None for row in group)
    for values in ([row.forward for row in group], [row.gradient for row in group]):
        known = [value for value in values if value]
        if known and max(known) > 100 * min(known) and max(known) > 1e-12:
            return True
    return False


def _tolerances(rows: Sequence[Row]) -> dict[tuple[str, str, str], tuple[float, float]]:
    families = tuple(dict.fromkeys(row.family for row in rows))
    return {
        (cell.family, cell.kernel, cell.condition): (cell.exact.forward, cell.exact.gradient)
        for cell in cells(families)
    }


def _square(row: Row, error: float | None, border: float) -> tuple[float, float, float]:
    from matplotlib.colors import to_rgb

    letter = _letter(row, error, border)
    if letter:
        verdict = next(name for name, sign in _LETTERS.items() if sign == letter)
        return to_rgb(_COLOURS[verdict])
    if error is None or error <= 0 or border <= 0:
        return _blue(_DEEPEST)
    return _blue(math.log10(error / border))


def _letter(row: Row, error: float | None, border: float) -> str:
    """Sign of a verdict in one of the two panels: a level may degrade in its gradient only."""
    if row.verdict in ("refuses", "defect"):
        return _LETTERS[row.verdict]
    return "d" if row.verdict == "degrades" and error is not None and error > border else ""


def _blue(depth: float) -> tuple[float, float, float]:
    """From #0072B2 at ten decades below the border to a pale blue at it."""
    share = min(max(1 + depth / -_DEEPEST, 0.0), 1.0)
    dark, pale = np.array([0, 0x72, 0xB2]) / 255, np.array([0xDD, 0xEE, 0xF8]) / 255
    red, green, blue = dark + share * (pale - dark)
    return float(red), float(green), float(blue)
