"""Machines that lack what others have: each training below works, and what it leaves is that of an ordinary one.

Conditions are made in a mount namespace of the training's own, which only root can have.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from nbavatar.config.core import to_mapping
from nbavatar.io.framepack import FramePack
from tests.scenes.toy import write_scene
from tests.scenes.training import train_config
from tests.unit.disks import fill
from tests.unit.users import OTHER

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[3]
CONFIG = train_config(
    steps=2, texels=4, unet={"width": 4, "depth": 3, "max_width": 8, "convs": 1}, weight_lpips=0.0, previews=1,
    coarse_side=16, prefetch=2,
)  # fmt: skip


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("scene"))


def commands(scene, out):
    nbavatar = [sys.executable, "-m", "nbavatar"]
    meshes = ["--meshes", scene["meshes"]]
    frames = [str(path) for path in scene["packs"]]
    yield [*nbavatar, "train", "--frames", *frames, *meshes, "--spectral", scene["spectral"], "--out", out / "m.pt",
           "--device", "cpu", "--cfg", json.dumps(to_mapping(CONFIG))]  # fmt: skip
    yield [*nbavatar, "render", "--model", out / "m.pt", "--frames", *frames[:1], *meshes, "--out", out / "r.zip",
           "--device", "cpu"]  # fmt: skip


BOTH = (
    "import json, sys; from nbavatar.cli import main; sys.exit(any(main(words) for words in json.loads(sys.argv[1])))"
)


def works(scene, out, prefix=(), **changes):
    """Trains and renders; returns the weights."""
    environment = {name: value for name, value in os.environ.items() if name not in ("NUMBA_CACHE_DIR", "TMPDIR")}
    environment |= {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    for name, value in changes.items():
        environment.pop(name, None)
        if value is not None:
            environment[name] = str(value)
    # In one process: what takes most of the time is to start Python and torch.
    words = [list(map(str, command[3:])) for command in commands(scene, out)]
    program = [sys.executable, "-c", BOTH, json.dumps(words)]
    done = subprocess.run([*prefix, *program], cwd="/", env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    with FramePack(out / "r.zip") as pack:
        assert pack.read("rgb", pack.frames[0]).size
    return torch.load(out / "m.pt", weights_only=True)["state"]


@pytest.fixture(scope="module")
def ordinary(scene, tmp_path_factory):
    return works(scene, tmp_path_factory.mktemp("ordinary"))


def same(a, b):
    assert a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def apart(setup):
    """Words before a command that run it where `setup` has been done, unseen by others."""
    words = ["unshare", "--mount", "--propagation", "private", "sh", "-c", f'{setup} && exec "$@"', "sh"]
    if shutil.which("unshare") is None or subprocess.run([*words, "true"], capture_output=True).returncode != 0:
        pytest.skip("only root, and not in every container, can have a mount namespace")
    return words


DEVICES = (
    "mkdir -p {0} && for d in null zero random urandom; do touch {0}/$d; mount --bind /dev/$d {0}/$d; done && "
    "mount --rbind {0} /dev && test ! -e /dev/shm"
)


def test_without_shared_memory(scene, ordinary, tmp_path):
    weights = works(scene, tmp_path, apart(DEVICES.format(tmp_path / "dev")))
    same(weights, ordinary)


def test_without_proc(scene, ordinary, tmp_path):
    """torch reads there what the processor can do, and without it rounds as the plainest processor does."""
    weights = works(scene, tmp_path, apart("mount -t tmpfs none /proc"))
    assert weights.keys() == ordinary.keys()
    for name, value in weights.items():
        # Two steps of Adam, whose first is as long as its rate (at most 0.01) whatever the gradient's size.
        torch.testing.assert_close(value.float(), ordinary[name].float(), rtol=0.0, atol=0.04)


def test_with_inputs_that_nobody_can_write(scene, ordinary, tmp_path):
    folder = Path(scene["meshes"]).parent
    weights = works(scene, tmp_path, apart(f"mount --bind {folder} {folder} && mount -o remount,ro,bind {folder}"))
    same(weights, ordinary)


def test_as_a_user_without_account_and_home(ordinary, public_folder):
    """As many clusters run containers: a number without a name, nowhere to write but the folder of the results."""
    scene = write_scene(public_folder)
    out = public_folder / "out"
    out.mkdir()
    os.chown(out, OTHER, OTHER)
    if subprocess.run(["setpriv", f"--reuid={OTHER}", sys.executable, "-c", ""], capture_output=True).returncode != 0:
        pytest.skip("this Python is readable for root only")
    prefix = ["setpriv", f"--reuid={OTHER}", f"--regid={OTHER}", "--clear-groups"]
    weights = works(scene, out, prefix, HOME=None, XDG_CACHE_HOME=None, TMPDIR=public_folder)
    same(weights, ordinary)
    assert not (ROOT / "~").exists() and not Path("/~").exists()


def test_with_a_full_folder_for_temporary_files(scene, ordinary, tmp_path, small_disk):
    fill(small_disk, 0)
    weights = works(scene, tmp_path, TMPDIR=small_disk)
    same(weights, ordinary)


def test_with_long_paths(scene, ordinary, tmp_path):
    """For results and for temporary files: some 2,000 bytes."""
    out = tmp_path.joinpath(*["d" * 200] * 9)
    (out / "tmp").mkdir(parents=True)
    weights = works(scene, out, TMPDIR=out / "tmp")
    same(weights, ordinary)


def test_where_another_user_owns_the_folder(public_folder):
    """As a root-squashed disk does: everything can be read, nothing written."""
    scene = write_scene(public_folder)
    prefix = ["setpriv", f"--reuid={OTHER}", f"--regid={OTHER}", "--clear-groups"]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "HOME": "/nonexistent", "TMPDIR": str(public_folder)}
    locked = public_folder / "locked"
    locked.mkdir(mode=0o755)
    for command in commands(scene, locked):
        if "render" in command:
            break
        done = subprocess.run([*prefix, *map(str, command)], cwd="/", env=environment, capture_output=True, text=True)
        assert done.returncode == 2, done.stderr
        line = done.stderr.splitlines()[-1]
        assert line.startswith(f"nbavatar train: error: {locked}/m.pt.state") and "Permission denied" in line
        assert "Traceback" not in done.stderr
    assert list(locked.iterdir()) == []


def test_where_there_are_no_locks_a_number_stands_for_them(tmp_path, monkeypatch, caplog):
    """The system's answer is made here: a network disk without locks is nothing that a test can have."""
    import errno

    from nbavatar.errors import DataError
    from nbavatar.io import locks
    from nbavatar.training import state

    def refused(*_):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(locks.fcntl, "flock", refused)
    first = state.RunFolder(tmp_path / "s", {})
    first.save({"step": 1})
    with pytest.raises(DataError, match=f"another training that writes to it .process {os.getpid()}"):
        state.RunFolder(tmp_path / "s", {})
    del first
    again = state.RunFolder(tmp_path / "s", {})
    assert again.load() == {"step": 1}
    del again
    lock = tmp_path / "s" / "lock"
    for holder in (f"{locks.machine()} {1 << 22}", "0123ab 1", ""):  # killed here, on another machine, never begun
        lock.write_text(holder)
        state.RunFolder(tmp_path / "s", {})
    assert "0123ab" not in lock.read_text()
    assert "another machine" in caplog.text
