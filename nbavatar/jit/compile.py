"""Numba on the CPU: how kernels are compiled, and that a machine compiles each only once.

    kernel          fast arithmetic: multiplications and additions may be contracted and reordered
    exact_kernel    arithmetic as it is written
    inlined, exact_inlined    parts of them, absorbed by their callers

Where the compiled code is kept is said in `nbavatar.jit.cache`. Of several processes that start at once, one compiles
and the others wait for it.
"""

import contextlib
import logging
import os
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from numba import njit

from nbavatar.jit.cache import cache_folder, sources_digest, stored_njit
from nbavatar.private import open_private

__all__ = ["FAST", "exact_inlined", "exact_kernel", "inlined", "kernel", "prepare"]

_LOG = logging.getLogger("nbavatar.jit")

# Contraction and reassociation only: comparisons with NaN and infinity must keep their meaning.
FAST = {"contract", "reassoc", "nsz", "arcp"}

_ABSORBED: dict[str, Any] = {
    "nogil": True, "error_model": "numpy", "forceinline": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True,
}  # fmt: skip


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


def prepare(name: str, kernels: dict[Any, tuple[Any, ...]]) -> None:
    """Loads kernels from disk, or compiles them and stores them there.

    Args:
        name: of this set of kernels, unique among all.
        kernels: dispatcher -> argument types.
    """
    if name in _READY:
        return
    with _READY_LOCK:
        if name in _READY:
            return
        modules = tuple(sorted({dispatcher.py_func.__module__ for dispatcher in kernels}))
        folder, marker = cache_folder(modules[0]), f"{name}-{sources_digest(modules)}.ready"
        if folder is None or (folder / marker).exists():
            _compile(kernels)
        else:
            with _locked(folder / "compile.lock"):
                if not (folder / marker).exists():
                    _LOG.warning("compiling the %s kernels, once for this machine", name)
                _compile(kernels)
                with contextlib.suppress(OSError):  # a full disk: the next process compiles again
                    (folder / marker).touch()
        _READY.add(name)


def _compile(kernels: dict[Any, tuple[Any, ...]]) -> None:
    for dispatcher, signature in kernels.items():
        dispatcher.compile(signature)
