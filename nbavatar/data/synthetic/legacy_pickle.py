"""Pickles as the official model files hold them.

FLAME and MANO were pickled by Python 2 with numpy 1, scipy and chumpy: byte strings without a type, module names that
have moved since, and arrays wrapped in `chumpy.ch.Ch`. Writing the same opcodes makes readers prove themselves on
what they will meet, and needs none of those packages. The dataset's own pickles come from Python 3.7 with numpy 1
(protocol 3, typed bytes).
"""

import io
import pickle
import struct
from typing import Any

import numpy as np

__all__ = ["Ch", "Select", "dump_array", "dump_legacy"]


class Ch:
    """Stands for `chumpy.ch.Ch`: an array in the state entry `x`."""

    def __init__(self, x: np.ndarray) -> None:
        self.x = x


class Select:
    """Stands for `chumpy.reordering.Select`: entries `idxs` of the raveled `a`, in shape `preferred_shape`."""

    def __init__(self, a: Ch, idxs: np.ndarray, preferred_shape: tuple[int, ...]) -> None:
        self.a, self.idxs, self.preferred_shape = a, idxs, preferred_shape


_NAMES = {
    Ch: ("chumpy.ch", "Ch"),
    Select: ("chumpy.reordering", "Select"),
}
_MODULES = {
    "numpy._core.multiarray": "numpy.core.multiarray",
    "scipy.sparse._csc": "scipy.sparse.csc",
}


# the C pickler cannot be told which opcodes to write
_PythonPickler: Any = pickle._Pickler


class _LegacyPickler(_PythonPickler):
    """Writes today's objects under the names that they had."""

    dispatch = _PythonPickler.dispatch.copy()

    def __init__(self, stream: io.BytesIO, python2: bool) -> None:
        super().__init__(stream, protocol=2 if python2 else 3)
        self._python2 = python2

    def save_global(self, obj: Any, name: str | None = None) -> None:
        module, name = _NAMES.get(
            obj, (getattr(obj, "__module__", None), name or getattr(obj, "__qualname__", obj.__name__))
        )
        module = _MODULES.get(str(module), str(module))
        if self._python2:
            module = {"builtins": "__builtin__", "copyreg": "copy_reg"}.get(module, module)
        self.write(pickle.GLOBAL + f"{module}\n{name}\n".encode("ascii"))
        self.memoize(obj)

    def _save_bytes(self, obj: bytes) -> None:
        if not self._python2:
            _PythonPickler.save_bytes(self, obj)
            return
        self.write(pickle.BINSTRING + struct.pack("<i", len(obj)) + obj)
        self.memoize(obj)

    dispatch[bytes] = _save_bytes
    dispatch[type] = save_global
    dispatch[type(len)] = save_global


def dump_legacy(content: Any, *, python2: bool = False) -> bytes:
    """Pickles plain data, numpy arrays, scipy csc matrices, `Ch` and `Select`.

    Args:
        content: what to write.
        python2: protocol 2 with untyped byte strings, as the body models; otherwise protocol 3, as the dataset.
    """
    stream = io.BytesIO()
    _LegacyPickler(stream, python2).dump(content)
    return stream.getvalue()


def dump_array(content: Any) -> bytes:
    """A `.npy` file of numpy format 1.0 holding one object in a 0-d array (how `np.save` stores a dictionary)."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"shape": (), "fortran_order": False, "descr": "|O"})
    holder = np.zeros((), dtype=object)
    holder[()] = content
    return stream.getvalue() + dump_legacy(holder)
