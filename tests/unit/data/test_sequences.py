import numpy as np
import pytest

from nbavatar.data.sequences import MeshSequence, Part, read_sequence, write_sequence
from nbavatar.errors import DataError
from nbavatar.io.arrays import read_arrays, write_arrays


def _sequence(rng, frames=("a", "b", "c")):
    verts = rng.normal(size=(len(frames), 4, 3)).astype(np.float32)
    part = Part(np.array([[0, 1, 2], [0, 2, 3]]), verts[0], verts)
    extras = {
        "contact.head": rng.random((len(frames), 4)) > 0.5,
        "camera.084.K": np.eye(3),
        "segments": np.array([[0, 2]]),
    }
    return MeshSequence(list(frames), {"head": part}, extras)


def test_sequence_round_trips(tmp_path, rng):
    sequence = _sequence(rng)
    write_sequence(tmp_path / "s.npz", sequence, {"stage": "fit"})
    read, record = read_sequence(tmp_path / "s.npz")
    assert read.frames == sequence.frames
    assert record["stage"] == "fit"
    assert list(read.parts) == ["head"]
    np.testing.assert_array_equal(read.parts["head"].verts, sequence.parts["head"].verts)
    np.testing.assert_array_equal(read.extras["contact.head"], sequence.extras["contact.head"])


def test_subset_cuts_rows_of_frames_and_nothing_else(rng):
    sequence = _sequence(rng)
    cut = sequence.subset(["c", "a"])
    np.testing.assert_array_equal(cut.parts["head"].verts, sequence.parts["head"].verts[[2, 0]])
    np.testing.assert_array_equal(cut.extras["contact.head"], sequence.extras["contact.head"][[2, 0]])
    # Three frames and a 3x3 camera matrix: a camera is never mistaken for one row a frame.
    np.testing.assert_array_equal(cut.extras["camera.084.K"], np.eye(3))
    with pytest.raises(DataError, match="frame x"):
        sequence.subset(["x"])


@pytest.mark.parametrize(
    ("faces", "verts", "match"),
    [
        ([[0, 1, 4]], (3, 4, 3), "vertex ids from 0 to 3, found 0 to 4"),
        ([[0, 1, 2]], (2, 4, 3), r"head.verts: expected \[3, V, 3\]"),
        ([[0, 1, 2]], (3, 5, 3), "head.verts"),
    ],
)
def test_write_refuses_shapes_that_disagree(tmp_path, faces, verts, match):
    part = Part(np.array(faces), np.zeros((4, 3), np.float32), np.zeros(verts, np.float32))
    with pytest.raises(DataError, match=match):
        write_sequence(tmp_path / "s.npz", MeshSequence(["a", "b", "c"], {"head": part}), {})
    assert list(tmp_path.iterdir()) == []


def test_sequence_without_any_part_is_refused(tmp_path):
    with pytest.raises(DataError, match="at least one part"):
        write_sequence(tmp_path / "s.npz", MeshSequence(["a"], {}), {})


@pytest.mark.parametrize(
    ("name", "change", "line"),
    [
        ("head.faces", lambda a: a + 0.5, r"head.faces: expected whole numbers \[F, 3\], found float64 \[2, 3\]"),
        ("head.faces", lambda a: a[:0], r"head.faces: expected \[F, 3\] with at least one face, found \[0, 3\]"),
        ("head.verts", lambda a: a.astype(complex), "head.verts: expected real numbers .* found complex128"),
        ("head.rest", lambda a: a.astype(str), "head.rest: expected real numbers .* found <U"),
        ("head.rest", lambda a: np.where(np.arange(4)[:, None] == 2, np.nan, a), "NaN or infinity at vertex 2"),
        (
            "head.verts",
            lambda a: np.where(np.arange(4)[:, None] == 3, np.inf, a),
            "NaN or infinity at frame 0, vertex 3",
        ),
        ("frames", lambda a: np.arange(3), "frames: expected frame ids, text"),
        ("frames", lambda a: np.array(["a", "b", "a"]), "frames: expected each frame once"),
    ],
)
def test_arrays_that_are_no_meshes_are_refused_when_they_are_read(tmp_path, rng, name, change, line):
    write_sequence(tmp_path / "s.npz", _sequence(rng), {})
    arrays, record = read_arrays(tmp_path / "s.npz")
    write_arrays(tmp_path / "s.npz", {**arrays, name: change(arrays[name])}, record)
    with pytest.raises(DataError, match=line) as error:
        read_sequence(tmp_path / "s.npz")
    assert "s.npz" in str(error.value)


def test_a_part_that_is_not_in_a_frame_is_nan_there(tmp_path, rng):
    sequence = _sequence(rng)
    sequence.parts["head"].verts[1] = np.nan
    write_sequence(tmp_path / "s.npz", sequence, {})
    verts = read_sequence(tmp_path / "s.npz")[0].parts["head"].verts
    assert np.isnan(verts[1]).all() and np.isfinite(verts[[0, 2]]).all()
