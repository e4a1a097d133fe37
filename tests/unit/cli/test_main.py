import subprocess
import sys

import pytest

from nbavatar import cli
from nbavatar.errors import DataError


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
def test_every_verb_explains_itself(verb):
    out = run(verb, "--help")
    assert out.returncode == 0
    assert len(out.stdout.splitlines()) > 5


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
        (
            ModuleNotFoundError("No module named 'igl'", name="igl"),
            "nbavatar doctor: error: package 'igl' is not installed",
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
    assert "\n" not in printed


def test_defects_of_ours_keep_their_traceback(monkeypatch):
    import nbavatar.cli.doctor as doctor

    def fail(_):
        raise KeyError("ours")

    monkeypatch.setattr(doctor, "main", fail)
    with pytest.raises(KeyError):
        cli.main(["doctor"])
