"""Every numerical kernel driven to its limits, one condition at a time, against an oracle of higher precision.

    --out      folder for table.csv (one line a measurement), table.md (one line a cell), heatmap.png and .pdf,
               curves.png and .pdf, record.json (all rows, with provenance)
    --quick    few levels of every cell: a smoke test of some seconds
    --strict   exit code 1 if there is a defect

A measurement's verdict is `exact` (errors of result and gradient within the tolerance of the number format), `degrades`
(within the bound that is stated for a degenerate level), `refuses` (one line that names the cause) or `defect` (NaN,
infinity, a crash, an error beyond its bound). Errors are relative in the Euclidean norm unless a unit is given. Nothing
but this package is read: all scenes are made here.
"""

import argparse
import dataclasses
from pathlib import Path

from nbavatar.cli.common import progress
from nbavatar.devices import lease_device
from nbavatar.errors import ConfigError, did_you_mean
from nbavatar.io.atomic import atomic_write
from nbavatar.io.records import write_json
from nbavatar.provenance import run_record

__all__ = ["add_arguments", "main"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options of `nbavatar extremes`."""
    parser.add_argument("--out", required=True, metavar="DIR", help="folder for the results")
    parser.add_argument("--quick", action="store_true", help="few levels of every cell")
    parser.add_argument("--families", nargs="+", metavar="NAME", help="only these families of kernels")
    parser.add_argument("--strict", action="store_true", help="exit code 1 if there is a defect")


def main(args: argparse.Namespace) -> int:
    """Measures, writes tables and pictures, prints what is not exact."""
    with lease_device("cpu"):
        from nbavatar.reporting.extremes import extremes_markdown
        from nbavatar.reporting.figures import save_figure
        from nbavatar.studies.extremes.cells import FAMILIES
        from nbavatar.studies.extremes.plots import curves, heat_map
        from nbavatar.studies.extremes.table import count_verdicts, csv_text, sweep

        for name in args.families or ():
            if name not in FAMILIES:
                raise ConfigError.of("--families", expected=f"of {', '.join(FAMILIES)}", found=repr(name),
                                     fix=did_you_mean(name, FAMILIES))  # fmt: skip
        families = tuple(name for name in FAMILIES if not args.families or name in args.families)
        rows = sweep(families, quick=args.quick, progress=lambda cells: progress(cells, "extremes"))
    lines = [dataclasses.asdict(row) for row in rows]
    totals = count_verdicts(rows)
    folder = Path(args.out)
    record = run_record("extremes", config={"families": families, "quick": args.quick}, inputs={})
    texts = {"table.csv": csv_text(rows), "table.md": "# Extremes\n\n" + extremes_markdown(lines)}
    for name, text in texts.items():
        with atomic_write(folder / name) as path:
            path.write_text(text, encoding="utf-8")
    for name, figure in (("heatmap", heat_map(rows)), ("curves", curves(rows))):
        for suffix in ("png", "pdf"):
            with atomic_write(folder / f"{name}.{suffix}") as path:
                save_figure(figure, path)
    write_json(folder / "record.json", {"kind": "extremes", "totals": totals, "rows": lines, "record": record})
    for row in rows:
        if row.verdict == "defect":
            print(f"defect: {row.family}/{row.kernel}: {row.condition}, {row.axis} {row.level}: {row.message}")
    print(", ".join(f"{number} {verdict}" for verdict, number in totals.items()))
    return 1 if args.strict and totals["defect"] else 0
