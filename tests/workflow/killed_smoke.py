"""Kills the smoke run at random moments, runs it once more, and compares its tables with those of an unbroken run.

    python tests/workflow/killed_smoke.py --kills 10 --seed 1 --folder /tmp/killed

No test of the suite: it takes as long as three smoke runs. Each kill (SIGKILL) hits one process at random of those that
are there: `nbavatar run`, its guard, `nbavatar warm`, Snakemake, a shell, a job. What is chosen is drawn from
the seed and printed; the moments of the machine are not, so that no two calls are alike in all. After each kill it is
checked that no process of the run goes on for longer than the time in which it is allowed to save its state.

Compared to the last digit: all values of all tables but measured times and memory, tables without such in all formats
but for digests of files that hold times, and every evaluated figure. Exit code 0 if all are the same, no temporary file
is left, and no process outlived its run; 1 otherwise. `--longest` should be about a quarter of what the run takes, so
that all its parts are hit; with `--begun` the run that is killed starts with what the unbroken one made of some stages,
so that short ones hit what comes late:

    python tests/workflow/killed_smoke.py --whole /tmp/killed/whole --folder /tmp/late --longest 40 --begun \\
        ingest tracks masks crop fit spectral deform train extremes
"""

import argparse
import csv
import json
import random
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import psutil

PATIENCE_S = 40.0  # of the guard and of Snakemake: three times ten seconds, and the machine is busy
MEASURED = {"ms", "fps", "memory_mb", "train_minutes", "train_memory_mb"}  # columns of tables


def main() -> int:
    """Does what the module says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--longest", type=float, default=60.0, help="latest moment of a kill [s]")
    parser.add_argument("--targets", nargs="*", default=[], help="targets of Snakemake instead of the whole run")
    parser.add_argument("--folder", type=Path, required=True, help="a new folder for both runs")
    parser.add_argument("--whole", type=Path, help="folder of an unbroken run that was made before")
    parser.add_argument(
        "--begun", nargs="*", default=[], metavar="STAGE", help="stages whose results are there already"
    )
    arguments = parser.parse_args()
    draw = random.Random(arguments.seed)
    print(f"seed {arguments.seed}, {arguments.kills} kills", flush=True)
    whole, broken = arguments.whole or arguments.folder / "whole", arguments.folder / "broken"
    broken.mkdir(parents=True)
    if arguments.whole is None:
        whole.mkdir()
        began = time.monotonic()
        if run(whole, arguments.targets).wait() != 0:
            print(f"the unbroken run failed: {(whole / 'log').read_text()[-3000:]}")
            return 1
        print(f"unbroken run: {time.monotonic() - began:.0f} s", flush=True)
    if arguments.begun:
        begin(whole, broken, arguments.begun)
    faults, done = [], 0
    while done < arguments.kills:
        delay = draw.uniform(1.0, arguments.longest)
        process = run(broken, arguments.targets)
        try:
            code = process.wait(delay)
            print(f"  the run was through after {done} kills, code {code}: {arguments.kills - done} kills not needed")
            break
        except subprocess.TimeoutExpired:
            pass
        done += 1
        family = [psutil.Process(process.pid), *psutil.Process(process.pid).children(recursive=True)]
        victim = draw.choice(sorted(family, key=lambda member: member.pid))
        try:
            name = " ".join(victim.cmdline()[1:5])
            victim.kill()
        except psutil.Error:
            name = "one that had just ended"
        print(f"  kill {done} after {delay:.1f} s: {name}", flush=True)
        # A job or a shell that is killed is Snakemake's to judge: it tries again or ends the run.
        if victim.pid != process.pid and psutil.pid_exists(process.pid) and "snakemake" not in name:
            try:
                process.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                process.terminate()  # not killed: without its guard only the next run would end what is left
        process.wait(10 * PATIENCE_S)
        _, left = psutil.wait_procs(family, timeout=PATIENCE_S)
        if left:
            faults.append(f"kill {done}: {[member.pid for member in left]} went on")
    began = time.monotonic()
    last = run(broken, arguments.targets)
    if last.wait() != 0:
        faults.append(f"the last run failed: {(broken / 'log').read_text()[-3000:]}")
    print(f"last run: {time.monotonic() - began:.0f} s", flush=True)
    faults += differences(whole / "results/smoke", broken / "results/smoke")
    faults += [f"left: {path}" for path in broken.rglob(".*.tmp*")]
    print("\n".join(faults) or f"{done} kills survived: the same tables, nothing left")
    return 1 if faults else 0


def begin(whole: Path, broken: Path, stages: list[str]) -> None:
    """Copies the dataset and some stages of the unbroken run, with their times and what Snakemake knows of them."""
    for name in ("config", "resources", ".snakemake", *(f"results/smoke/{stage}" for stage in stages)):
        shutil.copytree(whole / name, broken / name, symlinks=True)


def run(folder: Path, targets: list[str]) -> "subprocess.Popen[bytes]":
    """Starts the smoke run in a folder."""
    with open(folder / "log", "ab") as log:
        command = [
            sys.executable,
            "-m",
            "nbavatar",
            "run",
            "smoke",
            "--cores",
            "2",
            *(["--"] if targets else []),
            *targets,
        ]
        return subprocess.Popen(command, cwd=folder, stdout=log, stderr=log)


def differences(one: Path, other: Path) -> list[str]:
    """What differs between the results of two runs."""
    found = []
    sheets = sorted(one.glob("tables/*.csv"))
    if not sheets:
        found.append(f"no tables in {one}")
    for sheet in sheets:
        twin = other / "tables" / sheet.name
        rows = values(sheet)
        if not twin.is_file() or rows != values(twin):
            found.append(f"differs: {sheet.relative_to(one)}")
        if any(None in row.values() for row in rows):
            continue
        for file in sorted(one.glob(f"tables/{sheet.stem}.*")):
            twin = other / file.relative_to(one)
            if not twin.is_file() or text(file) != text(twin):
                found.append(f"differs: {file.relative_to(one)}")
    for path in sorted(one.glob("eval/**/*.json")):
        twin = other / path.relative_to(one)
        if not twin.is_file() or figures(path) != figures(twin):
            found.append(f"differs: {path.relative_to(one)}")
    return found


def values(path: Path) -> list[dict[str, str | None]]:
    """The rows of a table but for digests; what was measured is None."""
    with open(path, encoding="utf-8", newline="") as stream:
        rows: list[dict[str, str | None]] = [dict(row) for row in csv.DictReader(stream)]
    for row in rows:
        row["digest"] = ""
        if str(row["column"]).rpartition(".")[2] in MEASURED and row["block"] != "printed":
            row["text"] = row["value"] = row["mark"] = None
    return rows


def text(path: Path) -> str:
    """A table but for digests: what they are of tells how long a training took."""
    return re.sub(r"sha256:[0-9a-f]{64}", "sha256", path.read_text(encoding="utf-8"))


def figures(path: Path) -> object:
    """What a record says but for where, when and how fast it was made."""
    content = json.loads(path.read_text())
    return {key: value for key, value in content.items() if key not in ("record", "training")}


if __name__ == "__main__":
    sys.exit(main())
