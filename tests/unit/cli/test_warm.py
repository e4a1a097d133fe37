"""`nbavatar warm`: forked jobs behave as processes of their own do, for their callers and for the system."""

import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil
import pytest

from nbavatar.cli import SOCKET_VARIABLE, warm
from tests.unit.users import OTHER

# The command that runs under the server; one for all checks, because starting the server loads torch.
_SCRIPT = """
import json, os, subprocess, sys, time

import psutil

folder = sys.argv[1]
run = [sys.executable, "-m", "nbavatar"]
inputs = ["--meshes", "absent.npz", "--frames", "absent.zip", "--out", "out.zip"]
found = {}

done = subprocess.run([*run, "speed", "--help"], capture_output=True, text=True)
found["help"] = done.returncode, done.stdout, done.stderr

os.mkdir(f"{folder}/elsewhere")
done = subprocess.run([*run, "render", "--model", "absent.pt", *inputs], capture_output=True, text=True,
                      cwd=f"{folder}/elsewhere")
found["missing"] = done.returncode, done.stdout, done.stderr

# A job that lasts for minutes, unless its caller's end ends it.
server = psutil.Process(os.getppid())
idle = len(server.children())
caller = subprocess.Popen([*run, "extremes", "--out", f"{folder}/extremes"])


def jobs_become(number):
    for _ in range(600):
        if len(server.children()) - idle == number:
            return True
        time.sleep(0.05)
    return False


found["began"] = jobs_become(1)
caller.kill()
caller.wait()
found["ended"] = jobs_become(0)
with open(f"{folder}/found.json", "w") as stream:
    json.dump(found, stream)
sys.exit(7)
"""


def test_jobs_behave_as_processes_of_their_own(tmp_path):
    script = tmp_path / "command.py"
    script.write_text(_SCRIPT)
    command = [sys.executable, "-m", "nbavatar", "warm", "--", sys.executable, str(script), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 7, done.stderr  # the command's own
    found = json.loads((tmp_path / "found.json").read_text())

    code, out, err = found["help"]
    assert (code, err) == (0, "")
    assert out.startswith("usage: nbavatar speed")

    code, out, err = found["missing"]
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert err.startswith("nbavatar render: error: absent.pt: ")
    assert list((tmp_path / "elsewhere").iterdir()) == []  # it ran there, and left nothing

    assert found["began"]
    assert found["ended"]


def test_without_a_command_is_a_clear_line(capsys):
    from nbavatar.cli import main

    assert main(["warm"]) == 2
    assert "expected a command after `--`" in capsys.readouterr().err


# Callers that behave badly, beside one that behaves well.
_BAD = """
import os, socket, subprocess, sys, time
run = [sys.executable, "-m", "nbavatar"]
silent, half = socket.socket(socket.AF_UNIX), socket.socket(socket.AF_UNIX)
for caller in (silent, half):
    caller.connect(os.environ["NBAVATAR_WARM"])
socket.send_fds(half, [(1000).to_bytes(8, "big")], [0, 1, 2])
half.sendall(b"{")
for number in range(3):  # gone before they said anything, or in the middle
    with socket.socket(socket.AF_UNIX) as lost:
        lost.connect(os.environ["NBAVATAR_WARM"])
        if number:
            socket.send_fds(lost, [(1000).to_bytes(8, "big")], [0, 1, 2])
            lost.sendall(b"{" * number)
sys.exit(subprocess.run([*run, "speed", "--help"], stdout=subprocess.DEVNULL, timeout=120).returncode)
"""


def test_callers_that_stall_or_die_stop_nobody_else(tmp_path):
    (tmp_path / "command.py").write_text(_BAD)
    command = [sys.executable, "-m", "nbavatar", "warm", "--", sys.executable, str(tmp_path / "command.py")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stderr) == (0, "")


# A job that lasts for minutes, below a shell as Snakemake's are, and a program of the command's own.
_LASTING = """
import subprocess, sys
verb = [sys.executable, "-m", "nbavatar", "extremes", "--out", f"{sys.argv[1]}/extremes"]
subprocess.Popen(["bash", "-c", '"$@"; true', "job", *verb])
subprocess.Popen(["sleep", "1000"])
subprocess.Popen(["sleep", "1000"]).wait()
"""


def _lasting(tmp_path, environment=None):
    (tmp_path / "command.py").write_text(_LASTING)
    command = [
        sys.executable,
        "-m",
        "nbavatar",
        "warm",
        "--",
        sys.executable,
        str(tmp_path / "command.py"),
        str(tmp_path),
    ]
    server = subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)
    until = time.monotonic() + 300.0
    family: list[psutil.Process] = []
    while len(family) < 7:  # guard, command, shell, caller, job, two programs
        assert server.poll() is None and time.monotonic() < until, family
        time.sleep(0.05)
        family = psutil.Process(server.pid).children(recursive=True)
    return server, family


def test_told_to_terminate_it_ends_what_it_started(tmp_path):
    server, family = _lasting(tmp_path)
    server.terminate()
    assert server.wait(60) == 143
    assert psutil.wait_procs(family, timeout=60)[1] == []


def test_killed_it_leaves_no_process_and_the_next_removes_its_folder(tmp_path):
    place = Path(tempfile.mkdtemp(prefix="nbavatar-test-", dir="/tmp"))  # pytest's folders are too long for a socket
    environment = os.environ | {"TMPDIR": str(place)}
    server, family = _lasting(tmp_path, environment)
    server.kill()
    server.wait()
    assert psutil.wait_procs(family, timeout=60)[1] == []
    assert [path.name.startswith("nbavatar-warm-") for path in place.iterdir()] == [True]
    done = subprocess.run([sys.executable, "-m", "nbavatar", "warm", "--", "true"], env=environment)
    assert done.returncode == 0
    assert list(place.iterdir()) == []
    place.rmdir()


def test_without_a_folder_for_a_socket_jobs_still_run(tmp_path, monkeypatch, capsys):
    """Where TMPDIR is too long for a socket another folder is taken; where there is none, there is no server."""
    long = tmp_path / ("x" * 120)
    long.mkdir()
    code = "import os; raise SystemExit(3 if 'NBAVATAR_WARM' in os.environ else 4)"
    command = [sys.executable, "-m", "nbavatar", "warm", "--", sys.executable, "-c", code]
    assert subprocess.run(command, env=os.environ | {"TMPDIR": str(long)}).returncode == 3
    assert list(long.iterdir()) == []
    nowhere = (
        f"import tempfile, sys; tempfile.mkdtemp = lambda **_: (_ for _ in ()).throw(OSError()); "
        f"from nbavatar.cli import main; sys.exit(main(['warm', '--', sys.executable, '-c', {code!r}]))"
    )
    done = subprocess.run([sys.executable, "-c", nowhere], capture_output=True, text=True)
    assert done.returncode == 4
    assert "no folder for a socket" in done.stderr and done.stderr.count("\n") == 1


@pytest.mark.parametrize("owner", ["of the folder", "of the socket"])
def test_a_server_of_another_user_is_given_nothing(public_folder, monkeypatch, owner):
    """The name was free again, and is in the environment still: of a session, or of a job that a cluster runs."""
    folder = public_folder / "nbavatar-warm"
    folder.mkdir(mode=0o700)
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(folder / "socket"))
    if owner == "of the folder":
        os.chown(folder, OTHER, OTHER)
    reading, writing = os.pipe()
    other = os.fork()
    if other == 0:
        os.setuid(OTHER)
        listener.listen()
        os.write(writing, b".")
        connection, _ = listener.accept()
        os.write(writing, connection.recv(1000))
        os._exit(0)
    assert os.read(reading, 1) == b"."
    os.close(writing)
    monkeypatch.setenv(SOCKET_VARIABLE, str(folder / "socket"))
    try:
        assert warm.call(["train"]) is None  # and runs by itself
    finally:
        os.kill(other, signal.SIGKILL)
        os.waitpid(other, 0)
    assert os.read(reading, 1000) == b""


def test_without_the_server_a_job_runs_by_itself(tmp_path, monkeypatch):
    monkeypatch.setenv(SOCKET_VARIABLE, str(tmp_path / "gone" / "socket"))
    assert warm.call(["train"]) is None
