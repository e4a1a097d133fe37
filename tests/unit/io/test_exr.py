"""Vertex maps: an exact round trip, and files that other readers of OpenEXR understand."""

import zipfile

import numpy as np
import OpenEXR
import pytest

from nbavatar.errors import DataError
from nbavatar.io.exr import half_error, read_vertex_maps, write_vertex_maps


def test_round_trip_is_exact_for_every_float(tmp_path):
    rng = np.random.default_rng(0)
    position = rng.normal(size=(515, 7, 3)).astype(np.float32)
    position[3, 2] = np.nan
    position[4, 1] = [np.inf, -0.0, 1e-42]
    frames = [f"{i:05d}" for i in range(515)]
    path = tmp_path / "a.exr.zip"
    write_vertex_maps(path, {"head.position": position, "head.displacement": position * 0}, frames, {"seed": 1})
    maps, ids, record = read_vertex_maps(path)
    assert ids == frames and record == {"seed": 1} and set(maps) == {"head.position", "head.displacement"}
    assert maps["head.position"].tobytes() == position.tobytes()


def test_an_image_is_vertices_wide_and_frames_high(tmp_path):
    values = np.arange(4 * 5 * 3, dtype=np.float32).reshape(4, 5, 3)
    write_vertex_maps(tmp_path / "b.exr.zip", {"x": values}, list("abcd"), {})
    with zipfile.ZipFile(tmp_path / "b.exr.zip") as archive:
        archive.extract("x.000000.exr", tmp_path)
    with OpenEXR.File(str(tmp_path / "x.000000.exr"), separate_channels=True) as image:
        channels = image.channels()
        assert set(channels) == {"R", "G", "B"}
        for c, name in enumerate("RGB"):
            assert channels[name].pixels.dtype == np.float32
            np.testing.assert_array_equal(channels[name].pixels, values[..., c])


def test_equal_contents_give_equal_bytes(tmp_path):
    values = np.ones((2, 3, 3), np.float32)
    for name in ("a", "b"):
        write_vertex_maps(tmp_path / f"{name}.exr.zip", {"x": values}, ["0", "1"], {})
    assert (tmp_path / "a.exr.zip").read_bytes() == (tmp_path / "b.exr.zip").read_bytes()


def test_half_precision_would_cost_a_tenth_of_a_millimetre_on_a_head():
    positions = np.linspace(0.125, 0.25, 1001, dtype=np.float32)
    # 11 significant bits: spacing 2^-13 m in [1/8, 1/4), so an error of up to 2^-14 m = 0.06 mm.
    assert 0.9 * 2**-14 < half_error(positions) <= 2**-14


@pytest.mark.parametrize("damage", ["missing", "not_a_zip", "truncated"])
def test_damaged_files_end_in_one_line(tmp_path, damage):
    path = tmp_path / "c.exr.zip"
    if damage != "missing":
        write_vertex_maps(path, {"x": np.ones((2, 3, 3), np.float32)}, ["0", "1"], {})
        data = path.read_bytes()
        path.write_bytes(b"hello" if damage == "not_a_zip" else data[: len(data) // 2])
    with pytest.raises(DataError) as error:
        read_vertex_maps(path)
    assert "\n" not in str(error.value)


def test_an_empty_sequence_is_written_and_read(tmp_path):
    write_vertex_maps(tmp_path / "d.exr.zip", {"x": np.zeros((0, 3, 3), np.float32)}, [], {})
    assert read_vertex_maps(tmp_path / "d.exr.zip")[0]["x"].shape == (0, 3, 3)
