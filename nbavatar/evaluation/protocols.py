"""Which frames a protocol compares, and the name of that choice.

    novel_view         frames of the training split, seen by the held-out camera
    self_reenactment   frames of the test split (contiguous held-out blocks), seen by the training cameras
    all                every frame

Which cameras those are is decided by the files a command is given; which frames they hold is decided here.
"""

import hashlib
from collections.abc import Iterable, Mapping, Sequence

from nbavatar.errors import ConfigError, DataError

__all__ = ["check_coverage", "frames_digest", "select_frames"]

_WORD = {"novel_view": "train", "self_reenactment": "test"}


def select_frames(
    frames: Sequence[str], split: Mapping[str, str], protocol_split: str, limit: int | None = None
) -> list[str]:
    """Frames of one camera that a protocol compares.

    Args:
        frames: all frame ids, in time order.
        split: frame id -> ``train`` or ``test``; ids without an entry are training frames.
        protocol_split: ``novel_view``, ``self_reenactment`` or ``all``.
        limit: at most this many, evenly spaced from the first to the last.

    Returns:
        Frame ids in time order.

    Raises:
        ConfigError: unknown split.
    """
    if protocol_split == "all":
        chosen = list(frames)
    elif protocol_split in _WORD:
        chosen = [frame for frame in frames if split.get(frame, "train") == _WORD[protocol_split]]
    else:
        known = "novel_view, self_reenactment or all"
        raise ConfigError.of("protocol", "split", expected=known, found=repr(protocol_split))
    if limit is not None and len(chosen) > limit:
        last = len(chosen) - 1
        positions = [round(i * last / (limit - 1)) for i in range(limit)] if limit > 1 else [last // 2]
        chosen = [chosen[i] for i in positions]
    return chosen


def check_coverage(
    rendered: Iterable[str], expected: Mapping[str, Sequence[str]], limit: int | None, where: str
) -> None:
    """Makes sure that a render holds what its protocol asks for: no frame more, no frame less.

    Args:
        rendered: ids ``<camera>/<frame>``.
        expected: camera -> frame ids that the protocol allows (before any limit).
        limit: frames a camera at most, or None for all of them.
        where: name of the render, for the error line.

    Raises:
        DataError: a camera or frame that does not belong to the protocol, or one that is missing.
    """
    found: dict[str, set[str]] = {camera: set() for camera in expected}
    for name in rendered:
        camera, _, frame = name.partition("/")
        if camera not in expected:
            raise DataError.of(
                where, name, expected=f"cameras {', '.join(sorted(expected))}", found=f"camera {camera}",
                fix="give the crops of every rendered camera to --frames",
            )  # fmt: skip
        if frame not in set(expected[camera]):
            raise DataError.of(where, name, expected="frames of the protocol's split", found="a frame outside it")
        found[camera].add(frame)
    for camera, frames in expected.items():
        count = len(frames) if limit is None else min(limit, len(frames))
        if len(found[camera]) != count:
            missing = [frame for frame in frames if frame not in found[camera]][:3]
            raise DataError.of(
                where, f"camera {camera}", expected=f"{count} frames", found=f"{len(found[camera])}",
                fix=f"render again; missing are {', '.join(missing)} ...",
            )  # fmt: skip


def frames_digest(names: Iterable[str]) -> str:
    """12 hex digits that name a set of ``<camera>/<frame>`` ids, whatever its order."""
    return hashlib.sha256("\n".join(sorted(names)).encode()).hexdigest()[:12]
