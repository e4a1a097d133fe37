import subprocess
import sys

import pytest

from nbavatar import devices
from nbavatar.errors import DeviceError


def test_cpu_is_given_when_asked_for_or_when_there_is_nothing_else(monkeypatch):
    monkeypatch.setattr(devices, "_gpu_count", lambda: 0)
    for wanted in ("cpu", "auto"):
        with devices.lease_device(wanted) as device:
            assert device == "cpu"


def test_cuda_without_a_gpu_is_refused_not_replaced(monkeypatch):
    monkeypatch.setattr(devices, "_gpu_count", lambda: 0)
    with pytest.raises(DeviceError, match="expected a CUDA device, found none"), devices.lease_device("cuda"):
        pass


def test_a_choice_made_outside_is_kept(monkeypatch):
    monkeypatch.setattr(devices, "_gpu_count", lambda: 4)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3")
    with devices.lease_device("cuda") as device:
        assert device == "cuda"
        assert devices.os.environ["CUDA_VISIBLE_DEVICES"] == "3"


def test_processes_get_distinct_gpus_and_wait_for_a_free_one(monkeypatch, tmp_path):
    code = (
        "import os, sys, time\n"
        "from nbavatar import devices\n"
        "devices._gpu_count = lambda: 2\n"
        "with devices.lease_device('auto', patience_s=30):\n"
        "    index = os.environ['CUDA_VISIBLE_DEVICES']\n"
        "    mark = f'{sys.argv[1]}/in_use_{index}'\n"
        "    fd = os.open(mark, os.O_CREAT | os.O_EXCL)\n"  # fails if another process holds the same GPU
        "    time.sleep(0.3)\n"
        "    os.unlink(mark)\n"
        "    print(index)\n"
    )
    environment = {k: v for k, v in devices.os.environ.items() if k != "CUDA_VISIBLE_DEVICES"}
    environment["TMPDIR"] = str(tmp_path)
    jobs = [
        subprocess.Popen(
            [sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE, text=True, env=environment
        )
        for _ in range(5)
    ]
    outputs = [job.communicate()[0].strip() for job in jobs]
    assert [job.returncode for job in jobs] == [0] * 5
    assert set(outputs) == {"0", "1"}
