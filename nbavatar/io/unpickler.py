"""A pickle machine that builds plain data from an allow-list of names, in bounded time and memory.

A pickle is a program. Beside naming functions to call it can make the reader work without end: tuples that hold one
another twice are hashed in exponential time when they become keys, one opcode may claim gigabytes, and a few hundred
bytes may stand for a structure that no printing or conversion ever finishes. So:

    names       answered from a table, else refused; states only for objects of ours (`Shim`)
    keys        of dictionaries and sets: text, real numbers, and tuples or frozensets of few of them, of which there
                are at most `MAX_COMPOSITE_KEYS`, because whoever chooses them can make them collide
    opcodes     at most `MAX_OPCODES`; lengths never beyond the bytes that are there
    structure   no container that holds itself; no more entries than `MAX_ENTRIES`, counted as often as they are
                referred to
    memory      of all objects and copies together no more than `Budget` allows, asked before they are made

The machine is the standard library's in Python (`pickle._Unpickler`, of which the one in C is a translation): its
opcodes can be overridden one by one, and it keeps its memo in a dictionary, where the one in C allocates a table as
large as a file asks for.
"""

import collections
import io
import pickle
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from nbavatar.io.pickle_limits import ORDERED_ENTRY, Budget, Refused, checked_key, weight

__all__ = [
    "MAX_ENTRIES",
    "MAX_OPCODES",
    "Function",
    "Metered",
    "Shim",
    "Unpickler",
    "describe_class",
    "plain",
]

MAX_OPCODES = 16_000_000
"""Opcodes of one pickle; the largest file of the Decaf dataset has about a fifth."""
MAX_ENTRIES = 16_000_000
"""Entries of all containers of one pickle, shared ones counted wherever they are shared; an array counts as one
entry for every 4 numbers, text for every 16 letters."""
# Bytes that an opcode takes at most: the object, its growth with the first entries, and what `plain` notes of it.
_ANY, _ENTRY, _SET_ITEM, _CALL = 48, 64, 112, 400
_COST = {
    "MARK": 64, "PUT": 100, "BINPUT": 100, "LONG_BINPUT": 100, "MEMOIZE": 100, "EMPTY_LIST": 300, "LIST": 300,
    "EMPTY_DICT": 432, "DICT": 432, "EMPTY_SET": 432, "FROZENSET": 432, "TUPLE": 264, "TUPLE1": 264, "TUPLE2": 264,
    "TUPLE3": 264, "NEWOBJ": _CALL, "NEWOBJ_EX": _CALL, "REDUCE": _CALL, "OBJ": _CALL, "INST": _CALL,
}  # fmt: skip


_Machine: Any = pickle._Unpickler  # type: ignore[attr-defined]


class Function:
    """A callable without attributes, so that no opcode can alter it."""

    __slots__ = ("_call",)

    def __init__(self, call: Callable[..., Any]) -> None:
        object.__setattr__(self, "_call", call)

    def __call__(self, *args: Any) -> Any:
        """Calls it."""
        return self._call(*args)

    def __setattr__(self, name: str, value: Any) -> None:
        raise Refused(f"assignment to {name} of a function")


class Metered(Function):
    """A callable that takes the budget of the file before its arguments."""

    __slots__ = ()


class Shim:
    """Collects the state of an object whose class is replaced by plain data after loading."""

    __slots__ = ("state",)

    def __init__(self, *args: Any) -> None:
        self.state: dict[str, Any] = {}

    def __setstate__(self, state: Any) -> None:
        parts = [part for part in (state if isinstance(state, tuple) else (state,)) if isinstance(part, dict)]
        if not all(isinstance(key, str) for part in parts for key in part):
            raise Refused("a state without names")
        self.state = {key: value for part in parts for key, value in part.items()}

    def value(self, plain: Callable[[Any], Any], budget: Budget) -> Any:
        """The plain data that it stands for; `plain` resolves what it holds."""
        raise ValueError("an object without data")


class Unpickler(_Machine):
    """Reads one pickle from `stream`, from where it stands; see the module for what it allows.

    Args:
        stream: the whole file in memory.
        allowed: (module, name) -> what answers for it.
        budget: what copies that the file asks for are counted against.
        persistent: answers persistent ids, where the format has them (torch).
    """

    dispatch: dict[int, Callable[[Any], None]] = dict(_Machine.dispatch)

    def __init__(
        self,
        stream: io.BytesIO,
        allowed: Mapping[tuple[str, str], Any],
        budget: Budget,
        persistent: Callable[[Any], Any] | None = None,
    ) -> None:
        super().__init__(stream, encoding="latin1")
        self._allowed, self._budget, self._persistent = allowed, budget, persistent
        self._stream = stream

    def load(self) -> Any:
        """The object of the pickle, its shims not yet resolved (`plain`)."""
        self._opcodes = 0
        return super().load()

    def find_class(self, module: str, name: str) -> Any:
        """What answers for a name."""
        try:
            return self._allowed[module, name]
        except KeyError:
            raise Refused(f"{module}.{name}") from None

    def persistent_load(self, pid: Any) -> Any:
        """What answers for a persistent id."""
        if self._persistent is None:
            raise Refused("a persistent id")
        return self._persistent(pid)

    def load_dict(self) -> None:
        """DICT: as the standard library's, keys checked."""
        items = self.pop_mark()
        self._budget.take(_ENTRY * len(items))
        self.append({checked_key(items[i], self._budget): items[i + 1] for i in range(0, len(items), 2)})

    def load_setitem(self) -> None:
        """SETITEM."""
        value, key = self.stack.pop(), self.stack.pop()
        self._entered(self.stack[-1], 1)[checked_key(key, self._budget)] = value

    def load_setitems(self) -> None:
        """SETITEMS."""
        items = self.pop_mark()
        target = self._entered(self.stack[-1], len(items) // 2)
        for i in range(0, len(items), 2):
            target[checked_key(items[i], self._budget)] = items[i + 1]

    def load_additems(self) -> None:
        """ADDITEMS."""
        items = self.pop_mark()
        target = self.stack[-1]
        if type(target) is not set:
            raise Refused(f"items of a {type(target).__name__}")
        self._budget.take(_SET_ITEM * len(items))
        target.update(checked_key(item, self._budget) for item in items)

    def load_frozenset(self) -> None:
        """FROZENSET."""
        items = self.pop_mark()
        self._budget.take(_SET_ITEM * len(items))
        self.append(frozenset(checked_key(item, self._budget) for item in items))

    def load_append(self) -> None:
        """APPEND."""
        value = self.stack.pop()
        _list(self.stack[-1]).append(value)

    def load_appends(self) -> None:
        """APPENDS."""
        items = self.pop_mark()
        _list(self.stack[-1]).extend(items)

    def load_bytearray8(self) -> None:
        """BYTEARRAY8: never more than there is to read."""
        count = int.from_bytes(self.read(8), "little")
        if count > self._stream.getbuffer().nbytes:
            raise ValueError("a length beyond the end of the file")
        self.append(bytearray(self.read(count)))

    def load_build(self) -> None:
        """BUILD: states are for shims; an ordered dictionary's is dropped (torch keeps versions of layers there)."""
        state, target = self.stack.pop(), self.stack[-1]
        if isinstance(target, Shim):
            self._budget.take(sum(map(weight, state)) if isinstance(state, tuple) else weight(state))
            target.__setstate__(state)
        elif type(target) is not collections.OrderedDict:
            raise Refused(f"a state of {type(target).__name__}")

    def load_newobj(self) -> None:
        """NEWOBJ: objects of ours only."""
        args, cls = self.stack.pop(), self.stack.pop()
        self.append(_new(cls, args))

    def load_newobj_ex(self) -> None:
        """NEWOBJ_EX."""
        keywords, args, cls = self.stack.pop(), self.stack.pop(), self.stack.pop()
        if keywords:
            raise Refused("keywords of a class")
        self.append(_new(cls, args))

    def load_reduce(self) -> None:
        """REDUCE: calls what the table has answered, with a tuple."""
        args, call = self.stack.pop(), self.stack.pop()
        self.append(self._called(call, args))

    def load_obj(self) -> None:
        """OBJ."""
        call, *args = self.pop_mark()
        self.append(self._called(call, tuple(args)))

    def load_inst(self) -> None:
        """INST."""
        module, name = (self.readline()[:-1].decode("ascii") for _ in range(2))
        args = self.pop_mark()
        self.append(self._called(self.find_class(module, name), tuple(args)))

    def _called(self, call: Any, args: Any) -> Any:
        if not isinstance(args, tuple):
            raise Refused(f"a call with a {type(args).__name__}")
        self._budget.take(weight(args) + sum(map(weight, args)))
        if not isinstance(call, Function):
            return _new(call, args)
        return call(self._budget, *args) if isinstance(call, Metered) else call(*args)

    def _entered(self, target: Any, count: int) -> Any:
        """The mapping that is about to have so many more entries."""
        if type(target) not in (dict, collections.OrderedDict):
            raise Refused(f"entries of a {type(target).__name__}")
        self._budget.take((_ENTRY if type(target) is dict else ORDERED_ENTRY) * count)
        return target

    def get_extension(self, code: int) -> None:
        """EXT1, EXT2, EXT4: the registry of this process is none of a file's business."""
        raise Refused("an extension code")

    def _counted(opcode: Callable[["Unpickler"], None], cost: int) -> Callable[["Unpickler"], None]:
        def run(self: "Unpickler") -> None:
            self._opcodes += 1
            if self._opcodes > MAX_OPCODES:
                raise ValueError("far more entries than any file of the field has")
            self._budget.take(cost)
            opcode(self)

        return run

    for _name, _handler in {
        "DICT": load_dict, "SETITEM": load_setitem, "SETITEMS": load_setitems, "ADDITEMS": load_additems,
        "FROZENSET": load_frozenset, "APPEND": load_append, "APPENDS": load_appends, "BYTEARRAY8": load_bytearray8,
        "BUILD": load_build, "NEWOBJ": load_newobj, "NEWOBJ_EX": load_newobj_ex, "REDUCE": load_reduce,
        "OBJ": load_obj, "INST": load_inst,
    }.items():  # fmt: skip
        dispatch[getattr(pickle, _name)[0]] = _handler
    for _code in dispatch:
        dispatch[_code] = _counted(dispatch[_code], _ANY)
    for _name, _more in _COST.items():
        _code = getattr(pickle, _name)[0]
        dispatch[_code] = _counted(dispatch[_code], _more)
    del _name, _handler, _code, _counted, _more


def plain(value: Any, budget: Budget) -> Any:
    """Replaces shims by what they hold, inside containers too; shared objects stay shared.

    Raises:
        ValueError: a container that holds itself, more than `MAX_ENTRIES` entries, or a spent budget.
    """
    return _Plain(budget).of(value)[0]


class _Plain:
    """Resolves shims; knows of every object its result and how many entries it stands for."""

    def __init__(self, budget: Budget) -> None:
        self._budget = budget
        # Originals are kept alive beside their results, so that an id is not given to another object meanwhile.
        self._seen: dict[int, tuple[Any, Any, int] | None] = {}

    def of(self, value: Any) -> tuple[Any, int]:
        """(result, number of entries)."""
        if isinstance(value, (str, bytes)):
            return value, 1 + len(value) // 16
        if isinstance(value, (int, float)) or value is None:
            return value, 1
        key = id(value)
        if key in self._seen:
            known = self._seen[key]
            if known is None:
                raise ValueError("a container that holds itself")
            return known[1], known[2]
        self._seen[key] = None
        result = value.value(lambda inner: self.of(inner)[0], self._budget) if isinstance(value, Shim) else value
        result, count = self._inside(result)
        if count > MAX_ENTRIES:
            raise ValueError("a structure that refers to its parts without end")
        self._seen[key] = (value, result, count)
        return result, count

    def _inside(self, value: Any) -> tuple[Any, int]:
        if isinstance(value, dict):
            parts = [self.of(item) for item in value.values()]
            for name, (part, _) in zip(list(value), parts, strict=True):
                value[name] = part
        elif isinstance(value, list):
            parts = [self.of(item) for item in value]
            value[:] = [part for part, _ in parts]
        elif isinstance(value, tuple):
            parts = [self.of(item) for item in value]
            value = tuple(part for part, _ in parts)
        elif isinstance(value, np.ndarray) and value.dtype == object:
            parts = [self.of(item) for item in value.reshape(-1)]
            for index, (part, _) in zip(np.ndindex(value.shape), parts, strict=True):
                value[index] = part
        else:
            return value, 1 + (value.size // 4 if isinstance(value, np.ndarray) else 0)
        return value, 1 + sum(count for _, count in parts)


def _list(target: Any) -> list:
    if type(target) is not list:
        raise Refused(f"items of a {type(target).__name__}")
    return target


def _new(cls: Any, args: Any) -> Any:
    if not (isinstance(cls, type) and issubclass(cls, Shim)) or not isinstance(args, tuple):
        raise Refused(f"a call of {describe_class(cls)}")
    return cls(*args)


def describe_class(value: Any) -> str:
    """Name of a class, or of the class of anything else."""
    return value.__name__ if isinstance(value, type) else type(value).__name__
