"""Which modules of this package a module depends on, found by reading sources, never by running them.

Standard library only. A module counts where it is imported, at any place of a file, and where its full name stands in
quotes (`"nbavatar.methods.billboards.avatar:Avatar"`), because some are imported by name. Two things are left
out, each marked where it stands by the comment `# provenance: neutral` and its reason:

    a module    with that line among its first lines: nothing in it changes what is computed
    an import   with that comment at its end: what it brings reaches the result in another way that is recorded
"""
# provenance: neutral, because it only looks.

import functools
import re
from collections.abc import Callable, Iterable
from pathlib import Path

__all__ = ["PACKAGE", "REGISTRY", "ROOT", "dependencies", "imports_of", "is_neutral", "kinds_of", "source_of"]

PACKAGE = "nbavatar"
REGISTRY = "nbavatar.methods.registry"
ROOT = Path(__file__).resolve().parent

_MARK = r"#[ \t]*provenance:[ \t]*neutral\b"
_NEUTRAL = re.compile(rf"^{_MARK}", re.M)
_FROM = re.compile(rf"^[ \t]*from[ \t]+({PACKAGE}(?:\.\w+)*)[ \t]+import[ \t]+(\([^)]*\)[^\n]*|[^\n]*)", re.M)
_IMPORT = re.compile(rf"^[ \t]*import[ \t]+({PACKAGE}\b[^\n]*)", re.M)
_QUOTED = re.compile(rf"""["']({PACKAGE}(?:\.\w+)+)(?::\w+)?["']""")
_NAME = re.compile(r"\w+")
_DOTTED = re.compile(rf"{PACKAGE}(?:\.\w+)*")


@functools.cache
def source_of(module: str) -> Path | None:
    """File of a module, or None where there is none of that name."""
    base = ROOT.parent.joinpath(*module.split("."))
    for path in (base.with_suffix(".py"), base / "__init__.py"):
        if path.is_file():
            return path
    return None


@functools.cache
def _text(module: str) -> str:
    path = source_of(module)
    assert path is not None
    return path.read_text(encoding="utf-8")


@functools.cache
def is_neutral(module: str) -> bool:
    """Whether a module is marked as one that changes no result."""
    return _NEUTRAL.search(_text(module)) is not None


@functools.cache
def imports_of(module: str) -> frozenset[str]:
    """Modules of this package that a module names, without what is marked."""
    text = _text(module)
    names: set[str] = set()
    for found in _FROM.finditer(text):
        if re.search(_MARK, found[2]):
            continue
        names.add(found[1])
        listed = re.sub(r"#[^\n]*", "", found[2])
        names.update(f"{found[1]}.{name}" for name in _NAME.findall(listed))
    for found in _IMPORT.finditer(text):
        if not re.search(_MARK, found[1]):
            names.update(_DOTTED.findall(found[1].partition("#")[0]))
    names.update(_QUOTED.findall(text))
    return frozenset(name for name in names if name != module and source_of(name) is not None)


@functools.cache
def kinds_of(module: str) -> tuple[str, ...]:
    """Which classes of methods a module asks the registry for: `avatar`, `training`, `options`."""
    return tuple(kind for kind in ("avatar", "training", "options") if f"{kind}_class" in _text(module))


def dependencies(
    roots: Iterable[str],
    *,
    packages: bool = True,
    follow: Callable[[str], Iterable[str]] = imports_of,
) -> tuple[str, ...]:
    """Modules that roots depend on, themselves among them, sorted; neutral ones are left out with what they import.

    Args:
        roots: names of modules.
        packages: whether the packages that hold a module count too: Python runs their `__init__.py` first.
        follow: module -> the modules that it leads to.
    """
    seen: set[str] = set()
    queue = list(roots)
    while queue:
        module = queue.pop()
        if module in seen or source_of(module) is None or is_neutral(module):
            continue
        seen.add(module)
        queue.extend(follow(module))
        parent = module.rpartition(".")[0]
        if packages and parent:
            queue.append(parent)
    return tuple(sorted(seen))
