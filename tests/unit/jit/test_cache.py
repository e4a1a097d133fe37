"""Compiled kernels are kept where nobody else can put code, and are an aid only: without them all works."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import nbavatar
from tests.unit.users import OTHER, THIRD, as_user

SOURCE = Path(nbavatar.__file__).parent

# A kernel, and a constant of another module that is compiled into it.
KERNEL = """
import logging, sys
logging.basicConfig(level=logging.WARNING)
from nbavatar.doubling.factors import TWO
from nbavatar.jit.cache import cache_folder, stored_njit

@stored_njit()
def twice(x):
    return TWO * x

def main():
    print(twice(21), sum(twice.stats.cache_hits.values()), cache_folder(__name__))
"""


@pytest.fixture
def package(tmp_path):
    """A copy of what kernels need of this package, with a kernel in it."""
    folder = tmp_path / "nbavatar"
    folder.mkdir()
    for name in ("__init__", "errors", "imports", "packages", "private"):
        shutil.copy(SOURCE / f"{name}.py", folder)
    shutil.copytree(SOURCE / "jit", folder / "jit", ignore=shutil.ignore_patterns("__pycache__"))
    (folder / "doubling").mkdir()
    (folder / "doubling/factors.py").write_text("TWO = 2\n")
    (folder / "doubling/kernel.py").write_text(KERNEL)
    return folder


def call(package, preparation="", **changes):
    """Runs the kernel in a process of its own: what it gives, hits in the cache, folder; what is logged."""
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    environment |= {"PYTHONPATH": str(package.parent), "PYTHONDONTWRITEBYTECODE": "1"} | changes
    code = f"{preparation}\nfrom nbavatar.doubling.kernel import main\nmain()\n"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=package.parent, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split(), done.stderr


def run(package, **changes):
    (value, hits, folder), told = call(package, **changes)
    assert value == "42"
    return int(hits), folder, told


def test_the_second_process_finds_what_the_first_compiled(package):
    first, second = run(package), run(package)
    assert (first[0], second[0]) == (0, 1)
    assert Path(first[1]).parent == package / "__pycache__"
    assert Path(first[1]).name.startswith("doubling.kernel-")


def test_a_changed_source_is_compiled_again(package):
    run(package)
    (package / "doubling/kernel.py").write_text(KERNEL + "\n# another\n")
    assert run(package)[0] == 0


def test_a_changed_constant_of_another_module_is_compiled_in(package):
    """A kernel that is left as it was would still multiply by the old value."""
    run(package)
    (package / "doubling/factors.py").write_text("TWO = 3\n")
    (value, hits, _), _ = call(package)
    assert (value, hits) == ("63", "0")


def test_the_kernels_of_the_rasterizer_depend_on_the_constants_that_they_take():
    """`projection.py` holds FADE_FLOOR, which is compiled into the kernels of the projection."""
    from nbavatar.imports import dependencies

    found = dependencies(["nbavatar.rendering.billboards.cpu_projection_kernels"], packages=False)
    assert "nbavatar.rendering.billboards.projection" in found


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


def test_without_any_place_kernels_are_compiled_in_every_process(package):
    """A package that is read-only, no home directory, no folder for temporary files."""
    (package / "__pycache__").write_text("")
    preparation = "import tempfile; tempfile.tempdir = '/dev/null/absent'"
    found, told = call(package, preparation, HOME="/dev/null", XDG_CACHE_HOME="", NUMBA_CACHE_DIR="")
    assert found == ["42", "0", "None"]
    assert told.count("no place to keep compiled kernels") == 1


def test_a_full_disk_keeps_nothing_and_stops_nothing(package):
    limit = 100  # bytes a file; a kernel is thousands
    preparation = f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))"
    found, told = call(package, preparation)
    assert found[:2] == ["42", "0"]
    assert "cannot be kept" in told


# Three processes that reach `prepare` together, whose compiling lasts.
TOGETHER = """
import pathlib, sys, time
from numba import types
from nbavatar.doubling import kernel
from nbavatar.jit import compile

def slowly(kernels, quickly=compile._compile):
    time.sleep(0.5)
    quickly(kernels)

compile._compile = slowly
here = pathlib.Path(sys.argv[1])
(here / sys.argv[2]).touch()
while len(list(here.iterdir())) < 3:
    time.sleep(0.01)
compile.prepare("doubling", {kernel.twice: (types.int64,)})
kernel.main()
"""


def test_of_processes_that_start_together_one_compiles(package, tmp_path):
    """It says so, once; the others wait for what it has compiled."""
    (tmp_path / "here").mkdir()
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    environment["PYTHONPATH"] = str(package.parent)
    command = [sys.executable, "-c", TOGETHER, str(tmp_path / "here")]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    started = [
        subprocess.Popen([*command, str(number)], cwd=package.parent, env=environment, **streams) for number in range(3)
    ]
    results = [process.communicate(timeout=300) for process in started]
    assert sorted(out.split()[:2] for out, _ in results) == [["42", "0"], ["42", "1"], ["42", "1"]], results
    assert sorted(told.count("compiling the doubling kernels") for _, told in results) == [0, 0, 1]
    hits, _, told = run(package)
    assert hits == 1 and "compiling" not in told


def test_what_another_user_prepared_is_passed_over(public_folder, monkeypatch, caplog):
    """The other has made the folders that we would use, closed and open, and a link to one of the victim's."""
    from nbavatar import private
    from nbavatar.jit import cache as kernels

    package = public_folder / "package"
    package.mkdir(mode=0o755)
    monkeypatch.setattr(private, "ROOT", package)
    name = f"jit.lanes-{kernels.sources_digest(('nbavatar.jit.lanes',))}"
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
        return kernels.cache_folder.__wrapped__("nbavatar.jit.lanes"), caplog.text

    folder, told = as_user(THIRD, lambda: chosen(home / ".cache"))
    assert folder == home / ".cache" / "nbavatar" / name
    assert f"user {OTHER}" in told and "NUMBA_CACHE_DIR" in told
    folder, told = as_user(THIRD, lambda: chosen(package / "unwritable"))
    assert folder is None
    assert list(theirs.iterdir()) == []
    assert sorted(path.name for path in home.iterdir()) == [".cache"]
