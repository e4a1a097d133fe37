"""What several verbs share: the `--cfg` option, the run's progress bar."""
# provenance: neutral, because it reads options, which are recorded, and shows progress.

import argparse
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

from nbavatar.config.core import from_mapping, merge
from nbavatar.config.yamlfiles import parse_yaml, read_yaml
from nbavatar.errors import ConfigError, describe, parsing

__all__ = ["add_cfg_argument", "progress", "read_mapping", "read_settings", "stage_config"]

T = TypeVar("T")
Item = TypeVar("Item")


def add_cfg_argument(parser: argparse.ArgumentParser, cls: type) -> None:
    """Adds `--cfg`, the options of one stage as JSON text or a file."""
    parser.add_argument(
        "--cfg",
        default="{}",
        metavar="JSON|FILE",
        help=f"options of this stage ({cls.__name__}, see config/README.md) as JSON text, "
        "or a .json or .yaml file; what is not named keeps its default",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="one option, over --cfg, such as steps=500 or billboards.rates.features=1e-3; may be given several times",
    )


def stage_config(args: argparse.Namespace, cls: type[T]) -> T:
    """The stage's configuration from `--cfg` and `--set`; wrong keys, types and ranges end in one line."""
    mapping = read_mapping(args.cfg, "--cfg")
    if not args.set:
        return from_mapping(cls, mapping, "--cfg")
    return from_mapping(cls, merge(mapping, read_settings(args.set)), "--set" if args.cfg == "{}" else "--cfg, --set")


def read_settings(words: Iterable[str]) -> dict[str, Any]:
    """Options given one by one, `key.sub=value` with the value in YAML, as a nested mapping; the last of a key counts.

    Raises:
        ConfigError: no `=`, an empty key, or a value that is no YAML.
    """
    settings: dict[str, Any] = {}
    for word in words:
        key, equals, text = word.partition("=")
        names = key.strip().split(".")
        if not equals or not all(names):
            raise ConfigError.of("--set", expected="key=value or key.sub=value", found=describe(word))
        value = parse_yaml(text, f"--set {key}")
        for name in reversed(names):
            value = {name: value}
        settings = merge(settings, value)
    return settings


def read_mapping(text: str, option: str) -> dict[str, Any]:
    """Reads JSON text, or a `.json`, `.yaml` or `.yml` file, that holds a mapping."""
    where = option
    if not text.lstrip().startswith("{"):
        path, where = Path(text), f"{option} {text}"
        with parsing(option, "JSON text or a file", error=ConfigError):
            if not path.is_file():
                raise ConfigError.of(where, expected="JSON text or a file", found="neither")
        if path.suffix in (".yaml", ".yml"):
            return _mapping(read_yaml(path, "YAML"), where)
        with parsing(where, "JSON", damaged="text that does not parse", error=ConfigError):
            text = path.read_text(encoding="utf-8-sig")
    with parsing(where, "JSON", damaged="text that does not parse", error=ConfigError):
        value = json.loads(text)
    return _mapping(value, where)


def progress(items: Iterable[Item], description: str, total: int | None = None) -> Iterable[Item]:
    """Wraps an iterable in a progress bar on standard error."""
    from tqdm import tqdm

    return tqdm(items, desc=description, total=total, dynamic_ncols=True, mininterval=0.5)


def _mapping(value: Any, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ConfigError.of(where, expected="a mapping", found=type(value).__name__)
    return value
