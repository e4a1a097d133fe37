"""What a module's source says, whatever its comments, docstrings and layout: a digest of its syntax tree.

Parsing two hundred modules takes a second, at each plan and in each job, so digests are kept on disk, by digest of the
source that they were made of: what is kept is never stale. Where there is no place of this user's own to keep them
(`nbavatar.private`), modules are parsed in every process. Standard library only.
"""
# provenance: neutral, because it only looks.

import ast
import functools
import hashlib
import json
import os
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path

from nbavatar.errors import DataError
from nbavatar.imports import source_of
from nbavatar.private import cache_places, private_folder

__all__ = ["syntax_digest", "syntax_digests"]

# Another interpreter has other trees, another edition of this file writes them in another way.
_EDITION = f"1-{sys.version_info.major}.{sys.version_info.minor}"
_MOST = 4096  # digests that are kept
_DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def syntax_digests(modules: Iterable[str]) -> dict[str, str]:
    """Module of this package -> digest (64 hex digits) of its syntax tree."""
    sources = {}
    for module in modules:
        path = source_of(module)
        assert path is not None
        sources[module] = path.read_bytes()
    keys = {module: hashlib.sha256(source).hexdigest() for module, source in sources.items()}
    known = _kept()
    new = {keys[module]: syntax_digest(sources[module]) for module in sources if keys[module] not in known}
    if new:
        known |= new
        _keep(known if len(known) <= _MOST else {key: known[key] for key in keys.values()})
    return {module: known[key] for module, key in keys.items()}


def syntax_digest(source: bytes) -> str:
    """Digest (64 hex digits) of the syntax tree of a source text without positions and docstrings."""
    words: list[str] = []
    _append_words(ast.parse(source), words)
    return hashlib.sha256("".join(words).encode(errors="surrogatepass")).hexdigest()


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


@functools.cache
def _place() -> Path | None:
    """The file that digests are kept in, or None."""
    for place in cache_places():
        try:
            return private_folder(place / "syntax") / f"{_EDITION}.json"
        except (DataError, OSError):
            continue
    return None


@functools.cache
def _kept() -> dict[str, str]:
    """Digests by digest of the source, as they were kept; one dictionary, which grows with the process."""
    path = _place()
    if path is None:
        return {}
    try:
        stored = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    if not isinstance(stored, dict):
        return {}
    return {key: value for key, value in stored.items() if isinstance(value, str) and len(key) == len(value) == 64}


def _keep(known: dict[str, str]) -> None:
    path = _place()
    if path is None:
        return
    part = ""
    try:
        descriptor, part = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
        with open(descriptor, "w", encoding="utf-8") as stream:
            json.dump(known, stream)
        os.replace(part, path)
    except OSError:  # a full disk, a folder that can be read only
        if part and os.path.lexists(part):
            os.unlink(part)
