"""Folders and files that belong to this user alone, on machines that several people use.

In a folder such as `/tmp` anybody can put a folder, or a symbolic link, under the name that we are about to use. What
is read from there may be code (Numba unpickles its index), and what is written through a link lands in somebody's
file. So a place is used only if nobody else could have prepared it. Standard library only.
"""
# provenance: neutral, because it says where files may lie.

import contextlib
import os
import stat
import tempfile
from pathlib import Path

from nbavatar.errors import DataError
from nbavatar.imports import ROOT

__all__ = ["cache_places", "open_private", "private_folder"]

_MOST_LINKS = 40  # as many as Linux follows in one path
_WRITABLE_BY_OTHERS = stat.S_IWGRP | stat.S_IWOTH


def cache_places() -> list[Path]:
    """Where to keep what can be made again, best first: the package, the user's cache, temporary files.

    None of them is checked or made: that is `private_folder`'s.
    """
    places = [ROOT / "__pycache__"]
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    if os.path.isabs(home):  # without a home directory the name stays as it is
        places.append(Path(home) / "nbavatar")
    with contextlib.suppress(FileNotFoundError):  # no folder for temporary files is writable
        places.append(Path(tempfile.gettempdir()) / f"nbavatar-{os.getuid()}")
    return places


def private_folder(path: str | os.PathLike[str]) -> Path:
    """Makes a folder of this user's own (mode 0700, missing parents too), or checks the one that is there.

    Every folder above must belong to this user or to the system, and be closed to the writing of others unless it is
    sticky, as `/tmp` is; links on the way count by their owner. The folder itself must be no link, this user's, and
    closed to the writing of others.

    Raises:
        DataError: somebody else could have put it there, or could change it.
        OSError: it cannot be made.
    """
    folder = Path(os.path.abspath(path))
    _check_way(folder)
    for missing in [parent for parent in [*reversed(folder.parents), folder] if not os.path.lexists(parent)]:
        with contextlib.suppress(FileExistsError):  # another process was faster; what it made is checked below
            os.mkdir(missing, 0o700)
    _check_way(folder)
    info = os.lstat(folder)
    if stat.S_ISLNK(info.st_mode):
        raise _unsafe(folder, "a link")
    if not stat.S_ISDIR(info.st_mode):
        raise _unsafe(folder, "a file")
    if info.st_uid != os.geteuid():
        raise _unsafe(folder, f"one of user {info.st_uid}")
    if info.st_mode & _WRITABLE_BY_OTHERS:
        raise _unsafe(folder, f"one that others may write to (mode {stat.S_IMODE(info.st_mode):04o})")
    return folder


def open_private(path: str | os.PathLike[str]) -> int:
    """Opens a file for reading and writing, making it (mode 0600) when missing; links are not followed, nothing is cut.

    Returns:
        The descriptor; the caller closes it.

    Raises:
        DataError: a link, something other than a file, or somebody else's file is there.
        OSError: it cannot be opened.
    """
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK, 0o600)
    except OSError:
        if os.path.islink(path):
            raise _unsafe(path, "a link", "a file") from None
        raise
    info = os.fstat(descriptor)
    if stat.S_ISREG(info.st_mode) and info.st_uid == os.geteuid():
        return descriptor
    os.close(descriptor)
    found = f"one of user {info.st_uid}" if stat.S_ISREG(info.st_mode) else "something else"
    raise _unsafe(path, found, "a file")


def _check_way(folder: Path) -> None:
    """Checks all folders above one, as far as they exist, and the links on the way."""
    # Whoever owns the root of the file system owns the rest: root, or, in a container of a plain user, nobody.
    trusted = {0, os.geteuid(), os.lstat("/").st_uid}
    here, left, links = Path("/"), list(folder.parts[1:-1]), 0
    while True:
        try:
            info = os.lstat(here)
        except FileNotFoundError:
            return
        if info.st_uid not in trusted:
            raise _unsafe(folder, f"{here} of user {info.st_uid} above it")
        if stat.S_ISLNK(info.st_mode):
            links += 1
            if links > _MOST_LINKS:
                raise _unsafe(folder, f"a chain of links at {here}")
            left = [*os.readlink(here).split(os.sep), *left]
            here = Path("/") if not left[0] else here.parent
        elif info.st_mode & _WRITABLE_BY_OTHERS and not info.st_mode & stat.S_ISVTX:
            raise _unsafe(folder, f"{here} above it, that others may write to")
        while left and left[0] in ("", ".", ".."):
            here = here.parent if left.pop(0) == ".." else here
        if not left:
            return
        here = here / left.pop(0)


def _unsafe(path: str | os.PathLike[str], found: str, kind: str = "a folder") -> DataError:
    return DataError.of(path, expected=f"{kind} of yours that nobody else may write to", found=found,
                        fix="remove it, or name another place")  # fmt: skip
