import json
import os
import zipfile

import numpy as np
import pytest

from nbavatar.errors import DataError
from nbavatar.io.arrays import read_arrays, write_arrays
from nbavatar.io.atomic import atomic_write
from nbavatar.io.framepack import FramePack, FramePackWriter
from nbavatar.io.images import decode_image, encode_png
from nbavatar.io.records import read_json, write_json


def test_atomic_write_leaves_old_file_and_no_rest_when_it_fails(tmp_path):
    path = tmp_path / "a.exr.zip"
    path.write_text("old")
    with pytest.raises(RuntimeError), atomic_write(path) as temporary:
        temporary.write_text("half")
        assert temporary.name.endswith(".exr.zip")
        raise RuntimeError
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.exr.zip"]


def test_atomic_write_replaces_when_done(tmp_path):
    path = tmp_path / "new" / "b.txt"
    with atomic_write(path) as temporary:
        temporary.write_text("whole")
        assert not path.exists()
    assert path.read_text() == "whole"
    assert os.listdir(path.parent) == ["b.txt"]


def test_write_arrays_round_trips_and_its_bytes_depend_on_contents_only(tmp_path):
    arrays = {"b.x": np.arange(6, dtype=np.float32).reshape(2, 3), "a": np.array(["084", "x"]), "e": np.zeros((0, 3))}
    write_arrays(tmp_path / "1.npz", arrays, {"k": 1})
    write_arrays(tmp_path / "2.npz", dict(reversed(arrays.items())), {"k": 1})
    assert (tmp_path / "1.npz").read_bytes() == (tmp_path / "2.npz").read_bytes()
    read, record = read_arrays(tmp_path / "1.npz")
    assert record == {"k": 1}
    for name, array in arrays.items():
        np.testing.assert_array_equal(read[name], array)
        assert read[name].dtype == array.dtype
    np.testing.assert_array_equal(np.load(tmp_path / "1.npz")["b.x"], arrays["b.x"])


@pytest.mark.parametrize("name", ["a.npy", "record.json"])
def test_what_unpacks_to_far_more_than_the_file_is_refused_before(tmp_path, name):
    """What is unpacked grows further where it is converted, or parsed: numbers to float64, text to objects."""
    count = {"a.npy": 80 << 20, "record.json": 2 << 20}[name]
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        header = f"{{'descr': '|i1', 'fortran_order': False, 'shape': ({count},), }}\n".encode()
        start = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header if name == "a.npy" else b""
        archive.writestr(name, start + bytes(count))
    with pytest.raises(DataError, match=r"a\.npz: .* bytes that claims? to unpack to \d+"):
        read_arrays(tmp_path / "a.npz")


def test_read_arrays_names_what_is_wrong(tmp_path):
    with pytest.raises(DataError, match="no such file"):
        read_arrays(tmp_path / "none.npz")
    (tmp_path / "bad.npz").write_bytes(b"PK junk")
    with pytest.raises(DataError, match="damaged"):
        read_arrays(tmp_path / "bad.npz")
    write_arrays(tmp_path / "ok.npz", {"a": np.zeros(1)}, {})
    with pytest.raises(DataError, match=r"ok\.npz: b: expected an array of this name, found only a"):
        read_arrays(tmp_path / "ok.npz", required=("b",))
    truncated = (tmp_path / "ok.npz").read_bytes()[:-30]
    (tmp_path / "cut.npz").write_bytes(truncated)
    with pytest.raises(DataError, match="damaged"):
        read_arrays(tmp_path / "cut.npz")


def test_read_arrays_never_unpickles(tmp_path):
    np.savez(tmp_path / "p.npz", a=np.array([{"x": 1}], dtype=object))
    with pytest.raises(DataError):
        read_arrays(tmp_path / "p.npz")


def test_write_json_refuses_nan_and_leaves_nothing(tmp_path):
    with pytest.raises(ValueError):
        write_json(tmp_path / "x.json", {"psnr": float("nan")})
    assert os.listdir(tmp_path) == []
    write_json(tmp_path / "x.json", {"b": 1, "a": [1.5]})
    assert read_json(tmp_path / "x.json") == {"a": [1.5], "b": 1}
    (tmp_path / "x.json").write_text("{")
    with pytest.raises(DataError, match="does not parse"):
        read_json(tmp_path / "x.json")


@pytest.mark.parametrize("shape", [(5, 7), (5, 7, 3)])
def test_png_is_lossless_and_rgb(shape, rng, tmp_path):
    image = rng.integers(0, 256, shape, dtype=np.uint8)
    np.testing.assert_array_equal(decode_image(encode_png(image)), image)
    cv2 = pytest.importorskip("cv2")
    (tmp_path / "i.png").write_bytes(encode_png(image))
    other = cv2.imread(str(tmp_path / "i.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(other[..., ::-1] if image.ndim == 3 else other, image)


def test_decode_image_refuses_a_truncated_file(rng):
    encoded = encode_png(rng.integers(0, 256, (64, 64, 3), dtype=np.uint8))
    with pytest.raises(DataError, match="does not decode"):
        decode_image(encoded[: len(encoded) // 2])


def _manifest(frames):
    return {
        "stage": "crop", "subject": "S1", "camera": "084", "width": 4, "height": 3, "K": np.eye(3).tolist(),
        "cam_from_world": np.eye(4).tolist(), "frames": frames, "split": {frames[-1]: "test"}, "layers": {"rgb": "x"},
    }  # fmt: skip


def test_frame_pack_round_trips(tmp_path, rng):
    images = {f: rng.integers(0, 256, (3, 4, 3), dtype=np.uint8) for f in ("000", "001", "010")}
    with FramePackWriter(tmp_path / "a.zip", _manifest(list(images))) as writer:
        for frame, image in images.items():
            writer.add("rgb", frame, image)
        writer.manifest["K_per_frame"] = {f: (np.eye(3) * i).tolist() for i, f in enumerate(images)}
    pack = FramePack(tmp_path / "a.zip")
    assert pack.frames == ["000", "001", "010"]
    assert pack.split("test") == ["010"]
    assert pack.split("train") == ["000", "001"]
    assert pack.manifest["camera"] == "084"
    assert pack.intrinsics("010")[0, 0] == 2
    for frame, image in images.items():
        np.testing.assert_array_equal(pack.read("rgb", frame), image)
    with pytest.raises(DataError, match="rgb/003"):
        pack.read("rgb", "003")


def test_frame_pack_with_a_missing_image_is_not_written(tmp_path):
    with (
        pytest.raises(ValueError, match="rgb/001"),
        FramePackWriter(tmp_path / "a.zip", _manifest(["000", "001"])) as w,
    ):
        w.add("rgb", "000", np.zeros((3, 4, 3), np.uint8))
    assert os.listdir(tmp_path) == []


def test_frame_pack_of_another_format_or_damaged_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr("manifest.json", json.dumps({"format": 99}))
    with pytest.raises(DataError, match="format: expected 1, found 99"):
        FramePack(tmp_path / "a.zip")
    (tmp_path / "b.zip").write_bytes(b"nothing")
    with pytest.raises(DataError, match="damaged"):
        FramePack(tmp_path / "b.zip")


@pytest.mark.parametrize("size", [30_000, 3])
def test_a_frame_pack_is_as_large_as_its_pictures(tmp_path, size):
    """Renders are as large as the pack says: gigabytes of nothing, for a file of a few bytes."""
    manifest = {
        "stage": "crop", "subject": "toy", "camera": "c", "width": 4, "height": 4, "K": np.eye(3).tolist(),
        "cam_from_world": np.eye(4).tolist(), "frames": ["f0"], "layers": {"rgb": ""},
    }  # fmt: skip
    with FramePackWriter(tmp_path / "p.zip", manifest) as writer:
        writer.add("rgb", "f0", np.zeros((4, 4, 3), np.uint8))
    FramePack(tmp_path / "p.zip").close()
    with zipfile.ZipFile(tmp_path / "p.zip") as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    stored = json.loads(entries["manifest.json"]) | {"width": size, "height": size}
    with zipfile.ZipFile(tmp_path / "p.zip", "w") as archive:
        for name, content in (entries | {"manifest.json": json.dumps(stored)}).items():
            archive.writestr(name, content)
    with pytest.raises(DataError, match=rf"rgb/f0\.png: expected {size} x {size} as in the manifest, found 4 x 4"):
        FramePack(tmp_path / "p.zip")


@pytest.mark.parametrize("kind", ["a pipe", "a device"])
def test_what_has_no_end_is_not_read(tmp_path, kind):
    """Archives carry pipes and links."""
    path = tmp_path / "a"
    if kind == "a pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
    for read in (read_json, read_arrays, FramePack):
        with pytest.raises(DataError, match=f"found {kind}.*, which is never read"):
            read(path)
