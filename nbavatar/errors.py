"""Errors that a user can act on.

Every one of them is caught at the edge of the command line and printed as one
line, with exit code 2 and no traceback. Anything else that escapes is a defect
of ours and keeps its traceback.
"""
# provenance: neutral, because it words what goes wrong.

import contextlib
import errno
import importlib
import os
import reprlib
import stat
from collections.abc import Iterable, Iterator
from difflib import get_close_matches
from types import ModuleType
from typing import Any, Self

from nbavatar.packages import remedy

__all__ = [
    "ConfigError",
    "DataError",
    "DependencyError",
    "DeviceError",
    "NBAvatarError",
    "StorageError",
    "describe",
    "did_you_mean",
    "limit_of",
    "parsing",
    "require",
]


_LONGEST = 1000  # characters of a line


class NBAvatarError(Exception):
    """Base of all errors whose cause lies outside the program.

    Names and values in the text come from files: what a terminal would obey instead of showing is written out, and all
    is one line, cut in the middle where it is long beyond all measure.
    """

    def __init__(self, text: str = "") -> None:
        line = " ".join(text.splitlines())
        line = line if len(line) <= _LONGEST else f"{line[:600]} ... {line[-300:]}"
        super().__init__("".join(c if c.isprintable() else ascii(c)[1:-1] for c in line))

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


@contextlib.contextmanager
def parsing(
    where: object,
    expected: str,
    *,
    field: str = "",
    damaged: str = "a damaged one",
    fix: str = "",
    error: type[NBAvatarError] = DataError,
) -> Iterator[None]:
    """Translates whatever is raised while a file is opened and parsed into the one line that names it.

    Parsers raise nearly anything on damaged content, from `zlib.error` to `RecursionError`, so no list of kinds would
    be complete. The block should hold the parsing and nothing else: a defect of ours inside it would be told as the
    file's.

    Args:
        where: the file.
        expected: what it should be.
        field: part of the file that is parsed.
        damaged: what to call a file that does not parse; the parser's own words follow in brackets.
        fix: what the user should do.
        error: class of the error.

    Raises:
        NBAvatarError: of the class `error`; one that the block raises itself passes unchanged.
    """
    kind = _special(where)
    if kind:
        raise error.of(where, field, expected=expected, found=f"{kind}, which is never read", fix="remove it")
    try:
        yield
    except (NBAvatarError, NameError, ImportError):  # ours to mend, or a package that is missing
        raise
    except FileNotFoundError as cause:
        raise error.of(where, field, expected=expected, found="no such file") from cause
    except Exception as cause:
        found = f"{damaged} ({_reason(cause)})"
        if isinstance(cause, OSError) and cause.strerror:
            found = f"one that cannot be read: {cause.strerror}"
            fix = limit_of(cause) or fix
        elif _is_pointer(where):
            found, fix = "a pointer of Git LFS in its place", "fetch the file itself with: git lfs pull"
        raise error.of(where, field, expected=expected, found=found, fix=fix) from cause


def limit_of(error: OSError) -> str:
    """What to do about an error that a limit of the process explains; empty where none does."""
    many = error.errno in (errno.EMFILE, errno.ENFILE)  # packs of all cameras of a stage are open at a time
    return "raise the limit of open files (ulimit -n)" if many else ""


def _special(where: object) -> str:
    """What is there instead of a file: a pipe, which would be waited for, or a device, which may have no end.

    What is named as one, as shells do with `<(...)`, is meant.
    """
    path = str(where)
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        return ""
    if stat.S_ISREG(mode) or stat.S_ISDIR(mode) or path.startswith(("/dev/", "/proc/")):
        return ""
    return "a pipe" if stat.S_ISFIFO(mode) else "a device or socket"


def _is_pointer(where: object) -> bool:
    """Whether a file is what Git leaves in place of a large one that was not fetched."""
    try:
        with open(str(where), "rb") as stream:
            return stream.read(24) == b"version https://git-lfs."
    except (OSError, ValueError):
        return False


def _reason(cause: Exception) -> str:
    """Why a parser gave up, in one short line."""
    if isinstance(cause, KeyError):
        return f"no entry {describe(cause.args[0])}" if cause.args else "an entry is missing"
    if isinstance(cause, RecursionError):
        return "it is nested too deeply"
    if isinstance(cause, MemoryError):
        return "it asks for more memory than there is"
    text = " ".join(str(cause).split())
    return text if 0 < len(text) <= 200 else text[:197] + "..." if text else type(cause).__name__


class StorageError(NBAvatarError):
    """There is no room for a result: the disk is full, a quota is used up, a file grew beyond a limit."""


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Returns a hint such as `did you mean 'steps'?`, or the list of known words."""
    names = sorted(map(str, known))
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
            f"package '{package}' cannot be imported ({reason}); it is needed for {why}; {remedy(module)}"
        ) from error


def describe(value: Any) -> str:
    """Short text of a value for error lines; a value that refers to its parts many times over stays short too."""
    try:
        text = _REPR.repr(value)
    except (ValueError, RecursionError):  # a whole number of thousands of digits, for one
        text = f"a {type(value).__name__} that cannot be shown"
    return text if len(text) <= 80 else text[:77] + "..."


# A few hundred bytes of YAML or pickle may stand for a value whose whole text would never end.
_REPR = reprlib.Repr()
_REPR.maxlevel = 4
_REPR.maxstring = _REPR.maxother = _REPR.maxlong = 160
_REPR.maxlist = _REPR.maxtuple = _REPR.maxdict = _REPR.maxset = _REPR.maxfrozenset = 12
