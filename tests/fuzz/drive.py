"""Drives readers over damaged files; by hand: `python -m tests.fuzz.drive [--count N] [--seed S] [NAME ...]`.

Good is what is read, and what is refused in one line by an error of the package. Anything else is an escape. By hand
every reader gets a process of its own, of which the slowest call and the memory at its peak are told too.
"""

import argparse
import dataclasses
import faulthandler
import os
import random
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from nbavatar.errors import NBAvatarError
from tests.fuzz.mutations import mutate
from tests.fuzz.readers import READERS

__all__ = ["Outcome", "drive"]

_HANG_S = 60
# Nothing that parses a file starts a program, talks to a network or runs text as code.
_FORBIDDEN = ("os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.fork", "subprocess.Popen", "socket.connect")


@dataclasses.dataclass
class Outcome:
    """What became of the damaged files of one reader.

    Attributes:
        read, refused: how many.
        escapes: (number of the file, what was raised) of all others.
        ran: forbidden things that happened meanwhile.
        slowest: number of the file that took longest, and how long [s].
    """

    read: int = 0
    refused: int = 0
    escapes: list[tuple[int, BaseException]] = dataclasses.field(default_factory=list)
    ran: list[str] = dataclasses.field(default_factory=list)
    slowest: tuple[int, float] = (-1, 0.0)


_watching: list[Outcome] = []


def _watch(event: str, args: tuple) -> None:
    if _watching and event in _FORBIDDEN:
        _watching[-1].ran.append(f"{event}{args}")


def drive(name: str, folder: Path, count: int, seed: int = 0) -> Outcome:
    """Reads the good file, which must be read, and then `count` damaged ones."""
    reader = READERS[name]
    path = reader.write(folder)
    good = path.read_bytes()
    reader.read(path)
    outcome = Outcome()
    _watching.append(outcome)
    try:
        for number in range(count):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(mutate(good, reader.kind, random.Random(f"{name}:{seed}:{number}")))
            begun = time.perf_counter()
            try:
                reader.read(path)
                outcome.read += 1
            except NBAvatarError as error:
                outcome.refused += 1
                if "\n" in str(error) or len(str(error)) > 2000:
                    outcome.escapes.append((number, error))
            except Exception as error:
                outcome.escapes.append((number, error))
            took = time.perf_counter() - begun
            if took > outcome.slowest[1]:
                outcome.slowest = (number, took)
    finally:
        _watching.pop()
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(good)
    return outcome


sys.addaudithook(_watch)


def _child(name: str, count: int, seed: int, keep: Path | None) -> int:
    faulthandler.enable()
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if os.access(memory, os.W_OK) else None) as text:
        faulthandler.dump_traceback_later(_HANG_S + count, exit=True)
        outcome = drive(name, Path(text), count, seed)
        faulthandler.cancel_dump_traceback_later()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    kinds = sorted({f"{type(e).__name__}: {str(e)[:150]!r} ({n})" for n, e in outcome.escapes})
    print(
        f"{name}: {count} files, {outcome.read} read, {outcome.refused} refused, {len(outcome.escapes)} escaped, "
        f"{len(outcome.ran)} ran, slowest {outcome.slowest[1]:.2f} s (file {outcome.slowest[0]}), peak {peak:.0f} MB"
    )
    for kind in kinds[:12]:
        print(f"    {kind}")
    for event in outcome.ran[:3]:
        print(f"    ran {event}")
    if outcome.escapes and keep is not None:
        import traceback

        for _number, error in outcome.escapes[:3]:
            traceback.print_exception(error, limit=-5, file=sys.stdout)
    return 1 if outcome.escapes or outcome.ran else 0


def main() -> int:
    """Runs all readers, or those whose names begin as given."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="beginnings of names")
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--tracebacks", action="store_true", help="print the first ones")
    args = parser.parse_args()
    if args.child:
        return _child(args.names[0], args.count, args.seed, Path() if args.tracebacks else None)
    bad = 0
    for name in READERS:
        if args.names and not name.startswith(tuple(args.names)):
            continue
        options = [name, "--child", "--count", str(args.count), "--seed", str(args.seed)]
        options += ["--tracebacks"] * args.tracebacks
        done = subprocess.run(
            [sys.executable, "-m", "tests.fuzz.drive", *options], env=os.environ, capture_output=True, text=True
        )
        print(done.stdout.strip() or f"{name}: no answer", flush=True)
        said = [line for line in done.stderr.splitlines() if line.strip()]
        if said:
            print(f"    stderr, {len(said)} lines: {said[-1][:200]}", flush=True)
        if done.returncode not in (0, 1):
            print(f"    ENDED with {done.returncode}", flush=True)
        bad += done.returncode != 0
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
