"""Named arrays in one `.npz`, with a JSON record inside. No pickles, ever."""

import json
import os
import warnings
import zipfile
from collections.abc import Callable, Mapping, Sequence
from math import prod
from typing import IO, Any

import numpy as np

from nbavatar.errors import DataError, parsing
from nbavatar.io.archives import open_archive, read_record
from nbavatar.io.atomic import atomic_write
from nbavatar.io.records import canonical_json

__all__ = ["as_numbers", "check_text", "read_array_header", "read_arrays", "read_plain_array", "write_arrays"]

_RECORD = "record.json"
_LAST_CHARACTER = 0x10FFFF
_LARGEST_NUMBER = 16  # bytes, of a complex one
_EPOCH = (1980, 1, 1, 0, 0, 0)


def write_arrays(path: str | os.PathLike[str], arrays: Mapping[str, np.ndarray], record: Mapping[str, Any]) -> None:
    """Writes arrays and their record.

    The bytes depend on the contents only (fixed time stamps, sorted names), so equal results
    have equal digests. Entries are stored, not compressed: float geometry gains nothing.

    Args:
        path: target, by custom `*.npz`; `numpy.load` opens it.
        arrays: name -> array of numbers, booleans or fixed-width text. Names may hold dots.
        record: provenance and units, kept as `record.json` inside.
    """
    with atomic_write(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive:
        for name in sorted(arrays):
            array = np.asanyarray(arrays[name])
            if array.dtype == object:
                raise TypeError(f"array '{name}' holds Python objects; convert it first")
            with archive.open(zipfile.ZipInfo(name + ".npy", _EPOCH), "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, np.asarray(array, order="C"), allow_pickle=False)
        archive.writestr(zipfile.ZipInfo(_RECORD, _EPOCH), canonical_json(dict(record)))


def read_arrays(
    path: str | os.PathLike[str], required: Sequence[str] = ()
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Reads what `write_arrays` wrote, or any plain `.npz` (its record is then empty).

    Args:
        path: the file.
        required: names of arrays that have to be there.

    Raises:
        DataError: the file is missing or damaged, or an array of `required` is not in it.
    """
    with parsing(path, "an array file (.npz)"), open_archive(path) as archive:
        arrays = {}
        for entry in archive.infolist():
            if entry.filename.endswith(".npy"):
                with archive.open(entry) as stream:
                    arrays[entry.filename[:-4]] = read_plain_array(stream, entry.file_size)
        record = json.loads(read_record(archive, _RECORD)) if _RECORD in archive.namelist() else {}
        if not isinstance(record, dict):
            raise ValueError(f"{_RECORD} is no record")
    for name in required:
        if name not in arrays:
            raise DataError.of(path, name, expected="an array of this name", found=f"only {', '.join(sorted(arrays))}")
    return arrays, record


def read_array_header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, Fortran order and dtype of a `.npy` stream, which is left where the numbers begin.

    Raises:
        ValueError: no header of the formats 1.0 to 3.0.
    """
    version = np.lib.format.read_magic(stream)
    if version not in ((1, 0), (2, 0), (3, 0)):
        raise ValueError(f"format {version[0]}.{version[1]} of .npy files")
    # The reader of 2.0 takes 3.0 as well, up to names of fields, which none of ours have.
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the header is parsed as Python; damaged ones make its parser talk
        return read(stream)


def read_plain_array(stream: IO[bytes], size: int) -> np.ndarray:
    """The array of a `.npy` stream of `size` bytes, which can be rewound; what its header claims must be there.

    Raises:
        ValueError: damaged, an array of objects, or fewer or more bytes than shape and dtype ask for.
    """
    shape, _, dtype = read_array_header(stream)
    if dtype.hasobject:
        raise ValueError("an array of Python objects")
    claimed, there = prod(shape) * dtype.itemsize, size - stream.tell()
    if claimed != there or min(shape, default=0) < 0:
        raise ValueError(f"shape {shape} of {dtype} in {there} bytes")
    if dtype.names is not None:
        raise ValueError("an array of records")
    stream.seek(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it parses the header once more
        return check_text(np.lib.format.read_array(stream, allow_pickle=False))


def check_text(array: np.ndarray) -> np.ndarray:
    """The same array, if its text is made of characters: numpy takes any numbers, and Python breaks on them later.

    Raises:
        ValueError: an array of text with numbers beyond the last character of Unicode.
    """
    if array.dtype.kind == "U" and array.size and array.dtype.itemsize:
        codes = np.ascontiguousarray(array).reshape(-1).view(array.dtype.byteorder.replace("|", "=") + "u4")
        if codes.max() > _LAST_CHARACTER:
            raise ValueError("text with numbers that are no characters")
    return array


def as_numbers(value: Any, take: Callable[[int], None] = lambda count: None) -> np.ndarray:
    """Numbers in nested lists as an array; what is an array already stays as it is.

    Text is refused: of one long text and many short ones numpy makes an array that is as wide as the long one.

    Args:
        value: a number, an array, or lists or tuples of such.
        take: is told the bytes that are about to be asked for; may raise.

    Raises:
        ValueError: something else than numbers, or lists of unequal lengths.
    """
    if isinstance(value, np.ndarray):
        return value
    pending = [value]
    while pending:
        part = pending.pop()
        if isinstance(part, (list, tuple)):
            take(_LARGEST_NUMBER * len(part))
            pending.extend(part)
        elif isinstance(part, np.ndarray) and part.dtype.kind in "biufc":
            take(_LARGEST_NUMBER * part.size)
        elif not isinstance(part, (bool, int, float, complex, np.number, np.bool_)):
            raise ValueError(f"a {type(part).__name__} among numbers")
    return np.asarray(value)
