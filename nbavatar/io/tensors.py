"""Tensors in files that torch wrote, read without torch's own readers.

`torch.load(weights_only=True)` runs no code, but what it makes of sizes that disagree depends on its version and on the
format: in the older one a tensor larger than its storage, or a storage that is never filled, shows whatever lies in
memory there, and in both a few bytes may stand for a tensor of any size. Here every size is compared with the bytes
that are there, names are answered from an allow-list, and nothing else is built (`nbavatar.io.unpickler`).

Two formats: the zip of `torch.save` (`data.pkl` and a record for every storage), which avatars and training states
have; and the stream of older versions, in which single storages lie inside pickles (`parse_storage`).
"""

import collections
import io
import os
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from nbavatar.errors import DataError, parsing
from nbavatar.io.archives import open_archive
from nbavatar.io.pickle_limits import Budget, Refused
from nbavatar.io.unpickler import Function, Shim, Unpickler, plain

__all__ = ["parse_storage", "read_tensors", "rebuilt"]

_DTYPES = {
    "DoubleStorage": torch.float64,
    "FloatStorage": torch.float32,
    "HalfStorage": torch.float16,
    "BFloat16Storage": torch.bfloat16,
    "LongStorage": torch.int64,
    "IntStorage": torch.int32,
    "ShortStorage": torch.int16,
    "CharStorage": torch.int8,
    "ByteStorage": torch.uint8,
    "BoolStorage": torch.bool,
}
_MAGIC, _PROTOCOL = 0x1950A86A20F9469CFC6C, 1001
_MAX_AXES = 16


class _Kind(NamedTuple):
    """Stands for a class of storages."""

    dtype: torch.dtype


class _Storage:
    """A storage: a flat tensor that owns its memory."""

    __slots__ = ("flat",)

    def __init__(self, flat: Tensor) -> None:
        self.flat = flat


def rebuilt(storage: Any, offset: Any, size: Any, stride: Any, *_: Any) -> Tensor:
    """`torch._utils._rebuild_tensor_v2`: a strided view of a storage.

    Raises:
        ValueError: the view leaves the storage, or has more elements than the storage.
    """
    if not isinstance(storage, _Storage):
        raise Refused(f"a tensor on a {type(storage).__name__}")
    if any(not isinstance(part, (tuple, list)) or len(part) > _MAX_AXES for part in (size, stride)):
        raise ValueError("a tensor of impossible shape")
    axes = [(int(n), int(step)) for n, step in zip(size, stride, strict=True)]
    offset, total = int(offset), storage.flat.numel()
    if offset < 0 or any(n < 0 or step < 0 for n, step in axes):
        raise ValueError("a tensor of impossible shape")
    count = 1
    for n, _step in axes:
        count *= n
    last = offset + sum((n - 1) * step for n, step in axes)
    if count and (last >= total or count > total):
        raise ValueError(f"a tensor of {count} elements up to {last} on a storage of {total}")
    if not count:
        return storage.flat.new_zeros([n for n, _step in axes])
    return storage.flat.as_strided([n for n, _step in axes], [step for _n, step in axes], offset)


class _TensorShim(Shim):
    __slots__ = ()

    def __init__(self, *args: Any) -> None:
        super().__init__()
        self.state = {"args": args}

    def __setstate__(self, state: Any) -> None:
        raise Refused("state of a tensor")

    def value(self, plain: Callable[[Any], Any], budget: Budget) -> Tensor:
        return rebuilt(*self.state["args"])


def _parameter(data: Any, *_: Any) -> Any:
    """`torch._utils._rebuild_parameter`: the tensor that it holds."""
    if not isinstance(data, _TensorShim):
        raise Refused(f"a parameter of a {type(data).__name__}")
    return data


def _ordered(items: Any = ()) -> Any:
    if items != ():
        raise Refused("an ordered dictionary of something")
    return collections.OrderedDict()


_ALLOWED: dict[tuple[str, str], Any] = {
    ("collections", "OrderedDict"): Function(_ordered),
    ("torch._utils", "_rebuild_tensor_v2"): _TensorShim,
    ("torch._utils", "_rebuild_parameter"): Function(_parameter),
    **{("torch", name): _Kind(dtype) for name, dtype in _DTYPES.items()},
}


def read_tensors(path: str | os.PathLike[str], expected: str, fix: str = "") -> Any:
    """Reads what `torch.save` wrote: tensors, numbers, text and containers of them; on the CPU.

    Args:
        path: the file.
        expected: what it should be, for error lines.
        fix: what to do, for error lines.

    Raises:
        DataError: missing, damaged, sizes that disagree, or anything outside the allow-list (its name is said).
    """
    with (
        parsing(path, expected, damaged="a damaged or foreign file", fix=fix),
        open_archive(path, stored=True) as archive,
    ):
        [pickled] = [name for name in archive.namelist() if name.endswith("/data.pkl")]
        folder = pickled.removesuffix("data.pkl")
        if f"{folder}byteorder" in archive.namelist() and archive.read(f"{folder}byteorder") != b"little":
            raise ValueError("numbers of the other byte order")
        storages: dict[str, _Storage] = {}

        def persistent(pid: Any) -> _Storage:
            kind, key, count = _persistent(pid)
            if key not in storages:
                entry = archive.getinfo(f"{folder}data/{key}")
                if entry.file_size != count * kind.dtype.itemsize:
                    raise ValueError(f"a storage of {count} elements in {entry.file_size} bytes")
                with archive.open(entry) as stream:
                    storages[key] = _filled(stream, kind.dtype, count)
            found = storages[key]
            if found.flat.dtype != kind.dtype or found.flat.numel() != count:
                raise ValueError("one storage of two kinds")
            return found

        try:
            content = archive.read(pickled)
            budget = Budget(len(content))
            return plain(Unpickler(io.BytesIO(content), _ALLOWED, budget, persistent).load(), budget)
        except Refused as error:
            raise DataError.of(
                path, "pickle", expected="tensors, numbers and text only", found=f"{error}, which is not allowed",
                fix="the file may try to run code: obtain it from its original source",
            ) from None  # fmt: skip


def parse_storage(content: bytes, budget: Budget) -> _Storage:
    """`torch.storage._load_from_bytes`: the storage in a stream of pickles of older versions.

    Args:
        content: the stream.
        budget: of the file that it is part of.

    Raises:
        ValueError: another format, or sizes that disagree.
    """
    stream = io.BytesIO(content)
    described: list[tuple[_Kind, str, int]] = []

    def persistent(pid: Any) -> str:
        described.append(_persistent(pid))
        return described[-1][1]

    magic, protocol, system = (Unpickler(stream, {}, budget).load() for _ in range(3))
    if (magic, protocol) != (_MAGIC, _PROTOCOL) or system.get("little_endian") is not True:
        raise ValueError("a storage in another format")
    Unpickler(stream, _ALLOWED, budget, persistent).load()
    keys = Unpickler(stream, {}, budget).load()
    if len(described) != 1 or keys != [described[0][1]]:
        raise ValueError("other than one storage")
    kind, _, count = described[0]
    stored = int.from_bytes(stream.read(8), "little")
    if stored != count or len(content) - stream.tell() != count * kind.dtype.itemsize:
        raise ValueError(f"a storage of {count} elements in {len(content) - stream.tell()} bytes")
    return _filled(stream, kind.dtype, count)


def _persistent(pid: Any) -> tuple[_Kind, str, int]:
    """Kind, key and number of elements of a storage."""
    if not isinstance(pid, tuple) or len(pid) not in (5, 6) or pid[0] != "storage" or pid[5:] not in ((), (None,)):
        raise Refused("a persistent id that is no storage")
    _, kind, key, _, count = pid[:5]
    if not isinstance(kind, _Kind) or not isinstance(key, str) or not isinstance(count, int) or count < 0:
        raise Refused("a storage of unknown kind")
    return kind, key, count


def _filled(stream: Any, dtype: torch.dtype, count: int) -> _Storage:
    flat = torch.zeros(count, dtype=torch.uint8 if dtype is torch.bool else dtype)
    memory = flat.view(torch.uint8).numpy().data.cast("B")
    done = 0
    while done < len(memory):
        got = stream.readinto(memory[done:])
        if not got:
            raise ValueError(f"a storage that ends after {done} bytes")
        done += got
    # Other bytes than 0 and 1 are no booleans; torch would take them as they are.
    return _Storage(flat != 0 if dtype is torch.bool else flat)
