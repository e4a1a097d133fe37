"""Run a command, such as Snakemake, in which every verb that needs torch starts at once.

    nbavatar warm -- snakemake --cores 2 ...

Importing torch and loading the compiled kernels takes seconds, which is nothing for a training and most of a smoke
run of dozens of tiny jobs. This process loads them once, while COMMAND is already running. `nbavatar train`, `render`,
`evaluate` and the like below COMMAND then hand their arguments, folder, environment and open streams to it over a
socket, and it forks a process that runs them: one process a job, as ever, with nothing shared but what was loaded.
A job whose caller disappears is terminated, and so is all that was started here when COMMAND ends or this process does,
however it ends. Where no socket can be made COMMAND runs without it. Linux and macOS, without a GPU (CUDA does not
survive a fork).

Snakemake's `benchmark:` files then see the waiting caller; their wall times are right, their processor times and
memory are not.
"""

import argparse
import contextlib
import ctypes
import json
import os
import re
import selectors
import shutil
import signal
import socket
import stat
import struct
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Sequence
from pathlib import Path

from nbavatar.cli import SOCKET_VARIABLE
from nbavatar.cli.supervision import leave_guard, supervised, told_to_end, wait
from nbavatar.errors import ConfigError
from nbavatar.processes import alive, machine

__all__ = ["add_arguments", "call", "main"]

_LONGEST = 1 << 20  # bytes of a request: arguments and environment
_GRACE_S = 5.0  # for a job to save its state
_SOCKET = "socket"
_PR_SET_PDEATHSIG = 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options of `nbavatar warm`."""
    parser.add_argument("command", nargs=argparse.REMAINDER, metavar="-- COMMAND ...", help="what to run")


def call(argv: Sequence[str]) -> int | None:
    """Has the server run `nbavatar <argv>`; returns its exit code, or None where no server of this user is there.

    Environments outlive servers: in sessions that were begun below one, in jobs that a cluster runs elsewhere. What
    then listens under the old name may be anybody's, and would be given this process's environment and open files.
    """
    request = json.dumps({"argv": list(argv), "folder": os.getcwd(), "environment": dict(os.environ)}).encode()
    with socket.socket(socket.AF_UNIX) as connection:
        try:
            if not _ours(Path(os.environ[SOCKET_VARIABLE]).parent):
                return None
            connection.connect(os.environ[SOCKET_VARIABLE])
        except OSError:
            return None
        if not _same_user(connection):
            return None
        answer = b""
        with contextlib.suppress(ConnectionError):
            socket.send_fds(connection, [len(request).to_bytes(8, "big")], [0, 1, 2])
            connection.sendall(request)
            # If this process is ended, the server sees the connection close, and ends the job.
            answer = connection.recv(1)
    if not answer:
        print("nbavatar: error: the process of `nbavatar warm` is gone", file=sys.stderr)
        return 1
    return answer[0]


def _ours(folder: Path) -> bool:
    """Whether a folder is as the server makes it: this user's, and closed to all others."""
    info = os.lstat(folder)
    return stat.S_ISDIR(info.st_mode) and info.st_uid == os.geteuid() and not info.st_mode & 0o077


def _same_user(connection: socket.socket) -> bool:
    """Whether a process of this user listens at the other end, where the system tells (Linux)."""
    if not hasattr(socket, "SO_PEERCRED"):
        return True
    _, user, _ = struct.unpack("3i", connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
    return user == os.geteuid()


def main(args: argparse.Namespace) -> int:
    """Runs `nbavatar warm`; its exit code is the command's, or 143 when it was told to terminate."""
    command = args.command[1:] if args.command[:1] == ["--"] else args.command
    if not command:
        raise ConfigError("nbavatar warm: expected a command after `--`, found none")
    with contextlib.ExitStack() as stack:
        listener = stack.enter_context(socket.socket(socket.AF_UNIX))
        folder = _bound(listener)
        if folder is None:
            print("nbavatar warm: no folder for a socket, jobs start at their usual pace; set TMPDIR to a short path",
                  file=sys.stderr)  # fmt: skip
            return wait(stack.enter_context(supervised(command, os.environ)))
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        listener.listen(64)
        environment = {**os.environ, SOCKET_VARIABLE: str(folder / _SOCKET)}
        process = stack.enter_context(supervised(command, environment))
        _load()
        return _Server(listener).serve(process)


def _bound(listener: socket.socket) -> Path | None:
    """Binds the socket in a new folder of this user's own; the folder, or None where there is room for none."""
    form = re.compile(rf"nbavatar-warm-{machine()}-(\d+)-\w+")
    places = [os.environ.get("TMPDIR"), os.environ.get("XDG_RUNTIME_DIR"), "/tmp", "/var/tmp", "/dev/shm"]
    for place in filter(None, places):
        folder = ""
        with contextlib.suppress(OSError):
            for name in os.listdir(place):  # of servers that were killed
                match = form.fullmatch(name)
                if match and not alive(int(match[1])) and os.lstat(Path(place, name)).st_uid == os.geteuid():
                    shutil.rmtree(Path(place, name), ignore_errors=True)
        # A path that is too long for a socket is refused by Python, in a form of OSError without a number.
        with contextlib.suppress(OSError):
            folder = tempfile.mkdtemp(prefix=f"nbavatar-warm-{machine()}-{os.getpid()}-", dir=place)
            listener.bind(str(Path(folder) / _SOCKET))
            return Path(folder)
        if folder:
            shutil.rmtree(folder, ignore_errors=True)
    return None


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
    from nbavatar.methods.photometric import loss_dssim
    from nbavatar.rendering.billboards.functional import render_billboards

    alpha, camera = torch.zeros(1, 1, 1), torch.eye(4)
    place = torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.ones(1, 2)
    render_billboards(*place, torch.zeros(1, 1, 1, 3), alpha, camera, camera[:3, :3], 1, 1)
    loss_dssim(torch.zeros(1, 1, 1), torch.zeros(1, 1, 1))


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

    def serve(self, process: "subprocess.Popen[bytes]") -> int:
        """Serves until the command ends; returns its exit code."""
        interrupted = False
        try:
            while process.poll() is None and not told_to_end():
                try:
                    self._turn()
                except KeyboardInterrupt:  # the command has it from the keyboard too, and ends in its own way
                    if interrupted:
                        raise
                    interrupted = True
        finally:
            self._end_jobs()
        return wait(process)

    def _turn(self) -> None:
        self._reap()
        for key, _ in self._selector.select(timeout=1.0):
            if key.fileobj is self._listener:
                with contextlib.suppress(OSError):  # a caller that was gone before it was met
                    self._start(self._listener.accept()[0])
            elif key.fileobj == self._woken:
                with contextlib.suppress(BlockingIOError):
                    os.read(self._woken, 4096)
            elif isinstance(key.fileobj, socket.socket):
                self._look_at(key.fileobj)

    def _reap(self) -> None:
        for pid in list(self._jobs):
            ended, status = os.waitpid(pid, os.WNOHANG)
            if ended == 0:
                continue
            caller = self._jobs.pop(pid)
            code = os.waitstatus_to_exitcode(status)
            with contextlib.suppress(OSError, KeyError, ValueError):
                self._selector.unregister(caller)
            with contextlib.suppress(OSError):
                caller.sendall(bytes([code if code >= 0 else 128 - code]))
            caller.close()

    def _look_at(self, caller: socket.socket) -> None:
        """If a caller is gone its job ends too; if it still speaks, its job is about to listen."""
        try:
            gone = not caller.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT)
        except BlockingIOError:
            return
        except OSError:
            gone = True
        if not gone:
            time.sleep(0.001)
            return
        self._selector.unregister(caller)
        for pid, other in self._jobs.items():
            if other is caller:
                os.kill(pid, signal.SIGTERM)

    def _start(self, caller: socket.socket) -> None:
        # The request is read by the job, so that a caller that stalls keeps nobody but itself waiting.
        pid = os.fork()
        if pid == 0:
            status = 1
            try:
                self._forget()
                status = _run(caller)
            finally:
                os._exit(status)
        self._jobs[pid] = caller
        self._selector.register(caller, selectors.EVENT_READ)

    def _forget(self) -> None:
        """In a job: closes what is the server's, so that nobody takes the job for it."""
        leave_guard()
        # A job that was forked has no environment of its own by which a guard would find it. Linux only.
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
        signal.set_wakeup_fd(-1)
        for number in (signal.SIGCHLD, signal.SIGTERM, signal.SIGINT):
            signal.signal(number, signal.SIG_DFL if number != signal.SIGINT else signal.default_int_handler)
        if told_to_end():  # after the fork, before the line above
            os._exit(128 + signal.SIGTERM)
        self._selector.close()
        self._listener.close()
        for stream in (self._woken, self._wake):
            os.close(stream)
        for other in self._jobs.values():
            other.close()

    def _end_jobs(self) -> None:
        for number, patience in ((signal.SIGTERM, _GRACE_S), (signal.SIGKILL, _GRACE_S)):
            for pid in self._jobs:
                os.kill(pid, number)
            until = time.monotonic() + patience
            while self._jobs and time.monotonic() < until:
                self._reap()
                time.sleep(0.02)


def _run(caller: socket.socket) -> int:
    """A forked process becomes the caller's: its streams, folder and environment, then its verb."""
    header, streams, _, _ = socket.recv_fds(caller, 8, 3)
    size = int.from_bytes(header, "big")
    if len(header) != 8 or len(streams) != 3 or size > _LONGEST:
        return 1
    with caller.makefile("rb") as stream:
        content = stream.read(size)
    if len(content) < size:  # the caller is gone
        return 1
    caller.close()
    request = json.loads(content)
    for target, descriptor in enumerate(streams):
        os.dup2(descriptor, target)
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
