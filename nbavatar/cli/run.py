"""The whole pipeline in one command, in the folder you are in.

    nbavatar run smoke               a tiny synthetic subject through every stage, minutes on two cores
    nbavatar run capture FOLDER      an avatar, metrics, pictures and a report of your own capture
    nbavatar run compare FOLDER      three methods on one or more captures, at several budgets and seeds
    nbavatar run paper               every table of the paper; needs the Decaf dataset and the body models
    nbavatar run rehearsal           the same on synthetic people of the dataset's size, in few frames and steps

`paper --subjects S2` makes the rows of one subject; with `--subjects S1 S2` later only what is new is made. The first
call copies the configuration files (`config/`) and the page that says where data belongs (`resources/README.md`) into
this folder, where you can edit them; files that are there already are left as they are.
Results go to `results/<run>/`, logs to `logs/<run>/`. The same command again does only what is not done yet. What
follows `--` goes to snakemake: `-- -n` shows what would run, `-- subject_S2` makes one subject, `-- --configfile FILE`
takes other options. Configuration files are read first, and refused in one line where they are none. What a run that
was killed has left, processes and Snakemake's lock, is cleared away first. Needs the packages of the extra `pipeline`.
With `--profile slurm` every job goes to the cluster's queue (docs/cluster.md).
"""

import argparse
import importlib.util
import json
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from nbavatar.cli.run_words import check_files, executor_of, profile_files, read_words
from nbavatar.cli.supervision import run_workflow, wait
from nbavatar.errors import DataError, DependencyError
from nbavatar.io.atomic import atomic_write
from nbavatar.packages import install_line

__all__ = ["add_arguments", "copy_configuration", "main", "pipeline_folder"]

_WHAT = {
    "smoke": "a tiny synthetic subject through every stage",
    "capture": "train and evaluate an avatar on your own capture",
    "compare": "quality against the time of training, methods side by side, on your own captures",
    "paper": "every table of the paper",
    "rehearsal": "the paper on synthetic data of the dataset's size, in few frames and steps",
}
_OF_CAPTURES = ("capture", "compare")
_OF_THE_PAPER = ("paper", "rehearsal")
_LAYERED = {
    "compare": ("config/capture.yaml", "config/methods.yaml", "config/compare.yaml"),
    "rehearsal": ("config/paper.yaml", "config/rehearsal.yaml"),
}
_OURSELVES = (sys.executable, "-m", "nbavatar")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options."""
    what = parser.add_subparsers(
        dest="what", required=True, metavar="smoke|capture|compare|paper|rehearsal", parser_class=_Parser
    )
    for name, text in _WHAT.items():
        own = what.add_parser(name, help=text, description=text, epilog="What follows `--` goes to snakemake.")
        if name in _OF_CAPTURES:
            own.add_argument("folder", metavar="FOLDER", help="the capture")
        if name in _OF_THE_PAPER:
            own.add_argument("--subjects", nargs="+", metavar="NAME", help="only these (default: all of the sheet)")
        own.add_argument("--cores", type=int, metavar="N", help="processors to use, on a cluster by one job "
                         "(default: all of this machine, as many as a job has threads)")  # fmt: skip
        own.add_argument("--profile", metavar="NAME", help="where jobs run, if not on this machine: slurm, kubernetes, "
                         "or the folder of a profile of snakemake's")  # fmt: skip


class _Parser(argparse.ArgumentParser):
    """Takes the words after `--` as they are; as positional arguments they could not stand behind an option."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As ever, with the words after `--` in `snakemake`."""
        words: list[str] = list(args or ())
        end = words.index("--") if "--" in words else len(words)
        parsed, unknown = super().parse_known_args(words[:end], namespace)
        parsed.snakemake = words[end + 1 :]
        return parsed, unknown


def main(args: argparse.Namespace) -> int:
    """Runs snakemake on the workflow; its exit code."""
    if args.what in _OF_CAPTURES and not Path(args.folder).is_dir():
        raise DataError.of(args.folder, expected="a capture's folder", found="none")
    if importlib.util.find_spec("snakemake") is None:
        raise DependencyError(f"nbavatar run needs snakemake, which is not installed; {install_line('snakemake')}")
    source, here = pipeline_folder(), Path.cwd()
    for path in copy_configuration(source, here):
        print(f"{path}: written, yours to edit")
    words = _snakemake(args, source)
    if args.what == "paper":
        check = [*_OURSELVES, "check", "--layout", "decaf", "resources/DecafDataset", "--sheet", "config/subjects.tsv"]
        check += ["--subjects", *args.subjects] if args.subjects else []
        code = wait(subprocess.Popen(check))
        if code:
            return code
    given = read_words(args.snakemake)
    slurm = executor_of(given, source, args.profile or "") == "slurm"
    warm = args.what == "smoke" and args.profile is None and not given.profiles
    # The jobs of the smoke run take a second or two each: the profile and `nbavatar warm` are for such.
    code = run_workflow(words, warm=warm, slurm=slurm)
    report = here / "results" / args.what / "report" / "index.html"
    if code == 0 and report.is_file() and not args.snakemake:
        if args.what == "smoke":
            for table in sorted((here / "results" / "smoke" / "tables").glob("*.md")):
                lines = table.read_text(encoding="utf-8").splitlines()
                print("\n".join(line for line in lines if not line.startswith("<!--")))  # records, for programs
        print(f"viewer: {_own_command()} view results/{args.what}")
        print(f"report: {report.relative_to(here)}")
    return code


def _own_command() -> str:
    """How to call `nbavatar` from here: by its name where the shell finds this one, else by its path."""
    own = Path(sys.executable).parent / "nbavatar"
    found = shutil.which("nbavatar")
    if not own.is_file() or (found and os.path.samefile(found, own)):
        return "nbavatar"
    return shlex.quote(os.path.relpath(own) if own.is_relative_to(Path.cwd()) else str(own))


def _snakemake(args: argparse.Namespace, source: Path) -> list[str]:
    given = read_words(args.snakemake)
    words = [sys.executable, "-m", "snakemake", "--snakefile", str(source / "Snakefile")]
    # Snakemake limits every job's threads by it, those of other machines too.
    if args.cores or executor_of(given, source, args.profile or "") in ("", "local"):
        words += ["--cores", str(args.cores or os.cpu_count() or 2)]
    if args.profile is not None:
        words += ["--workflow-profile", str(_profile(args.profile, source))]
    elif args.what == "smoke":
        words += ["--workflow-profile", str(source / "profiles" / "ci")]
    words += args.snakemake
    configfiles = given.configfiles or _LAYERED.get(args.what, (f"config/{args.what}.yaml",))
    check_files(given, configfiles, source)
    if not given.configfiles:
        words += ["--configfile", *configfiles]
    # As quoted texts: snakemake reads values as YAML, where a folder may look like a number. Of two `--config` it takes
    # the last.
    if args.what in _OF_CAPTURES:
        words += ["--config", *given.values, f"data_root={json.dumps(args.folder, ensure_ascii=False)}"]
    elif args.what in _OF_THE_PAPER and args.subjects:
        words += ["--config", *given.values, f"only={json.dumps(args.subjects, ensure_ascii=False)}"]
    return words


def _profile(name: str, source: Path) -> Path:
    """The folder of a profile: one of the user's, or ours of that name."""
    found = profile_files(name, source)
    if not found:
        ours = ", ".join(sorted(path.name for path in (source / "profiles").iterdir() if path.is_dir()))
        raise DataError.of(name, expected=f"a folder with a profile.yaml in it, or one of {ours}", found="none")
    return found[0].parent.resolve()


def pipeline_folder() -> Path:
    """The folder that holds Snakefile, workflow/, config/ and profiles/: the wheel's, or the repository's.

    Raises:
        DependencyError: neither is there, as with modules that were copied by hand.
    """
    package = Path(__file__).resolve().parent.parent
    for folder in (package / "pipeline", package.parent):
        if (folder / "Snakefile").is_file() and (folder / "workflow").is_dir():
            return folder
    raise DependencyError(
        f"the workflow is neither in {package / 'pipeline'} nor in {package.parent}; install the wheel again, "
        "or clone the repository"
    )


def copy_configuration(source: Path, here: Path) -> list[Path]:
    """Copies the configuration and the page about data into a folder, where they are not there yet.

    Args:
        source: `pipeline_folder()`.
        here: the user's folder.

    Returns:
        The files written, relative to `here`; none where `here` is the repository itself.
    """
    written = []
    for path in sorted([*(source / "config").rglob("*"), source / "resources" / "README.md"]):
        name = path.relative_to(source)
        if not path.is_file() or (here / name).exists() or (here / name).is_symlink():
            continue
        with atomic_write(here / name) as temporary, open(temporary, "xb") as stream:  # never through a link
            stream.write(path.read_bytes())
        written.append(name)
    return written
