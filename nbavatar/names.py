"""The one rule for names of cameras, frames, subjects, variants: they become parts of paths, commands and pages.

A name consists of letters, marks and digits of any script, `.`, `_` and `-`, and begins with a letter, a digit or `_`:
so it names no folder above and no hidden file, is no option of a command, and means nothing to a shell.
"""

import re
import unicodedata
from collections.abc import Iterable

from nbavatar.errors import NBAvatarError, describe

__all__ = ["LONGEST", "check_apart", "check_name", "check_place", "is_name", "name_like"]

LONGEST = 120
"""Bytes of a name in UTF-8. File systems take 255, and stages add suffixes and temporary endings."""

_PLAIN = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")


def is_name(text: str) -> bool:
    """Whether a text can be a name; see the module for the rule."""
    if len(text) <= LONGEST and _PLAIN.fullmatch(text):  # nearly all of them, and frames can be 100,000
        return True
    begins = bool(text) and (_is_letter(text[0]) or text[0] == "_") and not unicodedata.combining(text[0])
    return begins and all(_is_letter(c) or c in "._-" for c in text) and len(text.encode()) <= LONGEST


def check_name(text: str, where: object, field: str = "", *, error: type[NBAvatarError]) -> str:
    """The same text, if it can be a name.

    Args:
        text: name of a camera, frame, subject, ...
        where: file, sheet or option that it comes from.
        field: which name in it.
        error: class of the error.

    Raises:
        NBAvatarError: of class `error`, one line.
    """
    if not is_name(text):
        rule = f"a name of letters, digits, '.', '_' and '-' that begins with a letter or digit, up to {LONGEST} bytes"
        raise error.of(where, field, expected=rule, found=describe(text), fix="rename it")
    return text


def check_apart(names: Iterable[str], where: object, field: str = "", *, error: type[NBAvatarError]) -> None:
    """Refuses two names that are written with other characters and read the same: composed letters and their parts.

    Some file systems keep only one of them, and a person cannot tell them apart.

    Raises:
        NBAvatarError: of class `error`, one line.
    """
    known: dict[str, str] = {}
    for name in names:
        if not name.isascii() and (other := known.setdefault(unicodedata.normalize("NFC", name), name)) != name:
            found = f"{other!a} and {name!a}"
            raise error.of(where, field, expected="names that look different", found=found, fix="rename one of them")


def check_place(path: str, where: object, field: str = "", *, error: type[NBAvatarError]) -> str:
    """The same path, if the workflow can have it among its inputs: there, braces are wildcards.

    Raises:
        NBAvatarError: of class `error`, one line.
    """
    if "{" in path or "}" in path:
        raise error.of(where, field, expected="a path without braces", found=describe(path), fix="rename or link it")
    return path


def name_like(text: str) -> str:
    """A name that resembles a text, such as a folder's: `_` stands for every character that names do not have."""
    text = unicodedata.normalize("NFC", text)
    name = "".join(c if _is_letter(c) or c in "._-" else "_" for c in text)
    return name if not name or _is_letter(name[0]) else f"_{name[1:]}"


def _is_letter(character: str) -> bool:
    """A letter, a mark that belongs to one (vowel signs of many scripts), or a decimal digit."""
    category = unicodedata.category(character)
    return category[0] in "LM" or category == "Nd"
