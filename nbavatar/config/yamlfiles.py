"""YAML files of people: parsed, and refused where they stand for more than they say.

YAML lets a value refer to others by name. A few hundred bytes can so stand for a value that refers to itself, or to its
parts so many times that nobody can print it.
"""

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nbavatar.errors import ConfigError, parsing

__all__ = ["check_numbers", "check_tree", "parse_yaml", "read_yaml"]

_MAX_ENTRIES = 1_000_000
_MAX_DIGITS = 1_000
_DIGITS = re.compile(r"[0-9_:.]{100,}")


def read_yaml(path: str | os.PathLike[str], expected: str) -> Any:
    """Reads a YAML file; a byte-order mark is skipped.

    Args:
        path: the file.
        expected: what it should be, for error lines.

    Raises:
        ConfigError: missing, not YAML, an empty key, or values that refer to one another without end.
    """
    with parsing(path, expected, damaged="text that does not parse", error=ConfigError):
        text = Path(path).read_text(encoding="utf-8-sig")
    return parse_yaml(text, path)


def parse_yaml(text: str, where: object) -> Any:
    """Parses YAML; `where` is named in errors, which are those of `read_yaml`."""
    import yaml

    with parsing(where, "YAML", damaged="text that does not parse", error=ConfigError):
        check_numbers(text)
        value = yaml.safe_load(text)
    check_tree(value, where)
    return value


def check_numbers(text: str) -> None:
    """Refuses numbers of thousands of digits, which take ages to read: to the base of 60, too.

    Raises:
        ValueError: there is one.
    """
    longest = max(map(len, _DIGITS.findall(text)), default=0)
    if longest > _MAX_DIGITS:
        raise ValueError(f"a number of {longest} characters")


def check_tree(value: Any, where: object) -> None:
    """Checks a value of YAML: no empty keys, and no more entries than a file of people has, shared ones counted again.

    Raises:
        ConfigError: one line that names the place.
    """
    with parsing(where, "YAML", damaged="a structure that cannot be followed", error=ConfigError):
        _entries(value, where, {})


def _entries(value: Any, where: object, known: dict[int, int | None]) -> int:
    """How many entries a value stands for."""
    if not isinstance(value, (Mapping, list, tuple, set)):
        return 1
    if id(value) in known:
        count = known[id(value)]
        if count is None:
            raise ConfigError.of(where, expected="values that end", found="one that holds itself")
        return count
    known[id(value)] = None
    total = 1
    for key, item in value.items() if isinstance(value, Mapping) else ((0, item) for item in value):
        if key is None:
            fix = "a name was forgotten, or is null or ~; write it in quotes if it is meant"
            raise ConfigError.of(where, expected="a name before every ':'", found="an empty key", fix=fix)
        total += _entries(item, where, known)
    if total > _MAX_ENTRIES:
        raise ConfigError.of(where, expected="values that end", found="ones that refer to one another without end")
    known[id(value)] = total
    return total
