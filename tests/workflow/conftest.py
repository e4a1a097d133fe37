"""A copy of the project whose commands are stubs: the plan is tested, nothing is computed."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.workflow import imported

ROOT = Path(__file__).parents[2]
# Creates whatever a rule's command is asked to write, notes its words in `calls`, and does nothing else.
STUB = """#!/bin/bash
verb=$1
printf '%q ' "$@" | tr '\\n' ' ' >> calls; echo >> calls
make() { mkdir -p "$(dirname "$1")"; echo made > "$1"; }
while [ $# -gt 0 ]; do
  case "$verb $1" in
    "tradeoff --out") for f in tradeoff.json points.csv presets.json front_ms.png front_memory.png front_bytes.png \
      savings.json savings.csv savings.md offline.json offline.csv offline.md offline.png
      do make "$2/$f"; done ;;
    "extremes --out") for f in table.md table.csv heatmap.png curves.png record.json; do make "$2/$f"; done ;;
    "video --out") make "$2"; make "$2.json" ;;
    "tradeoff --sheet") ;;
    "check --overview"|"check --record")
      if [ -e defect ]; then echo "cameras.json: a defect" >&2; exit 2; fi
      make "$2" ;;
    "deform --table") make "$2" ;;
    *" --out"|*" --csv"|*" --sheet"|*" --exr"|*" --picture"|*" --history"|*" --validate") make "$2" ;;
    "figure --out-stem") for s in png pdf json; do make "$2.$s"; done ;;
    *" --out-stem") for s in csv md tex html; do make "$2.$s"; done ;;
  esac
  shift
done
"""


ALL = -1  # of a rule: as many jobs as a run from nothing has


def counted(expected: dict[str, int], whole: dict[str, int]) -> dict[str, int]:
    """A plan in which `ALL` is replaced by the numbers of a plan from nothing."""
    return {rule: whole[rule] if count == ALL else count for rule, count in expected.items()}


def difference(before: dict[str, int], after: dict[str, int]) -> dict[str, int]:
    """Rule -> how many more jobs the second plan has; rules with as many are left out."""
    more = {rule: after.get(rule, 0) - before.get(rule, 0) for rule in {**before, **after}}
    return {rule: count for rule, count in more.items() if count}


class Project:
    """A project folder and ways to plan and run its workflow."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        for name in ("nbavatar", "workflow", "config", "profiles"):
            ignored = shutil.ignore_patterns("__pycache__", "assets", "*.nbi", "*.nbc")
            shutil.copytree(ROOT / name, folder / name, ignore=ignored)
        shutil.copy(ROOT / "Snakefile", folder)
        (folder / "bin").mkdir()
        stub = folder / "bin" / "nbavatar"
        stub.write_text(STUB)
        stub.chmod(0o755)
        self.environment = dict(os.environ)
        self.environment["PATH"] = (
            f"{folder / 'bin'}{os.pathsep}{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        )
        self.environment["PYTHONPATH"] = str(folder)

    def snakemake(self, *words: str, config: str = "config/smoke.yaml") -> subprocess.CompletedProcess[str]:
        """Runs snakemake in the folder; configuration files are separated by spaces, later ones win."""
        command = ["--cores", "2", "--configfile", *config.split(), *words]
        return imported.snakemake(command, self.folder, self.environment)

    def plan(self, *words: str, config: str = "config/smoke.yaml") -> dict[str, int]:
        """Rule -> number of jobs that a dry run would start."""
        done = self.snakemake("-n", *words, config=config)
        text = done.stdout + done.stderr
        assert done.returncode == 0, text[-3000:]
        if "Nothing to be done" in text:
            return {}
        table = re.search(r"^job +count\n[- ]+\n(.*?)^total", text, re.S | re.M)
        assert table, text[-3000:]
        counts = {name: int(count) for name, count in (line.split() for line in table[1].splitlines() if line.strip())}
        return {name: count for name, count in counts.items() if name != "all"}


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Project:
    """A fresh copy of the project for one test module."""
    return Project(tmp_path_factory.mktemp("project") / "p")
