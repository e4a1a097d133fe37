"""What answers for the names in pickles: shims that become numpy arrays, scipy arrays and plain containers.

numpy arrays, dtypes and scalars     under the module paths of numpy 1 and numpy 2
scipy.sparse csc, csr, coo           returned as scipy arrays of the same format, indices checked
chumpy.ch.Ch                         returned as the array it holds (state entry `x`)
chumpy.reordering.Select             returned as `a.ravel()[idxs].reshape(preferred_shape)`
torch tensors                        returned as numpy arrays (the published landmark files hold some)
builtin containers, OrderedDict, bytes written by Python 3 for Python 2 (`_codecs.encode`)
"""

import collections
from collections.abc import Callable
from typing import Any

import numpy as np

from nbavatar.errors import describe
from nbavatar.io.arrays import as_numbers, check_text
from nbavatar.io.pickle_limits import Budget, Refused, checked_key
from nbavatar.io.unpickler import Function, Metered, Shim, describe_class

__all__ = ["ALLOWED"]

_SPARSE_FORMATS = ("csc", "csr", "coo")
_DTYPE_LETTERS = tuple("biufcSUO?")
_MAX_AXES = 64  # numpy's own

Plain = Callable[[Any], Any]


class _Ch(Shim):
    __slots__ = ()

    def value(self, plain: Plain, budget: Budget) -> np.ndarray:
        return as_numbers(plain(self.state["x"]), budget.take)


class _Select(Shim):
    __slots__ = ()

    def value(self, plain: Plain, budget: Budget) -> np.ndarray:
        source, index = as_numbers(plain(self.state["a"]), budget.take), plain(self.state["idxs"])
        # A slice gives a view, which takes nothing; anything else as many numbers as it names.
        if not isinstance(index, slice):
            index = as_numbers(index, budget.take)
            budget.take(index.size * source.itemsize)
        picked = source.ravel()[index]
        shape = plain(self.state.get("preferred_shape"))
        return picked if shape is None else picked.reshape(_shape(shape))


def _shape(value: Any) -> tuple[int, ...]:
    if not isinstance(value, (list, tuple, np.ndarray)) or len(value) > _MAX_AXES:
        raise ValueError("a shape that is none")
    return tuple(int(n) for n in value)


class _Sparse(Shim):
    __slots__ = ()
    layout = ""

    def value(self, plain: Plain, budget: Budget) -> Any:
        import scipy.sparse

        state = {key.lstrip("_"): plain(value) for key, value in self.state.items()}
        shape = _shape(state["shape"])
        parts = state.get("coords") or tuple(state.get(name) for name in _SPARSE_PARTS[self.layout])
        if len(shape) != 2 or len(parts) != 2:
            raise ValueError("a sparse matrix of other than two axes")
        arrays = [as_numbers(part, budget.take) for part in (state["data"], *parts)]
        if any(array.dtype.kind not in "biufc" for array in arrays):
            raise ValueError("a sparse matrix of something else than numbers")
        budget.take(2 * sum(array.nbytes for array in arrays))
        if self.layout == "coo":
            return scipy.sparse.coo_array((arrays[0], tuple(arrays[1:])), shape=shape)
        build = scipy.sparse.csc_array if self.layout == "csc" else scipy.sparse.csr_array
        matrix = build(tuple(arrays), shape=shape)
        matrix.check_format(full_check=True)
        return matrix


_SPARSE_PARTS = {"coo": ("row", "col"), "csc": ("indices", "indptr"), "csr": ("indices", "indptr")}
_SPARSE = {
    layout: type(f"_Sparse_{layout}", (_Sparse,), {"__slots__": (), "layout": layout}) for layout in _SPARSE_FORMATS
}


class _Object(Shim):
    """Stands for `object` where old protocols name it as a base class."""

    __slots__ = ()

    def __setstate__(self, state: Any) -> None:
        raise Refused("state of a bare object")


def _reconstructor(cls: type, base: Any, state: Any) -> Any:
    """`copyreg._reconstructor`: protocols 0 and 1 build new-style instances through it."""
    if not (isinstance(cls, type) and issubclass(cls, Shim)) or base is not _Object:
        raise Refused("copyreg._reconstructor of a class that is not data")
    return cls()


class _Dtype(Shim):
    """A dtype, rebuilt from its letters: numpy trusts the flags of a dtype's state, and wrong ones crash it."""

    __slots__ = ("letters", "order")

    def __init__(self, *args: Any) -> None:
        super().__init__()
        self.letters, self.order = args[0], "|"

    def __setstate__(self, state: Any) -> None:
        version, order, base, names, fields = state[:5]
        if version not in (3, 4) or base is not None or names is not None or fields is not None:
            raise Refused("numpy dtype with fields")
        self.order = order.decode("latin-1") if isinstance(order, bytes) else order

    def value(self, plain: Plain, budget: Budget) -> np.dtype:
        return self.dtype()

    def dtype(self) -> np.dtype:
        letters = self.letters.decode("latin-1") if isinstance(self.letters, bytes) else self.letters
        if not isinstance(letters, str) or letters[:1] not in _DTYPE_LETTERS:
            raise Refused(f"numpy dtype {describe(letters)}")
        dtype = np.dtype(letters)
        return dtype if self.order in ("|", "=") else dtype.newbyteorder(">" if self.order == ">" else "<")


class _Array(Shim):
    """An array, rebuilt from shape, dtype and bytes (or a list, for arrays of objects)."""

    __slots__ = ()

    def __setstate__(self, state: Any) -> None:
        _, shape, dtype, fortran, content = state if len(state) == 5 else (None, *state)
        self.state = {"shape": shape, "dtype": dtype, "fortran": fortran, "content": content}

    def value(self, plain: Plain, budget: Budget) -> np.ndarray:
        dtype, content = _dtype(self.state["dtype"]), self.state["content"]
        shape = _shape(self.state["shape"])
        order = "F" if self.state["fortran"] else "C"
        if not dtype.hasobject:
            budget.take(len(content))
            raw = _raw(content)
            return check_text(np.frombuffer(raw, dtype=dtype)).reshape(shape, order=order).copy(order="K")
        if not isinstance(content, list):
            raise ValueError("an array of objects without a list")
        budget.take(8 * len(content))
        array = np.full(len(content), None, dtype=object)
        for index, item in enumerate(content):
            array[index] = item
        return array.reshape(shape, order=order)


def _dtype(shim: Any) -> np.dtype:
    if not isinstance(shim, _Dtype):
        raise Refused(f"dtype of class {type(shim).__name__}")
    return shim.dtype()


def _raw(content: Any) -> bytes:
    if isinstance(content, str):
        return content.encode("latin-1")
    if not isinstance(content, (bytes, bytearray)):
        raise ValueError(f"bytes of an array that are a {type(content).__name__}")
    return bytes(content)


def _array(subtype: Any, shape: Any, letters: Any) -> _Array:
    """`multiarray._reconstruct`: an empty array that receives its content as state."""
    if subtype is not _Array or tuple(shape) != (0,):
        raise Refused(f"numpy array of {describe_class(subtype)} and initial shape {describe(shape)}")
    return _Array()


def _scalar(dtype: Any, content: Any = b"") -> Any:
    """`multiarray.scalar`."""
    kind = _dtype(dtype)
    if kind.hasobject:
        raise Refused("numpy scalar of object type")
    if not isinstance(content, (str, bytes)) or len(content) != kind.itemsize:
        raise ValueError("a numpy scalar of the wrong length")
    return check_text(np.frombuffer(_raw(content), dtype=kind))[0]


class _FromBuffer(Shim):
    """`numeric._frombuffer`: arrays of pickle protocol 5."""

    __slots__ = ()

    def __init__(self, buffer: Any, dtype: Any, shape: Any, order: str, axis_order: Any = None) -> None:
        super().__init__()
        if axis_order is not None or _dtype(dtype).hasobject:
            raise Refused("numpy buffer of object type or permuted axes")
        self.state = {"content": buffer, "dtype": dtype, "shape": shape, "order": order}

    def __setstate__(self, state: Any) -> None:
        raise Refused("state of a buffer")

    def value(self, plain: Plain, budget: Budget) -> np.ndarray:
        raw = self.state["content"]
        if not isinstance(raw, (bytes, bytearray, memoryview)):
            raise ValueError(f"a buffer that is a {type(raw).__name__}")
        budget.take(len(raw))
        order, shape = self.state["order"], _shape(self.state["shape"])
        flat = check_text(np.frombuffer(bytearray(raw), dtype=_dtype(self.state["dtype"])))
        return flat.reshape(shape, order="F" if order == "F" else "C")


def _encode(text: str, encoding: str = "latin1", errors: str = "strict") -> bytes:
    """`_codecs.encode`: Python 3 writes bytes this way for Python 2."""
    if not isinstance(text, str) or encoding not in ("latin1", "latin-1", "iso-8859-1", "utf-8", "ascii"):
        raise Refused(f"_codecs.encode to {describe(encoding)}")
    return text.encode(encoding, errors)


class _Storage(Shim):
    """`torch.storage._load_from_bytes`."""

    __slots__ = ()

    def __init__(self, content: Any) -> None:
        super().__init__()
        self.state = {"content": content}

    def __setstate__(self, state: Any) -> None:
        raise Refused("state of a storage")

    def value(self, plain: Plain, budget: Budget) -> Any:
        from nbavatar.io.tensors import parse_storage  # torch is imported only if a file holds a tensor

        budget.take(len(self.state["content"]))
        return parse_storage(_raw(self.state["content"]), budget)


class _Tensor(Shim):
    """`torch._utils._rebuild_tensor_v2`, as a numpy array."""

    __slots__ = ()

    def __init__(self, storage: Any, *args: Any) -> None:
        super().__init__()
        self.state = {"storage": storage, "args": args}

    def __setstate__(self, state: Any) -> None:
        raise Refused("state of a tensor")

    def value(self, plain: Plain, budget: Budget) -> np.ndarray:
        from nbavatar.io.tensors import rebuilt

        array = rebuilt(plain(self.state["storage"]), *self.state["args"]).numpy()
        budget.take(array.nbytes)
        return array.copy()


def _container(kind: type) -> Callable[..., Any]:
    """A constructor of containers that copies a container of the file, and nothing else."""

    def build(budget: Budget, items: Any = ()) -> Any:
        if not isinstance(items, (list, tuple, set, frozenset, dict)):
            raise Refused(f"a {kind.__name__} of a {type(items).__name__}")
        if kind in (set, frozenset):
            return kind(checked_key(item, budget) for item in items)
        if kind in (dict, collections.OrderedDict):
            pairs = items.items() if isinstance(items, dict) else items
            return kind((checked_key(key, budget), value) for key, value in pairs)
        return kind(items)

    return build


def _number(kind: type) -> Callable[..., Any]:
    def build(*values: Any) -> Any:
        if not all(isinstance(value, (int, float, complex, str)) for value in values):
            raise Refused(f"a {kind.__name__} of something else")
        return kind(*values)

    return build


def _text(value: Any = "") -> str:
    if not isinstance(value, (str, int, float)):
        raise Refused(f"text of a {type(value).__name__}")
    return str(value)


def _bytearray(content: Any = b"", encoding: str = "latin1") -> bytearray:
    return bytearray(content if isinstance(content, (bytes, bytearray)) else _encode(content, encoding))


def _slice(*limits: Any) -> slice:
    if not all(limit is None or isinstance(limit, int) for limit in limits):
        raise Refused("a slice of something else")
    return slice(*limits)


def _table() -> dict[tuple[str, str], Any]:
    table: dict[tuple[str, str], Any] = {
        ("collections", "OrderedDict"): Metered(_container(collections.OrderedDict)),
        ("_codecs", "encode"): Function(_encode),
        ("numpy", "ndarray"): _Array,
        ("numpy", "dtype"): _Dtype,
        ("chumpy.ch", "Ch"): _Ch,
        ("chumpy.reordering", "Select"): _Select,
        ("torch.storage", "_load_from_bytes"): _Storage,
        ("torch._utils", "_rebuild_tensor_v2"): _Tensor,
    }
    for module in ("copy_reg", "copyreg"):
        table[module, "_reconstructor"] = Function(_reconstructor)
    for module in ("__builtin__", "builtins"):
        for kind in (set, frozenset, list, tuple, dict):
            table[module, kind.__name__] = Metered(_container(kind))
        for kind in (int, float, bool, complex):
            table[module, kind.__name__] = Function(_number(kind))
        table[module, "long"] = Function(_number(int))
        table[module, "str"] = table[module, "unicode"] = Function(_text)
        table[module, "bytearray"] = Function(_bytearray)
        table[module, "slice"] = Function(_slice)
        table[module, "object"] = _Object
    for core in ("numpy.core", "numpy._core"):
        table[f"{core}.multiarray", "_reconstruct"] = Function(_array)
        table[f"{core}.multiarray", "scalar"] = Function(_scalar)
        table[f"{core}.numeric", "_frombuffer"] = _FromBuffer
    for layout in _SPARSE_FORMATS:
        for suffix in ("matrix", "array"):
            for module in (f"scipy.sparse.{layout}", f"scipy.sparse._{layout}"):
                table[module, f"{layout}_{suffix}"] = _SPARSE[layout]
    return table


ALLOWED = _table()
"""(module, name) -> what answers for it."""
