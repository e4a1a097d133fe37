"""Files of torch, read without torch's readers: equal to what torch reads, and no size is believed."""

import collections
import pickle
import zipfile

import numpy as np
import pytest
import torch

from nbavatar.errors import DataError
from nbavatar.io.pickles import read_pickle
from nbavatar.io.tensors import read_tensors


def content():
    rng = torch.Generator().manual_seed(0)
    wide = torch.randn(4, 6, generator=rng)
    return {
        "float": wide,
        "turned": wide.T,
        "part": wide[1:3, ::2],
        "last": torch.randn(2, 3, 4, 5, generator=rng).to(memory_format=torch.channels_last),
        "parameter": torch.nn.Parameter(torch.ones(3)),
        "empty": torch.zeros(0, 3),
        "scalar": torch.tensor(2.5, dtype=torch.float64),
        "kinds": [torch.arange(5).to(kind) for kind in _KINDS],
        "numbers": (1, 2.5, None, True, "text", 3 << 70),
        "layer": torch.nn.Linear(2, 3).state_dict(),
    }


_KINDS = (torch.float16, torch.bfloat16, torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8, torch.bool)


def same(ours, theirs):
    if isinstance(theirs, torch.Tensor):
        assert type(ours) is torch.Tensor and ours.dtype == theirs.dtype and ours.stride() == theirs.stride()
        assert torch.equal(ours, theirs) and not ours.requires_grad
    elif isinstance(theirs, dict):
        assert type(ours) is type(theirs) and list(ours) == list(theirs)
        for key in theirs:
            same(ours[key], theirs[key])
    elif isinstance(theirs, (list, tuple)):
        assert type(ours) is type(theirs) and len(ours) == len(theirs)
        for one, other in zip(ours, theirs):
            same(one, other)
    else:
        assert ours == theirs and type(ours) is type(theirs)


def test_equal_to_what_torch_reads(tmp_path):
    path = tmp_path / "model.pt"
    torch.save(content(), path)
    found = read_tensors(path, "an avatar")
    same(found, torch.load(path, weights_only=True))
    assert isinstance(found["layer"], collections.OrderedDict)
    # Views of one storage go on sharing it.
    found["float"][2, 0] = 7.0
    assert found["turned"][0, 2] == found["part"][1, 0] == 7.0


def edit(path, change, compression=zipfile.ZIP_STORED):
    """The archive written anew, checksums right, each member through `change(name, bytes)`."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, data in members.items():
            archive.writestr(name, change(name.partition("/")[2], data))


def saved(path, size, stride, offset=0, elements=4):
    """A file with one tensor of this shape on a storage of so many float32, which its sizes may not fit."""
    torch.save({"a": torch.as_strided(torch.arange(100.0), (77,), (1,))[:4].clone()}, path)
    tuples = {1: b"\x85", 2: b"\x86"}[len(size)]
    shape = b"".join(b"J" + n.to_bytes(4, "little", signed=True) for n in size) + tuples
    steps = b"".join(b"J" + n.to_bytes(4, "little", signed=True) for n in stride) + tuples
    body = (
        b"\x80\x02}X\x01\x00\x00\x00actorch._utils\n_rebuild_tensor_v2\n((X\x07\x00\x00\x00storagectorch\nFloatStorage\n"
        b"X\x01\x00\x00\x000X\x03\x00\x00\x00cpuJ" + elements.to_bytes(4, "little") + b"tQ"
        b"J" + offset.to_bytes(4, "little", signed=True) + shape + steps + b"\x89ccollections\nOrderedDict\n)RtRs."
    )
    edit(path, lambda name, data: body if name == "data.pkl" else data)
    return path


def test_the_edited_file_is_right_where_its_sizes_are(tmp_path):
    found = read_tensors(saved(tmp_path / "m.pt", (2, 2), (2, 1)), "an avatar")["a"]
    assert torch.equal(found, torch.tensor([[0.0, 1.0], [2.0, 3.0]]))


@pytest.mark.parametrize(
    ("size", "stride", "options"),
    [
        ((4096,), (1,), {}),  # a storage that grows shows whatever lies behind it in memory
        ((4,), (1,), {"offset": 1}),
        ((2,), (9,), {}),
        ((1 << 30,), (0,), {}),  # one number, a thousand million times
        ((2, 2), (-1, 1), {}),
        ((4,), (1,), {"offset": -1}),
        ((-4,), (1,), {}),
        ((4,), (1,), {"elements": 1 << 20}),  # more than the record has bytes
        ((2,), (1,), {"elements": 2}),
    ],
)
def test_tensors_and_storages_beyond_their_bytes_are_refused(tmp_path, size, stride, options):
    with pytest.raises(DataError, match=r"m\.pt: expected an avatar, found a damaged or foreign file"):
        read_tensors(saved(tmp_path / "m.pt", size, stride, **options), "an avatar")


def test_names_beside_tensors_are_refused_and_not_run(tmp_path):
    class Evil:
        def __reduce__(self):
            return (eval, (f"open({str(tmp_path / 'ran')!r}, 'w')",))

    torch.save({"a": torch.zeros(1)}, tmp_path / "m.pt")
    edit(tmp_path / "m.pt", lambda name, data: pickle.dumps(Evil(), 2) if name == "data.pkl" else data)
    with pytest.raises(DataError, match=r"builtins?__?\.eval, which is not allowed"):
        read_tensors(tmp_path / "m.pt", "an avatar")
    assert not (tmp_path / "ran").exists()


def test_damaged_archives(tmp_path):
    path = tmp_path / "m.pt"
    for change in (
        lambda name, data: b"big" if name == "byteorder" else data,
        lambda name, data: data[:-1] if name == "data/0" else data,
        lambda name, data: data[:-3] if name == "data.pkl" else data,
    ):
        torch.save({"a": torch.zeros(4)}, path)
        edit(path, change)
        with pytest.raises(DataError, match="a damaged or foreign file"):
            read_tensors(path, "an avatar")
    # What torch writes is never compressed: a few bytes would stand for gigabytes of empty sets, or of text.
    torch.save({"a": torch.zeros(1 << 14)}, path)
    edit(path, lambda name, data: data, zipfile.ZIP_DEFLATED)
    with pytest.raises(DataError, match="claim to unpack"):
        read_tensors(path, "an avatar")
    path.write_bytes(b"no zip")
    with pytest.raises(DataError, match="a damaged or foreign file"):
        read_tensors(path, "an avatar")
    with pytest.raises(DataError, match="no such file"):
        read_tensors(tmp_path / "none.pt", "an avatar")


def _landmarks(path, change):
    """A pickled tensor whose stored stream went through `change`."""
    tensor = torch.arange(300)
    inner = tensor.untyped_storage()
    plain = pickle.dumps(tensor, protocol=2)
    assert inner.nbytes() == 2400
    # The stream lies in the pickle as text of latin-1 in UTF-8.
    start = plain.index(b"X", plain.index(b"_codecs")) + 5
    length = int.from_bytes(plain[start - 4 : start], "little")
    stream = change(plain[start : start + length].decode().encode("latin-1")).decode("latin-1").encode()
    path.write_bytes(plain[: start - 4] + len(stream).to_bytes(4, "little") + stream + plain[start + length :])
    return path


def test_storages_inside_pickles(tmp_path):
    path = tmp_path / "l.pkl"
    assert np.array_equal(read_pickle(_landmarks(path, lambda data: data)), np.arange(300))

    def without_keys(data):
        """The list of storages to fill is empty: torch returns memory as it found it."""
        start = data.rindex(b"\x80\x02]")
        return data[:start] + b"\x80\x02]q\x00." + data[data.index(b"a.", start) + 2 :]

    for change in (without_keys, lambda data: data[:-8], lambda data: data + b"\0" * 8, lambda data: data[:40]):
        with pytest.raises(DataError, match="damaged content"):
            read_pickle(_landmarks(path, change))
