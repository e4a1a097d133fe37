"""The reference page of all options, made from the dataclasses. Standard library only."""

import dataclasses
import json
import typing
from typing import Any

from nbavatar.config.core import json_schema, to_mapping
from nbavatar.config.detection import DetectConfig
from nbavatar.config.evaluation import ProtocolConfig
from nbavatar.config.preprocess import CropConfig
from nbavatar.config.run import RunConfig, Stages, Variant
from nbavatar.config.tables import Panel, TableLayout, TableRow

__all__ = ["reference_page", "run_schema"]

_HEADER = """# Configuration

<!-- Made by `nbavatar schema`; edit the dataclasses in nbavatar/config instead. -->

A run is one YAML file: `paper.yaml`, `smoke.yaml`, `capture.yaml`, or one of your own, given with
`snakemake --configfile FILE`. It lists only what differs from the defaults below. Unknown keys, wrong types and values
out of range stop the run before the first job.

Beside it stand sheets, tab-separated, in which every id is text: `subjects.tsv` (subject, training cameras, test
camera) and `runs.tsv` (subject, variant, protocol: one line for each number to produce; subject `*` means all).
`tables.yaml` lays the tables out, `reported.csv` holds what the paper printed.

Mind YAML: quote ids that look like numbers.
"""


def run_schema() -> dict[str, Any]:
    """JSON schema of a run's configuration file."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "NBAvatar run",
        **json_schema(RunConfig),
    }


def reference_page() -> str:
    """Markdown page with every option of every stage, its default, range and meaning."""
    parts = [_HEADER, _section("A run", RunConfig, skip=("stages",))]
    parts.append(_section("`crops.<name>`", CropConfig))
    parts.append(_section("`protocols.<name>`", ProtocolConfig))
    parts.append(_section("`variants.<name>`", Variant))
    hints = typing.get_type_hints(Stages)
    for field in dataclasses.fields(Stages):
        parts.append(_section(f"`stages.{field.name}`", hints[field.name], note=field.metadata["doc"]))
    parts.append(
        _section(
            "`nbavatar detect --cfg`", DetectConfig, note="Keypoints for captures that bring none; no rule runs it."
        )
    )
    parts.append("# Layout of the tables (`tables.yaml`)\n")
    for title, cls in (("`<table>`", TableLayout), ("`<table>.panels[]`", Panel), ("`<table>.rows[]`", TableRow)):
        parts.append(_section(title, cls))
    return "\n".join(parts)


def _section(title: str, cls: type, *, skip: tuple[str, ...] = (), note: str = "") -> str:
    lines = [f"## {title}", ""]
    if note:
        lines += [note, ""]
    lines += ["| key | default | allowed | meaning |", "|---|---|---|---|", *_rows(cls, "", skip), ""]
    return "\n".join(lines)


def _rows(cls: type, prefix: str, skip: tuple[str, ...]) -> list[str]:
    hints = typing.get_type_hints(cls)
    rows: list[str] = []
    for field in dataclasses.fields(cls):
        if field.name in skip:
            continue
        if dataclasses.is_dataclass(hints[field.name]):
            rows += _rows(hints[field.name], f"{prefix}{field.name}.", skip)
            continue
        default = field.default if field.default is not dataclasses.MISSING else None
        if field.default_factory is not dataclasses.MISSING:
            default = field.default_factory()
        text = json.dumps(to_mapping(default), ensure_ascii=False)
        doc = field.metadata.get("doc", "").replace("|", "\\|")
        doc = doc[:1].upper() + doc[1:]
        rows.append(f"| `{prefix}{field.name}` | `{text}` | {_allowed(hints[field.name], field.metadata)} | {doc} |")
    return rows


def _allowed(hint: Any, metadata: typing.Mapping[str, Any]) -> str:
    if metadata.get("choices"):
        return ", ".join(f"`{choice}`" for choice in metadata["choices"])
    low, high = metadata.get("min"), metadata.get("max")
    name = getattr(hint, "__name__", str(hint)) if not typing.get_args(hint) else str(hint)
    name = name.replace("|", "\\|").replace("nbavatar.config.", "").replace("typing.", "")
    bounds = " and ".join(
        f"{word} {limit:g}" for word, limit in (("at least", low), ("at most", high)) if limit is not None
    )
    return f"{name}, {bounds}" if bounds else name
