"""Numba's compiled code: where it is kept, and when it is stale.

The code of a module's kernels is stored under a digest of the sources of that module and of all that it imports in this
package, of Numba and of the processor: a changed helper, or a changed constant of another module, never meets a stale
kernel. It lies where nobody else may write (`nbavatar.private`), because Numba unpickles it: in
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
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
from llvmlite import binding
from numba.core import caching

from nbavatar.errors import DataError
from nbavatar.imports import dependencies, source_of
from nbavatar.private import cache_places, private_folder

__all__ = ["cache_folder", "sources_digest", "stored_njit"]

_LOG = logging.getLogger("nbavatar.jit")


def stored_njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit` whose compiled code is kept on disk, as described above; `options` are Numba's, without `cache`."""

    def compile_stored(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(**options)(function)
        if not numba.config.DISABLE_JIT and cache_folder(function.__module__) is not None:
            dispatcher._cache = _Cache(function)
        return dispatcher

    return compile_stored


@cache
def cache_folder(module: str) -> Path | None:
    """First safe and writable place for the compiled code of a module's kernels, or None."""
    named = os.environ.get("NUMBA_CACHE_DIR")
    candidates = [*([Path(named) / "nbavatar"] if named else []), *cache_places()]
    for candidate in candidates:
        try:
            folder = private_folder(candidate / f"{module.removeprefix('nbavatar.')}-{sources_digest((module,))}")
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
def sources_digest(modules: tuple[str, ...]) -> str:
    """Digest (20 hex digits) of everything that the compiled code of these modules depends on."""
    state = hashlib.sha256()
    # Packages are left out: what an `__init__.py` holds is compiled into a kernel only where it is imported from there.
    for name in dependencies(modules, packages=False) or modules:
        source = source_of(name)
        state.update(f"{name}\0".encode() + (source.read_bytes() if source else b""))
    host = (numba.__version__, platform.machine(), platform.python_version(), binding.get_host_cpu_name())
    state.update(repr(host).encode())
    state.update(binding.get_host_cpu_features().flatten().encode())
    return state.hexdigest()[:20]


class _Locator(caching._CacheLocator):
    """Tells Numba where the kernels of a module are kept and when they are stale."""

    def __init__(self, py_func: Any) -> None:
        self._lineno = py_func.__code__.co_firstlineno
        self._module = py_func.__module__

    def ensure_cache_path(self) -> None:
        """The folder was made and checked when it was chosen."""

    def get_cache_path(self) -> str:
        return str(cache_folder(self._module))

    def get_source_stamp(self) -> str:
        return sources_digest((self._module,))

    def get_disambiguator(self) -> str:
        return str(self._lineno)

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> "_Locator":
        return cls(py_func)


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
