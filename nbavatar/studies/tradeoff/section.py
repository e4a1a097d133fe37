"""What a report shows of a sweep: its presets, a paragraph a knob, the table, the fronts."""

from collections.abc import Mapping
from typing import Any, NamedTuple

__all__ = ["Section", "offline_section", "savings_section", "tradeoff_section"]


class Section(NamedTuple):
    """Part of a report.

    Attributes:
        title: its heading.
        paragraphs: text with `code` in backquotes and **bold** words.
        table: markdown.
        figures: names of pictures (.png, beside the result), in order, with captions.
    """

    title: str
    paragraphs: list[str]
    table: str
    figures: list[tuple[str, str]]


def tradeoff_section(result: Mapping[str, Any], table: str) -> Section:
    """Section of a sweep.

    Args:
        result: content of `tradeoff.json`.
        table: text of `points.md`.
    """
    where = f"{result['device']}, {result['size'][0]}x{result['size'][1]} px, {result['images']} held-out images"
    if result.get("frames", result["size"]) != result["size"]:
        where += f", which are {result['frames'][0]}x{result['frames'][1]} px, as are the pictures that they judge"
    presets = [f"**{name}**: {entry['label']}. {entry['why']}." for name, entry in result["presets"].items()]
    figures = [
        ("front_ms.png", f"Quality against time of a picture; {where}."),
        ("front_memory.png", "Quality against peak memory."),
        ("front_bytes.png", "Quality against the size of the avatar."),
    ]
    state = [] if result["complete"] else ["The sweep was stopped early: the points below are those it reached."]
    # The file's table follows its caption.
    rows = table[table.index("|") :] if "|" in table else table
    return Section("Speed against quality", [*state, *presets, *result["paragraphs"].values()], rows, figures)


def savings_section(result: Mapping[str, Any], table: str) -> Section:
    """Section of the savings; `savings.json` and `savings.md`."""
    largest = max(result["rows"], key=lambda row: row["faster"])
    text = (
        f"Every saving on and off, in a scene in which it matters. The largest: {largest['saving']} "
        f"({largest['scene']}), {largest['faster']:.1f}x."
    )
    return Section("Only what a scene requires", [text], table, [])


def offline_section(result: Mapping[str, Any], table: str) -> Section:
    """Section of the stages before training; `offline.json` and `offline.md`."""
    paragraphs = []
    groups: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for row in result["rows"]:
        groups.setdefault((row["stage"], row["knob"]), []).append(row)
    for (stage, knob), rows in groups.items():
        steps = ", ".join(f"{row['value']:g}: {row['error_mm']:.2f} mm in {row['ms']:.0f} ms" for row in rows)
        paragraphs.append(f"{stage.capitalize()}, {knob} ({rows[0]['meaning']}): {steps}.")
    if result.get("lacking"):
        paragraphs.append(f"Coarser meshes were not measured: {result['lacking']}.")
    figures = [("offline.png", "Error of the stages before training against their time, by knob.")]
    return Section("Stages before training", paragraphs, table, figures)
