"""Commands in the documents: each is run by a test, or it stands here why it is not; all name options that exist."""

import argparse
import importlib
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from nbavatar.cli import VERBS, main

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("resources/*.md")])

# How a command begins (without `.venv/bin/`) -> the file that runs it, and what stands there. The longest one counts.
RUN = {
    "make smoke": (".ci/run", "make smoke"),
    "make test": (".ci/run", "make test"),
    "nbavatar --help": ("tests/architecture/test_commands.py", "test_help_and_plans"),
    "nbavatar train --help": ("tests/architecture/test_commands.py", "test_help_and_plans"),
    "nbavatar train --frames results/smoke/": ("tests/workflow/test_smoke.py", "test_the_tutorial_trains_by_hand"),
    "nbavatar doctor": ("tests/unit/cli/test_doctor.py", '["doctor"'),
    "nbavatar run smoke": (".ci/run", "nbavatar run smoke"),
    "nbavatar run capture": ("tests/workflow/test_capture.py", "config/capture.yaml"),
    "nbavatar run compare": ("tests/workflow/test_dag.py", '"compare"'),
    "nbavatar run paper --profile slurm": ("tests/cluster/test_slurm.py", "profiles/slurm"),
    "nbavatar check": ("tests/unit/cli/test_check.py", '"check"'),
    "nbavatar import vhap": ("tests/unit/cli/test_import.py", '"vhap"'),
    "nbavatar import colmap": ("tests/unit/cli/test_import.py", '"colmap"'),
    "nbavatar import nerfstudio": ("tests/unit/cli/test_import.py", '"nerfstudio"'),
    "nbavatar import meshes": ("tests/unit/cli/test_import.py", '"meshes"'),
    "nbavatar ingest": ("tests/unit/cli/test_ingest.py", '"ingest"'),
    "nbavatar detect": ("tests/unit/detection/test_models.py", '"detect"'),
    "nbavatar fit": ("tests/unit/fitting/test_fit.py", '"fit"'),
    "nbavatar segment CAPTURE --method sam3": ("tests/unit/cli/test_segment.py", '"sam3"'),
    "nbavatar segment CAPTURE --method person": ("tests/unit/cli/test_segment.py", '"person"'),
    "nbavatar view": ("tests/unit/viewer/test_page.py", '"view"'),
    "nbavatar bench raster --json": ("tests/architecture/test_commands.py", "test_benchmarks_at_a_small_size"),
    "nbavatar bench raster --orders": ("tests/architecture/test_commands.py", "test_benchmarks_at_a_small_size"),
    "nbavatar bench viewer": ("tests/unit/studies/benchmarks/test_viewer.py", '"viewer"'),
    "python examples/render_avatar.py": ("tests/unit/test_api.py", "render_avatar.py"),
    "python -m pytest tests/unit/rendering/billboards/test_cuda_simulator.py": (".ci/run", "make test"),
    "snakemake --configfile config/smoke.yaml -n": ("tests/architecture/test_commands.py", "test_help_and_plans"),
    "snakemake --configfile config/capture.yaml config/methods.yaml": (
        "tests/workflow/test_dag.py",
        "config/methods.yaml",
    ),
    "snakemake table_ablation": ("tests/architecture/test_commands.py", "test_help_and_plans"),
    "snakemake subject_S2": ("tests/architecture/test_commands.py", "test_help_and_plans"),
    "snakemake stage_deform": ("tests/architecture/test_commands.py", "test_help_and_plans"),
}
# Not run by any test, and why.
NOT_RUN = {
    "make paper": "it needs Decaf, FLAME and MANO; tests/workflow/test_dag.py plans it",
    "make rehearsal": "hours; tests/workflow/test_dag.py plans it, and docs/rehearsal.md says which jobs have been run",
    "make capture": "one line around `nbavatar run capture`",
    "nbavatar bench raster --sweep": "tens of minutes: it measures every size in turn",
    "nbavatar bench raster --device cuda": "needs a GPU",
    "pip": "tests install nothing; .ci/run installs from the locks, test_packaging.py builds the wheel",
    "python -m pip": "tests install nothing",
    "git clone": "the address is the reader's; .ci/run clones the repository",
    "cd nbavatar": "follows `git clone`",
    "printf": "changes config/smoke; tests/workflow/test_rerun.py adds a row elsewhere and plans it",
    "ffmpeg": "another program",
    "mkdir": "prepares COLMAP's folder",
    "cp": "prepares COLMAP's folder",
    "mv": "prepares COLMAP's folder",
    "colmap": "another program; its files are read in tests/unit/cli/test_import.py",
    "hf download": "some GB behind a licence that a person has to accept",
    "snakemake --workflow-profile profiles/kubernetes": "no cluster here; docs/cluster.md says that it is planned only",
}
# Reads like a command, and is none.
OTHER = {"avatar": "the kind of file, in the metadata of exported tensors"}
# Numbers that the reader has to fill in.
PLACEHOLDERS = {"M": "1.0"}


def commands_of(page: Path) -> list[str]:
    """Commands of the page's blocks of shell, one a command: continued lines joined, comments and loops taken off."""
    found = []
    for block in re.findall(r"^```sh\n(.*?)^```", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL):
        for line in block.replace("\\\n", " ").splitlines():
            line = re.sub(r"\s+#.*$", "", line).strip()
            line = re.sub(r"^for \w+ in [^;]*; do (.*); done$", r"\1", line)
            found += [" ".join(part.split()).replace(".venv/bin/", "") for part in line.split(" && ") if part]
    return found


COMMANDS = [(page, command) for page in PAGES for command in commands_of(page)]


def known(command: str) -> str | None:
    """The longest beginning of a command that stands in one of the tables."""
    fits = [start for start in (*RUN, *NOT_RUN) if command == start or command.startswith(start)]
    return max(fits, key=len, default=None)


@pytest.mark.parametrize(("page", "command"), COMMANDS, ids=[f"{p.name}: {c[:60]}" for p, c in COMMANDS])
def test_a_command_is_run_somewhere_or_it_is_said_why_not(page, command):
    start = known(command)
    assert start, "name the test that runs it in RUN, or the reason in NOT_RUN"
    if start in RUN:
        file, words = RUN[start]
        assert words in (ROOT / file).read_text(encoding="utf-8"), f"{file} no longer runs `{start}`"


def test_the_tables_hold_no_command_that_is_gone():
    used = {known(command) for _, command in COMMANDS}
    assert set(RUN) | set(NOT_RUN) == used


def parser_of(verb: str) -> argparse.ArgumentParser:
    module = importlib.import_module(f"nbavatar.cli.{verb.replace('-', '_')}")
    parser = argparse.ArgumentParser(exit_on_error=False)
    module.add_arguments(parser)
    return parser


def options_of(parser: argparse.ArgumentParser) -> set[str]:
    """Options of a parser and of those below it."""
    found = {"--help", "-h"}
    for action in parser._actions:
        found.update(action.option_strings)
        for below in (action.choices or {}).values() if isinstance(action, argparse._SubParsersAction) else ():
            found |= options_of(below)
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_verbs_and_options_that_a_page_names_exist(page):
    text = page.read_text(encoding="utf-8")
    named = re.findall(r"`nbavatar ([^`\n]+)`", text)
    named += [command.removeprefix("nbavatar ") for command in commands_of(page) if command.startswith("nbavatar ")]
    for words in named:
        verb, *rest = words.partition(" -- ")[0].split()
        if verb.startswith(("-", "<", "...")) or words in OTHER:
            continue
        assert verb in VERBS, words
        parser = parser_of(verb)
        if verb == "bench" and rest:  # each kernel has options of its own
            parser.add_argument("--json")
            importlib.import_module(f"nbavatar.studies.benchmarks.{rest[0]}").add_arguments(parser)
        assert {word.partition("=")[0] for word in rest if word.startswith("--")} <= options_of(parser), words


@pytest.mark.parametrize(
    "command", sorted({c for _, c in COMMANDS if c.startswith("nbavatar ")} - {"nbavatar --help"}), ids=lambda c: c[:60]
)
def test_the_command_line_takes_a_command_as_it_stands(command):
    words = [PLACEHOLDERS.get(word, word) for word in shlex.split(command)[1:]]
    if "--help" not in words:
        parser_of(words[0]).parse_args(words[1:])  # raises where argparse would end the program


def test_help_and_plans(capsys):
    for words, said in ((["--help"], "train an avatar"), (["train", "--help"], "--meshes")):
        with pytest.raises(SystemExit) as ended:
            main(words)
        assert ended.value.code == 0 and said in capsys.readouterr().out
    # Of the smoke run, because the paper's plan needs Decaf.
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    targets = ("table_ablation", "subject_S2", "stage_deform")
    command = [sys.executable, "-m", "snakemake", "--configfile", "config/smoke.yaml", "-n", *targets]
    done = subprocess.run(command, cwd=ROOT, env=os.environ | {"PATH": path}, capture_output=True, text=True)
    assert done.returncode == 0, (done.stdout + done.stderr)[-2000:]


@pytest.mark.slow
def test_benchmarks_at_a_small_size(capsys):
    small = "--size 64 --billboards 60 --channels 3 --texels 4 --repeats 1 --window 16".split()
    assert main(["bench", "raster", "--json", *small]) == 0
    assert json.loads(capsys.readouterr().out)["forward_ms"] > 0
    assert main(["bench", "raster", "--orders", "--no-reference", *small]) == 0
    assert "center" in capsys.readouterr().out
