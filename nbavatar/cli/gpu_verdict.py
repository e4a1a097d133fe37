"""What `nbavatar doctor --gpu` finds of a GPU, kept so that it is found once.

A verdict belongs to the card, its driver, the versions of torch and numba-cuda, and the code of the rasterizer. It is
kept where compiled kernels are kept, in a folder that nobody else may write to; without such a place it is found anew.
"""

import contextlib
import hashlib
import importlib.metadata
from pathlib import Path
from typing import Any

from nbavatar.devices import device_name
from nbavatar.errors import DataError, DeviceError
from nbavatar.io.records import canonical_json, read_json, write_json
from nbavatar.private import cache_places, private_folder

__all__ = ["gpu_verdict", "require_right_gpu"]

_CODE = ("nbavatar.rendering.billboards.functional", "nbavatar.rendering.billboards.cuda")


def gpu_verdict(device: str, *, again: bool = False) -> tuple[dict[str, Any], bool]:
    """The findings about a device (`nbavatar.studies.benchmarks.device_check`), and whether they were known already.

    Args:
        device: `cuda`, or `cpu` to try the check itself.
        again: find them anew.
    """
    path = _place(device)
    if path is not None and path.is_file() and not again:
        with contextlib.suppress(DataError):  # cut short by a full disk
            found = read_json(path)
            if isinstance(found, dict) and isinstance(found.get("right"), bool):
                return found, True
    from nbavatar.studies.benchmarks.device_check import check_device

    found = check_device(device)
    if path is not None:
        with contextlib.suppress(OSError):  # a full disk: it is found again next time
            write_json(path, found)
    return found, False


def require_right_gpu(device: str) -> str | None:
    """The verdict's line where the card had not been looked at before; None where it had.

    Raises:
        DeviceError: the device computes something else than the reference.
    """
    from nbavatar.studies.benchmarks.device_check import verdict

    found, known = gpu_verdict(device)
    if not found["right"]:
        raise DeviceError(verdict(found))
    return None if known else verdict(found)


def _place(device: str) -> Path | None:
    """File of the verdict, or None where nothing can be kept."""
    from nbavatar.jit.cache import sources_digest

    key = {"device": device_name(device), "code": sources_digest(_CODE), "driver": _driver(device)}
    for package in ("torch", "numba-cuda"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            key[package] = importlib.metadata.version(package)
    name = hashlib.sha256(canonical_json(key).encode()).hexdigest()[:20]
    for place in cache_places():
        with contextlib.suppress(DataError, OSError):
            return private_folder(place / "devices") / f"{name}.json"
    return None


def _driver(device: str) -> str:
    if device == "cpu":
        return ""
    import torch

    major, minor = torch.cuda.get_device_capability()
    return f"CUDA {torch.version.cuda}, compute capability {major}.{minor}"
