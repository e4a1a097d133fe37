"""The SLURM profile through a real SLURM of one node: devices, limits, retries, without accounting.

Skipped where Debian's packages (tests/cluster/loopback.py) or the executor's package are not installed.
"""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cluster.loopback import available, slurm

ROOT = Path(__file__).parents[2]
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not available() or importlib.util.find_spec("snakemake_executor_plugin_slurm") is None,
        reason="SLURM, or snakemake-executor-plugin-slurm, is not installed",
    ),
]

# Rules of the names that the profile knows. A training is killed for its time in its first attempt, and goes on in its
# second from what it has saved; a job is killed for its memory in its first.
WORKFLOW = """
rule all:
    input: expand("gpu{i}", i=range(3)), "long", "large"

rule train:
    output: "gpu{i}"
    shell: "{sys.executable} hold.py $PWD/held > {output}"

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
        command = [sys.executable, "-m", "snakemake", "--workflow-profile", str(ROOT / "profiles/slurm"),
                   "--slurm-status-command", "squeue", "--slurm-no-account",
                   "--slurm-init-seconds-before-status-checks", "5"]  # fmt: skip
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    said = done.stdout + done.stderr
    assert done.returncode == 0, said[-6000:]
    assert {(tmp_path / f"gpu{i}").read_text().strip() for i in range(3)} <= {"0", "1"}
    assert not list(tmp_path.glob("held.*"))
    for name in ("long", "large"):
        assert (tmp_path / name).read_text() == "x\nx\n", name  # the second attempt met what the first had left
