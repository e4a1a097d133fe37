"""JSON records."""

import json
import os
from pathlib import Path
from typing import Any

from nbavatar.errors import DataError
from nbavatar.io.atomic import atomic_write

__all__ = ["canonical_json", "read_json", "write_json"]


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
    try:
        return json.loads(Path(path).read_text(encoding="utf-8-sig"))
    except FileNotFoundError as error:
        raise DataError.of(path, expected="a JSON file", found="no such file") from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise DataError.of(path, expected="JSON", found=f"text that does not parse ({error})") from error
