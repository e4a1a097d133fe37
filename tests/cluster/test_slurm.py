"""The SLURM profile through a real SLURM of one node: devices, limits, retries, trainings that go on.

Skipped where Debian's packages (tests/cluster/loopback.py) or the executor's package are not installed.
"""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from nbavatar.io.tensors import read_tensors
from tests.cluster.loopback import available, slurm
from tests.scenes.toy import write_scene
from tests.scenes.training import train_options

ROOT = Path(__file__).parents[2]
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not available() or importlib.util.find_spec("snakemake_executor_plugin_slurm") is None,
        reason="SLURM, or snakemake-executor-plugin-slurm, is not installed",
    ),
]

COMMAND = [sys.executable, "-m", "snakemake", "--workflow-profile", str(ROOT / "profiles/slurm"),
           "--slurm-status-command", "squeue", "--slurm-no-account",
           "--slurm-init-seconds-before-status-checks", "5"]  # fmt: skip

# Rules of the names that the profile knows. A training is killed for its time in its first attempt, and goes on in its
# second from what it has saved; a job is killed for its memory in its first.
WORKFLOW = """
rule all:
    input: expand("gpu{i}", i=range(3)), "long", "large", "wide"

rule train:
    output: "gpu{i}"
    shell: "{sys.executable} hold.py $PWD/held > {output}"

rule wide:
    output: "wide"
    threads: 3
    shell: "touch {output}"

rule long:
    output: "long"
    retries: 2
    resources: runtime=1
    shell:
        "echo x >> long.state; test $(wc -l < long.state) -gt 1 || sleep 600; cp long.state {output}"

rule large:
    output: "large"
    retries: 2
    resources: mem='200MB'
    shell:
        "echo x >> large.state; test $(wc -l < large.state) -gt 1 || "
        "{sys.executable} -c 'import time; x = bytearray(1 << 30); time.sleep(600)'; cp large.state {output}"
"""
# Holds the device that SLURM gave it for a while; fails if another job holds it too.
HOLD = """
import os, sys, time
device = os.environ["CUDA_VISIBLE_DEVICES"]
assert device in ("0", "1"), device
mark = os.open(f"{sys.argv[1]}.{device}", os.O_CREAT | os.O_EXCL)
time.sleep(5)
os.unlink(f"{sys.argv[1]}.{device}")
print(device)
"""


def test_devices_limits_and_retries(tmp_path):
    (tmp_path / "Snakefile").write_text("import sys\n" + WORKFLOW)
    (tmp_path / "hold.py").write_text(HOLD)
    with slurm() as environment:
        done = subprocess.run(COMMAND, cwd=tmp_path, env=environment, capture_output=True, text=True)
        given = subprocess.check_output(
            ["squeue", "--states=all", "--noheader", "--format=%C"], env=environment
        ).split()
    said = done.stdout + done.stderr
    assert done.returncode == 0, said[-6000:]
    assert {(tmp_path / f"gpu{i}").read_text().strip() for i in range(3)} <= {"0", "1"}
    assert not list(tmp_path.glob("held.*"))
    # A processor a thread (jobs that are tried again are there twice); trainings have four a GPU.
    assert {b"1": 3, b"3": 1, b"4": 3} == {count: given.count(count) for count in set(given)}
    for name in ("long", "large"):
        assert (tmp_path / name).read_text() == "x\nx\n", name  # the second attempt met what the first had left


# Runs a training; in the first attempt stops it after a checkpoint, and gives SLURM a reason to end the job: the limit
# of time, at whose SIGTERM the training is woken to save its state, or of memory, which ends it by SIGKILL.
STOP = """
import os, signal, subprocess, sys, time
how, folder, *command = sys.argv[1:]
training = subprocess.Popen(command)
def told(*_):
    training.send_signal(signal.SIGCONT)
    training.terminate()
signal.signal(signal.SIGTERM, told)
mark = os.path.join(folder, "stopped")
if how != "whole" and not os.path.exists(mark):
    while not os.path.exists(os.path.join(folder, "model.pt.state", "state.pt")) and training.poll() is None:
        time.sleep(0.01)
    training.send_signal(signal.SIGSTOP)
    with open(mark, "w") as stream:
        stream.write(str(training.poll()))
    if how == "memory":
        held = bytearray(2300 << 20)
sys.exit(training.wait())
"""
TRAININGS = """
rule all:
    input: expand("{how}/model.pt", how=["whole", "time", "memory"])

rule train:
    input: lambda wildcards: [] if wildcards.how == "whole" else "whole/model.pt"  # after it, kernels are compiled
    output: "{how}/model.pt"
    retries: 5
    resources:
        mem="2GB",
        # On a slow machine the first limit may come before the first checkpoint: it stays until one was met at work.
        runtime=lambda w, attempt: 30 if w.how != "time" or os.path.exists("time/stopped") else 1 + attempt,
    shell: "{PYTHON} stop.py {wildcards.how} {wildcards.how} {TRAIN} --out {output} >> attempts.{wildcards.how} 2>&1"
"""
OPTIONS = train_options({
    "steps": 150, "texels": 4, "unet": {"width": 4, "depth": 3, "max_width": 8, "convs": 1}, "weight_lpips": 0.0,
    "previews": 0, "coarse_side": 16, "checkpoint_seconds": 0.5,
})  # fmt: skip


def weights(value, name=""):
    """All tensors in what `torch.save` wrote, by their place."""
    if isinstance(value, torch.Tensor):
        return {name: value}
    pairs = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, (list, tuple)) else ()
    return {key: found for part, inner in pairs for key, found in weights(inner, f"{name}/{part}").items()}


def test_a_training_that_the_scheduler_ends_goes_on_to_the_same_weights(tmp_path):
    scene = write_scene(tmp_path / "scene")
    train = [
        sys.executable, "-m", "nbavatar", "train", "--device", "cpu", "--cfg", json.dumps(OPTIONS),
        "--meshes", str(scene["meshes"]), "--spectral", str(scene["spectral"]),
        "--frames", *map(str, scene["packs"][:2]),
    ]  # fmt: skip
    (tmp_path / "stop.py").write_text(STOP)
    (tmp_path / "Snakefile").write_text(
        f"import os, shlex\nPYTHON, TRAIN = {sys.executable!r}, shlex.join({train!r})\n{TRAININGS}"
    )
    with slurm() as environment:
        done = subprocess.run(COMMAND, cwd=tmp_path, env=environment, capture_output=True, text=True)
        jobs = subprocess.check_output(["squeue", "--states=all", "--noheader", "--format=%T %Z"], env=environment)
    said = done.stdout + done.stderr
    assert done.returncode == 0, said[-6000:]
    ends = sorted(line.split()[0] for line in jobs.decode().splitlines() if line.endswith(str(tmp_path)))
    # What is ended for its memory is a step, which is tried again in its own job.
    assert ends.count("COMPLETED") == 3 and "TIMEOUT" in ends, ends
    whole = weights(read_tensors(tmp_path / "whole/model.pt", "an avatar"))
    assert whole
    for how in ("time", "memory"):
        assert (tmp_path / how / "stopped").read_text() == "None"  # it was at work then
        found = weights(read_tensors(tmp_path / how / "model.pt", "an avatar"))
        assert found.keys() == whole.keys() and all(torch.equal(found[name], whole[name]) for name in whole), how


@pytest.mark.skipif(not available(accounts=True), reason="slurmdbd and MariaDB are not installed")
def test_a_site_with_accounts_needs_no_further_options(tmp_path):
    """Account and states of jobs come from the accounting database then."""
    (tmp_path / "Snakefile").write_text(ACCOUNTED)
    (tmp_path / "end.py").write_text(END)
    with slurm(accounts=True) as environment:
        command = [*COMMAND[:5], "--slurm-init-seconds-before-status-checks", "5"]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
        said = done.stdout + done.stderr
        assert done.returncode == 0, said[-6000:]
        rows = subprocess.check_output(
            ["sacct", "-X", "--noheader", "--parsable2", "--format=Account,State"], env=environment, text=True
        )
    # A command that fails is tried again in its own job; only one that takes its job along is seen in the accounts.
    assert sorted(rows.split()) == ["root|COMPLETED", "root|COMPLETED", "root|FAILED"]
    assert (tmp_path / "tried").read_text() == "x\n" * 3


ACCOUNTED = """
import sys

rule all:
    input: "b"

rule a:
    output: "a"
    shell: "echo a > {output}"

rule b:
    input: "a"
    output: "b"
    retries: 2
    shell:
        "echo x >> tried; case $(wc -l < tried) in"
        "  1) {sys.executable} end.py;;"
        "  2) false;;"
        "  *) cp a {output};;"
        " esac"
"""
# Kills all that belongs to the job it runs in.
END = """
import contextlib, os, psutil
for process in psutil.process_iter():
    with contextlib.suppress(psutil.Error):
        if process.environ().get("SLURM_JOB_ID") == os.environ["SLURM_JOB_ID"] and process.pid != os.getpid():
            process.kill()
"""
