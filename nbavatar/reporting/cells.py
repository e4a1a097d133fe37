"""Cells of a table: shown text, exact value, and where each number comes from."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

__all__ = ["COLUMNS", "MISSING", "Block", "Cell", "ColumnStyle", "PanelTable", "Source", "Table", "TableLine", "plain"]

MISSING = "—"


@dataclass(frozen=True)
class ColumnStyle:
    """How a metric is shown: heading, digits after the point, and which direction is better (None: neither)."""

    heading: str
    digits: int
    higher_is_better: bool | None


COLUMNS: Mapping[str, ColumnStyle] = {
    "psnr": ColumnStyle("PSNR", 2, True),
    "ssim": ColumnStyle("SSIM", 3, True),
    "lpips": ColumnStyle("LPIPS", 3, False),
    "psnr_fg": ColumnStyle("PSNR (foreground)", 2, True),
    "ssim_fg": ColumnStyle("SSIM (foreground)", 3, True),
    "fps": ColumnStyle("FPS", 0, True),
    "ms": ColumnStyle("Speed (ms)", 1, False),
    "memory_mb": ColumnStyle("Memory (MB)", 0, False),
    "model_mb": ColumnStyle("Model (MB)", 1, False),
    "primitives": ColumnStyle("Primitives", 0, None),
    "train_minutes": ColumnStyle("Training (min)", 1, False),
    "train_memory_mb": ColumnStyle("Training memory (MB)", 0, False),
    "train_cameras": ColumnStyle("Training Cameras", 0, None),
    "test_camera": ColumnStyle("Evaluation Cameras", 0, None),
}


@dataclass(frozen=True)
class Source:
    """Where a number comes from: file, digest of its bytes, protocol hash, image size [px]."""

    path: str
    digest: str
    protocol_hash: str = ""
    size: tuple[int, int] | None = None


@dataclass(frozen=True)
class Cell:
    """One cell; the text is ``MISSING`` where there is no number."""

    text: str = MISSING
    value: float | None = None
    mark: str = ""
    sources: tuple[Source, ...] = ()
    note: str = ""


@dataclass(frozen=True)
class TableLine:
    """One row: its label as laid out, its cells by column key, line above, shading."""

    label: str
    cells: Mapping[str, Cell]
    rule: bool = False
    shaded: bool = False


@dataclass(frozen=True)
class Block:
    """Rows of one kind: ``printed``, ``reproduced`` or ``difference``; comparable if sizes are the paper's."""

    kind: str
    title: str
    lines: Sequence[TableLine]
    comparable: bool = True


@dataclass(frozen=True)
class PanelTable:
    """One sub-table.

    Attributes:
        title: heading, may be empty.
        groups: (heading, column keys) of each group of columns; the heading is empty where there is no grouping.
        blocks: printed, reproduced, difference.
        unseen: further cells for the csv only: (block, row label, column key, cell).
    """

    title: str
    groups: Sequence[tuple[str, Sequence[str]]]
    blocks: Sequence[Block]
    unseen: Sequence[tuple[str, str, str, Cell]] = ()

    @property
    def columns(self) -> list[str]:
        """All column keys, in order."""
        return [key for _, keys in self.groups for key in keys]


@dataclass(frozen=True)
class Table:
    """A whole table, ready to be written in any format."""

    name: str
    title: str
    head: str
    label: str
    caption: str
    notes: Sequence[str]
    panels: Sequence[PanelTable]
    record: Mapping[str, Any] = field(default_factory=dict)


def plain(label: str) -> str:
    """A label without LaTeX: ``w/o $\\mathcal{L}_{NB}$`` becomes ``w/o L_NB``."""
    return re.sub(r"\\mathcal\{(\w+)\}|_\{(\w+)\}", lambda m: m.group(1) or f"_{m.group(2)}", label).replace("$", "")
