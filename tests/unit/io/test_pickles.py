"""The allow-listed unpickler: everything the datasets hold comes back, everything else is refused by name."""

import collections
import io
import os
import pickle
import subprocess
import sys
import types

import numpy as np
import pytest
import scipy.sparse
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nbavatar.errors import DataError
from nbavatar.io.pickles import read_array, read_pickle


def _write(path, value, protocol=2):
    path.write_bytes(value if isinstance(value, bytes) else pickle.dumps(value, protocol=protocol))
    return path


@pytest.mark.parametrize("protocol", range(6))
def test_plain_data_round_trips(tmp_path, protocol):
    rng = np.random.default_rng(0)
    value = {
        "084": {"intrinsic": rng.normal(size=(3, 3)), "extrinsic": rng.normal(size=(4, 4)).tolist()},
        7: collections.OrderedDict(a=np.float32(2.5), b=np.int64(-3), c=np.bool_(True), d=np.arange(5)[::2]),
        "cuts": [(3, 4), (9, 10)],
        "set": {1, 2},
        "bytes": b"\x00\xff",
        "fortran": np.asfortranarray(rng.normal(size=(4, 5))),
        "complex": 1j,
        "text": np.array(["a", "bcd"]),
    }
    found = read_pickle(_write(tmp_path / "a.pkl", value, protocol))
    np.testing.assert_equal(found, value)
    assert type(found[7]) is collections.OrderedDict
    objects = np.array([{"x": np.ones(2)}, [3, "t"], None], dtype=object)
    found_objects = read_pickle(_write(tmp_path / "o.pkl", objects, protocol))
    np.testing.assert_equal(found_objects.tolist(), objects.tolist())
    assert found["fortran"].flags.writeable


@pytest.mark.parametrize("protocol", [0, 1, 2, 4, 5])
@pytest.mark.parametrize("layout", ["csc", "csr", "coo"])
@pytest.mark.parametrize("kind", ["matrix", "array"])
def test_sparse_matrices(tmp_path, protocol, layout, kind):
    dense = np.random.default_rng(1).normal(size=(5, 9)) * (np.random.default_rng(2).random((5, 9)) < 0.4)
    matrix = getattr(scipy.sparse, f"{layout}_{kind}")(dense)
    found = read_pickle(_write(tmp_path / "s.pkl", {"J_regressor": matrix}, protocol))["J_regressor"]
    assert found.format == layout
    np.testing.assert_array_equal(found.toarray(), dense)


def test_sparse_with_indices_outside_is_refused(tmp_path):
    matrix = scipy.sparse.csc_matrix(np.eye(3))
    matrix.indices[1] = 99
    with pytest.raises(DataError, match="damaged"):
        read_pickle(_write(tmp_path / "s.pkl", matrix))


@pytest.mark.parametrize("protocol", [0, 1, 2])
def test_numpy_1_module_paths(tmp_path, protocol):
    """Files written by numpy 1 name numpy.core; those of numpy 2 name numpy._core."""
    value = {"a": np.arange(6.0).reshape(2, 3), "b": np.float64(0.1)}
    content = pickle.dumps(value, protocol=protocol)
    for old, new in ((b"numpy._core", b"numpy.core"), (b"numpy.core", b"numpy._core")):
        text = content.replace(old, new)
        np.testing.assert_equal(read_pickle(_write(tmp_path / "n.pkl", text)), value)


def test_python_2_strings_are_latin1(tmp_path):
    # Protocol 2 of Python 2: BINSTRING-style keys and raw array bytes as str, with copy_reg and __builtin__ names.
    raw = np.array([1.5, -2.0]).tobytes()
    content = (
        b"\x80\x02}U\x01aq\x01cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85U\x01b\x87R"
        b"(K\x01K\x02\x85cnumpy\ndtype\nU\x02f8K\x00K\x01\x87R(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
        b"\x89U" + bytes([len(raw)]) + raw + b"tbs."
    )
    np.testing.assert_equal(read_pickle(_write(tmp_path / "p.pkl", content)), {"a": np.array([1.5, -2.0])})


@pytest.fixture
def chumpy(monkeypatch):
    """Stand-ins for chumpy's classes, under its module names, so that pickles can be written as it writes them."""
    modules = {name: types.ModuleType(name) for name in ("chumpy", "chumpy.ch", "chumpy.reordering")}
    ch = type("Ch", (), {"__module__": "chumpy.ch"})
    select = type("Select", (), {"__module__": "chumpy.reordering"})
    modules["chumpy.ch"].Ch, modules["chumpy.reordering"].Select = ch, select
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    return ch, select


@pytest.mark.parametrize("protocol", [0, 1, 2, 4])
def test_chumpy_arrays_become_numpy(tmp_path, chumpy, protocol):
    ch, select = (cls.__new__(cls) for cls in chumpy)
    values = np.random.default_rng(0).normal(size=(4, 3, 20))
    ch.__dict__.update(x=values, _dirty_vars=set(), _itr=None)
    index = np.arange(values.size).reshape(values.shape)[:, :, :10].ravel()
    select.__dict__.update(a=ch, idxs=index, preferred_shape=(4, 3, 10))
    path = _write(tmp_path / "c.pkl", {"posedirs": ch, "shapedirs": select, "again": ch}, protocol)
    for name in ("chumpy", "chumpy.ch", "chumpy.reordering"):
        del sys.modules[name]
    found = read_pickle(path)
    np.testing.assert_array_equal(found["posedirs"], values)
    np.testing.assert_array_equal(found["shapedirs"], values[:, :, :10])
    assert found["again"] is found["posedirs"]


def test_object_npy_with_torch_tensors(tmp_path):
    """The published landmark files hold numpy arrays beside torch tensors."""
    value = {"static": np.arange(4), "dynamic": torch.arange(12).reshape(3, 4), "bary": torch.rand(2, 3).T}
    np.save(tmp_path / "e.npy", np.array(value, dtype=object), allow_pickle=True)
    found = read_array(tmp_path / "e.npy")
    np.testing.assert_array_equal(found["static"], value["static"])
    np.testing.assert_array_equal(found["dynamic"], value["dynamic"].numpy())
    np.testing.assert_array_equal(found["bary"], value["bary"].numpy())


def test_plain_npy(tmp_path):
    for array in (np.random.default_rng(0).normal(size=(3, 2)), np.asfortranarray(np.eye(3)), np.zeros((0, 4))):
        np.save(tmp_path / "a.npy", array)
        np.testing.assert_array_equal(read_array(tmp_path / "a.npy"), array)
    objects = np.array([[1, "a"], [None, {"k": 2}]], dtype=object)
    np.save(tmp_path / "o.npy", objects, allow_pickle=True)
    np.testing.assert_equal(read_array(tmp_path / "o.npy"), objects)


class _Evil:
    def __init__(self, call, *args):
        self.pair = (call, args)

    def __reduce__(self):
        return self.pair


def _marker(path):
    path.write_text("ran")


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
@pytest.mark.parametrize(
    ("call", "args", "name"),
    [
        (os.system, ("touch {}",), "system"),
        (eval, ("open({!r}, 'w')",), "eval"),
        (getattr, ([], "append"), "getattr"),
        (__import__, ("os",), "__import__"),
        (np.load, ("{}",), "load"),
        (io.open, ("{}", "w"), "open"),
        (np.memmap, ("{}",), "memmap"),
        (torch.load, ("{}",), "load"),
    ],
)
def test_code_is_refused_by_name_and_not_run(tmp_path, protocol, call, args, name):
    target = tmp_path / "ran"
    evil = _Evil(call, *(a.format(str(target)) if isinstance(a, str) else a for a in args))
    for path, reader in ((tmp_path / "e.pkl", read_pickle), (tmp_path / "e.npy", read_array)):
        if reader is read_pickle:
            _write(path, {"ok": 1, "bad": evil}, protocol)
        else:
            np.save(path, np.array([evil, None], dtype=object), allow_pickle=True)
        with pytest.raises(DataError) as caught:
            reader(path)
        line = str(caught.value)
        assert str(path) in line and name in line and "\n" not in line
        assert not target.exists()


def test_names_with_dots_do_not_reach_attributes(tmp_path):
    content = b"\x80\x04\x8c\x05numpy\x8c\x0endarray.tofile\x93."
    with pytest.raises(DataError, match=r"numpy\.ndarray\.tofile"):
        read_pickle(_write(tmp_path / "d.pkl", content))


def test_state_cannot_alter_the_reader(tmp_path):
    """BUILD on an allowed function or class must not leave anything behind for the next file."""
    for head in (
        b"c_codecs\nencode\n",
        b"cchumpy.ch\nCh\n",
        b"c__builtin__\nobject\n",
        b"cnumpy\ndtype\n",
        b"c__builtin__\nset\n",
    ):
        for state in (b"}U\x01xK\x01s", b"N}U\x01xK\x01s\x86"):
            with pytest.raises(DataError):
                read_pickle(_write(tmp_path / "b.pkl", b"\x80\x02" + head + state + b"b."))
    test_plain_data_round_trips(tmp_path, 2)


def test_reconstructor_makes_data_only(tmp_path):
    content = b"ccopy_reg\n_reconstructor\n(c__builtin__\nset\nc__builtin__\nobject\nNtR."
    with pytest.raises(DataError, match="_reconstructor"):
        read_pickle(_write(tmp_path / "r.pkl", content))


def test_array_of_huge_initial_shape_is_refused(tmp_path):
    names = b"\x80\x02cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\n"
    content = names + b"\x8a\x06\x00\x00\x00\x00\x00\x01\x85U\x01b\x87R."
    with pytest.raises(DataError, match="initial shape"):
        read_pickle(_write(tmp_path / "h.pkl", content))


def test_self_reference_is_refused(tmp_path):
    """Nothing that is converted to arrays or printed may go round in circles."""
    value: list = [1]
    value.append({"again": (value, value)})
    with pytest.raises(DataError, match="a container that holds itself"):
        read_pickle(_write(tmp_path / "s.pkl", value))


def test_missing_and_foreign_files(tmp_path):
    for reader, expected in ((read_pickle, "readable file"), (read_array, "a numpy .npy file")):
        with pytest.raises(DataError, match=f"{expected}.*found no such file"):
            reader(tmp_path / "none")
        with pytest.raises(DataError, match="cannot be read: Is a directory"):
            reader(tmp_path)
        with pytest.raises(DataError):
            reader(_write(tmp_path / "x", b"GIF89a not a pickle"))
        with pytest.raises(DataError):
            reader(_write(tmp_path / "x", b""))


def _levels(make, count=30):
    value = make(0, 0)
    for _ in range(count):
        value = make(value, value)
    return value


def _chains_of_selects(ch, select, count):
    """Selections of selections, twenty in a chain, each of which asks for a fresh megabyte."""
    source, index = ch.__new__(ch), np.zeros(1 << 17, dtype=np.int64)
    source.__dict__.update(x=np.zeros(8))
    chains = []
    for _ in range(count):
        last = source
        for _ in range(20):
            node = select.__new__(select)
            node.__dict__.update(a=last, idxs=index, preferred_shape=None)
            last = node
        chains.append(last)
    return chains


class _Call:
    def __init__(self, call, *args):
        self.pair = (call, args)

    def __reduce__(self):
        return self.pair


_TUPLES = b"K\x00" + 60 * b"2\x86"  # DUP TUPLE2: ((((0, 0), (0, 0)), ...

_LIST = b"](" + b"K\x01" * 20_000 + b"eq\x000"  # twenty thousand numbers, remembered
_CHUMPY = b"cchumpy.ch\nCh\n)\x81"

BOMBS = {
    # numpy would make every text as wide as the longest.
    "text among numbers": lambda: (
        b"\x80\x02" + _CHUMPY + b"}X\x01\x00\x00\x00x](X" + (10**5).to_bytes(4, "little") + b"x" * 10**5
        + b"X\x01\x00\x00\x00y" * 20_000 + b"esb."
    ),
    "sets of one list": lambda: b"\x80\x02" + _LIST + b"](c__builtin__\nset\nq\x01" + b"h\x00\x85R".join([b""] * 2) + (
        b"h\x01h\x00\x85R" * 2000 + b"e."
    ),
    "ordered mappings of one": lambda: (
        b"\x80\x02}(" + b"".join(b"J%sN" % n.to_bytes(4, "little") for n in range(20_000)) + b"uq\x000"
        + b"](ccollections\nOrderedDict\nq\x01h\x00\x85R" + b"h\x01h\x00\x85R" * 1000 + b"e."
    ),
    "states of one mapping": lambda: (
        b"\x80\x02}(" + b"".join(b"X\x05\x00\x00\x00%05dN" % n for n in range(20_000)) + b"uq\x000"
        + b"](" + (_CHUMPY + b"h\x00b") * 4000 + b"e."
    ),
    "empty sets": lambda: b"\x80\x04(" + b"\x8f" * 3_500_000 + b"l.",
    "keys that could collide": lambda: pickle.dumps({(k, -k): 0 for k in range(3000)}, protocol=2),
    "complex keys, which collide": lambda: pickle.dumps(dict.fromkeys(complex(-1000003 * k, k) for k in range(2000))),
    # A tuple's hash is not remembered: twice the time for every level, ages for 130 bytes.
    "hash of a key": lambda: b"\x80\x02}" + _TUPLES + b"K\x01s.",
    "hash of a set's item": lambda: b"\x80\x04(" + _TUPLES + b"\x91.",
    "hash of a set's item, called": lambda: b"\x80\x02c__builtin__\nfrozenset\n]" + _TUPLES + b"a\x85R.",
    "colliding keys": lambda: pickle.dumps({k * (2**61 - 1): 0 for k in range(1, 2000)}, protocol=2),
    "nested lists": lambda: pickle.dumps({"R": _levels(lambda a, b: [a, b])}, protocol=2),
    "nested tuples": lambda: pickle.dumps({"R": _levels(lambda a, b: (a, b))}, protocol=2),
    "text of nested tuples": lambda: pickle.dumps(_Call(str, _levels(lambda a, b: (a, b))), protocol=2),
    "shared arrays": lambda: pickle.dumps([_levels(lambda a, b: [a, b], 12), [[np.zeros(1 << 16)] * 4096]], protocol=2),
    "bytearray of a size": lambda: pickle.dumps(_Call(bytearray, 1 << 40), protocol=2),
    "bytearray of a claimed length": lambda: b"\x80\x05\x96" + (1 << 40).to_bytes(8, "little") + b"abc.",
    "text of a claimed length": lambda: b"\x80\x04\x8d" + (1 << 40).to_bytes(8, "little") + b"abc.",
    "frame of a claimed length": lambda: b"\x80\x04\x95" + (1 << 60).to_bytes(8, "little") + b"abc.",
    "memo of a claimed size": lambda: b"\x80\x02]r\xff\xff\xff\x7f0\x96.",
    "many copies of one text": lambda: (
        b"\x80\x02(X\x00\x00\x10\x00" + b"a" * (1 << 20) + b"q\x000"
        + b"c_codecs\nencode\nq\x010" + b"h\x01h\x00\x85R" * 2000 + b"l."
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BOMBS)
def test_bombs_are_refused_at_once(tmp_path, name):
    """Each would take minutes to ages, or more memory than there is; read in a process that may have a gigabyte."""
    content = BOMBS[name]()
    assert len(content) < 4_000_000
    code = (
        "import resource, sys, numpy, scipy.sparse\n"
        "from nbavatar.errors import DataError\n"
        "from nbavatar.io.pickles import read_pickle\n"
        "used = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()\n"
        "resource.setrlimit(resource.RLIMIT_AS, (used + (1 << 30),) * 2)\n"
        "try:\n    read_pickle(sys.argv[1])\n"
        "except DataError as error:\n    print(error)\n"
    )
    _write(tmp_path / "bomb.pkl", content)
    done = subprocess.run(
        [sys.executable, "-c", code, tmp_path / "bomb.pkl"], capture_output=True, text=True, timeout=60, check=True
    )
    assert "bomb.pkl: pickle: " in done.stdout, done
    assert "more memory than there is" not in done.stdout, done  # refused before it was asked for


def test_chains_of_selects_are_refused_when_they_outgrow_their_file(tmp_path, chumpy):
    ch, select = chumpy
    few = _write(tmp_path / "few.pkl", _chains_of_selects(ch, select, 2))
    many = _write(tmp_path / "many.pkl", _chains_of_selects(ch, select, 30))
    for name in ("chumpy", "chumpy.ch", "chumpy.reordering"):
        del sys.modules[name]
    assert [array.shape for array in read_pickle(few)] == [(1 << 17,)] * 2
    assert many.stat().st_size < 1_500_000
    with pytest.raises(DataError, match="far more memory than the file has bytes"):
        read_pickle(many)


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_containers_by_call_round_trip(tmp_path, protocol):
    value = {
        "set": {1, (2, "x")},
        "frozen": frozenset([frozenset([3]), 4]),
        "bytes": bytearray(b"\x00\xff"),
        "k": (1, 2),
    }
    value[(5, "key")] = slice(1, None, 2)
    assert read_pickle(_write(tmp_path / "c.pkl", value, protocol)) == value


_WHOLE = pickle.dumps(
    {"a": np.arange(20.0), "b": [1, (2, "x")], "c": scipy.sparse.eye_array(3, format="csc")}, protocol=2
)


@settings(max_examples=150, deadline=None, database=None, derandomize=True)
@given(cut=st.integers(0, len(_WHOLE) - 1), position=st.integers(0, len(_WHOLE) - 1), byte=st.integers(0, 255))
def test_damage_is_a_data_error_or_data(tmp_path_factory, cut, position, byte):
    """Truncation always fails cleanly; a flipped byte fails cleanly or yields data, never another exception."""
    path = tmp_path_factory.mktemp("damage") / "a.pkl"
    with pytest.raises(DataError):
        read_pickle(_write(path, _WHOLE[:cut]))
    changed = bytearray(_WHOLE)
    changed[position] = byte
    try:
        read_pickle(_write(path, bytes(changed)))
    except DataError as error:
        assert "\n" not in str(error)
