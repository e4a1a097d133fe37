"""Jobs that a run has in SLURM's queue: they are no processes of this machine, and outlive a run that is killed."""

import os
import subprocess
import time

__all__ = ["PREFIX_OPTION", "cancel_jobs"]

PREFIX_OPTION = "--slurm-jobname-prefix"
"""Option of snakemake-executor-plugin-slurm; the token of the run is handed over by it and names every job."""

_ANSWER_S = 60.0
_PATIENCE_S = 180.0  # SLURM itself waits 30 s by default between its signals, for a training to save its state
_POLL_S = 1.0


def cancel_jobs(run: str) -> int | None:
    """Cancels all jobs of a run and waits until none of them is left in the queue.

    Args:
        run: token of the run.

    Returns:
        How many there were; None if the queue could not be asked, or some would not go.
    """
    jobs = _queued(run)
    if not jobs:
        return None if jobs is None else 0
    try:
        subprocess.run(["scancel", *jobs], capture_output=True, timeout=_ANSWER_S, check=False)
    except (OSError, subprocess.SubprocessError):
        return None
    end = time.monotonic() + _PATIENCE_S
    while left := _queued(run):
        if time.monotonic() > end:
            return None
        time.sleep(_POLL_S)
    return None if left is None else len(jobs)


def _queued(run: str) -> list[str] | None:
    command = ["squeue", f"--user={os.getuid()}", "--noheader", "--format=%i|%j"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_ANSWER_S, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    pairs = [line.strip().partition("|") for line in done.stdout.splitlines()]
    return [job for job, _, name in pairs if name.startswith(f"{run}_")]
