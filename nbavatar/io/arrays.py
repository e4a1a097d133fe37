"""Named arrays in one `.npz`, with a JSON record inside. No pickles, ever."""

import json
import os
import zipfile
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from nbavatar.errors import DataError
from nbavatar.io.atomic import atomic_write
from nbavatar.io.records import canonical_json

__all__ = ["read_arrays", "write_arrays"]

_RECORD = "record.json"
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

    Raises:
        DataError: the file is missing or damaged, or an array of `required` is not in it.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            arrays = {}
            for entry in archive.namelist():
                if entry.endswith(".npy"):
                    with archive.open(entry) as stream:
                        arrays[entry[:-4]] = np.lib.format.read_array(stream, allow_pickle=False)
            record = json.loads(archive.read(_RECORD)) if _RECORD in archive.namelist() else {}
    except FileNotFoundError as error:
        raise DataError.of(path, expected="an array file (.npz)", found="no such file") from error
    except (zipfile.BadZipFile, ValueError, EOFError, OSError) as error:
        raise DataError.of(path, expected="an array file (.npz)", found=f"a damaged one ({error})") from error
    for name in required:
        if name not in arrays:
            raise DataError.of(path, name, expected="an array of this name", found=f"only {', '.join(sorted(arrays))}")
    return arrays, record
