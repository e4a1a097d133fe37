"""Which files of a capture a job reads, and a digest that tells whether they are still the same, without reading them.

Standard library only: the Snakefile asks for every job, and a capture has 100,000 files. A digest covers names, sizes
and times of change. Two files of one size and time (as archives leave them) could be exchanged unseen: for those the
time of the last renaming counts too. What a link points to always does.
"""

import functools
import hashlib
import json
import os
import stat
from collections.abc import Iterable
from pathlib import Path

__all__ = ["files_digest", "given_digest", "mesh_digest", "rig_digest", "supplied_digest", "supplied_place"]

_READ_WHOLE = 1_000_000  # bytes; snakemake compares files up to here by content, too
_VIDEOS = (".mp4", ".mkv", ".avi", ".mov", ".webm")


def files_digest(root: str, camera: str, kinds: Iterable[str]) -> str:
    """Digest of one camera's files of some kinds, such as `images`, `masks`, `alpha`."""
    frames = _frames(root)
    return _joined(_folder(root, kind, camera, frames=frames) for kind in kinds)


def mesh_digest(root: str) -> str:
    """Digest of a capture's meshes."""
    frames = _frames(root)
    return _joined([_folder(root, "meshes", frames=None if frames is None else frames | {"topology"})])


def rig_digest(root: str) -> str:
    """Digest of the contents of `cameras.json` and `splits.json`."""
    total = hashlib.sha256()
    for name in ("cameras.json", "splits.json"):
        try:
            total.update(_content(Path(root, name)) + b"\0")
        except OSError:
            total.update(b"missing\0")
    return total.hexdigest()[:12]


def given_digest(paths: Iterable[str]) -> str:
    """Digest of single files: of what is in small ones, of size and time of large ones.

    Times alone are compared with those of results, and do not tell of a file whose place an older one has taken: by a
    copy that keeps times, from a backup, out of an archive.
    """
    return _joined(map(_file, paths))


@functools.cache
def _file(path: str) -> str:
    try:
        known = os.stat(path)
        if known.st_size > _READ_WHOLE:
            return f"{known.st_size} {known.st_mtime_ns}"
        return hashlib.sha256(_content(Path(path))).hexdigest()
    except OSError:
        return "missing"


def _content(path: Path) -> bytes:
    """What is in a file; OSError where there is none, but a pipe or a device, which has no end."""
    if not path.is_file():
        raise FileNotFoundError(path)
    return path.read_bytes()


def supplied_place(folder: str, subject: str, camera: str) -> Path | None:
    """The folder or video with a camera's masks, made by the user with other tools.

    The first there is of `<folder>/<subject>/<camera>/`, `<folder>/<subject>/<camera>.<video>`, `<folder>/<camera>/`,
    `<folder>/<camera>.<video>`.
    """
    for base in (Path(folder, subject), Path(folder)):
        if (base / camera).is_dir():
            return base / camera
        for suffix in _VIDEOS:
            if (base / f"{camera}{suffix}").is_file():
                return base / f"{camera}{suffix}"
    return None


def supplied_digest(folder: str, subject: str, camera: str) -> str:
    """Digest of those masks; the same text where there are none."""
    place = supplied_place(folder, subject, camera) if folder else None
    if place is None:
        return ""
    if place.is_dir():
        return _joined([_folder(str(place))])
    return _joined([_folder(str(place.parent), frames=frozenset({camera}))])


def _joined(digests: Iterable[str]) -> str:
    return hashlib.sha256("\n".join(digests).encode()).hexdigest()[:12]


@functools.cache
def _folder(*parts: str, frames: frozenset[str] | None = None) -> str:
    """Digest of the files of a folder, or of those that are named after one of these frames."""
    text = "".join(
        f"{name}\0{facts}\0"
        for name, facts in _listing(os.path.join(*parts))
        if frames is None or os.path.splitext(name)[0] in frames
    )
    return hashlib.sha256(text.encode(errors="surrogateescape")).hexdigest()


@functools.cache
def _listing(folder: str) -> list[tuple[str, str]]:
    """(name, what is known of it without reading it) of all files of a folder, hidden ones left out, sorted."""
    found: list[tuple[str, os.stat_result | None, str]] = []
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                if entry.name.startswith("."):
                    continue
                link = os.readlink(entry.path) if entry.is_symlink() else ""
                try:
                    known = entry.stat()
                except OSError:  # a link to nothing
                    found.append((entry.name, None, link))
                    continue
                if stat.S_ISREG(known.st_mode):
                    found.append((entry.name, known, link))
    except OSError:  # no such folder: `check` says so
        return []
    alike: dict[tuple[int, int], int] = {}
    for _, known, _ in found:
        if known is not None:
            key = known.st_size, known.st_mtime_ns
            alike[key] = alike.get(key, 0) + 1
    result = []
    for name, known, link in found:
        facts = "missing" if known is None else f"{known.st_size} {known.st_mtime_ns}"
        if known is not None and alike[known.st_size, known.st_mtime_ns] > 1:
            facts += f" {known.st_ctime_ns}"
        result.append((name, f"{facts} {link}"))
    return sorted(result)


@functools.cache
def _frames(root: str) -> frozenset[str] | None:
    """Ids of all frames of a capture; None, which stands for every file, where `splits.json` cannot be read."""
    try:
        stored = json.loads(_content(Path(root, "splits.json")).decode("utf-8-sig"))
        return frozenset(str(frame) for frame in stored["frames"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
