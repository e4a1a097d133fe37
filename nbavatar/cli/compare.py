"""Quality against the time of training: every figure of variants at several budgets, with the spread over seeds.

    --evals  results of `nbavatar evaluate` (.json) of the comparison's avatars; others are passed over, and those that
             are not there yet are listed, so that a comparison can be looked at while it runs
    --out    folder: compare.md (a table a subject and protocol), compare.csv (a line an avatar and protocol), and
             <subject>_<protocol>.png (a plot a figure: PSNR, SSIM, LPIPS of both nets, PSNR and SSIM of the person,
             coverage too much and too little)
    --cfg    the comparison (variants, minutes or steps, seeds, protocols), as under `compare` in a run's file

The trainings are the workflow's: `nbavatar run compare FOLDER` makes all of it, and goes on where it was stopped.
"""

import argparse
from pathlib import Path

from nbavatar.cli.common import add_cfg_argument, stage_config
from nbavatar.cli.results import read_evaluation
from nbavatar.config.compare import CompareRun, compared
from nbavatar.errors import DataError
from nbavatar.io.atomic import atomic_write
from nbavatar.reporting.budgets import budget_cells, budget_figure, to_csv, to_markdown

__all__ = ["add_arguments", "main"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options of `nbavatar compare`."""
    parser.add_argument("--evals", nargs="+", required=True, metavar="JSON", help="evaluations")
    parser.add_argument("--out", required=True, metavar="DIR", help="folder to write to; made if absent")
    add_cfg_argument(parser, CompareRun)


def main(args: argparse.Namespace) -> int:
    """Writes table, rows and plots."""
    avatars = compared(stage_config(args, CompareRun))
    cells, missing = budget_cells(avatars, [read_evaluation(path) for path in args.evals])
    if not cells:
        wanted = avatars[0].name if avatars else "none, because --cfg names no variants"
        expected = f"evaluations of avatars of the comparison, such as {wanted}"
        raise DataError.of("--evals", expected=expected, found=f"none in {len(args.evals)} files")
    folder = Path(args.out)
    folder.mkdir(parents=True, exist_ok=True)
    for suffix, text in (("md", to_markdown(cells, missing)), ("csv", to_csv(cells))):
        with atomic_write(folder / f"compare.{suffix}") as path:
            path.write_text(text, encoding="utf-8")
    for subject, protocol in dict.fromkeys((cell.subject, cell.protocol) for cell in cells):
        own = [cell for cell in cells if (cell.subject, cell.protocol) == (subject, protocol)]
        with atomic_write(folder / f"{subject}_{protocol}.png") as path:
            budget_figure(own, f"{subject}, protocol {protocol}").savefig(path, format="png")
    print(f"{folder}/compare.md: {len(cells)} cells, {len(missing)} results missing")
    return 0
