"""Zip archives whose sizes are believable: arrays, frame packs, images and tensors travel in them."""

import os
import zipfile

__all__ = ["open_archive", "read_record"]

_FLOOR, _RECORD_FLOOR, _RATIO = 1 << 26, 1 << 20, 20


def open_archive(path: str | os.PathLike[str], *, stored: bool = False) -> zipfile.ZipFile:
    """Opens a zip for reading.

    Our own archives are stored, not compressed; those of users may be compressed, and some compress well. One that
    claims to hold more than 64 MiB and more than 20 times its own size is refused before anything is unpacked.

    Args:
        path: the file.
        stored: whether nothing in it may be compressed, as in what torch writes.

    Raises:
        ValueError: it claims to hold far more than its size.
        zipfile.BadZipFile, OSError: as `zipfile.ZipFile`.
    """
    archive = zipfile.ZipFile(path)
    try:
        claimed, size = sum(entry.file_size for entry in archive.infolist()), os.stat(path).st_size
        if claimed > (size if stored else max(_FLOOR, _RATIO * size)):
            raise ValueError(f"{size} bytes that claim to unpack to {claimed}")
    except BaseException:
        archive.close()
        raise
    return archive


def read_record(archive: zipfile.ZipFile, name: str) -> bytes:
    """Reads an entry that is parsed as a whole, and grows by that: what makes it so large must be in the file.

    Raises:
        ValueError: an entry of more than a megabyte that claims to be far more than its compressed bytes.
        KeyError: none of that name.
    """
    entry = archive.getinfo(name)
    if entry.file_size > max(_RECORD_FLOOR, _RATIO * entry.compress_size):
        raise ValueError(f"{name} of {entry.compress_size} bytes that claims to unpack to {entry.file_size}")
    return archive.read(entry)
