"""Numba on the CPU: compiled once a machine, kept on disk, run on torch's number of threads.

Where the compiled code is kept is said in `nbavatar.kernels`. Of several processes that start at
once, one compiles and the others wait for it.
"""

import contextlib
import logging
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch
from numba import njit

from nbavatar.kernels import cache_folder, keep_kernels, stored_njit
from nbavatar.private import open_private

__all__ = ["FAST", "SOURCES", "exact_inlined", "exact_kernel", "inlined", "kernel", "prepare", "run_workers"]

_LOG = logging.getLogger("nbavatar.raster")

# Contraction and reassociation only: comparisons with NaN and infinity must keep their meaning.
FAST = {"contract", "reassoc", "nsz", "arcp"}

_ABSORBED: dict[str, Any] = {
    "nogil": True, "error_model": "numpy", "forceinline": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True,
}  # fmt: skip

_HERE = Path(__file__).parent
# Files that the compiled code depends on.
SOURCES = tuple(_HERE / name for name in (
    "binning.py", "compile.py", "cpu_blend.py", "cpu_gather.py", "cpu_groups.py", "cpu_hits.py", "cpu_pixels.py",
    "cpu_projection_kernels.py", "cpu_queue.py", "cpu_scratch.py", "lanes.py", "memory.py", "scalar.py", "sorting.py",
))  # fmt: skip
keep_kernels(_HERE, SOURCES)


def kernel(function: Callable[..., Any]) -> Any:
    """Compiles a kernel: no interpreter lock, cached on disk."""
    return stored_njit(nogil=True, fastmath=FAST, error_model="numpy")(function)


def exact_kernel(function: Callable[..., Any]) -> Any:
    """Compiles a kernel whose arithmetic is rounded as it is written."""
    return stored_njit(nogil=True, error_model="numpy")(function)


def inlined(function: Callable[..., Any]) -> Any:
    """Compiles a function that its caller absorbs."""
    return njit(fastmath=FAST, **_ABSORBED)(function)


def exact_inlined(function: Callable[..., Any]) -> Any:
    """Compiles a function that an exact kernel absorbs."""
    return njit(**_ABSORBED)(function)


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Waits for the others that compile. Where there are no such locks, at worst several processes compile the same."""
    descriptor = -1
    with contextlib.suppress(ImportError, OSError):  # a system, or a file system, without them
        import fcntl

        descriptor = open_private(path)
        fcntl.flock(descriptor, fcntl.LOCK_EX)
    try:
        yield
    finally:
        if descriptor >= 0:
            os.close(descriptor)


_READY: set[str] = set()
_READY_LOCK = threading.Lock()


def prepare(name: str, kernels: dict[Any, tuple[Any, ...]], package: Path = _HERE) -> None:
    """Loads kernels from disk, or compiles them and stores them there.

    Args:
        name: of this set of kernels.
        kernels: dispatcher -> argument types.
        package: whose kernels they are.
    """
    key = f"{package.name} {name}"
    if key in _READY:
        return
    with _READY_LOCK:
        if key in _READY:
            return
        folder = cache_folder(package)
        if folder is None or (folder / f"{name}.ready").exists():
            _compile(kernels)
        else:
            with _locked(folder / "compile.lock"):
                if not (folder / f"{name}.ready").exists():
                    _LOG.warning("compiling the rasterizer's %s kernels, once for this machine", name)
                _compile(kernels)
                with contextlib.suppress(OSError):  # a full disk: the next process compiles again
                    (folder / f"{name}.ready").touch()
        _READY.add(key)


def _compile(kernels: dict[Any, tuple[Any, ...]]) -> None:
    for dispatcher, signature in kernels.items():
        dispatcher.compile(signature)


_POOL: tuple[int, int, ThreadPoolExecutor] | None = None  # process, threads, executor


def run_workers(work: Callable[[int], Any]) -> list[Any]:
    """Calls `work(worker)` for every worker, one a thread, and returns what each gave back."""
    global _POOL
    threads = torch.get_num_threads()
    if threads == 1:
        return [work(0)]
    # A forked child inherits the executor without its threads; it needs one of its own.
    if _POOL is None or _POOL[:2] != (os.getpid(), threads):
        _POOL = (os.getpid(), threads, ThreadPoolExecutor(threads - 1, thread_name_prefix="nbavatar-raster"))
    others = [_POOL[2].submit(work, worker) for worker in range(1, threads)]
    return [work(0)] + [other.result() for other in others]
