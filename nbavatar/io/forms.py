"""Forms that JSON records must have: which keys, which types; told in one line where they do not.

A form is written as the value looks:

    str, int, float, bool, dict, list    a value of that type; whole numbers are floats too
    object                               anything
    (form, form, None)                   one of several; None for null
    [form]                               a list of such values
    (Ellipsis, 3, form)                  a list of exactly three
    {"key": form, "key?": form}          a mapping with these keys, "?" where they may be missing; others are free
    {str: form}                          a mapping of any keys to such values
"""

import math
from typing import Any

from nbavatar.errors import DataError, describe

__all__ = ["check_form", "matrix_form"]

_WORDS = {str: "text", int: "a whole number", float: "a finite number", bool: "true or false", dict: "a mapping",
          list: "a list", None: "null", object: "anything"}  # fmt: skip


def matrix_form(rows: int, columns: int) -> tuple[Any, ...]:
    """The form of a matrix of finite numbers, as a list of rows."""
    return (Ellipsis, rows, (Ellipsis, columns, float))


def check_form(value: Any, form: Any, where: object, field: str = "") -> None:
    """Compares a value with a form (see the module).

    Args:
        value: of JSON.
        form: what it should look like.
        where: file, for the error line.
        field: place of the value in the file.

    Raises:
        DataError: the first place where it looks different.
    """
    if isinstance(form, dict):
        _check_mapping(value, form, where, field)
    elif isinstance(form, list):
        _check_list(value, form[0], where, field)
    elif isinstance(form, tuple) and form[:1] == (Ellipsis,):
        if not isinstance(value, list) or len(value) != form[1]:
            found = f"{len(value)}" if isinstance(value, list) else describe(value)
            raise DataError.of(where, field, expected=f"a list of {form[1]}", found=found)
        _check_list(value, form[2], where, field)
    elif isinstance(form, tuple):
        simple = [kind for kind in form if kind is None or isinstance(kind, type)]
        if not any(_is(value, kind) for kind in simple):
            others = [kind for kind in form if kind not in simple]
            if others and value is not None:
                check_form(value, others[0], where, field)
            else:
                expected = " or ".join(_WORDS[kind] for kind in simple) or "a value"
                raise DataError.of(where, field, expected=expected, found=describe(value))
    elif not _is(value, form):
        raise DataError.of(where, field, expected=_WORDS[form], found=describe(value))


def _check_mapping(value: Any, form: dict, where: object, field: str) -> None:
    if not isinstance(value, dict):
        raise DataError.of(where, field, expected="a mapping", found=describe(value))
    if str in form:
        for key, item in value.items():
            check_form(item, form[str], where, _joined(field, key))
        return
    for key, inner in form.items():
        name = key.removesuffix("?")
        if name in value:
            check_form(value[name], inner, where, _joined(field, name))
        elif name == key:
            found = f"only {', '.join(map(str, list(value)[:12])) or 'an empty mapping'}"
            raise DataError.of(where, _joined(field, name), expected="this key", found=found)


def _check_list(value: Any, form: Any, where: object, field: str) -> None:
    if not isinstance(value, list):
        raise DataError.of(where, field, expected="a list", found=describe(value))
    for number, item in enumerate(value):
        if not _is(item, form):  # the usual case first: lists of frames are long
            check_form(item, form, where, f"{field}[{number}]")


def _joined(field: str, key: object) -> str:
    return f"{field}.{key}" if field else f"{key}"


def _is(value: Any, kind: Any) -> bool:
    if kind is object:
        return True
    if kind is None:
        return value is None
    if kind is float:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and _finite(value)
    if kind is int:
        return isinstance(value, int) and not isinstance(value, bool) and _finite(value)
    return isinstance(kind, type) and isinstance(value, kind)


def _finite(value: float) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # a whole number beyond all floats
        return False
