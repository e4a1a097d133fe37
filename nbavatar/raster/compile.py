"""Numba on the CPU: compiled once a machine, kept on disk, run on torch's number of threads.

The compiled code is stored under a digest of this package's sources, of Numba and of the
processor, so a changed helper never meets a stale kernel. Where the package's own
`__pycache__` cannot be written, or `NUMBA_CACHE_DIR` names another place, the code goes there
or to the user's cache. Of several processes that start at once, one compiles and the others
wait for it.
"""

import contextlib
import hashlib
import logging
import os
import platform
import tempfile
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import numba
import torch
from llvmlite import binding
from numba import njit
from numba.core import caching

__all__ = ["FAST", "exact_inlined", "exact_kernel", "inlined", "keep_kernels", "kernel", "prepare", "run_workers"]

_LOG = logging.getLogger("nbavatar.raster")

# Contraction and reassociation only: comparisons with NaN and infinity must keep their meaning.
FAST = {"contract", "reassoc", "nsz", "arcp"}

_ABSORBED: dict[str, Any] = {
    "nogil": True, "error_model": "numpy", "forceinline": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True,
}  # fmt: skip

_SOURCES = (
    "binning.py", "compile.py", "cpu_blend.py", "cpu_gather.py", "cpu_groups.py", "cpu_hits.py", "cpu_pixels.py",
    "cpu_projection_kernels.py", "cpu_queue.py", "cpu_scratch.py", "lanes.py", "memory.py", "scalar.py", "sorting.py",
)  # fmt: skip


_HERE = Path(__file__).parent
_OTHERS: dict[Path, tuple[str, ...]] = {}  # packages besides this one whose kernels are kept -> their sources


def keep_kernels(package: Path, sources: tuple[str, ...]) -> None:
    """Has another package's kernels kept as this one's are; to be called before they are defined.

    Args:
        package: its folder.
        sources: files in it that the compiled code depends on, besides those of this package.
    """
    _OTHERS[package] = sources


@cache
def _digest(package: Path) -> str:
    """Digest of everything that a package's compiled code depends on."""
    state = hashlib.sha256()
    for name in _SOURCES:
        state.update((_HERE / name).read_bytes())
    for name in _OTHERS.get(package, ()):
        state.update((package / name).read_bytes())
    host = (numba.__version__, platform.machine(), platform.python_version(), binding.get_host_cpu_name())
    state.update(repr(host).encode())
    state.update(binding.get_host_cpu_features().flatten().encode())
    return state.hexdigest()[:20]


@cache
def cache_folder(package: Path = _HERE) -> Path:
    """First writable place for a package's compiled code."""
    candidates = []
    if os.environ.get("NUMBA_CACHE_DIR"):
        candidates.append(Path(os.environ["NUMBA_CACHE_DIR"]) / "nbavatar")
    candidates.append(package / "__pycache__")
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    candidates.append(Path(home) / "nbavatar")
    candidates.append(Path(tempfile.gettempdir()) / f"nbavatar-{os.getuid()}")
    for folder in candidates:
        with contextlib.suppress(OSError):
            folder = folder / f"{package.name}-{_digest(package)}"
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                return folder
    return Path(tempfile.mkdtemp(prefix="nbavatar-"))


class _Locator(caching._CacheLocator):
    """Tells Numba where the kernels of a package are kept and when they are stale."""

    def __init__(self, py_func: Any, py_file: str) -> None:
        self._lineno = py_func.__code__.co_firstlineno
        self._package = Path(py_file).parent

    def get_cache_path(self) -> str:
        return str(cache_folder(self._package))

    def get_source_stamp(self) -> str:
        return _digest(self._package)

    def get_disambiguator(self) -> str:
        return str(self._lineno)

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> "_Locator | None":
        return cls(py_func, py_file) if Path(py_file).parent in {_HERE, *_OTHERS} else None


caching.CodeLibraryCacheImpl._locator_classes.insert(0, _Locator)


def kernel(function: Callable[..., Any]) -> Any:
    """Compiles a kernel: no interpreter lock, cached on disk."""
    return njit(nogil=True, cache=True, fastmath=FAST, error_model="numpy")(function)


def exact_kernel(function: Callable[..., Any]) -> Any:
    """Compiles a kernel whose arithmetic is rounded as it is written."""
    return njit(nogil=True, cache=True, error_model="numpy")(function)


def inlined(function: Callable[..., Any]) -> Any:
    """Compiles a function that its caller absorbs."""
    return njit(fastmath=FAST, **_ABSORBED)(function)


def exact_inlined(function: Callable[..., Any]) -> Any:
    """Compiles a function that an exact kernel absorbs."""
    return njit(**_ABSORBED)(function)


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    try:
        import fcntl
    except ImportError:  # no such locks on this system: at worst two processes compile the same
        yield
        return
    with open(path, "w") as handle:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield


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
        stamp = cache_folder(package) / f"{name}.ready"
        if stamp.exists():
            _compile(kernels)
        else:
            with _locked(cache_folder(package) / "compile.lock"):
                if not stamp.exists():
                    _LOG.warning("compiling the rasterizer's %s kernels, once for this machine", name)
                _compile(kernels)
                stamp.touch()
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
