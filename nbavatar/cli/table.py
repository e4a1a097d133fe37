"""One table of the paper: printed numbers, reproduced numbers, their difference.

    --table      name of the table in the layout: novel_view_1024, self_reenactment_1024, interactavatar_512, ablation,
                 channels, speed, cameras
    --layout     config/tables.yaml: rows, columns, protocols
    --reported   config/reported.csv: every number the paper prints
    --evals      results of `nbavatar evaluate` (.json); those of other rows are ignored, missing ones show as missing
    --speeds     results of `nbavatar speed` (.json)
    --out-stem   STEM.csv (one line a cell, with its source), STEM.md, STEM.tex and STEM.html (to look at) are written

Results of another image size than the paper's, and all of them with --size-label, stand under a heading that says so.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import pandas as pd

from nbavatar.cli.common import add_cfg_argument, stage_config
from nbavatar.cli.results import read_results
from nbavatar.config.core import to_mapping
from nbavatar.config.evaluation import TableConfig
from nbavatar.config.tables import choose_table, read_tables
from nbavatar.errors import parsing
from nbavatar.io.atomic import atomic_write
from nbavatar.provenance import file_digest, run_record
from nbavatar.reporting.cells import Source
from nbavatar.reporting.formats import to_csv, to_latex, to_markdown
from nbavatar.reporting.markdown import markdown_to_html
from nbavatar.reporting.page import page
from nbavatar.reporting.printed import read_printed
from nbavatar.reporting.tables import build_table

__all__ = ["add_arguments", "main"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options of `nbavatar table`."""
    parser.add_argument("--table", required=True, metavar="NAME", help="which table")
    parser.add_argument("--layout", default="config/tables.yaml", metavar="YAML", help="layout of the tables")
    parser.add_argument("--reported", default="config/reported.csv", metavar="CSV", help="numbers printed in the paper")
    parser.add_argument("--evals", nargs="*", default=[], metavar="JSON", help="evaluations")
    parser.add_argument("--speeds", nargs="*", default=[], metavar="JSON", help="timings")
    parser.add_argument("--size-label", default="", metavar="TEXT", help="why no result is comparable with the paper")
    parser.add_argument("--out-stem", required=True, metavar="STEM", help="where to write, without suffix")
    add_cfg_argument(parser, TableConfig)


def main(args: argparse.Namespace) -> int:
    """Writes one table in four formats."""
    cfg = stage_config(args, TableConfig)
    layout = choose_table(read_tables(args.layout), args.table, args.layout)
    files = [*args.evals, *args.speeds]
    inputs = {"layout": args.layout, "reported": args.reported} | {f"results.{i}": path for i, path in enumerate(files)}
    table = build_table(
        args.table,
        layout,
        _read_printed(args.reported),
        read_results(files),
        printed_source=Source(args.reported, file_digest(args.reported)),
        lpips_net=cfg.lpips_net,
        difference=cfg.difference,
        size_label=args.size_label,
    )
    record = run_record("table", config={"table": args.table} | to_mapping(cfg), inputs=inputs)
    table = replace(table, record=record)
    texts = {"csv": to_csv(table), "md": to_markdown(table), "tex": to_latex(table)}
    shown = markdown_to_html(texts["md"].partition("\n")[2])  # the page has the title
    texts["html"] = page(table.title, args.size_label, [("table", args.table, shown)])
    for suffix, text in texts.items():
        with atomic_write(f"{args.out_stem}.{suffix}") as path:
            path.write_text(text, encoding="utf-8")
    print(f"{args.out_stem}.md written")
    return 0


def _read_printed(path: str) -> pd.DataFrame:
    with parsing(path, "the numbers printed in the paper (.csv)"):
        return read_printed(Path(path).read_text(encoding="utf-8-sig").splitlines(), path)
