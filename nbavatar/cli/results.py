"""Results of other verbs, read for tables, figures and reports: each must have its form (`nbavatar.io.forms`)."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nbavatar.errors import DataError, parsing
from nbavatar.io.forms import check_form
from nbavatar.io.records import read_json, read_record
from nbavatar.names import check_name
from nbavatar.provenance import file_digest
from nbavatar.reporting.cells import Source

__all__ = ["read_evaluation", "read_histories", "read_results", "read_sweep", "read_timing"]

_SIZE = (Ellipsis, 2, int)
_VALUES = {str: (float, None)}
_TRAINING = {
    "steps?": (int, None),
    "method?": (str, None),
    "mode?": (str, None),
    "primitives?": (int, None),
    "model_bytes?": (int, None),
    "train_seconds?": (float, None),
    "peak_memory_mb?": (float, None),
}
_RECORD = {
    "config?": object,
    "git?": (None, {"commit?": (str, None), "dirty?": (bool, None)}),
    "device?": (str, None),
    "code?": (str, None),
}
_EVALUATION = {
    "subject": str,
    "variant": str,
    "protocol": {"name": str},
    "protocol_hash": str,
    "size?": _SIZE,
    "metrics": _VALUES,
    "per_image": [{"camera": str, "frame": str}],
    "trivial?": (None, {str: _VALUES}),
    "training?": (None, _TRAINING),
    "cameras?": (None, [str]),
    "train_cameras?": (None, [str]),
    "record?": (None, _RECORD),
}
# What the caption of a table says beside the numbers.
_CAPTIONED = _EVALUATION | {
    "protocol": {"name": str, "split": str, "crop": str, "background": (Ellipsis, 3, float), "precision": str},
    "size": _SIZE,
    "count": int,
    "frames": str,
}
_TIMING = {
    "speed": {
        "ms": {str: (float, None)},
        "size?": _SIZE,
        "primitives?": (int, None),
        "billboards?": (int, None),
        "method?": (str, None),
        "model_mb?": (float, None),
        "peak_memory_mb?": (float, None),
        "train_peak_memory_mb?": (float, None),
        "train_seconds?": (float, None),
        "model_bytes?": (int, None),
    },
    **_RECORD,
}
_SWEEPS: dict[str, dict[str, Any]] = {
    "tradeoff": {
        "device": str,
        "size": _SIZE,
        "frames?": _SIZE,
        "images": int,
        "complete": bool,
        "presets": {str: {"label": str, "why": str}},
        "paragraphs": {str: str},
    },
    "savings": {"rows": [{"saving": str, "scene": str, "faster": float}]},
    "offline": {
        "rows": [{"stage": str, "knob": str, "meaning": str, "value": float, "error_mm": float, "ms": float}],
    },
}


def read_evaluation(path: str) -> dict[str, Any]:
    """A result of `nbavatar evaluate`.

    Raises:
        DataError: missing, or of another form.
    """
    return _named(read_record(path, _EVALUATION), path)


def read_timing(path: str) -> dict[str, Any]:
    """A result of `nbavatar speed`.

    Raises:
        DataError: missing, or of another form.
    """
    return read_record(path, _TIMING)


def read_results(paths: Sequence[str]) -> list[tuple[dict[str, Any], Source]]:
    """Results of `nbavatar evaluate` and of `nbavatar speed`, each with its source.

    A timing does not say whose it is; its place, `<subject>/<variant>.json`, does.

    Raises:
        DataError: missing, or of another form.
    """
    results = []
    for path in paths:
        content = read_json(path)
        if not isinstance(content, dict) or not {"metrics", "speed"} & set(content):
            raise DataError.of(path, expected="a result of nbavatar evaluate or speed", found="another JSON file")
        check_form(content, _CAPTIONED if "metrics" in content else _TIMING, path)
        if "metrics" in content:
            values = {f"{name}?": (float, None) for name in content["metrics"]}
            check_form(content["per_image"], [values], path, "per_image")
            _named(content, path)
        content = {"subject": Path(path).parent.name, "variant": Path(path).stem} | content
        size = content.get("size") or content.get("speed", {}).get("size")
        pixels = (int(size[0]), int(size[1])) if size else None
        results.append((content, Source(path, file_digest(path), content.get("protocol_hash", ""), pixels)))
    return results


def _named(evaluation: dict[str, Any], path: object) -> dict[str, Any]:
    """The same evaluation, if the names in it are names: they become parts of tables, pages and LaTeX."""
    for field, name in (
        ("subject", evaluation["subject"]),
        ("variant", evaluation["variant"]),
        ("protocol.name", evaluation["protocol"]["name"]),
    ):
        check_name(name, path, field, error=DataError)
    return evaluation


def read_sweep(path: Path) -> tuple[str, dict[str, Any]]:
    """A result of `nbavatar tradeoff`, and its kind: `tradeoff`, `savings` or `offline`.

    Raises:
        DataError: missing, or of another form.
    """
    content = read_json(path)
    kind = content.get("kind") if isinstance(content, dict) else None
    if not isinstance(kind, str) or kind not in _SWEEPS:
        raise DataError.of(path, "kind", expected=f"one of {', '.join(_SWEEPS)}", found=repr(kind)[:60])
    check_form(content, _SWEEPS[kind], path)
    if kind == "savings" and not content["rows"]:
        raise DataError.of(path, "rows", expected="one row or more", found="none")
    return kind, content


def read_histories(paths: list[str]) -> dict[str, list[dict[str, Any]]]:
    """Logged lines of trainings by avatar, named by the last two folders of the file.

    Raises:
        DataError: missing, or a line that is no record of a step.
    """
    histories: dict[str, list[dict[str, Any]]] = {}
    for name in paths:
        avatar = "/".join(Path(name).parts[-3:-1])
        if avatar in histories:
            raise DataError.of(name, expected="one history an avatar", found=f"{avatar} twice")
        with parsing(name, "a training history (.jsonl)", damaged="text that does not parse"):
            lines = Path(name).read_text(encoding="utf-8").splitlines()
            histories[avatar] = [json.loads(line) for line in lines if line.strip()]
        check_form(histories[avatar], [{"step": int}], name, "lines")
    return histories
