"""Plans of the configurations that the project ships, and of a Decaf folder that a test lays out."""

from pathlib import Path
from typing import Any

import yaml

from nbavatar.planning.run import Plan, read_plan

ROOT = Path(__file__).parents[3]


def shipped(name: str, **changes: Any) -> Plan:
    """The plan of `config/<name>.yaml`, with some of its top-level keys changed."""
    mapping = yaml.safe_load((ROOT / f"config/{name}.yaml").read_text()) | changes
    for key in ("subjects", "runs", "tables", "figures", "reported"):
        default = f"config/{key}.{'tsv' if key in ('subjects', 'runs') else 'yaml'}"
        if mapping.get(key, default):
            mapping[key] = str(ROOT / mapping.get(key, default))
    return read_plan(mapping)
