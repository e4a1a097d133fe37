"""Errors that a user can act on.

Every one of them is caught at the edge of the command line and printed as one
line, with exit code 2 and no traceback. Anything else that escapes is a defect
of ours and keeps its traceback.
"""

import importlib
from collections.abc import Iterable
from difflib import get_close_matches
from types import ModuleType
from typing import Any, Self

__all__ = [
    "ConfigError",
    "DataError",
    "DependencyError",
    "DeviceError",
    "NBAvatarError",
    "describe",
    "did_you_mean",
    "require",
]


class NBAvatarError(Exception):
    """Base of all errors whose cause lies outside the program."""

    @classmethod
    def of(cls, where: object, field: str = "", *, expected: object, found: object, fix: str = "") -> Self:
        """Builds the one line: which file, which field, expected, found, what to do.

        Args:
            where: file or other place that holds the offending value.
            field: name of the value inside `where`; empty for the file as a whole.
            expected: what would have been right.
            found: what is there.
            fix: what the user should do; empty where it is evident.
        """
        place = f"{where}: {field}" if field else f"{where}"
        line = f"{place}: expected {expected}, found {found}"
        return cls(" ".join(f"{line}; {fix}".split()) if fix else " ".join(line.split()))


class ConfigError(NBAvatarError):
    """A configuration value is unknown, of the wrong type or out of range."""


class DataError(NBAvatarError):
    """An input file is missing, damaged or disagrees with another one."""


class DependencyError(NBAvatarError):
    """An optional package, or a file that a package should carry, is missing."""


class DeviceError(NBAvatarError):
    """The device that was asked for is not there or too small."""


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Returns a hint such as `did you mean 'steps'?`, or the list of known words."""
    names = sorted(known)
    near = get_close_matches(word, names, n=1)
    return f"did you mean '{near[0]}'?" if near else f"known: {', '.join(names)}"


def require(module: str, package: str, why: str) -> ModuleType:
    """Imports a package that only some stages need.

    Args:
        module: name to import, such as `cv2`.
        package: name to install, such as `opencv-contrib-python-headless`.
        why: what it is needed for, as the end of "needed for ...".

    Raises:
        DependencyError: one line that names the package and why the import failed.
    """
    try:
        return importlib.import_module(module)
    except (ImportError, OSError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise DependencyError(
            f"package '{package}' cannot be imported ({reason}); it is needed for {why}; "
            f"install it with: python -m pip install {package}"
        ) from error


def describe(value: Any) -> str:
    """Short text of a value for error lines."""
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."
