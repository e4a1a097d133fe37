"""Typed configuration: frozen dataclasses, strict reading, a JSON schema.

Standard library only: the Snakefile imports this on every call.
"""

import dataclasses
import re
import types
import typing
from collections.abc import Mapping
from typing import Any, TypeVar

from nbavatar.errors import ConfigError, describe, did_you_mean

__all__ = ["from_mapping", "json_schema", "merge", "option", "to_mapping"]

T = TypeVar("T")

_EXPONENT = re.compile(r"[-+]?\d+(\.\d*)?[eE][-+]?\d+")


def option(
    default: Any,
    doc: str,
    *,
    min: float | None = None,
    max: float | None = None,
    choices: tuple[Any, ...] | None = None,
) -> Any:
    """Declares one configuration value.

    Args:
        default: value when the user says nothing; mutable defaults are copied per instance.
        doc: one or two sentences for the reference page, with units in [brackets].
        min: smallest allowed number (for sequences: of every element).
        max: largest allowed number (for sequences: of every element).
        choices: the allowed values (for sequences: of every element).
    """
    metadata = {"doc": doc, "min": min, "max": max, "choices": choices}
    if isinstance(default, (list, dict)):
        return dataclasses.field(default_factory=default.copy, metadata=metadata)
    if dataclasses.is_dataclass(default) and isinstance(default, type):
        return dataclasses.field(default_factory=default, metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


def from_mapping(cls: type[T], mapping: Mapping[str, Any], where: str) -> T:
    """Reads a mapping into the dataclass `cls`.

    Unknown keys, values of another type (a number where text belongs) and values out of range are refused. `1e-3`,
    which YAML 1.1 reads as text, is a number where a number with a fraction is meant.

    Raises:
        ConfigError: one line that names `where` and the key.
    """
    if not isinstance(mapping, Mapping):
        raise ConfigError.of(where, expected=f"a mapping with the keys of {cls.__name__}", found=describe(mapping))
    fields = {field.name: field for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
    hints = typing.get_type_hints(cls)
    values: dict[str, Any] = {}
    for key, value in mapping.items():
        if key not in fields:
            blocks = [name for name, hint in hints.items() if dataclasses.is_dataclass(hint) and _has(hint, key)]
            meant = f"write {blocks[0]}: {{{key}: ...}}" if blocks else did_you_mean(str(key), fields)
            raise ConfigError(f"{where}: unknown key '{key}'; {meant}")
        values[key] = _read(hints[key], value, fields[key].metadata, f"{where}.{key}")
    try:
        return cls(**values)
    except TypeError as error:
        missing = [n for n, f in fields.items() if n not in values and _has_no_default(f)]
        raise ConfigError.of(where, expected=f"the keys {', '.join(missing)}", found="none of them") from error


def to_mapping(value: Any) -> Any:
    """Turns a dataclass into plain dicts, lists, text and numbers (JSON-ready)."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_mapping(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): to_mapping(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_mapping(item) for item in value]
    return value


def merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Deep merge of plain mappings; `over` wins, lists are replaced whole."""
    result = dict(base)
    for key, value in over.items():
        if isinstance(value, Mapping) and isinstance(result.get(key), Mapping):
            result[key] = merge(result[key], value)
        else:
            result[key] = value
    return result


def json_schema(cls: type) -> dict[str, Any]:
    """JSON schema (draft 2020-12 subset) of a configuration dataclass."""
    hints = typing.get_type_hints(cls)
    properties: dict[str, Any] = {}
    required: list[str] = []
    for field in dataclasses.fields(cls):
        schema = _schema_of(hints[field.name])
        _constrain(schema, field.metadata)
        if field.metadata.get("doc"):
            schema["description"] = field.metadata["doc"]
        if _has_no_default(field):
            required.append(field.name)
        properties[field.name] = schema
    result: dict[str, Any] = {"type": "object", "properties": properties, "additionalProperties": False}
    if required:
        result["required"] = required
    return result


def _has(cls: Any, key: Any) -> bool:
    return key in {field.name for field in dataclasses.fields(cls)}


def _has_no_default(field: "dataclasses.Field[Any]") -> bool:
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def _read(hint: Any, value: Any, metadata: Mapping[str, Any], where: str) -> Any:
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        if value is None and type(None) in args:
            return None
        others = [arg for arg in args if arg is not type(None)]
        errors = []
        for arg in others:
            try:
                return _read(arg, value, metadata, where)
            except ConfigError as error:
                errors.append(error)
        raise errors[0]
    if dataclasses.is_dataclass(hint):
        return value if isinstance(value, hint) else from_mapping(hint, value, where)  # type: ignore[type-var]
    if origin in (list, tuple):
        if not isinstance(value, (list, tuple)):
            raise ConfigError.of(where, expected="a list", found=describe(value))
        if origin is tuple and args and args[-1] is not Ellipsis and len(args) != len(value):
            raise ConfigError.of(where, expected=f"{len(args)} values", found=f"{len(value)}")
        item = args[0] if args else Any
        return origin(_read(item, v, metadata, f"{where}[{i}]") for i, v in enumerate(value))
    if origin is dict:
        if not isinstance(value, Mapping):
            raise ConfigError.of(where, expected="a mapping", found=describe(value))
        if None in value:
            raise ConfigError.of(where, expected="a name before every ':'", found="an empty key")
        return {str(k): _read(args[1], v, metadata, f"{where}.{k}") for k, v in value.items()}
    if hint is not Any:
        value = _check_scalar(hint, value, where)
    choices = metadata.get("choices")
    if choices is not None and value not in choices:
        allowed = ", ".join(map(str, choices))
        raise ConfigError.of(where, expected=f"one of {allowed}", found=describe(value))
    for bound, fails, word in (("min", lambda v, b: v < b, "at least"), ("max", lambda v, b: v > b, "at most")):
        limit = metadata.get(bound)
        if limit is not None and isinstance(value, (int, float)) and fails(value, limit):
            raise ConfigError.of(where, expected=f"{word} {limit}", found=describe(value))
    return value


def _check_scalar(hint: Any, value: Any, where: str) -> Any:
    if hint is float and isinstance(value, str) and _EXPONENT.fullmatch(value):  # what YAML 1.1 reads as text
        value = float(value)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if hint is float and isinstance(value, float) and value != value:
        raise ConfigError.of(where, expected="a number", found="NaN")
    if (hint is int and isinstance(value, bool)) or not isinstance(value, hint):
        raise ConfigError.of(where, expected=_type_name(hint), found=describe(value))
    return value


def _type_name(hint: Any) -> str:
    names = {int: "a whole number", float: "a number", str: "text", bool: "true or false"}
    return names.get(hint, getattr(hint, "__name__", str(hint)))


def _schema_of(hint: Any) -> dict[str, Any]:
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        return {"anyOf": [_schema_of(arg) for arg in args]}
    if hint is type(None):
        return {"type": "null"}
    if dataclasses.is_dataclass(hint):
        return json_schema(hint)  # type: ignore[arg-type]
    if origin in (list, tuple):
        schema: dict[str, Any] = {"type": "array", "items": _schema_of(args[0]) if args else {}}
        if origin is tuple and args and args[-1] is not Ellipsis:
            schema |= {"minItems": len(args), "maxItems": len(args)}
        return schema
    if origin is dict:
        return {"type": "object", "additionalProperties": _schema_of(args[1])}
    names = {int: "integer", float: "number", str: "string", bool: "boolean"}
    return {"type": names[hint]} if hint in names else {}


def _constrain(schema: dict[str, Any], metadata: Mapping[str, Any]) -> None:
    if schema.get("type") == "array":
        return _constrain(schema["items"], metadata)
    if "anyOf" in schema:
        for part in schema["anyOf"]:
            if part.get("type") != "null":
                _constrain(part, metadata)
        return None
    if schema.get("type") in ("integer", "number"):
        if metadata.get("min") is not None:
            schema["minimum"] = metadata["min"]
        if metadata.get("max") is not None:
            schema["maximum"] = metadata["max"]
    if metadata.get("choices") is not None:
        schema["enum"] = list(metadata["choices"])
    return None
