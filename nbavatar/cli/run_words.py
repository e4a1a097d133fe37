"""The words that `nbavatar run` hands on to snakemake: which files they name, read before anything starts.

Snakemake ends in a traceback on a configuration that is not text or not YAML, and starts with one whose values do not
fit. Everything that can be known of the files is therefore looked at first, and refused in one line.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nbavatar.config.core import merge
from nbavatar.config.run import load_run
from nbavatar.config.yamlfiles import check_tree, parse_yaml
from nbavatar.errors import ConfigError, describe, parsing

__all__ = ["Words", "check_files", "executor_of", "profile_files", "read_words"]

_EXPECTED = "a configuration in YAML"


@dataclass(frozen=True)
class Words:
    """What the words name.

    Attributes:
        configfiles: as they overwrite one another; empty where none is named.
        values: KEY=VALUE of `--config`.
        profiles: names or paths of `--profile` and `--workflow-profile`.
        snakefile: another workflow than ours, or empty.
        executor: where jobs run, or empty.
    """

    configfiles: tuple[str, ...]
    values: tuple[str, ...]
    profiles: tuple[str, ...]
    snakefile: str
    executor: str


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> Any:
        raise ConfigError(f"words for snakemake: {message}")


def read_words(words: Sequence[str]) -> Words:
    """Reads the words as snakemake does: abbreviations, `--option=value`, the last of an option that is there twice.

    Raises:
        ConfigError: an option without its value, an abbreviation of several.
    """
    parser = _Parser(add_help=False)
    parser.add_argument("--configfile", "--configfiles", nargs="+", default=[])
    parser.add_argument("--config", "-C", nargs="*", default=[])
    parser.add_argument("--profile", action="append", default=[])
    parser.add_argument("--workflow-profile", default="none")
    parser.add_argument("--snakefile", "-s", default="")
    parser.add_argument("--executor", "-e", default="")
    found, _ = parser.parse_known_args(list(words))
    profiles = [name for name in (*found.profile, found.workflow_profile) if name != "none"]
    return Words(tuple(found.configfile), tuple(found.config), tuple(profiles), found.snakefile, found.executor)


def executor_of(words: Words, source: Path, profile: str = "") -> str:
    """Snakemake's executor: that of the words, else that of the last profile that names one, else empty.

    Args:
        words: of the user.
        source: folder of our workflow.
        profile: a further profile, that comes last.
    """
    found = ""
    for name in filter(None, (*words.profiles, profile)):
        for path in profile_files(name, source):
            found = str(_mapping(path).get("executor", found))
    return words.executor or found


def check_files(words: Words, configfiles: Sequence[str], source: Path) -> None:
    """Reads every file that a run would start from.

    Args:
        words: of the user.
        configfiles: the run's configuration, those of the words or our own.
        source: folder of our workflow.

    Raises:
        ConfigError: one line that names the file that is missing, no text, no YAML, or no configuration of a run.
    """
    if words.snakefile:
        with parsing(words.snakefile, "a Snakefile", damaged="one that is no text", error=ConfigError):
            Path(words.snakefile).read_text(encoding="utf-8")
    for name in words.profiles:
        for path in profile_files(name, source):
            _mapping(path)
    run: dict[str, Any] = {}
    for path in configfiles:
        run = merge(run, _mapping(path))
    if words.snakefile or words.values:  # another workflow, or values that only it puts together
        return
    base = _mapping("config/paper.yaml") if "run" not in run else {}  # as the Snakefile does
    try:
        load_run(merge(base, run))
    except ConfigError as error:
        raise ConfigError(f"{', '.join(configfiles)}: {error}") from None


def _mapping(path: str | Path) -> dict[str, Any]:
    """One file, JSON or YAML as snakemake takes them."""
    with parsing(path, _EXPECTED, damaged="text that does not parse", error=ConfigError):
        text = Path(path).read_text(encoding="utf-8-sig")
    try:
        value = json.loads(text)
        check_tree(value, path)
    except (ValueError, RecursionError):
        value = parse_yaml(text, path)
    if not isinstance(value, dict):
        raise ConfigError.of(path, expected="a mapping of options", found=describe(value))
    return value


def profile_files(name: str, source: Path) -> list[Path]:
    """Configuration files of a profile, wherever it is found near by."""
    for place in (Path(name), Path("profiles", name), source / "profiles" / name):
        if place.is_file():
            return [place]
        if place.is_dir():
            return sorted(path for kind in ("profile", "config") for path in place.glob(f"{kind}*.yaml"))
    return []
