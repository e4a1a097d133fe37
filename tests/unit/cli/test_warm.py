"""`nbavatar warm`: forked jobs behave as processes of their own do, for their callers and for the system."""

import json
import subprocess
import sys

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

# A job that reads a pipe nobody writes to lasts for ever, unless its caller's end ends it.
os.mkfifo(f"{folder}/model.pt")
server = psutil.Process(os.getppid())
idle = len(server.children())
caller = subprocess.Popen([*run, "render", "--model", f"{folder}/model.pt", *inputs])


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
