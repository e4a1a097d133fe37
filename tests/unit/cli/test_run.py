"""`nbavatar run`: what it hands to snakemake, what it copies, and what it never touches."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from nbavatar.cli import main, run

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def calls(monkeypatch):
    """Commands that would run; each ends well."""
    seen: list[list[str]] = []

    def call(words, *, warm, slurm):
        assert slurm == any("slurm" in word for word in words)
        seen.append([*(["warm"] if warm else []), *words])
        return 0

    monkeypatch.setattr(run, "run_workflow", call)
    return seen


def test_the_repository_is_found_and_nothing_is_copied_into_it():
    assert run.pipeline_folder() == ROOT
    assert run.copy_configuration(ROOT, ROOT) == []


def test_configuration_is_copied_once_and_what_is_there_is_kept(tmp_path):
    (tmp_path / "config").mkdir()
    (tmp_path / "config" / "smoke.yaml").write_text("mine", encoding="utf-8")
    (tmp_path / "config" / "paper.yaml").symlink_to(tmp_path / "elsewhere")
    written = {str(path) for path in run.copy_configuration(ROOT, tmp_path)}
    assert {"config/capture.yaml", "config/capture/runs.tsv", "resources/README.md"} <= written
    assert (tmp_path / "config" / "smoke.yaml").read_text(encoding="utf-8") == "mine"
    assert not (tmp_path / "elsewhere").exists(), "a link of the user's is not written through"
    assert run.copy_configuration(ROOT, tmp_path) == []


def test_smoke_is_warm_and_takes_its_profile(calls, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["run", "smoke", "--cores", "2", "--", "-n"]) == 0
    ((*head, flag, value),) = calls
    assert head[:4] == ["warm", sys.executable, "-m", "snakemake"]
    assert str(ROOT / "Snakefile") in head and head[head.index("--cores") + 1] == "2" and "-n" in head
    assert (flag, value) == ("--configfile", "config/smoke.yaml")
    assert (tmp_path / "config" / "smoke.yaml").is_file()


def test_the_last_lines_say_how_to_look_at_the_result(calls, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name, text in (("report/index.html", "page"), ("tables/a.md", "## Table\n<!-- {} -->\n| a |\n")):
        path = tmp_path / "results" / "smoke" / name
        path.parent.mkdir(parents=True)
        path.write_text(text, encoding="utf-8")
    assert main(["run", "smoke", "--cores", "2"]) == 0
    *table, viewer, report = capsys.readouterr().out.splitlines()
    assert "## Table" in table and not any("<!--" in line for line in table)
    assert viewer.startswith("viewer: ") and viewer.endswith("nbavatar view results/smoke")
    assert report == "report: results/smoke/report/index.html"


def test_a_capture_is_handed_over_as_text_whatever_its_name(calls, tmp_path, monkeypatch):
    """Snakemake reads `--config` values as YAML: `007` would be a number, `a: b` a mapping."""
    import yaml

    monkeypatch.chdir(tmp_path)
    for name in ("007", "a b", "null", "o'neil", 'say "cheese"', "頭"):
        Path(name).mkdir()
        assert main(["run", "capture", name]) == 0
        key, _, value = calls[-1][-1].partition("=")
        assert key == "data_root" and yaml.safe_load(value) == name


@pytest.mark.parametrize(
    "words",
    [
        ["capture", "data", "--cores", "1", "--", "stage_masks", "-n"],
        ["capture", "--cores", "1", "data", "--", "stage_masks", "-n"],
        ["capture", "--cores=1", "data", "--", "stage_masks", "-n"],
    ],
)
def test_words_for_snakemake_follow_options_in_any_order(calls, tmp_path, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    Path("data").mkdir()
    assert main(["run", *words]) == 0
    head = calls[-1]
    assert head[head.index("--cores") + 1] == "1" and head[head.index("stage_masks") + 1] == "-n"


def test_unknown_options_are_refused(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["run", "smoke", "--core", "2", "--cord", "3"])
    assert stop.value.code == 2 and "--cord" in capsys.readouterr().err


def test_own_configuration_replaces_ours(calls, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("data").mkdir()
    words = ["--configfile", "config/capture.yaml", "config/methods.yaml"]
    assert main(["run", "capture", "data", "--", *words]) == 0
    assert calls[-1].count("--configfile") == 1 and calls[-1][-5:-2] == words


def test_paper_stops_where_the_data_is_missing(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    assert main(["run", "paper"]) == 2
    assert "resources/DecafDataset" in capfd.readouterr().err


def test_a_missing_folder_and_a_missing_snakemake_are_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["run", "capture", "nowhere"]) == 2
    assert capsys.readouterr().err.strip() == "nbavatar run: error: nowhere: expected a capture's folder, found none"
    monkeypatch.setattr(run.importlib.util, "find_spec", lambda name: None)
    assert main(["run", "smoke"]) == 2
    assert 'python -m pip install "nbavatar[pipeline]"' in capsys.readouterr().err
    assert not list(tmp_path.iterdir()), "nothing is written before it is known that it can run"


def test_an_interrupt_leaves_the_command_time_to_end(tmp_path):
    """Snakemake removes its lock when it is interrupted; a caller that kills it at once leaves the folder locked."""
    child = (
        "import signal, sys, time, pathlib\n"
        "def end(*_): time.sleep(1); pathlib.Path('ended').touch(); sys.exit(3)\n"
        "signal.signal(signal.SIGINT, end)\n"
        "pathlib.Path('ready').touch(); time.sleep(60)\n"
    )
    call = f"sys.exit(run.run_workflow([sys.executable, '-c', {child!r}]))"
    code = f"import sys; from nbavatar.cli import run; {call}"
    process = subprocess.Popen([sys.executable, "-c", code], cwd=tmp_path, start_new_session=True)
    for _ in range(300):
        if (tmp_path / "ready").exists():
            break
        time.sleep(0.1)
    os.killpg(process.pid, signal.SIGINT)
    assert process.wait(timeout=60) == 3 and (tmp_path / "ended").exists()


@pytest.mark.parametrize(
    ("content", "words", "said"),
    [
        (b"stages:\n  train: {steps: 5}\n\xff\xfe", ["--configfile", "own.yaml"], "own.yaml: expected a configuration"),
        (b"stages: [1, {\n", ["--configfile=own.yaml"], "own.yaml: expected YAML, found text that does not parse"),
        (b"stages:\n\ttrain: 1\n", ["--configfiles", "config/capture.yaml", "own.yaml"], "own.yaml: expected YAML"),
        (b"", ["--configfile", "own.yaml"], "own.yaml: expected a mapping of options, found None"),
        (b"- 1\n", ["--configfile", "own.yaml"], "own.yaml: expected a mapping of options"),
        (b"", ["--configf", "own.yaml"], "words for snakemake: ambiguous option"),
        (b"a: &a [*a]\n", ["--configfile", "own.yaml"], "own.yaml: expected values that end"),
        (b"run: x\nstages: {trian: {}}\n", ["--configfile", "own.yaml"], "did you mean 'train'?"),
        (b"__use_yte__: true\nrun: ?open('pwned', 'w').name\n", ["--configfile", "own.yaml"], "unknown key"),
        (b"", ["-n", "--configfile", "nowhere.yaml"], "a configuration in YAML, found no such file"),
        (b"jobs: [\n", ["--workflow-profile", "own.yaml"], "own.yaml: expected YAML"),
        (b"rule all:\n    # \xe9\n", ["-s", "own.yaml"], "own.yaml: expected a Snakefile, found one that is no text"),
    ],
)  # fmt: skip
def test_a_configuration_that_is_none_is_one_line_before_anything_starts(
    calls, tmp_path, monkeypatch, capsys, content, words, said
):
    monkeypatch.chdir(tmp_path)
    Path("data").mkdir()
    Path("own.yaml").write_bytes(content)
    assert main(["run", "capture", "data", "--cores", "1", "--", *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("nbavatar run: error: ") and said in line
    assert not calls and not Path("pwned").exists()


def test_our_own_configuration_is_read_first_too(calls, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("config").mkdir()
    Path("config/smoke.yaml").write_bytes(b"\x00\xff")
    assert main(["run", "smoke"]) == 2
    assert "config/smoke.yaml: expected a configuration in YAML" in capsys.readouterr().err and not calls


def test_values_for_the_configuration_stay_beside_the_folder(calls, tmp_path, monkeypatch):
    """Of two `--config` snakemake takes the last; a file that names no run lies over the paper's."""
    monkeypatch.chdir(tmp_path)
    Path("data").mkdir()
    Path("own.yaml").write_text("tradeoff: {variants: [full]}\n", encoding="utf-8")
    words = ["--config", "run=mine", "device=cpu", "--configfile=own.yaml"]
    assert main(["run", "capture", "data", "--", *words]) == 0
    assert calls[-1][-4:] == ["--config", "run=mine", "device=cpu", 'data_root="data"']
    assert sum(word.startswith("--configfile") for word in calls[-1]) == 1
    assert main(["run", "capture", "data", "--", "--configfile", "own.yaml"]) == 0


def test_a_profile_takes_the_place_of_the_warm_run(calls, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    slurm = str(ROOT / "profiles/slurm")
    for words in (["--profile", "slurm"], ["--profile", slurm], ["--", "--workflow-profile", "slurm"]):
        assert main(["run", "smoke", *words]) == 0
    ours, folder, own = calls
    assert ours[:2] == [sys.executable, "-m"] and ours == folder  # not warm: its jobs are elsewhere
    assert ours[ours.index("--workflow-profile") + 1] == slurm
    assert own[0] != "warm" and own[-4:-2] == ["--workflow-profile", "slurm"]
    # Jobs of other machines are not limited by the processors of this one, unless somebody says so.
    assert not any("--cores" in words for words in calls)
    assert main(["run", "smoke", "--cores", "3", "--profile", "slurm"]) == 0
    assert calls[-1][calls[-1].index("--cores") + 1] == "3"
    assert main(["run", "smoke", "--profile", "slrum"]) == 2
    assert "slrum: expected a folder with a profile.yaml in it, or one of ci, " in capsys.readouterr().err


def test_configuration_is_not_written_through_a_link_that_waits_for_it(tmp_path):
    """As a shared folder, or an archive, may have it."""
    notes = tmp_path / "notes"
    notes.write_text("mine")
    (tmp_path / "here" / "config").mkdir(parents=True)
    for name in (".smoke.yaml.part", ".smoke.yaml"):
        (tmp_path / "here" / "config" / name).symlink_to(notes)
    run.copy_configuration(ROOT, tmp_path / "here")
    assert notes.read_text() == "mine"
    assert not (tmp_path / "here/config/smoke.yaml").is_symlink()


def test_the_rehearsal_lies_over_the_paper_and_subjects_are_chosen_as_text(calls, tmp_path, monkeypatch):
    import yaml

    monkeypatch.chdir(tmp_path)
    assert main(["run", "rehearsal", "--cores", "2"]) == 0
    assert calls[-1][-3:] == ["--configfile", "config/paper.yaml", "config/rehearsal.yaml"] and "warm" not in calls[-1]
    assert main(["run", "rehearsal", "--subjects", "S2", "007", "--", "--config", "device=cpu"]) == 0
    assert calls[-1][-3:-1] == ["--config", "device=cpu"]
    key, _, value = calls[-1][-1].partition("=")
    assert key == "only" and yaml.safe_load(value) == ["S2", "007"]


def test_the_paper_is_checked_for_the_subjects_that_are_wanted(calls, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    checked = []
    monkeypatch.setattr(run, "wait", lambda process: 0)
    monkeypatch.setattr(run.subprocess, "Popen", checked.append)
    assert main(["run", "paper", "--subjects", "S2"]) == 0
    assert checked[0][-4:] == ["--sheet", "config/subjects.tsv", "--subjects", "S2"]
    assert calls[-1][-1] == 'only=["S2"]'
