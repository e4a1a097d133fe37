"""Commands of which nothing is left when they end, however they end; and Snakemake, again after it was killed.

A run of the workflow is a tree of processes: this one, Snakemake, a shell for each job, the job. If one of them is
killed the others live on and write, beside the next run. So all of them carry a token of their run in the environment
(`NBAVATAR_RUN`), and whatever carries it is ended when this process ends its work; if this process is itself
killed, by a guard that waits for nothing else; and by the next run in the same folder in any case.

Jobs that it gave to SLURM are on other machines: they have the token in their names, and are cancelled then.

A killed Snakemake also leaves its lock. The next run removes it if the run that left it is known, was of this machine,
and is gone; else it says which command removes it.
"""

import contextlib
import json
import os
import secrets
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from nbavatar.cli.slurm_jobs import PREFIX_OPTION, cancel_jobs
from nbavatar.errors import DataError
from nbavatar.io.records import write_json
from nbavatar.processes import alive, machine

__all__ = ["RUN_VARIABLE", "end_run", "leave_guard", "run_workflow", "supervised", "told_to_end", "wait"]

RUN_VARIABLE = "NBAVATAR_RUN"
"""Environment variable with the token of the run that a process belongs to."""

_GRACE_S = 10.0  # for a training to save its state, for Snakemake to remove its lock
_OWN_LOCKS = {"0.input.lock", "0.output.lock"}  # of a run that is the only one of its folder
_GUARD_PIPES: set[int] = set()
_TOLD: list[int] = []
_POLL_S, _BEAT_S = 0.2, 5.0
_MOST_STREAMS = 1 << 16
_RECORD = "nbavatar-run.json"
# First as the keyboard would: Snakemake then ends its jobs and removes its lock.
_ORDER = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
# With these Snakemake changes nothing, or nothing but its lock.
_HARMLESS = {
    "-n", "--dry-run", "--dryrun", "--unlock", "--lint", "--dag", "--rulegraph", "--filegraph", "--summary",
    "--detailed-summary", "-D", "-S", "--list-rules", "--list", "-l", "--list-target-rules", "--lt", "--help", "-h",
    "--version", "-v",
}  # fmt: skip


def run_workflow(
    snakemake: Sequence[str], *, warm: bool = False, slurm: bool = False, folder: str | os.PathLike[str] = "."
) -> int:
    """Runs Snakemake as the only run of its folder; returns its exit code.

    Args:
        snakemake: the command, such as `[sys.executable, "-m", "snakemake", "--cores", "2"]`.
        warm: run it below `nbavatar warm`, if it has jobs.
        slurm: its jobs go to SLURM.
        folder: Snakemake's working folder; must be the current one unless the command says otherwise.

    Raises:
        DataError: another run works in the folder, or a lock is there of which nobody knows whose it is.
    """
    if _HARMLESS & set(snakemake):
        return wait(subprocess.Popen(list(snakemake)))
    command = [sys.executable, "-m", "nbavatar", "warm", "--", *snakemake] if warm else list(snakemake)
    token = f"{machine()}-{os.getpid()}-{secrets.token_hex(8)}"
    if slurm:
        command += [PREFIX_OPTION, token]
    with _claimed(Path(folder).resolve() / ".snakemake", snakemake, token, slurm):
        # Below `nbavatar warm` it is that which interrupts Snakemake.
        order = (signal.SIGTERM, signal.SIGKILL) if warm else _ORDER
        with supervised(command, os.environ, token, order, slurm) as process:
            record = Path(folder).resolve() / ".snakemake" / _RECORD
            return wait(process, lambda: _beat(record))


@contextlib.contextmanager
def supervised(
    command: Sequence[str],
    environment: Mapping[str, str],
    token: str | None = None,
    order: Sequence[signal.Signals] = _ORDER,
    slurm: bool = False,
) -> Iterator["subprocess.Popen[bytes]"]:
    """Starts a command; when the block ends, nothing of what the command started is left.

    SIGTERM is noted, for `told_to_end`; the block should then end. A process in which this is used must not have
    started threads.

    Args:
        command: program and arguments.
        environment: of the command.
        token: of the run; a new one by default, and inside another run that run's.
        order: signals that end the command, each when the one before has not.
        slurm: whether jobs of the run are in SLURM's queue.
    """
    outer = os.environ.get(RUN_VARIABLE) if token is None else None
    token = outer or token or f"{machine()}-{os.getpid()}-{secrets.token_hex(8)}"
    _TOLD.clear()
    # Noted, not raised: an exception out of a handler is lost where the interpreter runs hooks, as around a fork.
    former = signal.signal(signal.SIGTERM, lambda *_: _TOLD.append(signal.SIGTERM))
    # The outer run has a guard, and ends what is left of this one.
    guard = contextlib.nullcontext() if outer else _guarded(token, slurm)
    try:
        with guard:
            process = subprocess.Popen(command, env={**environment, RUN_VARIABLE: token})
            try:
                yield process
            finally:
                signal.signal(signal.SIGTERM, signal.SIG_IGN)
                _end(process, order)
                if not outer:
                    end_run(token)
                    if slurm:
                        cancel_jobs(token)
    finally:
        signal.signal(signal.SIGTERM, former)


def told_to_end() -> bool:
    """Whether this process was sent SIGTERM while it supervised a command."""
    return bool(_TOLD)


def wait(process: "subprocess.Popen[bytes]", beat: Callable[[], None] = lambda: None) -> int:
    """Waits for a command; its exit code, 128 and the signal's number if a signal ended it; 143 when told to end.

    An interrupt from the keyboard reaches the command too, which is left to end in its own way; a second one is ours.
    """
    interrupted = False
    while not told_to_end():
        beat()
        try:
            code = process.wait(_POLL_S)
            return code if code >= 0 else 128 - code
        except subprocess.TimeoutExpired:
            continue
        except KeyboardInterrupt:
            if interrupted:
                raise
            interrupted = True
    return 128 + signal.SIGTERM


def end_run(token: str, grace_s: float = _GRACE_S) -> int:
    """Ends all processes of a run but this one: asks them, waits, and kills what is left; returns how many there were.

    Only processes of this user on this machine are found, and only where the system lists them (`/proc`).
    """
    members = _members(token)
    if not members:
        return 0
    import psutil

    for process in members:
        with contextlib.suppress(psutil.Error):
            process.terminate()
    _, left = psutil.wait_procs(members, timeout=grace_s)
    count = len(members)
    while left:  # what is killed cannot start anything, what was started meanwhile is found
        for process in left:
            with contextlib.suppress(psutil.Error):
                process.kill()
        psutil.wait_procs(left, timeout=grace_s)
        left = _members(token)
    return count


def _members(token: str) -> list[Any]:
    try:
        import psutil
    except ImportError:  # comes with Snakemake, without which there is little to end
        return []
    found = []
    with contextlib.suppress(psutil.Error, OSError):  # no /proc
        for process in psutil.process_iter():
            with contextlib.suppress(psutil.Error, OSError):
                ours = process.pid != os.getpid() and process.environ().get(RUN_VARIABLE) == token
                if ours and process.status() != psutil.STATUS_ZOMBIE:
                    found.append(process)
    return found


def _end(process: "subprocess.Popen[bytes]", order: Sequence[signal.Signals]) -> None:
    """Ends the command itself."""
    for number in order:
        if process.poll() is not None:
            return
        process.send_signal(number)
        with contextlib.suppress(subprocess.TimeoutExpired, KeyboardInterrupt):
            process.wait(_GRACE_S if len(order) > 2 else 3 * _GRACE_S)


@contextlib.contextmanager
def _guarded(token: str, slurm: bool) -> Iterator[None]:
    """While the block lasts, a process waits for the end of this one, and then ends the run."""
    reading, writing = os.pipe()
    guard = os.fork()
    if guard == 0:
        status = 1
        try:
            os.setsid()  # out of reach of the keyboard, and of a kill of the whole group
            devnull = os.open(os.devnull, os.O_RDWR)
            for stream in range(3):
                os.dup2(devnull, stream)
            os.dup2(reading, 3)
            os.closerange(4, _MOST_STREAMS)
            for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
                signal.signal(number, signal.SIG_IGN)
            if os.read(3, 1) == b"":
                end_run(token)
                if slurm:
                    cancel_jobs(token)
            status = 0
        finally:
            os._exit(status)
    os.close(reading)
    _GUARD_PIPES.add(writing)
    try:
        yield
    finally:
        _GUARD_PIPES.discard(writing)
        with contextlib.suppress(OSError):  # the guard was killed
            os.write(writing, b".")
        os.close(writing)
        os.waitpid(guard, 0)


def leave_guard() -> None:
    """To be called in a process that was forked and goes on: a guard waits until nobody holds its pipe."""
    while _GUARD_PIPES:
        os.close(_GUARD_PIPES.pop())


@contextlib.contextmanager
def _claimed(state: Path, snakemake: Sequence[str], token: str, slurm: bool) -> Iterator[None]:
    """Makes this run the only one of Snakemake's folder, after what a killed one left is cleared away."""
    record, locks = state / _RECORD, state / "locks"
    former = _former(record)
    if former is not None and former["machine"] == machine():
        if _same(former["process"], former["started"]):
            found, fix = f"process {former['process']}, at work here", f"wait, or end it: kill {former['process']}"
            raise DataError.of(state.parent, expected="no other run", found=found, fix=fix)
        orphans = end_run(former["run"])
        if orphans:
            print(f"nbavatar: ended {orphans} processes that a killed run had left", file=sys.stderr)
        _cancel_former(former, state.parent)
    left = sorted(path.name for path in locks.glob("*.lock"))
    if left:
        known = former is not None and former["machine"] == machine() and not _younger(locks, record)
        if former is None or not known or not set(left) <= _OWN_LOCKS or _snakemakes(state.parent):
            found, fix = "one whose run is not known", shlex.join([*snakemake, "--unlock"])
            fix = f"if no run works there, remove it by: {fix}"
            raise DataError.of(state.parent, expected="no lock of Snakemake", found=found, fix=fix)
        shutil.rmtree(locks)
        print(f"nbavatar: removed the lock of process {former['process']}, which was killed", file=sys.stderr)
    own = {"machine": machine(), "process": os.getpid(), "started": _started(os.getpid()), "run": token,
           "slurm": slurm}  # fmt: skip
    write_json(record, own)
    try:
        yield
    finally:
        # A Snakemake that was told to end and took longer than it was given was killed by us, and its lock is ours.
        if (
            told_to_end()
            and {path.name for path in locks.glob("*.lock")} <= _OWN_LOCKS
            and not _snakemakes(state.parent)
        ):
            shutil.rmtree(locks, ignore_errors=True)
        if not any(locks.glob("*.lock")) and _former(record) == own:
            record.unlink(missing_ok=True)


def _beat(record: Path) -> None:
    """Marks the record of a run that lives, now and then, by its time."""
    with contextlib.suppress(OSError):
        if time.time() - record.stat().st_mtime > _BEAT_S:
            os.utime(record)


def _younger(locks: Path, record: Path) -> bool:
    """Whether a lock was made after the run of the record had ended: it is another's then."""
    try:
        ended = record.stat().st_mtime + 2 * _BEAT_S
        return any(path.stat().st_mtime > ended for path in locks.glob("*.lock"))
    except OSError:
        return True


def _cancel_former(former: dict[str, Any], folder: Path) -> None:
    """Ends the jobs that a killed run has in SLURM's queue: they would write beside the next one's."""
    if not former["slurm"]:
        return
    count = cancel_jobs(former["run"])
    if count is None:
        fix = f"when SLURM answers, cancel the jobs whose names begin with {former['run']} (squeue, scancel)"
        raise DataError.of(folder, expected="no jobs of a killed run in SLURM's queue", found="that it may have some",
                           fix=f"{fix} and remove .snakemake/{_RECORD}")  # fmt: skip
    if count:
        print(f"nbavatar: cancelled {count} jobs that a killed run had in SLURM's queue", file=sys.stderr)


def _former(record: Path) -> dict[str, Any] | None:
    try:
        content = json.loads(record.read_text(encoding="utf-8"))
        return {"machine": str(content["machine"]), "process": int(content["process"]),
                "started": content["started"] and float(content["started"]), "run": str(content["run"]),
                "slurm": content.get("slurm") is True}  # fmt: skip
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _started(process: int) -> float | None:
    """When a process began [s], or None if it is not there or the system does not tell."""
    try:
        import psutil

        return psutil.Process(process).create_time()
    except Exception:  # no psutil, no /proc, no such process
        return None


def _same(process: int, started: float | None) -> bool:
    """Whether a process lives and is the one that began then; numbers of processes are used again."""
    if not alive(process):
        return False
    now = _started(process)
    return now is None or started is None or abs(now - started) < 1.0


def _snakemakes(folder: Path) -> list[int]:
    """Living processes of Snakemake whose folder is this one, as far as the system tells."""
    found = []
    with contextlib.suppress(Exception):  # no psutil, no /proc
        import psutil

        for process in psutil.process_iter():
            with contextlib.suppress(psutil.Error, OSError):
                named = any(Path(word).name == "snakemake" for word in process.cmdline()[:4])
                if named and Path(process.cwd()) == folder and process.pid != os.getpid():
                    found.append(process.pid)
    return found
