"""Files that are either whole or absent: whatever stops their writer, a full disk and a power failure too."""

import contextlib
import errno
import hashlib
import os
import re
import secrets
import time
from collections.abc import Iterator
from pathlib import Path

from nbavatar.errors import NBAvatarError, StorageError
from nbavatar.processes import alive, machine

__all__ = ["atomic_write", "no_links", "storage_errors", "temporary_beside"]

_ABANDONED_S = 24 * 3600.0  # a temporary file that nothing was written to for so long has no writer
_LONG_NAME = 200  # bytes
_ROOM = {
    errno.ENOSPC: ("a full disk", "free space"),
    errno.EDQUOT: ("a quota that is used up", "free space or have the quota raised"),
    errno.EFBIG: ("a limit of file sizes", "raise the limit (ulimit -f)"),
}


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yields a temporary path beside `path`; renames it to `path` when the block succeeds.

    The temporary file keeps the suffix (libraries choose formats by it) and is removed when the block fails, so a
    crash, a full disk or an interrupt leaves the former file untouched. It is on the disk before it is renamed: no
    power failure leaves a result that is named as one and is empty. What killed writers of the same file left beside it
    is removed. Missing parent folders are made.

    Raises:
        StorageError: the disk is full, a quota is used up, or the file grew beyond a limit.
    """
    target = Path(path)
    with storage_errors(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = temporary_beside(target)
        try:
            yield temporary
            _to_disk(temporary)
            os.replace(temporary, target)
        finally:
            with contextlib.suppress(FileNotFoundError):
                temporary.unlink()


def temporary_beside(path: str | os.PathLike[str]) -> Path:
    """A new name for a temporary file of this process beside `path`; those that killed processes left are removed."""
    target = Path(path)
    suffix = "".join(target.suffixes[-2:])
    stem = target.name[: len(target.name) - len(suffix)] if suffix else target.name
    if len(os.fsencode(target.name)) > _LONG_NAME:  # file systems end names at 255 bytes, and ours is longer
        stem, suffix = hashlib.sha256(stem.encode()).hexdigest()[:32], suffix[-_LONG_NAME // 2 :]
    _sweep(target.parent, stem, suffix)
    return target.with_name(f".{stem}.{machine()}-{os.getpid()}.{secrets.token_hex(4)}.tmp{suffix}")


def no_links(path: str, flags: int) -> int:
    """Opener for files that are appended to or written in place: what a folder from elsewhere links to is not ours.

    Raises:
        OSError: as `os.open`; ELOOP where the file is a link.
    """
    return os.open(path, flags | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)


@contextlib.contextmanager
def storage_errors(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turns an error of the block whose cause is that there is no room into one line that names `path`.

    Raises:
        StorageError: the disk is full, a quota is used up, or the file grew beyond a limit.
    """
    try:
        yield
    except NBAvatarError:
        raise
    except Exception as error:  # libraries wrap the system's error in kinds of their own
        cause = _cause(error)
        if cause is None:
            raise
        found, fix = _ROOM[cause]
        fix = f"{fix} and run the same command again; what was there before is unchanged"
        raise StorageError.of(path, expected="room to write", found=found, fix=fix) from error


def _cause(error: BaseException) -> int | None:
    """Number of the system's error for missing room behind an error, or None."""
    seen: set[int] = set()
    link: BaseException | None = error
    while link is not None and id(link) not in seen:
        if isinstance(link, OSError) and link.errno in _ROOM:
            return link.errno
        seen.add(id(link))
        link = link.__cause__ or link.__context__
    return None


def _to_disk(path: Path) -> None:
    """Waits until a file's contents are on the disk; some disks tell only now that they are full."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP, errno.ENOSYS):  # file systems that cannot be asked to
            raise
    finally:
        os.close(descriptor)


def _sweep(folder: Path, stem: str, suffix: str) -> None:
    """Removes temporary files of the same target whose process is gone, or, of other machines, that are a day old."""
    form = re.compile(rf"\.{re.escape(stem)}\.(?P<host>\w+)-(?P<process>\d+)\.[0-9a-f]{{8}}\.tmp{re.escape(suffix)}")
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            match = form.fullmatch(entry.name)
            if match is None:
                continue
            gone = match["host"] == machine() and not alive(int(match["process"]))
            with contextlib.suppress(OSError):
                if gone or time.time() - entry.stat(follow_symlinks=False).st_mtime > _ABANDONED_S:
                    os.unlink(entry.path)
