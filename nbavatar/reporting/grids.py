"""Grids of pictures for print: columns of methods, rows of views, insets and error maps.

Everything lies on one pair of axes at places computed in inches, so a grid costs its pictures and little more (a pair
of axes a picture, laid out by matplotlib, costs twenty times that), and nothing is ever cut off at the rim.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from nbavatar.reporting.pictures import RAMP, reduce_picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["GridRow", "grid_figure"]

_CELL, _GAP, _LEFT, _TOP, _RIM = 1.45, 0.05, 0.42, 0.30, 0.06
_BAR = 0.85
# Pictures up to this side are shown pixel by pixel; larger ones are reduced to it, which is 350 dpi in a cell.
_SHARP, _LARGE = 128, 512


@dataclass(frozen=True)
class GridRow:
    """One row.

    Attributes:
        name: at its left.
        pictures: uint8 [H, W, 3] or [H, W], one a column; None leaves the place empty.
        window: part of every picture to frame, (x0, y0, x1, y1) as shares of its sides; None for no frame.
        space: more room above this row: a new subject begins.
        notes: a short line in the lower left corner of each picture; may be shorter than the row.
    """

    name: str
    pictures: Sequence[np.ndarray | None]
    window: tuple[float, float, float, float] | None = None
    space: bool = False
    notes: Sequence[str] = field(default_factory=tuple)


def grid_figure(columns: Sequence[str], rows: Sequence[GridRow], *, bar: tuple[str, float] | None = None) -> "Figure":
    """A grid of pictures.

    Args:
        columns: headings; too long ones are broken into lines.
        rows: from top to bottom.
        bar: (quantity with unit, its largest value) of the colour bar beside the last row; None for none.
    """
    import textwrap

    from matplotlib.figure import Figure

    heights = [_CELL * _aspect(row) for row in rows]
    tops, y = [], _RIM + _TOP
    for row, height in zip(rows, heights, strict=True):
        y += 0.12 if row.space else 0.0
        tops.append(y)
        y += height + _GAP
    width = _LEFT + len(columns) * (_CELL + _GAP) + (_BAR if bar else 0.0) + _RIM
    figure = Figure(figsize=(width, y + _RIM), dpi=200)
    # Otherwise vector formats would melt all pictures into one of the figure's resolution.
    figure.suppressComposite = True
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0, width), ylim=(y + _RIM, 0))
    axes.axis("off")
    for number, heading in enumerate(columns):
        x = _LEFT + number * (_CELL + _GAP) + _CELL / 2
        lines = textwrap.wrap(heading, 20)[:2]
        # By line from the baseline: a descender in one heading would lift it above the others.
        for up, line in enumerate(reversed(lines)):
            axes.text(x, _RIM + _TOP - 0.08 - 0.115 * up, line, ha="center", va="baseline", fontsize=8)
    for row, top, height in zip(rows, tops, heights, strict=True):
        axes.text(_LEFT - 0.08, top + height / 2, row.name, rotation=90, ha="right", va="center", fontsize=8)
        for number, picture in enumerate(row.pictures):
            if picture is not None:
                note = row.notes[number] if number < len(row.notes) else ""
                _place(axes, picture, _LEFT + number * (_CELL + _GAP), top, _CELL, height, row.window, note)
    if bar and rows:
        _colour_bar(axes, *bar, width - _BAR + 0.1, tops[-1], heights[-1])
    return figure


def _aspect(row: GridRow) -> float:
    shapes = [picture.shape[:2] for picture in row.pictures if picture is not None]
    return shapes[0][0] / shapes[0][1] if shapes else 1.0


def _place(
    axes: "Axes",
    picture: np.ndarray,
    x: float,
    y: float,
    width: float,
    height: float,
    window: tuple[float, float, float, float] | None,
    note: str,
) -> None:
    from matplotlib.patches import Rectangle

    sharp = max(picture.shape[:2]) <= _SHARP
    shown = picture if sharp else reduce_picture(picture, _LARGE)
    if shown.ndim == 2:
        shown = np.repeat(shown[..., None], 3, axis=-1)
    axes.imshow(
        shown,
        extent=(x, x + width, y + height, y),
        aspect="auto",
        interpolation="none" if sharp else "antialiased",
        origin="upper",
    )
    axes.add_patch(Rectangle((x, y), width, height, fill=False, edgecolor="#999999", linewidth=0.6))
    if window is not None:
        x0, y0, x1, y1 = window
        place = (x + x0 * width, y + y0 * height)
        axes.add_patch(
            Rectangle(place, (x1 - x0) * width, (y1 - y0) * height, fill=False, edgecolor="#d55e00", linewidth=1.0)
        )
    if note:
        box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0}
        axes.text(x + 0.04, y + height - 0.04, note, fontsize=6, va="bottom", ha="left", bbox=box)


def _colour_bar(axes: "Axes", quantity: str, largest: float, x: float, y: float, height: float) -> None:
    """The ramp of error maps and displacements, with its scale."""
    from matplotlib.patches import Rectangle

    anchors = np.linspace(0, 1, len(RAMP))
    position = np.linspace(1, 0, 256)
    table = np.asarray(RAMP, dtype=np.float32)
    colours = np.stack([np.interp(position, anchors, table[:, c]) for c in range(3)], -1)[:, None]
    axes.imshow(
        np.round(colours).astype(np.uint8), extent=(x, x + 0.1, y + height, y), aspect="auto", interpolation="none"
    )
    axes.add_patch(Rectangle((x, y), 0.1, height, fill=False, edgecolor="#444444", linewidth=0.5))
    for share in (0.0, 0.5, 1.0):
        place = y + height * (1 - share)
        axes.text(x + 0.14, place, f"{share * largest:g}", fontsize=6, va="center")
    axes.text(x + 0.52, y + height / 2, quantity, fontsize=6, rotation=90, va="center", ha="center")
