"""Builds the paper's tables: printed numbers, reproduced numbers, and their difference.

Every table has the paper's rows and columns, up to three times: as printed, as reproduced, and the difference of the
two (reproduced - printed, of the digits shown). A result whose images are not of the paper's size is shown under a
heading that says so and is never subtracted from a printed number. Means are recomputed from the numbers of the
subjects, and are missing unless every subject is there.

All cells of a table are one data frame (``nbavatar.reporting.cells.Table``). Each names the number that it shows by
subject, variant, protocol and metric; numbers of no single subject, that is means and timings, have the subject ``""``.
"""
# pyright: reportArgumentType=false, reportReturnType=false
# The stubs of pandas take a column for a table and know one kind of key.

import math
from collections.abc import Sequence
from dataclasses import replace
from decimal import Decimal

import pandas as pd

from nbavatar.config.tables import TIMED, TRAINED, Panel, TableLayout, TableRow
from nbavatar.reporting.captions import (
    describe_deviations,
    describe_difference,
    describe_few_steps,
    describe_protocol,
    describe_speeds,
    describe_trainings,
)
from nbavatar.reporting.cells import PanelTable, Source, Table, style_of, to_text
from nbavatar.reporting.ranks import rank_marks
from nbavatar.reporting.results import Result, tidy_results

__all__ = ["build_table"]

_NUMBER = ["subject", "variant", "protocol", "metric"]
_EXTRA = ("psnr_fg", "ssim_fg", "lpips_alex", "lpips_vgg")
_TRIVIAL = ("psnr", "psnr_fg", "ssim")


def build_table(
    name: str,
    layout: TableLayout,
    printed: pd.DataFrame,
    results: Sequence[Result],
    *,
    printed_source: Source,
    lpips_net: str = "vgg",
    size_label: str = "",
    difference: str = "comparable",
) -> Table:
    """One table of the paper.

    Args:
        name: its name.
        layout: rows, columns, panels.
        printed: result of ``read_printed``.
        results: content and source of each evaluation and timing.
        printed_source: file and digest of the printed numbers.
        lpips_net: backbone shown in the LPIPS columns.
        size_label: if not empty, nothing reproduced is comparable with the paper, and this is the reason.
        difference: `size` for the difference from printed numbers wherever images are of the paper's size.

    Raises:
        DataError: two results answer for the same cell.
    """
    numbers = tidy_results(results, images=False)
    sources = {source.path: (source,) for _, source in results}
    numbers = numbers.assign(sources=numbers["source"].map(sources), note="")
    if layout.subjects == ["*"]:  # every subject that there is a result for
        shown = numbers["variant"].isin(layout.variants) & numbers["protocol"].isin(layout.protocols)
        layout = replace(layout, subjects=sorted(numbers["subject"][shown].unique()))
    panels, blocks, notes = [], [], []
    for i, panel in enumerate(layout.panels):
        table = PanelTable(panel.title, _groups(layout))
        grid = _grid(layout, panel, table.columns, numbers, lpips_net)
        found = _reproduced(layout, grid, numbers, results)
        if panel.reported:
            own = [_printed(layout, panel, grid, printed, printed_source)]
            sizes = _other_sizes(layout, found)
            reasons = size_label or sizes
            if reasons:
                remark = f"{reasons}; not comparable with the paper"
                own.append(found.assign(heading=f"Reproduced ({remark})", comparable=False))
                notes.append(f"Reproduced numbers: {remark}.")
            else:
                own.append(found.assign(heading="Reproduced", comparable=True))
            if not reasons or (difference == "size" and not sizes):
                apart = _difference(layout, *own)
                own += [apart] if any(apart["text"]) else []
                notes += [describe_difference(size_label)] if reasons and any(apart["text"]) else []
        else:
            own = [found.assign(heading=size_label or "Results", comparable=False)]
        own.append(_unseen(layout, panel, numbers).assign(comparable=all(block["comparable"].all() for block in own)))
        panels.append(table)
        blocks += [block.assign(panel=i) for block in own]
        notes += _notes(layout, panel, printed, results, lpips_net)
    cells = pd.concat(blocks, ignore_index=True)
    notes = tuple(dict.fromkeys(notes))
    caption = " ".join(filter(None, (_caption(layout), describe_few_steps(layout, results))))
    return Table(name, layout.title, layout.head, layout.label, caption, notes, panels, cells)


def _caption(layout: TableLayout) -> str:
    words = [layout.caption.strip()]
    if layout.ranked and layout.second:
        words.append("Best in bold, second best underlined, within each block; equal digits share a mark.")
    elif layout.ranked:
        words.append("Best in bold, within each block.")
    return " ".join(words)


def _notes(
    layout: TableLayout, panel: Panel, printed: pd.DataFrame, results: Sequence[Result], lpips_net: str
) -> list[str]:
    notes = describe_deviations(layout, panel, printed)
    if layout.speeds:
        timed = [r for r in results if "metrics" not in r[0] and str(r[0]["variant"]) in layout.speeds]
        notes += describe_speeds(panel, timed)
    if layout.kind in ("subjects", "mean", "subject"):
        judged = [r for r in results if "metrics" in r[0] and str(r[0]["variant"]) in layout.variants]
        judged = [r for r in judged if r[0]["protocol"]["name"] == panel.protocol]
        notes += [*describe_protocol(panel, judged, lpips_net), *describe_trainings(layout, judged)]
    return notes


def _groups(layout: TableLayout) -> list[tuple[str, list[str]]]:
    if layout.kind == "subjects":
        return [
            (heading, [f"{subject}.{metric}" for metric in layout.columns])
            for subject, heading in [*((s, s) for s in layout.subjects), ("mean", "Mean")]
        ]
    prefix = {"mean": "mean.", "subject": f"{layout.subjects[0]}." if layout.subjects else ""}.get(layout.kind, "")
    return [("", [f"{prefix}{metric}" for metric in layout.columns])]


def _grid(
    layout: TableLayout, panel: Panel, columns: Sequence[str], numbers: pd.DataFrame, lpips_net: str
) -> pd.DataFrame:
    """All cells of a panel, with what tells the number of each; without text.

    Where the table shows means only, rows of single subjects follow (``alone``): a mean is missing until all are there.
    """
    lines = [(row, "") for row in layout.rows]
    if layout.kind == "mean":
        known = set(zip(numbers["subject"], numbers["variant"], numbers["protocol"], strict=True))
        lines += [(r, s) for r in layout.rows for s in layout.subjects if (s, r.variant, panel.protocol) in known]
    cells = [
        {
            "line": line,
            "label": f"{row.label}, {alone} alone" if alone else row.label,
            "rule": row.rule and not alone,
            "shaded": row.shaded and not alone,
            "alone": alone,
            "row": row.reported_id,
            "column": column,
            **dict(zip(_NUMBER, _number(layout, panel, row, column, alone, lpips_net), strict=True)),
        }
        for line, (row, alone) in enumerate(lines)
        for column in columns
    ]
    return pd.DataFrame(cells).assign(shown=True, mark="")


def _number(
    layout: TableLayout, panel: Panel, row: TableRow, column: str, alone: str, lpips_net: str
) -> tuple[str, str, str, str]:
    """Subject, variant, protocol and metric of the number that a cell shows."""
    subject, _, metric = column.rpartition(".")
    if layout.kind == "cameras":
        return row.stage, row.variant, panel.protocol, metric
    if (layout.kind == "speed" or metric in TIMED) and not alone:
        stage = "" if metric == "memory_mb" else f".{row.stage or 'total_fp32'}"
        return "", row.variant, "", f"{metric}{stage}"
    metric = f"lpips_{lpips_net}" if metric == "lpips" else metric
    return alone or ("" if subject == "mean" else subject), row.variant, panel.protocol, metric


def _reproduced(
    layout: TableLayout, grid: pd.DataFrame, numbers: pd.DataFrame, results: Sequence[Result]
) -> pd.DataFrame:
    if layout.kind == "cameras":
        known = _cameras(results)
    else:
        subject = layout.subjects[0] if layout.kind == "subject" else ""
        known = pd.concat([numbers[numbers["protocol"] != ""], _means(numbers, layout.subjects)])
        known = pd.concat([known, _timings(numbers, subject)])[[*_NUMBER, "value", "sources", "note"]]
    cells = grid[grid["variant"] != ""].merge(known.drop_duplicates(_NUMBER), on=_NUMBER, how="left")
    if layout.kind != "cameras":
        cells["text"] = [
            "" if math.isnan(v) else to_text(c, v) for c, v in zip(cells["column"], cells["value"], strict=True)
        ]
    single = cells["alone"] != ""
    cells["note"] = cells["note"].where(~single, cells["alone"]).where(cells["text"] != "", "")
    return _completed(_ranked(cells[~single], layout), cells[single]).assign(block="reproduced")


def _means(numbers: pd.DataFrame, subjects: Sequence[str]) -> pd.DataFrame:
    """Means over all subjects, summed exactly, so that their order does not matter."""
    kept = numbers[numbers["subject"].isin(list(subjects)) & (numbers["protocol"] != "")]
    kept = kept[~kept["metric"].isin(TRAINED)]
    kept = kept.sort_values("subject", key=lambda names: names.map(list(subjects).index), kind="stable")
    means = kept.groupby(["variant", "protocol", "metric"], sort=False).agg(
        value=("value", lambda values: math.fsum(values) / len(values)),
        count=("value", "size"),
        sources=("sources", lambda sources: sum(sources, ())),
    )
    return means[means["count"] == len(subjects)].reset_index().assign(subject="", note="")


def _timings(numbers: pd.DataFrame, subject: str) -> pd.DataFrame:
    """One timing a variant, of a subject if it has one, else of the first that has.

    A stage that ends in ``half`` is fp16 where that was timed, else bf16. Frames per second are of the times.
    """
    timed = numbers[numbers["protocol"] == ""]
    timed = timed.sort_values("subject", key=lambda names: names != subject, kind="stable")
    timed = timed[timed["subject"] == timed.groupby("variant")["subject"].transform("first")]
    stages = timed[timed["metric"].str.startswith("ms.")]
    stages = stages.assign(note=stages["metric"].str.removeprefix("ms."))
    halves = stages[stages["metric"].str.endswith(("_fp16", "_bf16"))]
    halves = halves.sort_values("metric", key=lambda names: names.str[-4:], ascending=False, kind="stable")
    stages = pd.concat([stages, halves.assign(metric=halves["metric"].str[:-4] + "half")])
    rates = stages.assign(value=1000.0 / stages["value"], metric=stages["metric"].str.replace("ms.", "fps.", n=1))
    return pd.concat([timed[timed["metric"] == "memory_mb"], stages, rates]).assign(subject="")


def _cameras(results: Sequence[Result]) -> pd.DataFrame:
    rows = [
        (content["subject"], content["variant"], content["protocol"]["name"], metric, ", ".join(content[key]), source)
        for content, source in results
        for metric, key in (("train_cameras", "train_cameras"), ("test_camera", "cameras"))
        if "metrics" in content and content.get(key)
    ]
    cells = pd.DataFrame(rows, columns=[*_NUMBER, "text", "sources"], dtype=object)
    return cells.assign(sources=[(replace(s, size=None),) for s in cells["sources"]], note="", value=math.nan)


def _printed(
    layout: TableLayout, panel: Panel, grid: pd.DataFrame, printed: pd.DataFrame, source: Source
) -> pd.DataFrame:
    own = printed[printed["table"] == panel.reported][["row", "column", "value", "note"]]
    cells = grid[(grid["row"] != "") & (grid["alone"] == "")].merge(own, on=["row", "column"], how="left")
    cells = cells.rename(columns={"value": "text"}).fillna({"text": ""})
    cells["value"] = pd.to_numeric(cells["text"], errors="coerce")
    cells["sources"] = [(source,) if text else () for text in cells["text"]]
    cells = _completed(_ranked(cells, layout))
    return cells.assign(block="printed", heading="Printed in the paper", comparable=True)


def _difference(layout: TableLayout, printed: pd.DataFrame, reproduced: pd.DataFrame) -> pd.DataFrame:
    reference = printed.drop_duplicates(["label", "column"], keep="last")[["label", "column", "text", "sources"]]
    cells = reproduced.merge(reference, on=["label", "column"], how="left", suffixes=("", "_printed"))
    both = [bool(text) and bool(other) for text, other in zip(cells["text"], cells["text_printed"].fillna(""))]
    texts = zip(cells["column"], cells["text"], cells["text_printed"], both, strict=True)
    cells["text"] = [_subtracted(*three) if there else "" for *three, there in texts]
    cells["value"] = pd.to_numeric(cells["text"], errors="coerce")
    pairs = zip(cells["sources"], cells["sources_printed"], both, strict=True)
    cells["sources"] = [(*own, *other) if there else () for own, other, there in pairs]
    word = "Comparison" if layout.kind == "cameras" else "Difference, reproduced - printed"
    return cells.assign(block="difference", heading=word, mark="", note="")


def _subtracted(column: str, text: str, printed: str) -> str:
    """Reproduced - printed, of the digits shown; of cameras, whether they are the same."""
    if style_of(column).higher_is_better is None:
        return "same" if set(text.split(", ")) == set(printed.split(", ")) else "differs"
    difference = Decimal(text) - Decimal(printed)
    digits = max(len(number.partition(".")[2]) for number in (text, printed))
    return f"{difference:+.{digits}f}" if difference else f"{abs(difference):.{digits}f}"


def _other_sizes(layout: TableLayout, cells: pd.DataFrame) -> str:
    """Sizes of the reproduced images that are not the paper's, in words; empty if there is none."""
    sizes = {source.size for sources in cells["sources"] for source in sources}
    other = sorted(size for size in sizes - {(layout.size, layout.size)} if size is not None)
    return "size " + ", ".join(f"{w} x {h} px" for w, h in other) if other else ""


def _ranked(cells: pd.DataFrame, layout: TableLayout) -> pd.DataFrame:
    if not layout.ranked:
        return cells
    cells = cells.copy()
    for column, texts in cells.groupby("column")["text"]:
        higher = style_of(column).higher_is_better
        if higher is not None:
            cells.loc[texts.index, "mark"] = rank_marks(texts, higher_is_better=higher, second=layout.second)
    return cells


def _completed(*parts: pd.DataFrame) -> pd.DataFrame:
    """Parts as one, with no source and no remark where there is no number."""
    cells = pd.concat(parts, ignore_index=True)
    sources = [sources if isinstance(sources, tuple) else () for sources in cells["sources"]]
    return cells.assign(sources=sources, note=cells["note"].fillna(""), text=cells["text"].fillna(""))


def _unseen(layout: TableLayout, panel: Panel, numbers: pd.DataFrame) -> pd.DataFrame:
    """What the csv has beyond the table: foreground metrics, every LPIPS net, the trivial answers."""
    own = numbers[numbers["protocol"] == panel.protocol] if panel.protocol else numbers[:0]
    trivial = [m for m in own["metric"].unique() if "." in m and m.rpartition(".")[2] in _TRIVIAL]
    grid = pd.DataFrame(
        [
            (i, row.label, row.variant, subject, metric)
            for i, row in enumerate(layout.rows)
            for subject in layout.subjects
            for metric in (*_EXTRA, *trivial)
        ],
        columns=["line", "label", "variant", "subject", "metric"],
        dtype=object,
    )
    cells = grid.merge(own, on=["variant", "subject", "metric"])
    cells = cells.assign(column=[f"{s}.{m}" for s, m in zip(cells["subject"], cells["metric"], strict=True)])
    cells["text"] = [to_text(metric, value) for metric, value in zip(cells["metric"], cells["value"], strict=True)]
    return cells.assign(block="reproduced", mark="", heading="", rule=False, shaded=False, shown=False)
