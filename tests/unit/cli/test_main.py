import argparse
import importlib
import os
import subprocess
import sys

import pytest

from nbavatar import cli
from nbavatar.errors import DataError
from nbavatar.waiting import SPINS, VARIABLES


def run(*words):
    return subprocess.run([sys.executable, "-m", "nbavatar", *words], capture_output=True, text=True)


def test_help_lists_every_verb_and_starts_without_heavy_packages():
    code = (
        "import sys; from nbavatar.cli import main\n"
        "try: main(['--help'])\nexcept SystemExit as e: assert e.code == 0\n"
        "assert not {'torch', 'numpy', 'cv2'} & set(sys.modules)"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    for verb in cli.VERBS:
        assert verb in out.stdout


@pytest.mark.parametrize("verb", sorted(cli.VERBS))
def test_every_verb_explains_itself(verb, capsys):
    with pytest.raises(SystemExit) as end:
        cli.main([verb, "--help"])
    assert end.value.code == 0
    assert len(capsys.readouterr().out.splitlines()) > 5


def test_unknown_verb_is_one_line_and_exit_code_2():
    out = run("trian")
    assert out.returncode == 2
    assert out.stderr.strip() == "nbavatar: error: unknown verb 'trian'; did you mean 'train'?"


def test_no_verb_prints_help_and_fails():
    assert run().returncode == 2


def test_version():
    from nbavatar import __version__

    assert run("--version").stdout.strip() == f"nbavatar {__version__}"


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (DataError("x.npz: expected a, found b"), "nbavatar doctor: error: x.npz: expected a, found b"),
        (OSError(28, "No space left on device", "out.zip"), "nbavatar doctor: error: out.zip: No space left on device"),
        (OSError(27, "File too large", "model.pt"), "nbavatar doctor: error: model.pt: File too large"),
        (OSError(36, "File name too long", "n" * 300), "nbavatar doctor: error: 'nnnnn"),
        (OSError(37, "No locks available", "/net/lock"), "nbavatar doctor: error: /net/lock: No locks available"),
        (OSError(5, "Input/output error"), "nbavatar doctor: error: file system: Input/output error"),
        (IsADirectoryError(21, "Is a directory", b"a\xff\x1b"), "nbavatar doctor: error: 'a"),
        (MemoryError("Unable to allocate 9 GiB"), "nbavatar doctor: error: out of memory: Unable to allocate 9 GiB"),
        (DataError("no camera 'a\nb'"), "nbavatar doctor: error: no camera 'a b'"),
        (DataError("a\x1b]0;b\x07 " + "c" * 5000), "nbavatar doctor: error: a\\x1b]0;b\\x07 ccc"),
        (
            ModuleNotFoundError("No module named 'igl'", name="igl"),
            "nbavatar doctor: error: package 'libigl' is not installed",
        ),
    ],
)
def test_errors_of_the_outside_end_in_one_line(monkeypatch, capsys, error, line):
    import nbavatar.cli.doctor as doctor

    def fail(_):
        raise error

    monkeypatch.setattr(doctor, "main", fail)
    assert cli.main(["doctor"]) == 2
    printed = capsys.readouterr().err.strip()
    assert printed.startswith(line)
    assert "\n" not in printed and "\x1b" not in printed and len(printed) < 1100


@pytest.mark.parametrize("defect", [KeyError("ours"), OSError(9, "Bad file descriptor"), OSError("no number")])
def test_defects_of_ours_keep_their_traceback(monkeypatch, defect):
    import nbavatar.cli.doctor as doctor

    def fail(_):
        raise defect

    monkeypatch.setattr(doctor, "main", fail)
    with pytest.raises(type(defect)):
        cli.main(["doctor"])


@pytest.mark.parametrize("link", [False, True])
def test_an_input_is_not_replaced_by_a_result(tmp_path, capsys, link):
    given, out = tmp_path / "t.npz", tmp_path / "t.npz"
    given.write_bytes(b"meshes")
    if link:
        out = tmp_path / "other.npz"
        out.symlink_to(given)
    assert cli.main(["spectral", "--meshes", str(given), "--out", str(out)]) == 2
    assert "expected a file to write, found the input of --meshes" in capsys.readouterr().err
    assert cli.main(["shell", "--masks", "m.zip", "--meshes", str(given), "--out", "s.npz", "--picture", str(out)]) == 2
    assert "--picture: expected a file to write, found the input of --meshes" in capsys.readouterr().err
    assert given.read_bytes() == b"meshes"


# Options that name a file to read; every other option that names a file has to be one that writes it.
READ = {
    *("assets", "camera", "cameras", "capture", "cfg", "evals", "extremes", "figures", "flame", "frames", "histories"),
    *(
        "layout",
        "light",
        "masks",
        "meshes",
        "model",
        "models",
        "photos",
        "pictures",
        "presets",
        "protocol",
        "render",
        "renders",
    ),
    *(
        "reported",
        "sequences",
        "source",
        "spectral",
        "speeds",
        "start",
        "supplied",
        "tables",
        "target",
        "tracks",
        "tradeoffs",
    ),
    *("train_frames", "videos"),
}
FILES = {"CSV", "EXR", "FILE", "HTML", "JSON", "JSONL", "JSON|FILE", "MP4", "NPZ", "PATH", "PKL", "PNG", "PT", "ZIP"}


@pytest.mark.parametrize("verb", cli.VERBS)
def test_of_every_option_that_names_a_file_it_is_known_whether_it_is_written(verb):
    """Otherwise a new one could replace what a user has; see `_keep_inputs`."""
    parser = argparse.ArgumentParser()
    importlib.import_module(f"nbavatar.cli.{verb.replace('-', '_')}").add_arguments(parser)
    written = {*cli._OUTPUTS, *cli._OUTPUTS_OF.get(verb, ())}
    read = READ | ({"sheet"} if verb == "tradeoff" else set())
    named = {action.dest for action in parser._actions if action.metavar in FILES and action.option_strings}
    assert named <= written | read
    assert not written & read


@pytest.mark.parametrize("own", [None, ("OMP_WAIT_POLICY", "active"), ("GOMP_SPINCOUNT", "7")])
def test_threads_wait_briefly_from_before_torch_is_loaded_unless_the_user_says_how(own):
    code = (
        "import os, sys; from nbavatar.cli import main; main(['trian'])\n"
        "assert 'torch' not in sys.modules; print(os.environ.get('GOMP_SPINCOUNT'))"
    )
    environment = {name: value for name, value in os.environ.items() if name not in VARIABLES}
    environment |= dict([own] if own else [])
    out = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment
    )  # fmt: skip
    expected = {None: str(SPINS), "OMP_WAIT_POLICY": "None", "GOMP_SPINCOUNT": "7"}[own and own[0]]
    assert out.stdout.strip() == expected
