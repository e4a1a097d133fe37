"""How threads of torch wait for each other: spinning, as its OpenMP does by itself, or as `nbavatar` lets them.

    nbavatar bench waiting                  # an otherwise idle machine
    nbavatar bench waiting --busy 2         # beside two processes that never rest
    nbavatar bench waiting --spins 1000 0   # compares other numbers of turns, the first two of them

Two processes make the same training steps of a capture's avatar (`nbavatar bench train --config`), one step at a
time in turns, each with another limit on how long a thread that waits spins before it sleeps (`GOMP_SPINCOUNT`).
Figures: medians of wall time [ms], and `ratio`, the median over the turns of the second's time by the first's.
"""

import argparse
import contextlib
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

from nbavatar.errors import DataError, NBAvatarError
from nbavatar.waiting import SPINS, VARIABLES

__all__ = ["add_arguments", "run", "serve"]

_CHILD = "from nbavatar.studies.benchmarks.waiting import serve; serve({size}, {options!r})"
_BUSY = "while True: pass"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the scene's and the measurement's options."""
    parser.add_argument("--size", type=int, default=256, help="image side [px] (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1, help="of torch (default: %(default)s)")
    parser.add_argument("--busy", type=int, default=0, help="processes that compute beside (default: %(default)s)")
    parser.add_argument("--config", default=None, metavar="YAML", help="run whose training it is (default: captures')")
    parser.add_argument(
        "--spins", type=int, nargs=2, default=(-1, SPINS), metavar="N",
        help=f"turns of the two; -1: as OpenMP does by itself (default: -1 and {SPINS})",
    )  # fmt: skip
    parser.add_argument("--repeats", type=int, default=9, help="turns a median is taken of (default: %(default)s)")


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Measures; see the module's description for the figures.

    Raises:
        DataError: a number of pixels, threads or repeats under 1.
        NBAvatarError: a process ended before its time.
    """
    for name in ("size", "threads", "repeats"):
        if getattr(args, name) < 1:
            raise DataError.of("bench waiting", f"--{name}", expected="at least 1", found=getattr(args, name))
    times: list[list[float]] = [[], []]
    with contextlib.ExitStack() as stack:
        pair = [stack.enter_context(_stepping(args, spins)) for spins in args.spins]
        for process in pair:
            _step(process)  # compiles, and makes the optimizer's state
        for _ in range(args.busy):
            stack.enter_context(_running([sys.executable, "-c", _BUSY]))
        for _ in range(args.repeats):
            for process, own in zip(pair, times, strict=True):
                own.append(_step(process))
    return {
        "threads": args.threads,
        "busy": args.busy,
        "load": os.getloadavg()[0],
        "spins": " ".join(str(spins) for spins in args.spins),
        "first_ms": statistics.median(times[0]),
        "second_ms": statistics.median(times[1]),
        "ratio": statistics.median(b / a for a, b in zip(*times, strict=True)),
    }


def serve(size: int, options: str) -> None:
    """Makes one training step for each line on standard input, and prints its wall time [ms]."""
    from nbavatar.studies.benchmarks.step_scene import StepScene, training_options

    step = StepScene(size, training_options(options), "cpu").stepping()
    for _ in sys.stdin:
        began = time.perf_counter()
        step()
        sys.stdout.write(f"{1e3 * (time.perf_counter() - began)}\n")
        sys.stdout.flush()


@contextlib.contextmanager
def _stepping(args: argparse.Namespace, spins: int) -> Iterator[subprocess.Popen]:
    environment = {name: value for name, value in os.environ.items() if name not in VARIABLES}
    environment["OMP_NUM_THREADS"] = str(args.threads)
    if spins >= 0:
        environment["GOMP_SPINCOUNT"] = str(spins)
    with _running(
        [sys.executable, "-c", _CHILD.format(size=args.size, options=str(args.config))], environment
    ) as process:
        yield process


@contextlib.contextmanager
def _running(command: list[str], environment: dict[str, str] | None = None) -> Iterator[subprocess.Popen]:
    """A process with pipes, ended at the end."""
    with subprocess.Popen(
        command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def _step(process: subprocess.Popen) -> float:
    assert process.stdin is not None and process.stdout is not None
    with contextlib.suppress(BrokenPipeError):
        process.stdin.write("\n")
        process.stdin.flush()
    line = process.stdout.readline()
    if not line:
        raise NBAvatarError(f"bench waiting: a process that makes training steps ended, exit code {process.wait()}")
    return float(line)
