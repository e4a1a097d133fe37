"""A run that is killed leaves nothing that goes on writing, and does not stop the next one."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from nbavatar.cli import supervision
from nbavatar.errors import DataError

PATIENCE_S = 60.0  # on a machine that does ten other things

# As Snakemake does: a lock, a shell for the job, the job, which writes for ever; on an interrupt all of it goes.
SNAKEMAKE = r"""
import os, pathlib, subprocess, sys, time
locks = pathlib.Path(".snakemake/locks")
if "--again" in sys.argv:
    sys.exit(1 if locks.exists() else 0)
locks.mkdir(parents=True)
for kind in ("input", "output"):
    (locks / f"0.{kind}.lock").write_text("results/a")
if "--slurm-jobname-prefix" in sys.argv:
    name = sys.argv[sys.argv.index("--slurm-jobname-prefix") + 1]
    pathlib.Path("queue").write_text(f"7|{name}_1\n8|another\n9|{name}_1\n")
job = "import os, time\nwhile True:\n open('job', 'w').write(str(os.getpid()))\n time.sleep(0.05)"
shell = subprocess.Popen(["bash", "-c", 'set -e; "$0" -c "$1"; true', sys.executable, job])
pathlib.Path("snakemake").write_text(str(os.getpid()))
try:
    shell.wait()
except KeyboardInterrupt:
    shell.kill()
finally:
    for lock in locks.iterdir():
        lock.unlink()
    locks.rmdir()
"""
LAUNCHER = """
import os, sys
from nbavatar.cli import supervision
from nbavatar.errors import NBAvatarError
supervision._GRACE_S = 3.0
try:
    words = [sys.executable, "-m", "snakemake", *sys.argv[1:]]
    sys.exit(supervision.run_workflow(words, slurm=os.path.exists("squeue")))
except NBAvatarError as error:
    sys.exit(f"line: {error}")
"""


@pytest.fixture
def start(tmp_path, monkeypatch):
    (tmp_path / "snakemake.py").write_text(SNAKEMAKE)
    started = []

    def start(*words):
        environment = os.environ | {"PYTHONPATH": f"{tmp_path}:{Path(__file__).parents[3]}"}
        process = subprocess.Popen([sys.executable, "-c", LAUNCHER, *words], cwd=tmp_path, env=environment,
                                   stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)  # fmt: skip
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
    supervision.end_run(token(tmp_path))


def token(folder):
    try:
        return json.loads((folder / ".snakemake/nbavatar-run.json").read_text())["run"]
    except FileNotFoundError:
        return "none"


def until(condition):
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def at_work(folder):
    """Waits for a run to work; the processes of Snakemake and of its job."""
    (folder / "job").unlink(missing_ok=True)
    until(lambda: (folder / "job").exists() and (folder / "job").read_text() and (folder / "snakemake").exists())
    return int((folder / "snakemake").read_text()), int((folder / "job").read_text())


def gone(*processes):
    until(lambda: not any(psutil.pid_exists(process) for process in processes))


def test_a_killed_run_is_ended_by_its_guard_and_the_next_goes_on(start, tmp_path):
    run = start()
    processes = at_work(tmp_path)
    run.kill()
    gone(*processes)
    again = start("--again")
    _, error = again.communicate(timeout=PATIENCE_S)
    assert again.returncode == 0, error
    assert not (tmp_path / ".snakemake/nbavatar-run.json").exists()


def test_a_killed_run_without_its_guard_is_ended_by_the_next(start, tmp_path):
    run = start()
    processes = at_work(tmp_path)
    for child in psutil.Process(run.pid).children():
        if child.pid != processes[0]:
            child.kill()  # the guard
    run.kill()
    run.wait()
    time.sleep(0.3)
    assert all(psutil.pid_exists(process) for process in processes)
    again = start("--again")
    _, error = again.communicate(timeout=PATIENCE_S)
    assert again.returncode == 0, error
    assert "ended 3 processes that a killed run had left" in error  # Snakemake, the shell, the job
    gone(*processes)


def test_jobs_of_a_killed_run_in_the_queue_are_cancelled_and_no_others(start, tmp_path, monkeypatch):
    """By the guard, and, where that was killed too, by the next run; which does not start where it cannot know."""
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    queue = tmp_path / "queue"
    for name, script in (("squeue", "cat queue"), ("scancel", r'for job; do sed -i "/^$job|/d" queue; done')):
        (tmp_path / name).write_text(f"#!/bin/sh\ncd {tmp_path} || exit\n{script}\n")
        (tmp_path / name).chmod(0o755)
    run = start()
    processes = at_work(tmp_path)
    run.kill()
    gone(*processes)
    until(lambda: queue.read_text() == "8|another\n")
    assert start("--again").wait(PATIENCE_S) == 0
    run = start()
    processes = at_work(tmp_path)
    for child in psutil.Process(run.pid).children():
        if child.pid != processes[0]:
            child.kill()
    run.kill()
    run.wait()
    (tmp_path / "squeue").write_text("#!/bin/sh\nexit 1\n")
    _, error = (again := start("--again")).communicate(timeout=PATIENCE_S)
    assert again.returncode == 1 and "whose names begin with" in error
    (tmp_path / "squeue").write_text(f"#!/bin/sh\ncat {queue}\n")
    _, error = (again := start("--again")).communicate(timeout=PATIENCE_S)
    assert again.returncode == 0 and "cancelled 2 jobs that a killed run had" in error, error
    assert queue.read_text() == "8|another\n"


def test_a_killed_snakemake_takes_its_jobs_along_and_its_lock_is_removed(start, tmp_path):
    run = start()
    processes = at_work(tmp_path)
    os.kill(processes[0], signal.SIGKILL)
    run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 137
    gone(*processes)
    assert len(list((tmp_path / ".snakemake/locks").iterdir())) == 2
    again = start("--again")
    _, error = again.communicate(timeout=PATIENCE_S)
    assert again.returncode == 0, error
    assert f"removed the lock of process {run.pid}, which was killed" in error


def test_told_to_terminate_it_ends_all_and_leaves_no_lock(start, tmp_path):
    run = start()
    processes = at_work(tmp_path)
    run.terminate()
    run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 143
    gone(*processes)
    assert not (tmp_path / ".snakemake/locks").exists()
    assert not (tmp_path / ".snakemake/nbavatar-run.json").exists()


def test_two_runs_do_not_share_a_folder(start, tmp_path):
    run = start()
    processes = at_work(tmp_path)
    second = start()
    _, error = second.communicate(timeout=PATIENCE_S)
    assert second.returncode == 1
    assert f"found process {run.pid}, at work here; wait, or end it: kill {run.pid}" in error
    assert all(psutil.pid_exists(process) for process in processes)
    looking = start("--again", "-n")  # a dry run may look on
    looking.communicate(timeout=PATIENCE_S)
    assert token(tmp_path) != "none"


@pytest.mark.parametrize("left", ["nothing", "another machine", "two runs"])
def test_a_lock_that_is_not_known_is_left_and_the_command_is_told(tmp_path, monkeypatch, left):
    monkeypatch.chdir(tmp_path)
    state = tmp_path / ".snakemake"
    (state / "locks").mkdir(parents=True)
    (state / "locks/0.input.lock").write_text("a")
    record = {"machine": supervision.machine(), "process": 1 << 22, "started": 1.0, "run": "x"}  # no such process
    if left == "another machine":
        record["machine"] = "0123ab"
    if left == "two runs":
        (state / "locks/1.input.lock").write_text("b")
    if left != "nothing":
        (state / "nbavatar-run.json").write_text(json.dumps(record))
    command = "/bin/snakemake --configfile 'my config.yaml' --unlock"
    with pytest.raises(DataError, match=f"if no run works there, remove it by: {command}$"):
        supervision.run_workflow(["/bin/snakemake", "--configfile", "my config.yaml"])
    assert (state / "locks/0.input.lock").exists()


def test_a_number_that_is_used_again_is_another_process(tmp_path, monkeypatch):
    """After a restart of the machine the number of the killed run is somebody else's."""
    monkeypatch.chdir(tmp_path)
    state = tmp_path / ".snakemake"
    (state / "locks").mkdir(parents=True)
    (state / "locks/0.output.lock").write_text("a")
    started = psutil.Process(os.getppid()).create_time() - 1000.0
    record = {"machine": supervision.machine(), "process": os.getppid(), "started": started, "run": "x"}
    (state / "nbavatar-run.json").write_text(json.dumps(record))
    assert supervision.run_workflow([sys.executable, "-c", "raise SystemExit(7)"]) == 7
    assert not (state / "locks").exists()


def test_a_lock_that_is_younger_than_the_run_is_another_s(start, tmp_path):
    """Of a plain snakemake in another container, that sees the same disk."""
    run = start()
    processes = at_work(tmp_path)
    os.kill(processes[0], signal.SIGKILL)
    run.communicate(timeout=PATIENCE_S)
    record = tmp_path / ".snakemake/nbavatar-run.json"
    os.utime(record, (1e9, 1e9))
    again = start("--again")
    _, error = again.communicate(timeout=PATIENCE_S)
    assert again.returncode == 1 and "found one whose run is not known" in error
    assert len(list((tmp_path / ".snakemake/locks").iterdir())) == 2


@pytest.mark.parametrize(("words", "program"), [(["-n"], "snakemake"), ([], "nbavatar")])
def test_what_starts_no_job_loads_nothing(tmp_path, monkeypatch, words, program):
    """`nbavatar warm` imports torch, and compiles kernels where none are kept yet."""
    monkeypatch.chdir(tmp_path)
    found = []
    real = subprocess.Popen

    def started(command, **options):
        found.append(command)
        return real([sys.executable, "-c", ""], **options)

    monkeypatch.setattr(supervision.subprocess, "Popen", started)
    assert supervision.run_workflow([sys.executable, "-m", "snakemake", *words], warm=True) == 0
    command = next(command for command in found if "snakemake" in command)
    assert command[1:3] == ["-m", program]
