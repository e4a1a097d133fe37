"""Reading of pickles through an allow-list: data in, no code run.

A pickle names the functions that rebuild it, so a hostile file can name any function at all. Here only names
that rebuild plain data are answered, each by a function of ours (`nbavatar.io.pickle_types`); any other name is
refused with the name in the message. What the datasets and body models of the field hold is enough: numpy arrays,
scipy's sparse matrices, chumpy's arrays and selections, torch's tensors, and containers of Python.

Text of Python 2 files is decoded as latin-1. `.npy` files whose array holds objects are pickles inside; they
are read by the same rules. Time and memory are bounded by the size of the file (`nbavatar.io.unpickler`).
"""

import io
import os
from pathlib import Path
from typing import Any

import numpy as np

from nbavatar.errors import DataError, parsing
from nbavatar.io.arrays import read_array_header, read_plain_array
from nbavatar.io.pickle_limits import Budget, Refused
from nbavatar.io.pickle_types import ALLOWED
from nbavatar.io.unpickler import Unpickler, plain

__all__ = ["parse_pickle", "read_array", "read_pickle"]


def _load(content: bytes, path: Path) -> Any:
    stream, budget = io.BytesIO(content), Budget(len(content))
    with parsing(path, "a complete pickle", field="pickle", damaged="damaged content", fix="fetch the file again"):
        try:
            return plain(Unpickler(stream, ALLOWED, budget).load(), budget)
        except Refused as error:
            raise DataError.of(
                path,
                "pickle",
                expected="arrays and plain containers only",
                found=f"the name '{error}', which is not allowed",
                fix="the file may try to run code: obtain it from its original source",
            ) from None


def _read(path: Path | str) -> bytes:
    with parsing(path, "a readable file (.pkl)"):
        return Path(path).read_bytes()


def read_pickle(path: Path | str) -> Any:
    """Reads a pickle of plain data.

    Args:
        path: file; any pickle protocol, written by Python 2 or 3.

    Returns:
        The content, with chumpy objects and torch tensors as numpy arrays and sparse matrices as scipy sparse arrays.

    Raises:
        DataError: the file is missing, damaged, or names anything outside the allow-list (the name is said).
    """
    return _load(_read(path), Path(path))


def parse_pickle(content: bytes, path: Path | str) -> Any:
    """Parses a pickle that has been read already, as `read_pickle` does; for files whose digest is checked first.

    Args:
        content: the whole file.
        path: where it is from; used in error lines only.

    Raises:
        DataError: the content is damaged, or names anything outside the allow-list (the name is said).
    """
    return _load(content, Path(path))


def read_array(path: Path | str) -> Any:
    """Reads a `.npy` file; arrays of objects are unpickled by the same allow-list.

    Args:
        path: file of numpy format 1.0, 2.0 or 3.0.

    Returns:
        The array. A 0-d array of objects, the usual wrapping of a dictionary, is returned as its only element.

    Raises:
        DataError: the file is missing, is not a `.npy` file, is cut short, or its pickle is refused.
    """
    with parsing(path, "a numpy .npy file"), open(path, "rb") as stream:
        shape, fortran, dtype = read_array_header(stream)
        if not dtype.hasobject:
            size = os.fstat(stream.fileno()).st_size
            stream.seek(0)
            return read_plain_array(stream, size)
        content = _load(stream.read(), Path(path))
        array = content if isinstance(content, np.ndarray) else np.array(content, dtype=object)
        if shape == () and array.size == 1:
            return array.reshape(-1)[0]
        return array.reshape(shape, order="F" if fortran else "C")
