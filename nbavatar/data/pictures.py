"""Pictures of a camera's folder by the name of their frame."""

import functools
import os
from pathlib import Path

from nbavatar.errors import DataError
from nbavatar.io.pictures import PICTURE_TYPES

__all__ = ["find_picture", "list_pictures"]

_OTHERS = (".tif", ".tiff", ".bmp", ".gif", ".exr", ".hdr", ".jp2", ".avif", ".heic", ".tga", ".ppm", ".pgm", ".npy")


def list_pictures(folder: Path) -> dict[str, list[str]]:
    """Names of the picture files of a folder by what they are called without their ending, in upper or lower case.

    Kinds of pictures that are not read are listed as well, so that an error can name them.
    """
    try:
        return _listing(str(folder), os.stat(folder).st_mtime_ns)
    except (FileNotFoundError, NotADirectoryError):
        return {}


def find_picture(folder: Path, name: str) -> Path | None:
    """The picture `<name>.<jpg, jpeg, png or webp>` of a folder, or None if there is none of any kind.

    Raises:
        DataError: there are two, or one of a kind that is not read.
    """
    files = list_pictures(folder).get(name, [])
    known = [file for file in files if Path(file).suffix.lower() in PICTURE_TYPES]
    if len(known) > 1:
        raise DataError.of(folder, expected=f"one picture {name}", found=" and ".join(known), fix="keep one of them")
    if not known and files:
        fix = "convert it to png"
        raise DataError.of(
            folder / files[0], expected="an image (jpg, png or webp)", found=Path(files[0]).suffix, fix=fix
        )
    if known and not (folder / known[0]).is_file():  # a pipe of that name would be waited for without end
        raise DataError.of(folder / known[0], expected="an image (jpg, png or webp)", found="no plain file")
    return folder / known[0] if known else None


@functools.lru_cache(maxsize=64)
def _listing(folder: str, _changed: int) -> dict[str, list[str]]:
    """The listing at one time of change: folders hold 100,000 files, and are asked for each of them."""
    found: dict[str, list[str]] = {}
    for file in sorted(os.listdir(folder)):
        name, suffix = os.path.splitext(file)
        if suffix.lower() in PICTURE_TYPES + _OTHERS and not file.startswith("."):
            found.setdefault(name, []).append(file)
    return found
