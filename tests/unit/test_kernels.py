"""Compiled kernels are kept where nobody else can put code, and are an aid only: without them all works."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.unit.users import OTHER, THIRD, as_user

ROOT = Path(__file__).parents[2]

# A package of its own with one kernel; what it computes, and how often it was compiled.
MODULE = """
import logging, sys
logging.basicConfig(level=logging.WARNING)
from nbavatar.kernels import cache_folder, keep_kernels, stored_njit
from pathlib import Path
keep_kernels(Path(__file__).parent, [Path(__file__)])

@stored_njit()
def twice(x):
    return 2 * x

if __name__ == "__main__":
    print(twice(21), sum(twice.stats.cache_hits.values()), cache_folder(Path(__file__).parent))
"""


@pytest.fixture
def package(tmp_path):
    folder = tmp_path / "package"
    folder.mkdir()
    (folder / "kernel.py").write_text(MODULE)
    return folder


def run(package, **changes):
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    environment |= {"PYTHONPATH": str(ROOT)} | changes
    done = subprocess.run([sys.executable, str(package / "kernel.py")], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    value, hits, folder = done.stdout.split()
    assert value == "42"
    return int(hits), folder, done.stderr


def test_the_second_process_finds_what_the_first_compiled(package):
    first, second = run(package), run(package)
    assert (first[0], second[0]) == (0, 1)
    assert Path(first[1]).parent == package / "__pycache__"


def test_a_changed_source_is_compiled_again(package):
    run(package)
    (package / "kernel.py").write_text(MODULE + "\n# another\n")
    assert run(package)[0] == 0


@pytest.mark.parametrize("damage", [b"", None])
def test_a_damaged_store_is_compiled_over(package, damage):
    _, folder, _ = run(package)
    stored = [path for path in Path(folder).iterdir() if path.suffix in (".nbi", ".nbc")]
    assert {path.suffix for path in stored} == {".nbi", ".nbc"}
    for path in stored:
        content = path.read_bytes()
        path.write_bytes(content[: len(content) // 2] if damage is None else damage)
    hits, _, told = run(package)
    assert hits == 0
    assert "cannot be read" in told
    run(package)  # mends what is left of the damage
    assert run(package)[0] == 1


def run_after(package, preparation, **changes):
    code = f"import runpy, sys\n{preparation}\nrunpy.run_path(sys.argv[1], run_name='__main__')\n"
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"} | changes
    done = subprocess.run([sys.executable, "-c", code, str(package / "kernel.py")], env=environment,
                          capture_output=True, text=True)  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.split()[:3], done.stderr


def test_without_any_place_kernels_are_compiled_in_every_process(package):
    """A package that is read-only, no home directory, no folder for temporary files."""
    (package / "__pycache__").write_text("")
    preparation = "import tempfile; tempfile.tempdir = '/dev/null/absent'"
    found, told = run_after(package, preparation, HOME="/dev/null", XDG_CACHE_HOME="", NUMBA_CACHE_DIR="")
    assert found == ["42", "0", "None"]
    assert told.count("no place to keep compiled kernels") == 1


def test_a_full_disk_keeps_nothing_and_stops_nothing(package):
    limit = 100  # bytes a file; a kernel is thousands
    preparation = f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))"
    found, told = run_after(package, preparation)
    assert found[:2] == ["42", "0"]
    assert "cannot be kept" in told


def test_what_another_user_prepared_is_passed_over(public_folder, monkeypatch, caplog):
    """The other has made the folders that we would use, closed and open, and a link to one of the victim's."""
    from nbavatar import kernels

    package = public_folder / "package"
    package.mkdir(mode=0o755)
    (package / "kernel.py").write_text(MODULE)
    name = f"package-{kernels._digest(package)}"
    theirs = public_folder / "named" / "nbavatar" / name
    as_user(OTHER, lambda: (os.umask(0), theirs.mkdir(parents=True, mode=0o777)))
    home = public_folder / "home"
    home.mkdir()
    os.chown(home, THIRD, THIRD)
    temporary = public_folder / "tmp"
    temporary.mkdir()
    temporary.chmod(0o1777)
    as_user(OTHER, lambda: os.symlink(home, temporary / f"nbavatar-{THIRD}"))

    def chosen(cache):
        monkeypatch.setenv("NUMBA_CACHE_DIR", str(public_folder / "named"))
        monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
        monkeypatch.setattr("tempfile.tempdir", str(temporary))
        return kernels.cache_folder.__wrapped__(package), caplog.text

    folder, told = as_user(THIRD, lambda: chosen(home / ".cache"))
    assert folder == home / ".cache" / "nbavatar" / name
    assert f"user {OTHER}" in told and "NUMBA_CACHE_DIR" in told
    folder, told = as_user(THIRD, lambda: chosen(package / "unwritable"))
    assert folder is None
    assert list(theirs.iterdir()) == []
    assert sorted(path.name for path in home.iterdir()) == [".cache"]
