"""Which GPUs there are, as the driver says.

Device files do not tell: containers and WSL2 have no plain `/dev/nvidia0`, and a GPU that is split (MIG) is several
devices behind one file. NVML, the driver's library for administration, knows all of them and ignores
`CUDA_VISIBLE_DEVICES`; CUDA itself is asked where NVML is absent, and where that variable already chooses several, in a
process of its own, because a process can ask CUDA only once. Standard library only.
"""
# provenance: neutral, because which GPUs there are says nothing of what is computed on them.

import ctypes
import os
import subprocess
import sys
from typing import Any

__all__ = ["cuda_gpus", "list_gpus", "nvml_gpus"]

_UUID_BYTES = 96
_MIG_ON = 1
_PATIENCE_S = 120.0  # of a driver that loads its firmware first, on a node with many GPUs

# Prints one identifier a device, as CUDA numbers them. The second call differs from the first for a part of a GPU only.
_ASK_CUDA = """
import ctypes, uuid
cuda = ctypes.CDLL("libcuda.so.1")
count, device, whole, part = ctypes.c_int(), ctypes.c_int(), (ctypes.c_ubyte * 16)(), (ctypes.c_ubyte * 16)()
if cuda.cuInit(0) == 0 and cuda.cuDeviceGetCount(ctypes.byref(count)) == 0:
    for index in range(count.value):
        cuda.cuDeviceGet(ctypes.byref(device), index)
        known = cuda.cuDeviceGetUuid(whole, device) == 0
        split = known and cuda.cuDeviceGetUuid_v2(part, device) == 0 and bytes(part) != bytes(whole)
        number = uuid.UUID(bytes=bytes(part if split else whole))
        print(("MIG-" if split else "GPU-") + str(number) if known else index)
"""


def list_gpus() -> list[str]:
    """Identifiers, fit for `CUDA_VISIBLE_DEVICES`, of the GPUs (or parts of GPUs) that this process may use.

    What `CUDA_VISIBLE_DEVICES` allows where it is set, else all that the driver knows; empty without a driver.
    """
    if "CUDA_VISIBLE_DEVICES" in os.environ:
        return cuda_gpus()
    return nvml_gpus() or cuda_gpus()


def nvml_gpus() -> list[str]:
    """Identifiers of all GPUs, and of the parts of those that are split; empty where NVML is absent or fails."""
    try:
        nvml: Any = ctypes.CDLL("libnvidia-ml.so.1")
    except OSError:
        return []
    if nvml.nvmlInit_v2() != 0:
        return []
    try:
        count = ctypes.c_uint()
        if nvml.nvmlDeviceGetCount_v2(ctypes.byref(count)) != 0:
            return []
        found: list[str] = []
        for index in range(count.value):
            device = ctypes.c_void_p()
            if nvml.nvmlDeviceGetHandleByIndex_v2(index, ctypes.byref(device)) == 0:
                found += _parts(nvml, device) or _uuid(nvml, device)
        return found
    finally:
        nvml.nvmlShutdown()


def cuda_gpus() -> list[str]:
    """Identifiers of the devices that CUDA shows to this process's environment, in CUDA's order; empty without CUDA."""
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return []
    command = [sys.executable, "-I", "-c", _ASK_CUDA]
    try:
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
                              timeout=_PATIENCE_S, check=False)  # fmt: skip
    except subprocess.TimeoutExpired:
        return []
    return done.stdout.split()


def _parts(nvml: Any, device: ctypes.c_void_p) -> list[str]:
    """Identifiers of the parts of a GPU that is split (MIG); empty for one that is whole."""
    now, later, most = ctypes.c_uint(), ctypes.c_uint(), ctypes.c_uint()
    # A GPU that cannot be split, and an old driver, answer with an error.
    if nvml.nvmlDeviceGetMigMode(device, ctypes.byref(now), ctypes.byref(later)) != 0 or now.value != _MIG_ON:
        return []
    if nvml.nvmlDeviceGetMaxMigDeviceCount(device, ctypes.byref(most)) != 0:
        return []
    found: list[str] = []
    for index in range(most.value):
        part = ctypes.c_void_p()
        if nvml.nvmlDeviceGetMigDeviceHandleByIndex(device, index, ctypes.byref(part)) == 0:
            found += _uuid(nvml, part)
    return found


def _uuid(nvml: Any, device: ctypes.c_void_p) -> list[str]:
    text = ctypes.create_string_buffer(_UUID_BYTES)
    return [text.value.decode()] if nvml.nvmlDeviceGetUUID(device, text, _UUID_BYTES) == 0 else []
