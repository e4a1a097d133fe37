"""Builds the paper's tables: printed numbers, reproduced numbers, and their difference.

Every table has the paper's rows and columns, up to three times: as printed, as reproduced, and the difference of the
two (reproduced - printed, of the digits shown). A result whose images are not of the paper's size is shown under a
heading that says so and is never subtracted from a printed number. Means are recomputed from the cells of the
subjects, and are missing unless every subject is there.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from decimal import Decimal
from typing import Any

from nbavatar.config.tables import TIMED, TRAINED, Panel, TableLayout, TableRow
from nbavatar.errors import DataError
from nbavatar.reporting.captions import (
    describe_deviations,
    describe_protocol,
    describe_speeds,
    describe_trainings,
)
from nbavatar.reporting.cells import COLUMNS, MISSING, Block, Cell, PanelTable, Source, Table, TableLine
from nbavatar.reporting.printed import Printed
from nbavatar.reporting.ranks import rank_marks

__all__ = ["Result", "build_table", "index_results"]

Result = tuple[Mapping[str, Any], Source]
PrintedCells = Mapping[tuple[str, str, str], Printed]
_EXTRA = ("psnr_fg", "ssim_fg", "lpips_alex", "lpips_vgg")


def index_results(results: Sequence[Result]) -> dict[tuple[str, str, str], Result]:
    """Evaluations by (subject, variant, protocol), timings by (subject, variant, "").

    Args:
        results: content and source of each file; each content has its ``subject`` and ``variant``.

    Raises:
        DataError: two results answer for the same cell, or a file is of another kind.
    """
    index: dict[tuple[str, str, str], Result] = {}
    for result, source in results:
        if "metrics" not in result and "ms" not in result.get("speed", {}):
            raise DataError.of(
                source.path, expected="a result of nbavatar evaluate or speed", found="another JSON file"
            )
        protocol = result["protocol"]["name"] if "metrics" in result else ""
        key = (str(result["subject"]), str(result["variant"]), protocol)
        if key in index:
            other = index[key][1].path
            raise DataError.of(source.path, expected="one result a cell", found=f"the same cell in {other}")
        index[key] = (result, source)
    return index


def build_table(
    name: str,
    layout: TableLayout,
    printed: PrintedCells,
    results: Mapping[tuple[str, str, str], Result],
    *,
    printed_source: Source,
    lpips_net: str = "vgg",
    size_label: str = "",
) -> Table:
    """One table of the paper.

    Args:
        name: its name.
        layout: rows, columns, panels.
        printed: result of ``read_printed``.
        results: result of ``index_results``.
        printed_source: file and digest of the printed numbers.
        lpips_net: backbone shown in the LPIPS columns.
        size_label: if not empty, nothing reproduced is comparable with the paper, and this is the reason.
    """
    layout = _with_subjects(layout, results)
    panels = []
    notes: list[str] = []
    for panel in layout.panels:
        groups = _groups(layout)
        columns = [key for _, keys in groups for key in keys]
        found = _ranked(_reproduced(layout, panel, columns, results, lpips_net), layout)
        found += _single_subjects(layout, panel, results, lpips_net) if layout.kind == "mean" else []
        if panel.reported:
            blocks = [_printed_block(layout, panel, columns, printed, printed_source)]
            reasons = _reasons(layout, found, size_label)
            if reasons:
                remark = f"{'; '.join(reasons)}; not comparable with the paper"
                blocks.append(Block("reproduced", f"Reproduced ({remark})", found, comparable=False))
                notes.append(f"Reproduced numbers: {remark}.")
            else:
                blocks.append(Block("reproduced", "Reproduced", found))
                difference = _difference_block(layout, *blocks)
                if any(line.cells for line in difference.lines):
                    blocks.append(difference)
        else:
            blocks = [Block("reproduced", size_label or "Results", found, comparable=False)]
        unseen = _unseen(layout, panel, results)
        panels.append(PanelTable(panel.title, groups, blocks, unseen))
        notes.extend(describe_deviations(layout, panel, printed))
        used = [results[k] for k in results if k[2] == panel.protocol and k[1] in layout.variants]
        if layout.kind == "speed" or layout.speeds:
            notes.extend(describe_speeds(panel, [results[k] for k in results if k[2] == "" and k[1] in layout.speeds]))
        if layout.kind in ("subjects", "mean", "subject"):
            notes.extend(describe_protocol(panel, used, lpips_net))
            notes.extend(describe_trainings(layout, used))
    return Table(name, layout.title, layout.head, layout.label, _caption(layout), tuple(dict.fromkeys(notes)), panels)


def _with_subjects(layout: TableLayout, results: Mapping[tuple[str, str, str], Result]) -> TableLayout:
    """Resolves the subject ``*``: every subject that the table has a result for."""
    if layout.subjects != ["*"]:
        return layout
    found = sorted(
        {s for s, variant, protocol in results if variant in layout.variants and protocol in layout.protocols}
    )
    return replace(layout, subjects=found)


def _caption(layout: TableLayout) -> str:
    words = [layout.caption.strip()]
    if layout.ranked and layout.second:
        words.append("Best in bold, second best underlined, within each block; equal digits share a mark.")
    elif layout.ranked:
        words.append("Best in bold, within each block.")
    return " ".join(words)


def _groups(layout: TableLayout) -> list[tuple[str, list[str]]]:
    if layout.kind == "subjects":
        return [
            (heading, [f"{subject}.{metric}" for metric in layout.columns])
            for subject, heading in [*((s, s) for s in layout.subjects), ("mean", "Mean")]
        ]
    prefix = {"mean": "mean.", "subject": f"{layout.subjects[0]}." if layout.subjects else ""}.get(layout.kind, "")
    return [("", [f"{prefix}{metric}" for metric in layout.columns])]


def _metric(column: str) -> str:
    return column.rpartition(".")[2]


def _printed_block(
    layout: TableLayout, panel: Panel, columns: Sequence[str], printed: PrintedCells, source: Source
) -> Block:
    lines = []
    for row in layout.rows:
        cells = {}
        for column in columns:
            cell = printed.get((panel.reported, row.reported_id, column)) if row.reported_id else None
            if cell is not None:
                value = _float(cell.text)
                cells[column] = Cell(cell.text, value, sources=(source,), note=cell.note)
        if cells or row.reported_id:
            lines.append(TableLine(row.label, cells, row.rule, row.shaded))
    return Block("printed", "Printed in the paper", _ranked(lines, layout))


def _reproduced(
    layout: TableLayout,
    panel: Panel,
    columns: Sequence[str],
    results: Mapping[tuple[str, str, str], Result],
    lpips_net: str,
) -> list[TableLine]:
    lines = []
    for row in layout.rows:
        if not row.variant:
            continue
        cells = {}
        for column in columns:
            cell = _reproduced_cell(layout, panel, row, column, results, lpips_net)
            if cell is not None:
                cells[column] = cell
        lines.append(TableLine(row.label, cells, row.rule, row.shaded))
    return lines


def _single_subjects(
    layout: TableLayout, panel: Panel, results: Mapping[tuple[str, str, str], Result], lpips_net: str
) -> list[TableLine]:
    """Rows of single subjects below their mean, which is missing until all of them are there."""
    lines = []
    for row in layout.rows:
        for subject in layout.subjects:
            result = results.get((subject, row.variant, panel.protocol))
            if result is None:
                continue
            cells = {}
            for metric in layout.columns:
                value = result[0]["metrics"].get(_key(metric, lpips_net))
                if value is not None:
                    cells[f"mean.{metric}"] = Cell(_text(metric, value), value, sources=(result[1],), note=subject)
            lines.append(TableLine(f"{row.label}, {subject} alone", cells))
    return lines


def _reproduced_cell(
    layout: TableLayout,
    panel: Panel,
    row: TableRow,
    column: str,
    results: Mapping[tuple[str, str, str], Result],
    lpips_net: str,
) -> Cell | None:
    subject, _, metric = column.rpartition(".")
    if layout.kind == "cameras":
        return _camera_cell(results.get((row.stage, row.variant, panel.protocol)), metric)
    if layout.kind == "speed" or metric in TIMED:
        stage = row.stage or "total_fp32"
        timings = [value for key, value in results.items() if key[1] == row.variant and key[2] == ""]
        if layout.kind == "subject":
            timings = [value for value in timings if value[0]["subject"] == layout.subjects[0]] or timings
        return _speed_cell(timings[0], stage, metric) if timings else None
    if metric in TRAINED:
        return _trained_cell(results.get((subject, row.variant, panel.protocol)), metric)
    if subject == "mean":
        return _mean_cell(layout, panel, row, metric, results, lpips_net)
    result = results.get((subject, row.variant, panel.protocol))
    if result is None:
        return None
    value = result[0]["metrics"].get(_key(metric, lpips_net))
    return None if value is None else Cell(_text(metric, value), value, sources=(result[1],))


def _mean_cell(
    layout: TableLayout,
    panel: Panel,
    row: TableRow,
    metric: str,
    results: Mapping[tuple[str, str, str], Result],
    lpips_net: str,
) -> Cell | None:
    found = [results.get((subject, row.variant, panel.protocol)) for subject in layout.subjects]
    present = [result for result in found if result is not None]
    values = [result[0]["metrics"].get(_key(metric, lpips_net)) for result in present]
    numbers = [value for value in values if value is not None]
    if not numbers or len(numbers) < len(layout.subjects):
        return None
    value = math.fsum(numbers) / len(numbers)
    return Cell(_text(metric, value), value, sources=tuple(source for _, source in present))


def _speed_cell(result: Result, stage: str, column: str) -> Cell | None:
    """One timing; the stage ``renderer_half`` is fp16 where it was timed, else bf16."""
    if column == "memory_mb":
        memory = result[0]["speed"].get("peak_memory_mb")
        return Cell(_text(column, float(memory)), float(memory), sources=(result[1],)) if memory else None
    times = result[0]["speed"]["ms"]
    names = [stage.replace("half", precision) for precision in ("fp16", "bf16")] if stage.endswith("half") else [stage]
    name = next((name for name in names if times.get(name)), None)
    if name is None:
        return None
    value = float(times[name]) if column == "ms" else 1000.0 / float(times[name])
    return Cell(_text(column, value), value, sources=(result[1],), note=name)


def _trained_cell(result: Result | None, column: str) -> Cell | None:
    """What a training cost, from the record that its renders carry."""
    training = (result[0].get("training") or {}) if result is not None else {}
    key, unit = {
        "model_mb": ("model_bytes", 1e6),
        "primitives": ("primitives", 1.0),
        "train_minutes": ("train_seconds", 60.0),
        "train_memory_mb": ("peak_memory_mb", 1.0),
    }[column]
    if result is None or training.get(key) is None:
        return None
    value = float(training[key]) / unit
    return Cell(_text(column, value), value, sources=(result[1],))


def _camera_cell(result: Result | None, column: str) -> Cell | None:
    if result is None:
        return None
    cameras = result[0].get("train_cameras" if column == "train_cameras" else "cameras") or []
    return Cell(", ".join(cameras), sources=(replace(result[1], size=None),)) if cameras else None


def _difference_block(layout: TableLayout, printed: Block, reproduced: Block) -> Block:
    lines = []
    by_label = {line.label: line for line in printed.lines}
    for line in reproduced.lines:
        other = by_label.get(line.label)
        cells = {}
        for column, cell in line.cells.items():
            reference = other.cells.get(column) if other else None
            if reference is None:
                continue
            cells[column] = _difference(_metric(column), cell, reference)
        lines.append(TableLine(line.label, cells, line.rule, line.shaded))
    word = "Comparison" if layout.kind == "cameras" else "Difference, reproduced - printed"
    return Block("difference", word, lines)


def _difference(metric: str, cell: Cell, reference: Cell) -> Cell:
    sources = (*cell.sources, *reference.sources)
    if COLUMNS[metric].higher_is_better is None:
        same = set(cell.text.split(", ")) == set(reference.text.split(", "))
        return Cell("same" if same else "differs", sources=sources)
    difference = Decimal(cell.text) - Decimal(reference.text)
    digits = max(_decimals(cell.text), _decimals(reference.text))
    text = f"{difference:+.{digits}f}" if difference else f"{abs(difference):.{digits}f}"
    return Cell(text, float(difference), sources=sources)


def _decimals(text: str) -> int:
    return len(text.partition(".")[2])


def _reasons(layout: TableLayout, lines: Sequence[TableLine], size_label: str) -> list[str]:
    """Why reproduced numbers are not comparable with the paper's; empty if they are."""
    if size_label:
        return [size_label]
    paper = (layout.size, layout.size)
    sizes = {source.size for line in lines for cell in line.cells.values() for source in cell.sources}
    other = sorted(size for size in sizes if size is not None and size != paper)
    return ["size " + ", ".join(f"{w} x {h} px" for w, h in other)] if other else []


def _ranked(lines: Sequence[TableLine], layout: TableLayout) -> list[TableLine]:
    if not layout.ranked:
        return list(lines)
    columns = list(dict.fromkeys(column for line in lines for column in line.cells))
    result = [dict(line.cells) for line in lines]
    for column in columns:
        higher = COLUMNS[_metric(column)].higher_is_better
        if higher is None:
            continue
        texts = [line.cells[column].text if column in line.cells else MISSING for line in lines]
        marks = rank_marks(texts, higher_is_better=higher, second=layout.second)
        for cells, mark in zip(result, marks, strict=True):
            if column in cells:
                cells[column] = replace(cells[column], mark=mark)
    return [replace(line, cells=cells) for line, cells in zip(lines, result, strict=True)]


def _unseen(
    layout: TableLayout, panel: Panel, results: Mapping[tuple[str, str, str], Result]
) -> list[tuple[str, str, str, Cell]]:
    """What the csv carries beyond the table: foreground metrics, every LPIPS net, the trivial answers."""
    found = []
    for row in layout.rows:
        for subject in layout.subjects:
            result = results.get((subject, row.variant, panel.protocol))
            if result is None or not panel.protocol:
                continue
            values = {key: result[0]["metrics"].get(key) for key in _EXTRA}
            for answer, metrics in (result[0].get("trivial") or {}).items():
                values |= {f"{answer}.{metric}": metrics.get(metric) for metric in ("psnr", "psnr_fg", "ssim")}
            for key, value in values.items():
                if value is not None:
                    cell = Cell(_text(key.rpartition(".")[2], value), value, sources=(result[1],))
                    found.append(("reproduced", row.label, f"{subject}.{key}", cell))
    return found


def _key(metric: str, lpips_net: str) -> str:
    return f"lpips_{lpips_net}" if metric == "lpips" else metric


def _text(metric: str, value: float) -> str:
    style = COLUMNS["lpips" if metric.startswith("lpips") else metric]
    digits = style.digits
    if metric == "fps" and value < 10:
        digits = 2 if value < 1 else 1
    return f"{value:.{digits}f}"


def _float(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
