"""Reading of pickles through an allow-list: data in, no code run.

A pickle names the functions that rebuild it, so a hostile file can name any function at all. Here only names
that rebuild plain data are answered, each by a function of ours; any other name is refused with the name in
the message. What the datasets and body models of the field hold is enough:

    numpy arrays, dtypes and scalars     under the module paths of numpy 1 and numpy 2
    scipy.sparse csc, csr, coo           returned as scipy arrays of the same format, indices checked
    chumpy.ch.Ch                         returned as the array it holds (state entry `x`)
    chumpy.reordering.Select             returned as `a.ravel()[idxs].reshape(preferred_shape)`
    torch tensors                        returned as numpy arrays (the published landmark files hold some)
    builtin containers, OrderedDict, bytes written by Python 3 for Python 2 (`_codecs.encode`)

Text of Python 2 files is decoded as latin-1. `.npy` files whose array holds objects are pickles inside; they
are read by the same rules. Limit: memory is bounded by what the file asks for, as with any reader.
"""

import collections
import io
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from nbavatar.errors import DataError

__all__ = ["parse_pickle", "read_array", "read_pickle"]

_ERRORS = (
    pickle.UnpicklingError, EOFError, ValueError, TypeError, KeyError, IndexError, AttributeError, MemoryError,
    OverflowError, UnicodeDecodeError, ImportError, RecursionError,
)  # fmt: skip
_SPARSE_FORMATS = ("csc", "csr", "coo")
_MAX_ELEMENTS = 1 << 34
_DTYPE_LETTERS = tuple("biufcSUO?")


class _Refused(Exception):
    """A name outside the allow-list; its text is the name."""


class _Function:
    """A callable without attributes, so that the BUILD opcode cannot alter it."""

    __slots__ = ("_call",)

    def __init__(self, call: Callable[..., Any]) -> None:
        object.__setattr__(self, "_call", call)

    def __call__(self, *args: Any) -> Any:
        return self._call(*args)

    def __setattr__(self, name: str, value: Any) -> None:
        raise _Refused(f"assignment to {name} of a function")


class _Shim:
    """Collects the state of an object whose class is replaced by plain data after loading."""

    __slots__ = ("state",)

    def __init__(self, *args: Any) -> None:
        self.state: dict[str, Any] = {}

    def __setstate__(self, state: Any) -> None:
        parts = state if isinstance(state, tuple) else (state,)
        self.state = {str(key): value for part in parts if isinstance(part, dict) for key, value in part.items()}

    def value(self) -> Any:
        raise ValueError("an object without data")


class _Ch(_Shim):
    __slots__ = ()

    def value(self) -> np.ndarray:
        return np.asarray(_plain(self.state["x"]))


class _Select(_Shim):
    __slots__ = ()

    def value(self) -> np.ndarray:
        source = np.asarray(_plain(self.state["a"]))
        picked = source.ravel()[np.asarray(_plain(self.state["idxs"]))]
        shape = _plain(self.state.get("preferred_shape"))
        return picked if shape is None else picked.reshape(tuple(int(n) for n in shape))


class _Sparse(_Shim):
    __slots__ = ()
    layout = ""

    def value(self) -> Any:
        import scipy.sparse

        state = {key.lstrip("_"): _plain(value) for key, value in self.state.items()}
        shape = tuple(int(n) for n in state["shape"])
        if self.layout == "coo":
            row, col = state["coords"] if "coords" in state else (state["row"], state["col"])
            return scipy.sparse.coo_array((state["data"], (row, col)), shape=shape)
        build = scipy.sparse.csc_array if self.layout == "csc" else scipy.sparse.csr_array
        matrix = build((state["data"], state["indices"], state["indptr"]), shape=shape)
        matrix.check_format(full_check=True)
        return matrix


_SPARSE = {
    layout: type(f"_Sparse_{layout}", (_Sparse,), {"__slots__": (), "layout": layout}) for layout in _SPARSE_FORMATS
}


class _Object:
    """Stands for `object` where old protocols name it as a base class."""

    __slots__ = ()

    def __setstate__(self, state: Any) -> None:
        raise _Refused("state of a bare object")


def _reconstructor(cls: type, base: Any, state: Any) -> Any:
    """`copyreg._reconstructor`: protocols 0 and 1 build new-style instances through it."""
    if not (isinstance(cls, type) and issubclass(cls, _Shim)) or base is not _Object:
        raise _Refused("copyreg._reconstructor of a class that is not data")
    return cls()


class _Dtype(_Shim):
    """A dtype, rebuilt from its letters: numpy trusts the flags of a dtype's state, and wrong ones crash it."""

    __slots__ = ("letters", "order")

    def __init__(self, *args: Any) -> None:
        self.letters, self.order = args[0], "|"

    def __setstate__(self, state: Any) -> None:
        version, order, base, names, fields = state[:5]
        if version not in (3, 4) or base is not None or names is not None or fields is not None:
            raise _Refused("numpy dtype with fields")
        self.order = order.decode("latin-1") if isinstance(order, bytes) else order

    def value(self) -> np.dtype:
        letters = self.letters.decode("latin-1") if isinstance(self.letters, bytes) else self.letters
        if not isinstance(letters, str) or letters[:1] not in _DTYPE_LETTERS:
            raise _Refused(f"numpy dtype {letters!r}")
        dtype = np.dtype(letters)
        return dtype if self.order in ("|", "=") else dtype.newbyteorder(">" if self.order == ">" else "<")


class _Array(_Shim):
    """An array, rebuilt from shape, dtype and bytes (or a list, for arrays of objects)."""

    __slots__ = ()

    def __setstate__(self, state: Any) -> None:
        _, shape, dtype, fortran, content = state if len(state) == 5 else (None, *state)
        self.state = {"shape": shape, "dtype": dtype, "fortran": fortran, "content": content}

    def value(self) -> np.ndarray:
        dtype, content = _dtype(self.state["dtype"]), self.state["content"]
        shape = tuple(int(n) for n in self.state["shape"])
        order = "F" if self.state["fortran"] else "C"
        if not dtype.hasobject:
            return np.frombuffer(_raw(content), dtype=dtype).reshape(shape, order=order).copy(order="K")
        if not isinstance(content, list):
            raise ValueError("an array of objects without a list")
        array = np.full(len(content), None, dtype=object)
        for index, item in enumerate(content):
            array[index] = item
        return array.reshape(shape, order=order)


def _dtype(shim: Any) -> np.dtype:
    if not isinstance(shim, _Dtype):
        raise _Refused(f"dtype of class {type(shim).__name__}")
    return shim.value()


def _raw(content: Any) -> bytes:
    return content.encode("latin-1") if isinstance(content, str) else bytes(content)


def _array(subtype: Any, shape: Any, letters: Any) -> _Array:
    """`multiarray._reconstruct`: an empty array that receives its content as state."""
    if subtype is not _Array or tuple(shape) != (0,):
        raise _Refused(f"numpy array of class {subtype!r} and initial shape {shape!r}")
    return _Array()


def _scalar(dtype: Any, content: Any = b"") -> Any:
    """`multiarray.scalar`."""
    kind = _dtype(dtype)
    if kind.hasobject:
        raise _Refused("numpy scalar of object type")
    return np.frombuffer(_raw(content), dtype=kind, count=1)[0]


def _from_buffer(buffer: Any, dtype: Any, shape: Any, order: str, axis_order: Any = None) -> Any:
    """`numeric._frombuffer`: arrays of pickle protocol 5."""
    kind = _dtype(dtype)
    if kind.hasobject or axis_order is not None:
        raise _Refused("numpy buffer of object type or permuted axes")
    return np.frombuffer(buffer, dtype=kind).reshape(shape, order="F" if order == "F" else "C")


def _encode(text: str, encoding: str = "latin1", errors: str = "strict") -> bytes:
    """`_codecs.encode`: Python 3 writes bytes this way for Python 2."""
    if not isinstance(text, str) or encoding not in ("latin1", "latin-1", "iso-8859-1", "utf-8", "ascii"):
        raise _Refused(f"_codecs.encode to {encoding!r}")
    return text.encode(encoding, errors)


def _storage(content: bytes) -> Any:
    """`torch.storage._load_from_bytes`, through torch's own weights-only reader."""
    import torch

    return torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)


def _tensor(storage: Any, offset: int, size: Any, stride: Any, *_: Any) -> np.ndarray:
    """`torch._utils._rebuild_tensor_v2`: a strided view of a storage, copied to a numpy array."""
    import torch

    flat = torch.tensor([], dtype=storage.dtype)
    flat.set_(storage, int(offset), tuple(int(n) for n in size), tuple(int(n) for n in stride))
    return flat.numpy().copy()


def _table() -> dict[tuple[str, str], Any]:
    """Allowed (module, name) pairs and what answers for each."""
    table: dict[tuple[str, str], Any] = {
        ("collections", "OrderedDict"): collections.OrderedDict,
        ("_codecs", "encode"): _Function(_encode),
        ("numpy", "ndarray"): _Array,
        ("numpy", "dtype"): _Dtype,
        ("chumpy.ch", "Ch"): _Ch,
        ("chumpy.reordering", "Select"): _Select,
        ("torch.storage", "_load_from_bytes"): _Function(_storage),
        ("torch._utils", "_rebuild_tensor_v2"): _Function(_tensor),
    }
    for module in ("copy_reg", "copyreg"):
        table[module, "_reconstructor"] = _Function(_reconstructor)
    for module in ("__builtin__", "builtins"):
        for kind in (set, frozenset, bytearray, complex, slice, list, dict, tuple, int, float, bool, str):
            table[module, kind.__name__] = kind
        table[module, "object"] = _Object
        table[module, "long"] = int
        table[module, "unicode"] = str
    for core in ("numpy.core", "numpy._core"):
        table[f"{core}.multiarray", "_reconstruct"] = _Function(_array)
        table[f"{core}.multiarray", "scalar"] = _Function(_scalar)
        table[f"{core}.numeric", "_frombuffer"] = _Function(_from_buffer)
    for layout in _SPARSE_FORMATS:
        for suffix in ("matrix", "array"):
            for module in (f"scipy.sparse.{layout}", f"scipy.sparse._{layout}"):
                table[module, f"{layout}_{suffix}"] = _SPARSE[layout]
    return table


_ALLOWED = _table()


class _Unpickler(pickle.Unpickler):
    """An unpickler that answers only to names of `_ALLOWED`."""

    def find_class(self, module: str, name: str) -> Any:
        try:
            return _ALLOWED[module, name]
        except KeyError:
            raise _Refused(f"{module}.{name}") from None

    def persistent_load(self, pid: Any) -> Any:
        raise _Refused("a persistent id")


def _plain(value: Any, seen: dict[int, Any] | None = None) -> Any:
    """Replaces shims by what they hold, inside containers too; shared objects stay shared."""
    seen = {} if seen is None else seen
    key = id(value)
    if key in seen:
        return seen[key][1]
    result: Any = value.value() if isinstance(value, _Shim) else value
    seen[key] = (value, result)
    if isinstance(result, dict):
        for name in list(result):
            result[name] = _plain(result[name], seen)
    elif isinstance(result, list):
        result[:] = [_plain(item, seen) for item in result]
    elif isinstance(result, tuple):
        result = tuple(_plain(item, seen) for item in result)
    elif isinstance(result, np.ndarray) and result.dtype == object:
        for index in np.ndindex(result.shape):
            result[index] = _plain(result[index], seen)
    # The original is kept alive beside the result, so that its id is not given to another object meanwhile.
    seen[key] = (value, result)
    return result


def _load(stream: io.BufferedIOBase, path: Path) -> Any:
    try:
        return _plain(_Unpickler(stream, encoding="latin1").load())
    except _Refused as error:
        raise DataError.of(
            path,
            "pickle",
            expected="arrays and plain containers only",
            found=f"the name '{error}', which is not allowed",
            fix="the file may try to run code: obtain it from its original source",
        ) from None
    except _ERRORS as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise DataError.of(
            path,
            "pickle",
            expected="a complete pickle",
            found=f"damaged content ({reason})",
            fix="fetch the file again",
        ) from None


def _open(path: Path | str) -> tuple[Path, io.BufferedReader]:
    path = Path(path)
    try:
        return path, open(path, "rb")
    except OSError as error:
        raise DataError.of(path, expected="a readable file", found=error.strerror or str(error)) from None


def read_pickle(path: Path | str) -> Any:
    """Reads a pickle of plain data.

    Args:
        path: file; any pickle protocol, written by Python 2 or 3.

    Returns:
        The content, with chumpy objects and torch tensors as numpy arrays and sparse matrices as scipy sparse arrays.

    Raises:
        DataError: the file is missing, damaged, or names anything outside the allow-list (the name is said).
    """
    path, stream = _open(path)
    with stream:
        return _load(stream, path)


def parse_pickle(content: bytes, path: Path | str) -> Any:
    """Parses a pickle that has been read already, as `read_pickle` does; for files whose digest is checked first.

    Args:
        content: the whole file.
        path: where it is from; used in error lines only.

    Raises:
        DataError: the content is damaged, or names anything outside the allow-list (the name is said).
    """
    return _load(io.BytesIO(content), Path(path))


def read_array(path: Path | str) -> Any:
    """Reads a `.npy` file; arrays of objects are unpickled by the same allow-list.

    Args:
        path: file of numpy format 1.0, 2.0 or 3.0.

    Returns:
        The array. A 0-d array of objects, the usual wrapping of a dictionary, is returned as its only element.

    Raises:
        DataError: the file is missing, is not a `.npy` file, is cut short, or its pickle is refused.
    """
    path, stream = _open(path)
    with stream:
        try:
            version = np.lib.format.read_magic(stream)
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, fortran, dtype = read(stream)
            if dtype.hasobject:
                count = int(np.prod(shape, dtype=object)) if shape else 1
                if count > _MAX_ELEMENTS:
                    raise ValueError(f"shape {shape} is too large")
            else:
                stream.seek(0)
                return np.lib.format.read_array(stream, allow_pickle=False)
        except _ERRORS as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise DataError.of(path, expected="a numpy .npy file", found=reason) from None
        content = _load(stream, path)
    array = content if isinstance(content, np.ndarray) else np.array(content, dtype=object)
    if shape == () and array.size == 1:
        return array.reshape(-1)[0]
    if array.size != count:
        raise DataError.of(path, expected=f"{count} elements as its header says", found=f"{array.size}")
    return array.reshape(shape, order="F" if fortran else "C")
