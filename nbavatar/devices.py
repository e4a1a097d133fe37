"""Which device a command computes on, and an exclusive lease of one GPU for each process.

Workflow engines count GPUs but do not hand out their numbers: four jobs on a machine with four GPUs all start
on the first. Here a process takes a lease of one GPU and makes only that GPU visible to itself. A lease is a
name of the kernel (a socket in Linux's abstract name space, called after the GPU's own identifier), not a file: it
holds between users, there is no folder that somebody else could have prepared, and the kernel frees it when the
process ends, however it ends. It does not hold between containers with networks of their own. Standard library only,
and to be called before torch is imported.

Without a GPU a process keeps the memory that it frees. The C library gives large blocks back to the system at once, and
the system clears every page of the next one: in a training step at 1024 px that was a fifth of the processor time.
"""
# provenance: neutral, because where it is computed is recorded.

import contextlib
import ctypes
import errno
import os
import random
import socket
import struct
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from nbavatar.errors import DeviceError
from nbavatar.gpus import list_gpus

__all__ = ["device_name", "lease_device", "peak_memory_mb"]

_SILENCE_S = 5.0  # a wait longer than this says what it waits for


@contextlib.contextmanager
def lease_device(wanted: str = "auto", *, patience_s: float = 24 * 3600.0) -> Iterator[str]:
    """Yields `cpu` or `cuda`, with `CUDA_VISIBLE_DEVICES` set to one GPU of this process's own.

    One GPU that `CUDA_VISIBLE_DEVICES` names already is taken as it is, the batch system or the user has chosen it;
    among several that it names one is leased, as among all where it is not set.

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
    gpus = [] if wanted == "cpu" or _hidden(assigned) else list_gpus()
    if not gpus:
        if wanted == "cuda":
            fix = "use --device cpu or device: cpu"
            raise DeviceError.of("device", expected="a CUDA device", found="none", fix=fix)
        _keep_freed_memory()
        yield "cpu"
        return
    if assigned is not None and len(gpus) == 1:
        yield "cuda"
        return
    with _leased(gpus, patience_s) as gpu:
        os.environ["CUDA_VISIBLE_DEVICES"] = gpu
        try:
            yield "cuda"
        finally:
            if assigned is None:
                os.environ.pop("CUDA_VISIBLE_DEVICES", None)
            else:
                os.environ["CUDA_VISIBLE_DEVICES"] = assigned


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


_TRIM_THRESHOLD, _MMAP_MAX = -1, -4  # parameters of mallopt, malloc.h of glibc
_NEVER, _NONE = -1, 0


def _keep_freed_memory() -> None:
    """Has glibc take large blocks from the heap, and never give the heap back; MALLOC_... of the user wins."""
    tuned = "glibc.malloc" in os.environ.get("GLIBC_TUNABLES", "")
    if tuned or any(name.startswith("MALLOC_") for name in os.environ):
        return
    with contextlib.suppress(OSError, AttributeError):  # another C library
        mallopt = ctypes.CDLL("libc.so.6").mallopt
        mallopt(_TRIM_THRESHOLD, _NEVER)
        mallopt(_MMAP_MAX, _NONE)


def _hidden(assigned: str | None) -> bool:
    """Whether `CUDA_VISIBLE_DEVICES` hides all GPUs: CUDA stops at the first name that names none, such as -1."""
    return assigned is not None and assigned.split(",")[0].strip().lower() in ("", "-1", "nodevfiles", "none", "void")


@contextlib.contextmanager
def _leased(gpus: list[str], patience_s: float) -> Iterator[str]:
    """Holds one of some GPUs, the first that is free."""
    began, told = time.monotonic(), False
    while True:
        for gpu in gpus:
            with socket.socket(socket.AF_UNIX) as lease:
                try:
                    lease.bind(_lease_name(gpu))
                except OSError as error:
                    if error.errno == errno.EADDRINUSE:
                        continue
                    fix = "name one in CUDA_VISIBLE_DEVICES"
                    found = f"an error of the system ({error.strerror})"
                    raise DeviceError.of("device", expected="a lease of a GPU", found=found, fix=fix) from error
                lease.listen(64)  # whoever waits can ask who holds it
                yield gpu
                return
        waited = time.monotonic() - began
        if waited > patience_s:
            raise DeviceError(f"none of the {len(gpus)} GPUs came free within {patience_s:.0f} s; {_holders(gpus)}")
        if waited > min(_SILENCE_S, patience_s) and not told:
            print(f"nbavatar: waiting for a GPU: {_holders(gpus)}", file=sys.stderr)  # noqa: T201
            told = True
        time.sleep(random.uniform(0.2, 1.0))


def _lease_name(gpu: str) -> str:
    return f"\0nbavatar-{gpu}"


def _holders(gpus: list[str]) -> str:
    """Which processes hold which GPUs, for people."""
    known = []
    for gpu in gpus:
        with socket.socket(socket.AF_UNIX) as asking, contextlib.suppress(OSError):
            asking.setblocking(False)
            asking.connect(_lease_name(gpu))
            record = asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
            process, user, _ = struct.unpack("3i", record)
            known.append(f"{gpu} is held by process {process} of user {user}")
    return ", ".join(known) or "their holders are not known"
