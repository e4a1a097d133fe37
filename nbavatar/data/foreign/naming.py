"""Which part of a picture's path is the camera and which the frame."""

import re
from collections.abc import Sequence
from pathlib import PurePosixPath

from nbavatar.errors import ConfigError, DataError

__all__ = ["ONLY_FRAME", "parse_names"]

ONLY_FRAME = "0"
"""What the frame is called where every picture is a camera of its own."""


def parse_names(paths: Sequence[str], template: str, where: object) -> tuple[list[tuple[str, str]], bool]:
    """(camera, frame) of pictures.

    Args:
        paths: of the pictures, as the source has them.
        template: such as `{camera}/{frame}` or `{frame}_{camera}`, compared with the end of a path without its suffix;
            `{camera}` alone means that every picture is a camera, `{frame}` alone that one camera moves; empty for
            `{camera}/{frame}` where the pictures lie in several folders, else `{camera}`.
        where: file, for errors.

    Returns:
        one pair a path, and whether it is one moving camera.

    Raises:
        ConfigError: a template without either.
        DataError: a path that the template does not fit.
    """
    trimmed = [_without_suffix(path) for path in paths]
    if not template:
        folders = {str(PurePosixPath(path).parent) for path in trimmed}
        template = "{camera}/{frame}" if len(folders) > 1 else "{camera}"
    fields = re.findall(r"\{(\w*)\}", template)
    if not fields or set(fields) - {"camera", "frame"} or len(set(fields)) < len(fields):
        raise ConfigError.of(
            "--names", expected="{camera} and {frame}, or one of them, each once", found=repr(template)
        )
    pattern = re.escape(template)
    for field in fields:
        pattern = pattern.replace(re.escape(f"{{{field}}}"), rf"(?P<{field}>[^/]+)")
    pairs = []
    for path in trimmed:
        match = re.search(rf"(?:^|/){pattern}$", path)
        if match is None:
            raise DataError.of(
                where, f"picture {path!r}", expected=f"a name such as {template}", found="another",
                fix="say with --names what is the camera and what the frame",
            )  # fmt: skip
        found = match.groupdict()
        pairs.append((found.get("camera", "camera"), found.get("frame", ONLY_FRAME)))
    return pairs, "camera" not in fields


def _without_suffix(path: str) -> str:
    path = path.replace("\\", "/")
    return re.sub(r"\.(png|jpe?g|webp|tiff?)$", "", path, flags=re.IGNORECASE)
