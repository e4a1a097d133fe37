"""No room: every kind of file ends in one line with its path, nothing under its name but what was there before."""

import errno
import fcntl
import gc
import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from nbavatar.errors import DataError, StorageError
from nbavatar.io.arrays import read_arrays, write_arrays
from nbavatar.io.atomic import atomic_write, temporary_beside
from nbavatar.io.eventfile import EventFile
from nbavatar.io.exr import read_vertex_maps, write_vertex_maps
from nbavatar.io.framepack import FramePack, FramePackWriter
from nbavatar.io.records import read_json, write_json
from nbavatar.io.video import VideoWriter, read_video
from nbavatar.training.state import RunFolder
from tests.unit.disks import fill

ROOM = 100_000  # bytes that are left, or that a file may have; every file below takes more
NOISE = np.random.default_rng(0)
PICTURES = NOISE.integers(0, 256, (12, 256, 256, 3), dtype=np.uint8)


def arrays(path):
    write_arrays(path, {"x": np.ones(40_000)}, {})
    assert read_arrays(path)[0]["x"].shape == (40_000,)


def record(path):
    write_json(path, {"x": "y" * 300_000})
    assert len(read_json(path)["x"]) == 300_000


def vertex_maps(path):
    write_vertex_maps(path, {"x": NOISE.random((60, 500, 3), np.float32)}, [str(i) for i in range(60)], {})
    assert read_vertex_maps(path)[0]["x"].shape == (60, 500, 3)


def frame_pack(path):
    manifest = {"stage": "ingest", "subject": "S", "camera": "1", "width": 256, "height": 256, "layers": ["rgb"],
                "cam_from_world": np.eye(4).tolist(), "frames": [str(i) for i in range(len(PICTURES))]}  # fmt: skip
    with FramePackWriter(path, manifest) as pack:
        for number, picture in enumerate(PICTURES):
            pack.add("rgb", str(number), picture)
    with FramePack(path) as pack:
        assert all(np.array_equal(pack.read("rgb", str(i)), picture) for i, picture in enumerate(PICTURES))


def video(path, codec="mp4v", repeats=3):
    with VideoWriter(path, 25.0, codec) as writer:
        for picture in [*PICTURES] * repeats:
            writer.add(picture)
    assert len(list(read_video(path, count=repeats * len(PICTURES)))) == repeats * len(PICTURES)


def vp9(path):
    video(path, "vp09", 1)


def drawing(path):
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    figure = Figure((8, 8))
    figure.figimage(NOISE.random((600, 600)))
    with atomic_write(path) as temporary:
        figure.savefig(temporary, metadata={})
    assert path.stat().st_size > ROOM


def model(path):
    """As models and checkpoints are written."""
    with atomic_write(path) as temporary, open(temporary, "wb") as stream:
        torch.save({"x": torch.ones(80_000)}, stream)
    assert torch.load(path, weights_only=True)["x"].shape == (80_000,)


def page(path):
    with atomic_write(path) as temporary:
        temporary.write_text("p" * 300_000, encoding="utf-8")
    assert path.stat().st_size == 300_000


WRITERS = {
    "x.npz": arrays, "x.json": record, "x.exr.zip": vertex_maps, "x.zip": frame_pack, "x.mp4": video, "y.mp4": vp9,
    "x.png": drawing, "x.pdf": drawing, "x.pt": model, "x.html": page,
}  # fmt: skip


@pytest.fixture
def limit():
    """A limit of the size of files, as `ulimit -f` sets."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)

    def set_limit(size: int) -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))

    yield set_limit
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("left", [0, ROOM])
def test_a_full_disk_is_one_line_and_nothing_is_lost(small_disk, name, left):
    path, write = small_disk / name, WRITERS[name]
    path.write_bytes(b"former")
    filler = fill(small_disk, left)
    with pytest.raises(StorageError) as error:
        write(path)
    line = str(error.value)
    assert line.startswith(f"{path}: expected room to write, found ") and "\n" not in line
    assert "a full disk" in line or "No space left" in line
    assert path.read_bytes() == b"former"
    assert sorted(os.listdir(small_disk)) == sorted(["filler", name])
    filler.unlink()
    write(path)  # the same command again
    assert os.listdir(small_disk) == [name]


@pytest.mark.parametrize("name", WRITERS)
def test_a_limit_of_file_sizes_is_one_line_and_nothing_is_lost(tmp_path, limit, name):
    path, write = tmp_path / name, WRITERS[name]
    path.write_bytes(b"former")
    limit(ROOM)
    with pytest.raises(StorageError) as error:
        write(path)
    line = str(error.value)
    assert line.startswith(f"{path}: expected room to write, found ") and "\n" not in line
    assert "a limit of file sizes" in line or "File too large" in line
    assert path.read_bytes() == b"former"
    assert os.listdir(tmp_path) == [name]
    limit(resource.getrlimit(resource.RLIMIT_FSIZE)[1])
    write(path)


def test_a_disk_that_was_full_for_a_time_leaves_no_video(small_disk):
    """Room is there again when the video ends: only reading it back tells."""
    path = small_disk / "x.mp4"
    filler = fill(small_disk, ROOM)
    with pytest.raises(DataError, match=rf"{path}: frames: expected 36, found a file of which not all come back"):
        with VideoWriter(path, 25.0, "mp4v") as writer:
            for number, picture in enumerate([*PICTURES] * 3):
                if number == 20:
                    filler.unlink()
                writer.add(picture)
    assert os.listdir(small_disk) == []


def test_several_videos_appear_all_or_none(small_disk):
    from nbavatar.data.synthetic.dataset import _Videos

    paths = [small_disk / f"{name}.mp4" for name in "abc"]
    fill(small_disk, ROOM)
    with pytest.raises(StorageError, match=rf"{small_disk}/[abc]\.mp4: .*a full disk"):
        with _Videos(paths, "mp4v") as videos:
            for picture in PICTURES:
                for index in range(3):
                    videos.write(index, picture)
    assert os.listdir(small_disk) == ["filler"]


def test_a_quota_is_named(tmp_path):
    """The system's answer is made here: a quota needs a file system that has them."""
    with (
        pytest.raises(StorageError, match=r"x\.json: .*found a quota that is used up"),
        atomic_write(tmp_path / "x.json"),
    ):
        raise OSError(errno.EDQUOT, os.strerror(errno.EDQUOT))
    assert os.listdir(tmp_path) == []


def test_other_errors_stay_what_they_are(tmp_path):
    with pytest.raises(ZeroDivisionError), atomic_write(tmp_path / "x"):
        raise ZeroDivisionError
    with pytest.raises(PermissionError), atomic_write(tmp_path / "x"):
        raise PermissionError(errno.EACCES, "")


def test_logs_and_curves_name_their_file_and_go_on_after(small_disk):
    folder = RunFolder(small_disk / "m.pt.state", {})
    folder.log({"step": 1, "loss": 0.5})
    folder.save({"step": 1})
    filler = fill(small_disk, 0)
    with pytest.raises(StorageError, match=r"(events\.jsonl|tfevents.*): expected room to write, found a full disk"):
        for step in range(2, 3000):  # what is left of a block takes some lines yet
            folder.log({"step": step, "loss": 0.5})
    with pytest.raises(StorageError, match=r"m\.pt\.state/state\.pt: expected room to write, found a full disk"):
        folder.save({"step": 2, "weights": torch.ones(100_000)})
    filler.unlink()
    del folder
    gc.collect()  # the errors above hold frames that hold the folder, and with it its lock, until they are collected
    again = RunFolder(small_disk / "m.pt.state", {})
    state = again.load()
    assert state is not None and state["step"] == 1
    again.log({"step": 2, "loss": 0.25})
    assert again.events() == [{"step": 1, "loss": 0.5}, {"step": 2, "loss": 0.25}]
    again.save({"step": 2})


def test_curves_name_their_file(tmp_path, limit):
    curves = EventFile(tmp_path)
    limit(curves.path.stat().st_size)
    with pytest.raises(StorageError, match=r"tfevents.* a limit of file sizes"):
        curves.scalars(1, {"x": 1.0})


def test_what_is_named_was_on_the_disk_before(tmp_path, monkeypatch):
    calls = []
    for name in ("fsync", "replace"):
        original = getattr(os, name)
        monkeypatch.setattr(os, name, lambda *args, name=name, original=original: (calls.append(name), original(*args)))
    write_json(tmp_path / "x.json", {})
    assert calls == ["fsync", "replace"]


KILLED = """
import os, signal, sys
from nbavatar.io.atomic import atomic_write
with atomic_write(sys.argv[1]) as temporary:
    temporary.write_text("half")
    print(temporary, flush=True)
    if len(sys.argv) > 2:
        sys.stdin.read()
    else:
        os.kill(os.getpid(), signal.SIGKILL)
"""


def test_leftovers_of_a_killed_writer_go_with_the_next_and_those_of_a_living_one_stay(tmp_path):
    path = tmp_path / "picture.exr.zip"
    command = [sys.executable, "-c", KILLED, str(path)]
    killed = Path(subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False).stdout.strip())
    assert killed.read_text() == "half"
    with subprocess.Popen([*command, "wait"], stdout=subprocess.PIPE, stdin=subprocess.PIPE, text=True) as living:
        held = Path(living.stdout.readline().strip())
        elsewhere = tmp_path / ".picture.0123ab-1.89abcdef.tmp.exr.zip"  # of another machine
        others = [tmp_path / ".picture2.0123ab-1.89abcdef.tmp.exr.zip", tmp_path / ".picture.tmp.exr.zip"]
        for file in (elsewhere, *others):
            file.write_text("")
        with atomic_write(path) as temporary:
            temporary.write_text("whole")
        assert not killed.exists()
        assert held.exists() and elsewhere.exists() and all(file.exists() for file in others)
        old = elsewhere.stat().st_mtime - 2 * 24 * 3600
        for file in (elsewhere, *others):
            os.utime(file, (old, old))
        temporary_beside(path)
        assert not elsewhere.exists() and all(file.exists() for file in others)
        living.communicate()
    assert path.read_text() == "half" and not held.exists()  # the last writer wins, whole


def test_the_longest_name_that_a_disk_takes(tmp_path):
    path = tmp_path / ("ü" * 125 + ".json")  # 255 bytes
    write_json(path, {"x": 1})
    assert read_json(path) == {"x": 1}


@pytest.mark.parametrize("name", ["events.jsonl", "lock"])
@pytest.mark.parametrize("locks", [True, False])
def test_what_a_state_from_elsewhere_links_to_is_not_written(tmp_path, monkeypatch, name, locks):
    def no_lock(*_: object) -> None:
        raise OSError(errno.ENOLCK, "")

    if not locks:  # as on some network disks, where the file itself says who holds it
        monkeypatch.setattr(fcntl, "flock", no_lock)
    notes = tmp_path / "notes"
    notes.write_text('{"step": 1}\n')
    state = tmp_path / "m.pt.state"
    RunFolder(state, {})
    gc.collect()
    (state / name).unlink(missing_ok=True)
    (state / name).symlink_to(notes)
    with pytest.raises(OSError, match="symbolic links"):
        RunFolder(state, {}).log({"step": 2, "loss": 0.5})
    assert notes.read_text() == '{"step": 1}\n'
