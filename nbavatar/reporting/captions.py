"""Sentences under a table: protocol, sizes, devices, and where the paper does not agree with itself."""

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from nbavatar.config.tables import Panel, TableLayout
from nbavatar.methods.registry import METHODS
from nbavatar.reporting.cells import COLUMNS, Source, plain
from nbavatar.reporting.printed import deviating_marks, deviating_means

__all__ = ["describe_deviations", "describe_difference", "describe_few_steps", "describe_protocol"]
__all__ += ["describe_speeds", "describe_trainings"]

_SPLITS = {
    "novel_view": "training frames in the held-out camera",
    "self_reenactment": "held-out frames in the training cameras",
    "all": "all frames",
}
_NETS = {"alex": "AlexNet", "vgg": "VGG16"}
_FEW_STEPS = 1000  # in fewer, no method has got anywhere: which is ahead says nothing about them
_MARKS = {"best": "bold", "second": "underlined", "": "unmarked"}


def describe_protocol(panel: Panel, results: Sequence[tuple[Mapping[str, Any], Source]], lpips_net: str) -> list[str]:
    """One sentence for each protocol that the results were made under, and one with the trivial answers."""
    if not results:
        return [f"No results under protocol {panel.protocol} yet."]
    by_hash: dict[str, list[Mapping[str, Any]]] = {}
    for result, _ in results:
        by_hash.setdefault(result["protocol_hash"], []).append(result)
    sentences = []
    remark = " (the paper names no backbone)" if panel.reported else ""
    for digest, group in sorted(by_hash.items()):
        protocol = group[0]["protocol"]
        sizes = sorted({tuple(result["size"]) for result in group})
        colour, split = protocol["background"], _SPLITS.get(protocol["split"], protocol["split"])
        ground = "white" if min(colour) == 1 else "black" if max(colour) == 0 else str(colour)
        frames = sorted({f"{r['subject']} {r['count']} images, frames {r['frames']}" for r in group})
        sentences.append(
            f"Protocol {protocol['name']} ({digest}): {split}, crop {protocol['crop']}, "
            f"{', '.join(f'{w} x {h}' for w, h in sizes)} px, {ground} background, {protocol['precision']}; "
            f"LPIPS by {_NETS[lpips_net]}{remark}; {'; '.join(frames)}."
        )
    trivial = _describe_trivial([result for result, _ in results])
    return sentences + ([trivial] if trivial else [])


def _describe_trivial(results: Sequence[Mapping[str, Any]]) -> str:
    """PSNR of the trivial answers, by subject."""
    names = {"background": "background only", "mean_image": "mean training image"}
    by_subject: dict[str, str] = {}
    for result in results:
        values = [
            f"{names.get(answer, answer)} {metrics['psnr']:.2f}"
            for answer, metrics in (result.get("trivial") or {}).items()
            if metrics.get("psnr") is not None
        ]
        if values:
            by_subject.setdefault(str(result["subject"]), ", ".join(values))
    if not by_subject:
        return ""
    return "PSNR of the trivial answers: " + "; ".join(f"{s} {text}" for s, text in sorted(by_subject.items())) + "."


def describe_speeds(panel: Panel, results: Sequence[tuple[Mapping[str, Any], Source]]) -> list[str]:
    """Devices and sizes of timings."""
    if not results:
        return ["No timings yet."]
    seen = []
    for result, source in results:
        size = f", {source.size[0]} x {source.size[1]} px" if source.size else ""
        speed = result["speed"]
        count = speed.get("primitives") or speed.get("billboards")
        method = METHODS.get(speed.get("method") or "billboards")
        kind = method.primitives if method else "primitives"
        seen.append(f"{result.get('device') or 'an unknown device'}{size}" + (f", {count} {kind}" if count else ""))
    remark = " (the paper: 1024 x 1024 px, on an RTX 4090)" if panel.reported else ""
    return ["Timings reproduced on " + "; ".join(dict.fromkeys(seen)) + remark + "."]


def describe_trainings(layout: TableLayout, results: Sequence[tuple[Mapping[str, Any], Source]]) -> list[str]:
    """One sentence with the method, mode and budget of every row, where its renders say so."""
    words = []
    for row in layout.rows:
        found = [r["training"] for r, _ in results if r["variant"] == row.variant and r.get("training")]
        if not row.variant or not found:
            continue
        first = found[0]
        method = str(first.get("method") or "billboards").replace("_", " ")
        mode = f", mode {first['mode']}" if first.get("mode") else ""
        steps = sorted({int(training["steps"]) for training in found if training.get("steps") is not None})
        numbers = " to ".join(f"{n:,}" for n in dict.fromkeys((steps[0], steps[-1]))) if steps else ""
        budget = f", {numbers} {'step' if numbers == '1' else 'steps'}" if steps else ""
        words.append(f"{plain(row.label)}: {method}{mode}{budget}")
    return [f"Trained here: {'; '.join(dict.fromkeys(words))}."] if words else []


def describe_few_steps(layout: TableLayout, results: Sequence[tuple[Mapping[str, Any], Source]]) -> str:
    """A sentence for the caption where all trainings were too short to compare methods by; else empty."""
    trainings = [r["training"] for r, _ in results if r["variant"] in layout.variants and r.get("training")]
    steps = [int(training["steps"]) for training in trainings if training.get("steps") is not None]
    if not steps or max(steps) >= _FEW_STEPS or layout.kind == "cameras":
        return ""
    shown = "that every stage runs, not which method is better."
    if max(steps) == 1:
        return f"One training step ranks nothing: it shows {shown}"
    return f"{max(steps):,} training steps rank nothing: they show {shown}"


def describe_difference(label: str) -> str:
    """What a difference from printed numbers may be read as where the reproduced ones are not comparable."""
    return (
        f"Differences are between unlike things (here: {label}): they show that every printed number has its "
        "counterpart, and say nothing of how well the paper is reproduced."
    )


def describe_deviations(layout: TableLayout, panel: Panel, printed: pd.DataFrame) -> list[str]:
    """Where means and marks that are recomputed from the paper's printed cells differ from what it prints."""
    if layout.kind == "cameras" or not panel.reported:
        return []
    place = f" ({panel.title})" if panel.title else ""
    sentences = []
    means = deviating_means(printed, panel.reported, layout.subjects)
    if means:
        items = [f"{row} {COLUMNS[metric].heading} {text} (cells give {mean:f})" for row, metric, text, mean in means]
        sentences.append(f"Printed means that the printed cells do not give{place}: {'; '.join(items)}.")
    elif layout.kind == "subjects":
        sentences.append("All printed means follow from the printed cells within rounding.")
    if layout.ranked:
        marks = deviating_marks(printed, panel.reported, second=layout.second)
        items = [
            f"{row} {column.replace('.', ' ').replace(metric, COLUMNS[metric].heading)} "
            f"(paper: {_MARKS[theirs]}; digits: {_MARKS[ours]})"
            for row, column, theirs, ours in marks
            for metric in [column.rpartition(".")[2]]
        ]
        if items:
            sentences.append(f"Marks of the paper that its printed digits do not give{place}: {'; '.join(items)}.")
    return sentences
