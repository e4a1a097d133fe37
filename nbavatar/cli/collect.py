"""All numbers of a run as one tidy table for pandas: one number a row.

    --run        name of the run
    --evals      results of `nbavatar evaluate` (.json): means over all images, values of each image, trivial answers,
                 what the training took
    --speeds     results of `nbavatar speed` (.json)
    --out        CSV: run, subject, variant, protocol, view (camera), frame, metric, value, unit, protocol_hash, size,
                 source, digest; view and frame are empty where a number is of the whole
                 (nbavatar/reporting/results.py says more)

In a notebook (identifiers stay text):

    results = pandas.read_csv("results/paper/results.csv", dtype={name: str for name in ("subject", "view", "frame")})
"""

import argparse

from nbavatar.cli.results import read_results
from nbavatar.io.atomic import atomic_write
from nbavatar.reporting.results import tidy_results

__all__ = ["add_arguments", "main"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options of `nbavatar collect`."""
    parser.add_argument("--run", default="", metavar="NAME", help="name of the run")
    parser.add_argument("--evals", nargs="*", default=[], metavar="JSON", help="evaluations")
    parser.add_argument("--speeds", nargs="*", default=[], metavar="JSON", help="timings")
    parser.add_argument("--out", required=True, metavar="CSV", help="table to write")


def main(args: argparse.Namespace) -> int:
    """Writes the table."""
    table = tidy_results(read_results([*args.evals, *args.speeds]), args.run)
    with atomic_write(args.out) as path:
        table.to_csv(path, index=False, lineterminator="\n")
    print(f"{args.out}: {len(table)} numbers")
    return 0
