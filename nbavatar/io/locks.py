"""One process at a time writes to a folder.

The lock is the system's: it is freed however its holder ends. Some network disks have none; there the file says by
number which process of which machine holds it, which is judged by whether that process is alive. Of a process of
another machine nothing can be known: it is taken to be gone, with a warning, because a training that was moved to
another node of a cluster has to go on.
"""

import contextlib
import errno
import fcntl
import logging
import os
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

from nbavatar.errors import DataError
from nbavatar.io.atomic import no_links
from nbavatar.processes import alive, machine

__all__ = ["Hold", "hold"]

_LOG = logging.getLogger("nbavatar.io")
_NO_LOCKS = {errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS, errno.EINVAL}


class Hold:
    """A lock that is held until it is released, at the latest when this object or its process ends."""

    def __init__(self, descriptor: int) -> None:
        self._ends = [weakref.finalize(self, os.close, descriptor)]

    def first(self, action: Callable[..., None], *arguments: Any) -> None:
        """Adds what is to be done at the release, before everything that was added earlier."""
        self._ends.insert(0, weakref.finalize(self, action, *arguments))

    def release(self) -> None:
        """Frees the lock now; the second call does nothing.

        An exception that somebody keeps (a notebook, a debugger, a test) keeps the frames of its traceback, and with
        them every object there: without this the lock of a training that failed would be held until that exception
        is forgotten.
        """
        for end in self._ends:
            end()


def hold(path: str | os.PathLike[str], purpose: str) -> Hold:
    """Takes the lock of a file, which is made when missing; never waits.

    Args:
        path: the file, in the folder that it stands for.
        purpose: what its holder does, such as `another training that writes to it`.

    Raises:
        DataError: another process holds it.
        OSError: the file cannot be opened.
    """
    descriptor = no_links(os.fspath(path), os.O_RDWR | os.O_CREAT)
    lock = Hold(descriptor)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise _held(path, purpose) from None
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        _hold_by_number(Path(path), purpose, lock)
    return lock


def _hold_by_number(path: Path, purpose: str, lock: Hold) -> None:
    where, _, number = path.read_text(encoding="utf-8", errors="replace").partition(" ")
    if where == machine() and number.isdigit() and alive(int(number)):
        raise _held(path, f"{purpose} (process {number})")
    if where and where != machine():
        _LOG.warning("%s: this disk has no locks; process %s of another machine is taken to have ended", path, number)
    own = f"{machine()} {os.getpid()}"
    _write(path, own)
    lock.first(_forget, path, own)


def _forget(path: Path, own: str) -> None:
    with contextlib.suppress(OSError):
        if path.read_text(encoding="utf-8", errors="replace") == own:
            _write(path, "")


def _write(path: Path, text: str) -> None:
    with open(path, "w", encoding="utf-8", opener=no_links) as stream:
        stream.write(text)


def _held(path: str | os.PathLike[str], found: str) -> DataError:
    fix = "wait for its end or stop it"
    return DataError.of(Path(path).parent, expected="a folder of its own", found=found, fix=fix)
