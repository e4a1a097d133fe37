"""Which device a command computes on, and an exclusive lease of one GPU for each process.

Workflow engines count GPUs but do not hand out their numbers: four jobs on a machine with four GPUs all start
on the first. Here a process takes a lock file per GPU and makes only that GPU visible to itself. The
kernel drops the lock when the process ends, however it ends. Standard library only, and to be called before
torch is imported.
"""

import contextlib
import fcntl
import os
import random
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from nbavatar.errors import DeviceError

__all__ = ["device_name", "lease_device", "peak_memory_mb"]


@contextlib.contextmanager
def lease_device(wanted: str = "auto", *, patience_s: float = 24 * 3600.0) -> Iterator[str]:
    """Yields `cpu` or `cuda`, with `CUDA_VISIBLE_DEVICES` set to one GPU of this process's own.

    Args:
        wanted: `cpu`, `cuda`, or `auto` (a GPU where there is one).
        patience_s: how long to wait for a free GPU [s].

    Raises:
        DeviceError: `cuda` was asked for and there is none, or none came free in time. It never falls back
            to the CPU silently.
    """
    if wanted not in ("auto", "cpu", "cuda"):
        raise DeviceError.of("device", expected="auto, cpu or cuda", found=repr(wanted))
    assigned = os.environ.get("CUDA_VISIBLE_DEVICES")
    count = _gpu_count()
    if wanted == "cpu" or (wanted == "auto" and (count == 0 or assigned == "")):
        yield "cpu"
        return
    if count == 0 or assigned == "":
        raise DeviceError.of("device", expected="a CUDA device", found="none", fix="use --device cpu or device: cpu")
    if assigned is not None:  # the batch system or the user has chosen
        yield "cuda"
        return
    with _locked(count, patience_s) as index:
        os.environ["CUDA_VISIBLE_DEVICES"] = str(index)
        try:
            yield "cuda"
        finally:
            os.environ.pop("CUDA_VISIBLE_DEVICES", None)


def device_name(device: str) -> str:
    """Human name of `cpu` or `cuda` for records, such as the GPU's model or the CPU's."""
    if device.startswith("cuda"):
        import torch

        return torch.cuda.get_device_name(0)
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return "cpu: " + line.partition(":")[2].strip()
    except OSError:
        pass
    return "cpu"


def peak_memory_mb(device: str) -> float:
    """Peak memory of the process [MB]: on a GPU its allocations, on the CPU the resident set."""
    if device == "cuda":
        import torch

        return torch.cuda.max_memory_allocated() / 1e6
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak / 1e3


def _gpu_count() -> int:
    return sum(1 for path in Path("/dev").glob("nvidia[0-9]*") if path.name[6:].isdigit())


@contextlib.contextmanager
def _locked(count: int, patience_s: float) -> Iterator[int]:
    folder = Path(tempfile.gettempdir()) / f"nbavatar-gpus-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    deadline = time.monotonic() + patience_s
    while True:
        for index in range(count):
            stream = open(folder / f"gpu{index}.lock", "w")
            try:
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                stream.close()
                continue
            with stream:
                yield index
            return
        if time.monotonic() > deadline:
            raise DeviceError(f"none of the {count} GPUs came free within {patience_s:.0f} s")
        time.sleep(random.uniform(0.2, 1.0))
