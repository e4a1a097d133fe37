"""JSON records."""

import json
import os
from pathlib import Path
from typing import Any

from nbavatar.errors import parsing
from nbavatar.io.atomic import atomic_write
from nbavatar.io.forms import check_form

__all__ = ["canonical_json", "read_json", "read_record", "write_json"]


def canonical_json(value: Any) -> str:
    """One line, sorted keys: equal values give equal text, fit for digests."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def write_json(path: str | os.PathLike[str], value: Any) -> None:
    """Writes sorted, indented JSON; NaN and infinities are refused (they are not JSON)."""
    text = json.dumps(value, sort_keys=True, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def read_json(path: str | os.PathLike[str]) -> Any:
    """Reads JSON; a byte-order mark is skipped.

    Raises:
        DataError: the file is missing or is not JSON.
    """
    with parsing(path, "JSON", damaged="text that does not parse"):
        return json.loads(Path(path).read_text(encoding="utf-8-sig"))


def read_record(path: str | os.PathLike[str], form: Any) -> Any:
    """Reads JSON that has a form (`nbavatar.io.forms`).

    Raises:
        DataError: the file is missing, is not JSON, or looks different; the key is named.
    """
    value = read_json(path)
    check_form(value, form, path)
    return value
