"""One figure for print, as PNG and PDF: which one, and what it shows, is said in config/figures.yaml.

    --figure     name in the layout: novel_view, ablation, features, cross_reenactment, contact, training, pareto ...
    --layout     config/figures.yaml
    --renders    frame packs of `nbavatar render` (comparison)
    --frames     frame packs of `nbavatar crop`: truth, labels for the place of contact, cameras
    --evals      results of `nbavatar evaluate` (pareto, and PSNR in comparisons)
    --speeds     results of `nbavatar speed`, in <subject>/<variant>.json (pareto)
    --histories  training histories, in <subject>/<variant>/ (curves)
    --models     model.pt of `nbavatar train`, in <subject>/<variant>/ (features, reenactment)
    --sequences  mesh sequences (.npz), named by their subject (features, contact); of `nbavatar reenact`, in
                 <source>/<target>.npz (reenactment)
    --out-stem   writes STEM.png, STEM.pdf and STEM.json (caption, frames shown, run record)

What is not given is left out; a figure with nothing to show says so in its picture. Only features and reenactment
compute (a picture or a few); they need torch, the others do not.
"""

import argparse
from contextlib import ExitStack
from pathlib import Path

from nbavatar.cli.report import read_renders
from nbavatar.cli.results import read_evaluation, read_histories, read_timing
from nbavatar.config.core import to_mapping
from nbavatar.config.figures import FigureLayout, choose_figure, read_figures
from nbavatar.data.sequences import MeshSequence, read_sequence
from nbavatar.io.atomic import atomic_write
from nbavatar.io.framepack import FramePack
from nbavatar.io.records import write_json
from nbavatar.provenance import run_record
from nbavatar.reporting.gallery import (
    Drawn,
    comparison_drawn,
    contact_drawn,
    curves_drawn,
    pareto_drawn,
    pictures_drawn,
)

__all__ = ["add_arguments", "main"]

_INPUTS = (
    ("renders", "ZIP", "rendered images"),
    ("frames", "ZIP", "ground-truth crops"),
    ("evals", "JSON", "evaluations"),
    ("speeds", "JSON", "timings"),
    ("histories", "JSONL", "training histories"),
    ("models", "PT", "trained avatars"),
    ("sequences", "NPZ", "mesh sequences"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options of `nbavatar figure`."""
    parser.add_argument("--figure", required=True, metavar="NAME", help="which figure")
    parser.add_argument("--layout", default="config/figures.yaml", metavar="YAML", help="layout of the figures")
    for name, kind, text in _INPUTS:
        parser.add_argument(f"--{name}", nargs="*", default=[], metavar=kind, help=text)
    parser.add_argument("--size-label", default="", metavar="TEXT", help="why it is not what the paper shows")
    parser.add_argument("--out-stem", required=True, metavar="STEM", help="where to write, without suffix")


def main(args: argparse.Namespace) -> int:
    """Draws one figure."""
    from nbavatar.reporting.figures import label_figure, save_figure

    layout = choose_figure(read_figures(args.layout), args.figure, args.layout)
    drawn = _draw(args, layout)
    label_figure(drawn.figure, args.size_label)
    for suffix in ("png", "pdf"):
        with atomic_write(f"{args.out_stem}.{suffix}") as path:
            save_figure(drawn.figure, path)
    files = [path for name, _, _ in _INPUTS for path in getattr(args, name)]
    inputs = {"layout": args.layout} | {f"inputs.{i}": path for i, path in enumerate(files)}
    record = run_record("figure", config={"figure": args.figure} | to_mapping(layout), inputs=inputs)
    content = {"kind": "figure", "title": layout.title, "caption": layout.caption, "shown": drawn.shown}
    content |= {"label": args.size_label} if args.size_label else {}
    write_json(f"{args.out_stem}.json", content | {"record": record})
    print(f"{args.out_stem}.png: {', '.join(drawn.shown) or 'nothing to show'}")
    return 0


def _draw(args: argparse.Namespace, layout: FigureLayout) -> Drawn:
    if layout.kind == "curves":
        return curves_drawn(read_histories(args.histories))
    if layout.kind == "pareto":
        speeds = [(Path(path).stem, read_timing(path)) for path in args.speeds]
        return pareto_drawn([read_evaluation(path) for path in args.evals], speeds, layout.protocol)
    with ExitStack() as stack:
        crops = [stack.enter_context(FramePack(path)) for path in args.frames]
        if layout.kind == "comparison":
            packs = [stack.enter_context(FramePack(path)) for path in args.renders]
            evals = [(path, read_evaluation(path)) for path in args.evals]
            return comparison_drawn(read_renders(packs, evals), crops, layout)
        if layout.kind == "contact":
            return contact_drawn(_sequences(args.sequences, layout), crops, layout.frames)
        return pictures_drawn(*_showcase(args, layout, crops))


def _showcase(args: argparse.Namespace, layout: FigureLayout, crops: list[FramePack]) -> tuple:
    # torch is imported for these two kinds only.
    from nbavatar.evaluation.showcase import show_features, show_reenactment
    from nbavatar.methods.storage import load_avatar

    models = {Path(path).parts[-3]: path for path in args.models if Path(path).parts[-2] == layout.variant}
    avatars = {subject: load_avatar(path) for subject, path in models.items() if layout.shows(subject)}
    if layout.kind == "features":
        return show_features(avatars, _sequences(args.sequences, layout), crops, layout.frames)
    driven = {
        (Path(path).parts[-2], Path(path).stem): read_sequence(path)[0]
        for path in args.sequences
        if layout.shows(Path(path).parts[-2])
    }
    return show_reenactment(avatars, driven, crops, layout.frames)


def _sequences(paths: list[str], layout: FigureLayout) -> dict[str, MeshSequence]:
    return {Path(path).stem: read_sequence(path)[0] for path in paths if layout.shows(Path(path).stem)}
