"""Numba's compiled code: where it is kept, and when it is stale.

The code is stored under a digest of the sources that it depends on, of Numba and of the processor, so a changed helper
never meets a stale kernel. It lies where nobody else may write (`nbavatar.private`), because Numba unpickles it: in
`NUMBA_CACHE_DIR` if that is set, else in the package's own `__pycache__`, else in the user's cache, else in the folder
for temporary files. Where there is no such place, and where what is stored cannot be read or the disk is full, kernels
are compiled anew in each process: slower, never wrong.
"""

import hashlib
import logging
import os
import pickle
import platform
import tempfile
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import Any

import numba
from llvmlite import binding
from numba.core import caching

from nbavatar.errors import DataError
from nbavatar.private import private_folder

__all__ = ["cache_folder", "keep_kernels", "stored_njit"]

_LOG = logging.getLogger("nbavatar.kernels")

_PACKAGE = Path(__file__).parent
_SOURCES: dict[Path, tuple[Path, ...]] = {}  # package -> files that its compiled code depends on


def keep_kernels(package: Path, sources: Iterable[Path]) -> None:
    """Says which files a package's kernels depend on; to be called before they are defined.

    Without it they are all files of the package and of `nbavatar.mesh`, whose functions others compile in.
    """
    _SOURCES[package] = tuple(sources)


def stored_njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit` whose compiled code is kept on disk, as described above; `options` are Numba's, without `cache`."""

    def compile_stored(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(**options)(function)
        package = Path(function.__code__.co_filename).parent
        if not numba.config.DISABLE_JIT and cache_folder(package) is not None:
            dispatcher._cache = _Cache(function)
        return dispatcher

    return compile_stored


@cache
def cache_folder(package: Path) -> Path | None:
    """First safe and writable place for a package's compiled code, or None."""
    named = os.environ.get("NUMBA_CACHE_DIR")
    candidates = [Path(named) / "nbavatar"] if named else []
    candidates.append(package / "__pycache__")
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    if os.path.isabs(home):  # without a home directory the name stays as it is
        candidates.append(Path(home) / "nbavatar")
    try:
        candidates.append(Path(tempfile.gettempdir()) / f"nbavatar-{os.getuid()}")
    except FileNotFoundError:  # no folder for temporary files is writable
        pass
    for candidate in candidates:
        try:
            folder = private_folder(candidate / f"{package.name}-{_digest(package)}")
            with tempfile.TemporaryFile(dir=folder) as probe:
                probe.write(b"room")
            return folder
        except DataError as refusal:
            if named and candidate is candidates[0]:
                _LOG.warning("compiled kernels are not kept in NUMBA_CACHE_DIR: %s", refusal)
        except OSError:
            continue
    _LOG.warning("no place to keep compiled kernels: they are compiled in every process; set NUMBA_CACHE_DIR to one")
    return None


@cache
def _digest(package: Path) -> str:
    """Digest of everything that a package's compiled code depends on."""
    state = hashlib.sha256()
    for source in _SOURCES.get(package) or (*sorted((_PACKAGE / "mesh").glob("*.py")), *sorted(package.glob("*.py"))):
        state.update(source.read_bytes())
    host = (numba.__version__, platform.machine(), platform.python_version(), binding.get_host_cpu_name())
    state.update(repr(host).encode())
    state.update(binding.get_host_cpu_features().flatten().encode())
    return state.hexdigest()[:20]


class _Locator(caching._CacheLocator):
    """Tells Numba where the kernels of a package are kept and when they are stale."""

    def __init__(self, py_func: Any, py_file: str) -> None:
        self._lineno = py_func.__code__.co_firstlineno
        self._package = Path(py_file).parent

    def ensure_cache_path(self) -> None:
        """The folder was made and checked when it was chosen."""

    def get_cache_path(self) -> str:
        return str(cache_folder(self._package))

    def get_source_stamp(self) -> str:
        return _digest(self._package)

    def get_disambiguator(self) -> str:
        return str(self._lineno)

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> "_Locator":
        return cls(py_func, py_file)


class _CacheImpl(caching.CompileResultCacheImpl):
    _locator_classes = [_Locator]


class _Cache(caching.FunctionCache):
    """Numba's cache, which it is no error to do without."""

    _impl_class = _CacheImpl

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        # What a file that was cut short by a full disk or a power failure makes pickle and LLVM raise.
        except (OSError, EOFError, pickle.UnpicklingError, AttributeError, LookupError, RuntimeError, TypeError,
                ValueError) as error:  # fmt: skip
            _LOG.warning("%s: a stored kernel cannot be read (%s) and is compiled again", self._cache_path, error)
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except (EOFError, pickle.UnpicklingError, AttributeError, LookupError, TypeError, ValueError):
            self.flush()  # the index is damaged; the next process writes it anew
        except OSError as error:
            _LOG.warning("%s: a compiled kernel cannot be kept (%s)", self._cache_path, error.strerror)
