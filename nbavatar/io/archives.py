"""Zip archives whose sizes are believable: arrays, frame packs, images and tensors travel in them."""

import os
import zipfile

__all__ = ["open_archive"]

_FLOOR, _RATIO = 1 << 30, 20


def open_archive(path: str | os.PathLike[str]) -> zipfile.ZipFile:
    """Opens a zip for reading.

    Our own archives are stored, not compressed; those of users may be compressed, and some compress well. One that
    claims to hold more than 1 GiB and more than 20 times its own size is refused before anything is unpacked.

    Raises:
        ValueError: it claims to hold far more than its size.
        zipfile.BadZipFile, OSError: as `zipfile.ZipFile`.
    """
    archive = zipfile.ZipFile(path)
    try:
        claimed, size = sum(entry.file_size for entry in archive.infolist()), os.stat(path).st_size
        if claimed > max(_FLOOR, _RATIO * size):
            raise ValueError(f"{size} bytes that claim to unpack to {claimed}")
    except BaseException:
        archive.close()
        raise
    return archive
