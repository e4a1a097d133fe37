"""Run a command, such as Snakemake, in which every verb that needs torch starts at once.

    nbavatar warm -- snakemake --cores 2 ...

Importing torch and loading the compiled kernels takes seconds, which is nothing for a training and most of a smoke
run of dozens of tiny jobs. This process loads them once, while COMMAND is already running. `nbavatar train`, `render`,
`evaluate` and the like below COMMAND then hand their arguments, folder, environment and open streams to it over a
socket, and it forks a process that runs them: one process a job, as ever, with nothing shared but what was loaded.
A job whose caller disappears is terminated. Linux and macOS, without a GPU (CUDA does not survive a fork).

Snakemake's `benchmark:` files then see the waiting caller; their wall times are right, their processor times and
memory are not.
"""

import argparse
import contextlib
import json
import os
import selectors
import signal
import socket
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Sequence
from pathlib import Path

from nbavatar.cli import SOCKET_VARIABLE
from nbavatar.errors import ConfigError

__all__ = ["add_arguments", "call", "main"]

_LONGEST = 1 << 20  # bytes of a request: arguments and environment


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options of `nbavatar warm`."""
    parser.add_argument("command", nargs=argparse.REMAINDER, metavar="-- COMMAND ...", help="what to run")


def call(argv: Sequence[str]) -> int:
    """Has the server run `nbavatar <argv>`; returns its exit code."""
    request = json.dumps({"argv": list(argv), "folder": os.getcwd(), "environment": dict(os.environ)}).encode()
    with socket.socket(socket.AF_UNIX) as connection:
        answer = b""
        with contextlib.suppress(ConnectionError):
            connection.connect(os.environ[SOCKET_VARIABLE])
            socket.send_fds(connection, [len(request).to_bytes(8, "big")], [0, 1, 2])
            connection.sendall(request)
            # If this process is ended, the server sees the connection close, and ends the job.
            answer = connection.recv(1)
    if not answer:
        print("nbavatar: error: the process of `nbavatar warm` is gone", file=sys.stderr)
        return 1
    return answer[0]


def main(args: argparse.Namespace) -> int:
    """Runs `nbavatar warm`; its exit code is the command's."""
    command = args.command[1:] if args.command[:1] == ["--"] else args.command
    if not command:
        raise ConfigError("nbavatar warm: expected a command after `--`, found none")
    with tempfile.TemporaryDirectory(prefix="nbavatar-") as folder:
        path = str(Path(folder) / "socket")
        with socket.socket(socket.AF_UNIX) as listener:
            listener.bind(path)
            listener.listen(64)
            process = subprocess.Popen(command, env={**os.environ, SOCKET_VARIABLE: path})
            try:
                _load()
                return _Server(listener).serve(process)
            finally:
                if process.poll() is None:
                    process.terminate()
                    process.wait()


def _load() -> None:
    """Imports what the verbs need and has the kernels ready, on one thread: a fork would lose all others."""
    import torch

    torch.set_num_threads(1)

    import nbavatar.cli.evaluate
    import nbavatar.cli.render
    import nbavatar.cli.speed
    import nbavatar.cli.train
    import nbavatar.evaluation.evaluate
    import nbavatar.evaluation.speed
    import nbavatar.training.loop  # noqa: F401
    from nbavatar.raster.functional import render_billboards

    alpha, camera = torch.zeros(1, 1, 1), torch.eye(4)
    place = torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.ones(1, 2)
    render_billboards(*place, torch.zeros(1, 1, 1, 3), alpha, camera, camera[:3, :3], 1, 1)


class _Server:
    """Forks a process for every request, and tells the caller how it ended."""

    def __init__(self, listener: socket.socket) -> None:
        self._listener = listener
        self._selector = selectors.DefaultSelector()
        self._selector.register(listener, selectors.EVENT_READ)
        self._jobs: dict[int, socket.socket] = {}  # process -> caller
        # The end of a child wakes the selector.
        self._woken, self._wake = os.pipe()
        os.set_blocking(self._woken, False)
        os.set_blocking(self._wake, False)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        signal.set_wakeup_fd(self._wake, warn_on_full_buffer=False)
        self._selector.register(self._woken, selectors.EVENT_READ)

    def serve(self, process: subprocess.Popen[bytes]) -> int:
        """Serves until the command ends; returns its exit code."""
        while process.poll() is None:
            self._reap()
            for key, _ in self._selector.select(timeout=1.0):
                if key.fileobj is self._listener:
                    self._start(self._listener.accept()[0])
                elif key.fileobj == self._woken:
                    with contextlib.suppress(BlockingIOError):
                        os.read(self._woken, 4096)
                else:
                    self._abandon(key.fileobj)
        for pid in self._jobs:
            os.kill(pid, signal.SIGTERM)
        return process.returncode if process.returncode >= 0 else 128 - process.returncode

    def _reap(self) -> None:
        for pid in list(self._jobs):
            ended, status = os.waitpid(pid, os.WNOHANG)
            if ended == 0:
                continue
            caller = self._jobs.pop(pid)
            code = os.waitstatus_to_exitcode(status)
            with contextlib.suppress(OSError, KeyError):
                self._selector.unregister(caller)
            with contextlib.suppress(OSError):
                caller.sendall(bytes([code if code >= 0 else 128 - code]))
            caller.close()

    def _abandon(self, caller: object) -> None:
        """The caller is gone: its job ends too."""
        for pid, other in self._jobs.items():
            if other is caller:
                self._selector.unregister(other)
                os.kill(pid, signal.SIGTERM)

    def _start(self, caller: socket.socket) -> None:
        header, streams, _, _ = socket.recv_fds(caller, 8, 3)
        size = int.from_bytes(header, "big")
        if len(header) != 8 or len(streams) != 3 or size > _LONGEST:
            caller.close()
            return
        with caller.makefile("rb") as stream:
            request = json.loads(stream.read(size))
        pid = os.fork()
        if pid == 0:
            os._exit(_run(request, streams))
        for stream in streams:
            os.close(stream)
        self._jobs[pid] = caller
        self._selector.register(caller, selectors.EVENT_READ)


def _run(request: dict, streams: Sequence[int]) -> int:
    """A forked process becomes the caller's: its streams, folder and environment, then its verb."""
    signal.set_wakeup_fd(-1)
    for number in (signal.SIGCHLD, signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_DFL if number != signal.SIGINT else signal.default_int_handler)
    for target, stream in enumerate(streams):
        os.dup2(stream, target)
    os.environ.clear()
    os.environ.update(request["environment"])
    del os.environ[SOCKET_VARIABLE]
    os.chdir(request["folder"])
    try:
        import torch

        from nbavatar import cli

        # Read by OpenMP when torch is imported, which was before this job was known.
        torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS") or os.cpu_count() or 1))
        code = cli.main(request["argv"])
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except BaseException:
        traceback.print_exc()
        code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    return code
