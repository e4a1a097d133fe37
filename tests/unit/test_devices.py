"""One GPU for each process, whoever runs it; which GPUs there are is what the driver says."""

import ctypes
import os
import platform
import subprocess
import sys
import time

import pytest

from nbavatar import devices, gpus
from nbavatar.errors import DeviceError
from tests.unit.users import OTHER, THIRD, as_user

WHOLE = ["GPU-00000000-0000-0000-0000-000000000001", "GPU-00000000-0000-0000-0000-000000000002"]


@pytest.fixture(autouse=True)
def _no_choice(monkeypatch):
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)


@pytest.fixture
def two(monkeypatch):
    """Two GPUs of this test alone."""
    names = [f"GPU-{os.getpid()}-{time.monotonic_ns()}-{index}" for index in range(2)]
    monkeypatch.setattr(devices, "list_gpus", lambda: names)
    return names


def test_cpu_is_given_when_asked_for_or_when_there_is_nothing_else(monkeypatch):
    monkeypatch.setattr(devices, "list_gpus", list)
    for wanted in ("cpu", "auto"):
        with devices.lease_device(wanted) as device:
            assert device == "cpu"


_FAULTS = """
import resource
from nbavatar.devices import lease_device

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    block = b"1" * (256 << 20)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

with lease_device("cpu"):
    print(faults(), faults())
"""


@pytest.mark.skipif(not platform.libc_ver()[0], reason="another C library than glibc")
@pytest.mark.parametrize("setting", [{}, {"MALLOC_TOP_PAD_": "0"}, {"GLIBC_TUNABLES": "glibc.malloc.top_pad=0"}])
def test_memory_is_used_again_without_a_page_fault(setting):
    """The system clears the pages of a block once; where the user has tuned the C library it stays as it is."""
    clean = {name: value for name, value in os.environ.items() if not name.startswith(("MALLOC_", "GLIBC_TUNABLES"))}
    words = [sys.executable, "-c", _FAULTS]
    run = subprocess.run(words, env=clean | setting, capture_output=True, text=True, check=True)
    first, second = map(int, run.stdout.split())
    assert first >= 128  # 256 MiB in pages of 2 MiB
    assert second > first / 2 if setting else second < first / 10


@pytest.mark.parametrize("hidden", ["", "-1", " -1 ", "-1,0", "NoDevFiles"])
def test_cuda_without_a_gpu_is_refused_not_replaced(monkeypatch, two, hidden):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", hidden)
    with devices.lease_device("auto") as device:
        assert device == "cpu"
    with pytest.raises(DeviceError, match="expected a CUDA device, found none"), devices.lease_device("cuda"):
        pass
    monkeypatch.setattr(devices, "list_gpus", list)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    with pytest.raises(DeviceError, match="expected a CUDA device, found none"), devices.lease_device("cuda"):
        pass


def test_one_gpu_that_was_chosen_outside_is_kept(monkeypatch, two):
    monkeypatch.setattr(devices, "list_gpus", lambda: two[:1])
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3")
    with devices.lease_device("cuda") as device:
        assert device == "cuda"
        assert os.environ["CUDA_VISIBLE_DEVICES"] == "3"


def test_among_several_chosen_outside_one_is_leased(monkeypatch, two):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2,3")
    with devices.lease_device("cuda"), devices._leased(two, 0.0) as other:
        assert {os.environ["CUDA_VISIBLE_DEVICES"], other} == set(two)
    assert os.environ["CUDA_VISIBLE_DEVICES"] == "2,3"


def test_processes_get_distinct_gpus_and_wait_for_a_free_one(tmp_path, two):
    code = (
        "import os, sys, time\n"
        "from nbavatar import devices\n"
        f"devices.list_gpus = lambda: {two}\n"
        "with devices.lease_device('auto', patience_s=30):\n"
        "    index = os.environ['CUDA_VISIBLE_DEVICES']\n"
        "    mark = f'{sys.argv[1]}/in_use_{index}'\n"
        "    fd = os.open(mark, os.O_CREAT | os.O_EXCL)\n"  # fails if another process holds the same GPU
        "    time.sleep(0.3)\n"
        "    os.unlink(mark)\n"
        "    print(index)\n"
    )
    jobs = [
        # Each with a folder for temporary files of its own, as jobs of a batch system have.
        subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE, text=True,
                         env=os.environ | {"TMPDIR": str(tmp_path / str(number))})
        for number in range(5)
    ]  # fmt: skip
    outputs = [job.communicate()[0].strip() for job in jobs]
    assert [job.returncode for job in jobs] == [0] * 5
    assert set(outputs) == set(two)


def test_a_lease_holds_between_users_and_leaves_no_file(public_folder, two, monkeypatch):
    """The other user has put links under the names of lock files of old; what they point to stays as it is."""
    precious = public_folder / "precious"
    precious.write_text("everything")
    os.chown(precious, THIRD, THIRD)
    place = public_folder / f"nbavatar-gpus-{THIRD}"
    as_user(OTHER, lambda: (place.mkdir(), os.symlink(precious, place / "gpu0.lock")))
    monkeypatch.setattr("tempfile.tempdir", str(public_folder))

    with devices.lease_device("cuda"):
        held = os.environ.pop("CUDA_VISIBLE_DEVICES")

        def lease_other():
            os.environ.pop("CUDA_VISIBLE_DEVICES", None)
            with devices._leased(two, 0.0) as taken:
                return taken

        assert as_user(THIRD, lease_other) == next(gpu for gpu in two if gpu != held)
        with devices._leased(two, 0.0):
            match = f"none of the 2 GPUs.* held by process {os.getpid()} of user 0, .* of user 0"
            with pytest.raises(DeviceError, match=match):
                as_user(THIRD, lease_other)
    assert precious.read_text() == "everything"
    assert as_user(THIRD, lambda: len(list(place.iterdir()))) == 1


def test_a_killed_holder_frees_its_gpu(two):
    code = (
        "import sys, time\n"
        "from nbavatar import devices\n"
        f"devices.list_gpus = lambda: {two[:1]}\n"
        "with devices.lease_device('cuda'):\n"
        "    print('held', flush=True)\n"
        "    time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(DeviceError, match=f"held by process {holder.pid}"), devices._leased(two[:1], 0.0):
            pass
        holder.kill()
        holder.wait()
        with devices._leased(two[:1], 10.0) as taken:
            assert taken == two[0]


class Driver:
    """NVML of a machine with one whole GPU, one that is split in two of at most seven parts, and one that is lost."""

    parts = {1: {0: "MIG-a", 4: "MIG-b"}}

    def nvmlInit_v2(self):
        return 0

    def nvmlShutdown(self):
        return 0

    def nvmlDeviceGetCount_v2(self, count):
        count._obj.value = 3
        return 0

    def nvmlDeviceGetHandleByIndex_v2(self, index, device):
        device._obj.value = 100 + index
        return 15 if index == 2 else 0  # NVML_ERROR_GPU_IS_LOST

    def nvmlDeviceGetMigMode(self, device, now, later):
        now._obj.value = int(device.value - 100 in self.parts)
        return 0

    def nvmlDeviceGetMaxMigDeviceCount(self, device, most):
        most._obj.value = 7
        return 0

    def nvmlDeviceGetMigDeviceHandleByIndex(self, device, index, part):
        part._obj.value = 1000 + 10 * (device.value - 100) + index
        return 0 if index in self.parts[device.value - 100] else 6  # NVML_ERROR_NOT_FOUND

    def nvmlDeviceGetUUID(self, device, text, size):
        number = device.value - 1000
        text.value = (WHOLE[0] if number < 0 else self.parts[number // 10][number % 10]).encode()
        return 0


def test_the_driver_is_asked_for_gpus_and_their_parts(monkeypatch):
    monkeypatch.setattr(ctypes, "CDLL", lambda name: Driver())
    assert gpus.list_gpus() == [WHOLE[0], "MIG-a", "MIG-b"]


def test_without_a_driver_there_is_no_gpu(monkeypatch):
    def absent(name):
        raise OSError(f"{name}: cannot open shared object file")

    monkeypatch.setattr(ctypes, "CDLL", absent)
    assert gpus.list_gpus() == []
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")
    assert gpus.list_gpus() == []


# CUDA's driver library in C: as many devices as CUDA_VISIBLE_DEVICES names, the second a part of a GPU.
CUDA = r"""
#include <stdlib.h>
#include <string.h>
int cuInit(unsigned flags) { return 0; }
int cuDeviceGetCount(int *count) {
  const char *set = getenv("CUDA_VISIBLE_DEVICES");
  *count = 0;
  if (set && *set) for (*count = 1; *set; set++) *count += *set == ',';
  return 0;
}
int cuDeviceGet(int *device, int index) { *device = index; return 0; }
int cuDeviceGetUuid(unsigned char *id, int device) { memset(id, 0, 16); id[15] = 1 + device; return 0; }
int cuDeviceGetUuid_v2(unsigned char *id, int device) { memset(id, device ? 9 : 0, 16); id[15] = 1 + device; return 0; }
"""


def test_cuda_is_asked_where_the_environment_chooses(tmp_path):
    source, library = tmp_path / "cuda.c", tmp_path / "libcuda.so.1"
    source.write_text(CUDA)
    try:
        subprocess.run(["cc", "-shared", "-fPIC", "-o", library, source], check=True, capture_output=True)
    except FileNotFoundError:
        pytest.skip("no C compiler to make a driver with")
    code = "from nbavatar import gpus; print(*gpus.list_gpus())"
    for chosen, expected in (
        ("", ""),
        ("0", WHOLE[0]),
        ("5,7", f"{WHOLE[0]} MIG-09090909-0909-0909-0909-090909090902"),
    ):
        environment = os.environ | {"LD_LIBRARY_PATH": str(tmp_path), "CUDA_VISIBLE_DEVICES": chosen}
        done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
        assert done.stdout.strip() == expected
