"""What a table is made of: how metrics are shown, where numbers come from, and the table itself."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["COLUMNS", "MISSING", "ColumnStyle", "PanelTable", "Source", "Table", "plain", "style_of", "to_text"]

MISSING = "—"


@dataclass(frozen=True)
class ColumnStyle:
    """How a metric is shown: heading, digits after the point, which direction is better (None: neither), unit."""

    heading: str
    digits: int
    higher_is_better: bool | None
    unit: str = "1"


COLUMNS: Mapping[str, ColumnStyle] = {
    "psnr": ColumnStyle("PSNR", 2, True, "dB"),
    "ssim": ColumnStyle("SSIM", 3, True),
    "lpips": ColumnStyle("LPIPS", 3, False),
    "psnr_fg": ColumnStyle("PSNR (foreground)", 2, True, "dB"),
    "ssim_fg": ColumnStyle("SSIM (foreground)", 3, True),
    "fps": ColumnStyle("FPS", 0, True, "1/s"),
    "ms": ColumnStyle("Speed (ms)", 1, False, "ms"),
    "memory_mb": ColumnStyle("Memory (MB)", 0, False, "MB"),
    "model_mb": ColumnStyle("Model (MB)", 1, False, "MB"),
    "primitives": ColumnStyle("Primitives", 0, None),
    "train_minutes": ColumnStyle("Training (min)", 1, False, "min"),
    "train_memory_mb": ColumnStyle("Training memory (MB)", 0, False, "MB"),
    "train_cameras": ColumnStyle("Training Cameras", 0, None),
    "test_camera": ColumnStyle("Evaluation Cameras", 0, None),
}
_OTHER = ColumnStyle("", 3, None)


def style_of(column: str) -> ColumnStyle:
    """Style of a column or metric: ``S1.psnr``, ``background.psnr``, ``lpips_vgg`` and ``ms.raster`` are known too."""
    first, last = column.partition(".")[0], column.rpartition(".")[2]
    name = first if first in ("ms", "fps") else "lpips" if last.startswith("lpips") else last
    return COLUMNS.get(name, _OTHER)


def to_text(column: str, value: float) -> str:
    """A number in the digits that its column shows; frames per second get one digit more below 10, and below 1."""
    digits = style_of(column).digits
    if style_of(column) is COLUMNS["fps"] and value < 10:
        digits = 2 if value < 1 else 1
    return f"{value:.{digits}f}"


@dataclass(frozen=True)
class Source:
    """Where a number comes from: file, digest of its bytes, protocol hash, image size [px]."""

    path: str
    digest: str
    protocol_hash: str = ""
    size: tuple[int, int] | None = None


@dataclass(frozen=True)
class PanelTable:
    """Headings of one sub-table.

    Attributes:
        title: heading, may be empty.
        groups: (heading, column keys) of each group of columns; the heading is empty where there is no grouping.
    """

    title: str
    groups: Sequence[tuple[str, Sequence[str]]]

    @property
    def columns(self) -> list[str]:
        """All column keys, in order."""
        return [key for _, keys in self.groups for key in keys]


@dataclass(frozen=True)
class Table:
    """A whole table, ready to be written in any format.

    Attributes:
        name, title, head, label, caption, notes: its words; ``head`` is the heading of the first column.
        panels: its sub-tables.
        cells: one row a cell, in the order of panels, blocks, lines and columns:

            panel       number of the panel
            block       printed, reproduced or difference
            heading     heading of the block
            line        number of the line within the layout
            label       label of the line, as laid out
            rule        whether a line is drawn above
            shaded      whether the line is shaded
            column      key of the column
            text        what is shown; empty where there is no number
            value       the number, NaN where there is none
            mark        best, second or nothing
            sources     tuple of ``Source``
            note        remark
            comparable  whether sizes are the paper's
            shown       whether the cell is shown, or is in the csv only

        record: run record.
    """

    name: str
    title: str
    head: str
    label: str
    caption: str
    notes: Sequence[str]
    panels: Sequence[PanelTable]
    cells: "pd.DataFrame"
    record: Mapping[str, Any] = field(default_factory=dict)


def plain(label: str) -> str:
    """A label without LaTeX: ``w/o $\\mathcal{L}_{NB}$`` becomes ``w/o L_NB``."""
    return re.sub(r"\\mathcal\{(\w+)\}|_\{(\w+)\}", lambda m: m.group(1) or f"_{m.group(2)}", label).replace("$", "")
