"""Files that hold named layouts: what config/tables.yaml and config/figures.yaml have in common."""

import os
from collections.abc import Mapping
from typing import TypeVar

from nbavatar.config.core import from_mapping
from nbavatar.config.yamlfiles import read_yaml
from nbavatar.errors import ConfigError, did_you_mean
from nbavatar.names import check_name

__all__ = ["choose_layout", "read_layouts"]

T = TypeVar("T")


def read_layouts(path: str | os.PathLike[str], cls: type[T], kind: str) -> dict[str, T]:
    """Reads a file of named layouts.

    Args:
        path: a YAML file, name -> layout.
        cls: dataclass of one layout.
        kind: what is laid out, for errors: `table`, `figure`.

    Raises:
        ConfigError: no such file, not YAML, an unknown key, a wrong type.
    """
    content = read_yaml(path, f"the layout of the {kind}s (.yaml)")
    if not isinstance(content, dict):
        raise ConfigError.of(path, expected=f"{kind} name -> layout", found=type(content).__name__)
    named = {check_name(str(name), path, kind, error=ConfigError): value for name, value in content.items()}
    return {name: from_mapping(cls, value, f"{path}: {name}") for name, value in named.items()}


def choose_layout(layouts: Mapping[str, T], name: str, where: str, kind: str) -> T:
    """One layout by its name.

    Raises:
        ConfigError: there is none of this name.
    """
    if name not in layouts:
        raise ConfigError(f"{where}: unknown {kind} '{name}'; {did_you_mean(name, layouts)}")
    return layouts[name]
