"""Writes what is generated from the configuration's dataclasses.

    workflow/schemas/config.schema.json   JSON schema of a run's YAML file, for editors
    config/README.md                      every option with default, range and meaning

Run it after changing an option; a test compares both files with the code.
"""

import argparse
from pathlib import Path

from nbavatar.config.reference import reference_page, run_schema
from nbavatar.io.atomic import atomic_write
from nbavatar.io.records import write_json

__all__ = ["add_arguments", "main"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds where to write."""
    parser.add_argument("--schema", default="workflow/schemas/config.schema.json", help="target of the JSON schema")
    parser.add_argument("--reference", default="config/README.md", help="target of the reference page (Markdown)")


def main(args: argparse.Namespace) -> int:
    """Writes both files."""
    write_json(args.schema, run_schema())
    with atomic_write(Path(args.reference)) as temporary:
        temporary.write_text(reference_page(), encoding="utf-8")
    print(f"wrote {args.schema} and {args.reference}")
    return 0
