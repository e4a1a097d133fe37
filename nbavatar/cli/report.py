"""One self-contained HTML page: tables, comparison pictures, training curves, provenance.

    --tables     tables (.md, and .csv to download)
    --evals      results of `nbavatar evaluate` (.json): figures under the pictures, provenance
    --renders    frame packs of `nbavatar render`: render, error map and billboard opacity of chosen frames
    --frames     frame packs of `nbavatar crop`: the truth beside them
    --histories  training histories (.jsonl), one a trained avatar, in <subject>/<variant>/; previews in
                 model.pt.state/previews beside them are shown where they exist
    --speeds     results of `nbavatar speed`, in <subject>/<variant>.json: with the evaluations, quality against cost
    --pictures   further pictures (.png): of the refit and the contact stage, and results of `nbavatar figure`, whose
                 titles and captions (.json beside them) are shown
    --videos     results of `nbavatar video` (.mp4): played in the page up to `video_mb`, linked beyond
    --figures    folder for <subject>_<protocol>_<n>.png and .pdf, training.png and .pdf: the same for print
    --out        index.html; needs no network and no other file

Every part may be left out; what is not given is not shown.
"""

import argparse
import base64
import json
import os
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from nbavatar.cli.common import add_cfg_argument, stage_config
from nbavatar.config.evaluation import ReportConfig
from nbavatar.errors import DataError
from nbavatar.io.atomic import atomic_write
from nbavatar.io.framepack import FramePack
from nbavatar.io.images import decode_image
from nbavatar.io.records import read_json
from nbavatar.reporting.comparison import ROWS, Comparison, Rendered, compare_frames, to_strip
from nbavatar.reporting.page import (
    curves_section,
    page,
    pareto_section,
    pictures_section,
    provenance_section,
    strips_section,
    tables_section,
    videos_section,
)
from nbavatar.reporting.pictures import ERROR_MAX, data_uri, reduce_picture

__all__ = ["add_arguments", "main", "read_histories", "read_renders"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options of `nbavatar report`."""
    for name, kind, text in (
        ("--tables", "FILE", "tables"),
        ("--evals", "JSON", "evaluations"),
        ("--speeds", "JSON", "timings"),
        ("--renders", "ZIP", "rendered images"),
        ("--frames", "ZIP", "ground-truth crops"),
        ("--histories", "JSONL", "training histories"),
        ("--pictures", "PNG", "further pictures"),
        ("--videos", "MP4", "videos"),
    ):
        parser.add_argument(name, nargs="*", default=[], metavar=kind, help=text)
    parser.add_argument(
        "--size-label", default="", metavar="TEXT", help="why figures are not comparable with the paper"
    )
    parser.add_argument("--figures", metavar="DIR", help="also write the comparisons as PNG and PDF figures here")
    parser.add_argument("--out", required=True, metavar="HTML", help="page to write")
    add_cfg_argument(parser, ReportConfig)


def main(args: argparse.Namespace) -> int:
    """Writes the page."""
    cfg = stage_config(args, ReportConfig)
    evals = [(path, read_json(path)) for path in args.evals]
    speeds = [(path, read_json(path)) for path in args.speeds]
    with ExitStack() as stack:
        renders = read_renders([stack.enter_context(FramePack(path)) for path in args.renders], evals)
        crops = [stack.enter_context(FramePack(path)) for path in args.frames]
        comparisons = compare_frames(renders, crops, frames=cfg.frames)
    strips = {
        f"{subject}, protocol {protocol}": [to_strip(comparison, max_side=cfg.max_side) for comparison in group]
        for (subject, protocol), group in comparisons.items()
    }
    histories = read_histories(args.histories)
    if args.figures:
        _write_figures(Path(args.figures), comparisons, histories)
    pictures = [(_is_figure(path), _picture(path, cfg)) for path in args.pictures]
    measured = [(Path(path).stem, content) for path, content in speeds]
    sections = [
        ("tables", "Tables", tables_section(_tables(args.tables))),
        ("pictures", "Comparison with the truth", strips_section(strips) if strips else ""),
        ("pareto", "Quality against cost", pareto_section([content for _, content in evals], measured)),
        ("figures", "Figures", pictures_section([picture for figure, picture in pictures if figure])),
        ("videos", "Videos", videos_section([_video(path, args.out, cfg) for path in args.videos])),
        ("training", "Training", _training(args.histories, histories, cfg)),
        ("stages", "Geometry", pictures_section([picture for figure, picture in pictures if not figure])),
        ("provenance", "Provenance", provenance_section([*evals, *speeds]) if evals or speeds else ""),
    ]
    with atomic_write(args.out) as path:
        path.write_text(page(cfg.title, args.size_label, sections), encoding="utf-8")
    print(f"{args.out}: {Path(args.out).stat().st_size / 1e6:.1f} MB")
    return 0


def _tables(paths: list[str]) -> dict[str, tuple[str, str]]:
    texts: dict[str, dict[str, str]] = {}
    for name in paths:
        path = Path(name)
        try:
            texts.setdefault(path.stem, {})[path.suffix] = path.read_text(encoding="utf-8")
        except FileNotFoundError as error:
            raise DataError.of(name, expected="a table (.md or .csv)", found="no such file") from error
    return {stem: (found.get(".md", ""), found.get(".csv", "")) for stem, found in texts.items()}


def read_renders(packs: list[FramePack], evals: list[tuple[str, Any]]) -> list[Rendered]:
    """Renders with their figures per image, where an evaluation has them."""
    figures: dict[tuple[str, str, str], dict[str, Any]] = {}
    for _, content in evals:
        key = (content["subject"], content["variant"], content["protocol"]["name"])
        figures[key] = {f"{row['camera']}/{row['frame']}": row for row in content["per_image"]}
    found = []
    for pack in packs:
        manifest = pack.manifest
        config = (manifest.get("record") or {}).get("config") or {}
        variant = manifest.get("variant") or pack.path.parent.name
        protocol = config.get("name") or pack.path.stem
        background = manifest.get("background") or config.get("background") or (1.0, 1.0, 1.0)
        per_image = figures.get((manifest["subject"], variant, protocol), {})
        found.append(Rendered(manifest["subject"], variant, protocol, background, pack, per_image))
    return found


def _write_figures(
    folder: Path, comparisons: dict[tuple[str, str], list[Comparison]], histories: dict[str, list[dict[str, Any]]]
) -> None:
    from nbavatar.reporting.figures import save_figure
    from nbavatar.reporting.gallery import comparison_rows, curves_drawn
    from nbavatar.reporting.grids import grid_figure

    figures = {"training": curves_drawn(histories).figure} if histories else {}
    for (subject, protocol), group in comparisons.items():
        for number, comparison in enumerate(group):
            columns = [(column.title, column.title) for column in comparison.columns]
            rows = comparison_rows(comparison, columns, ROWS)
            bar = ("|error|, sRGB [1]", ERROR_MAX) if any(row.name == "error" for row in rows) else None
            figures[f"{subject}_{protocol}_{number}"] = grid_figure([title for title, _ in columns], rows, bar=bar)
    for name, figure in figures.items():
        for suffix in ("png", "pdf"):
            with atomic_write(folder / f"{name}.{suffix}") as path:
                save_figure(figure, path)


def read_histories(paths: list[str]) -> dict[str, list[dict[str, Any]]]:
    """Logged lines by avatar, named by the last two folders of the file."""
    histories: dict[str, list[dict[str, Any]]] = {}
    for name in paths:
        avatar = "/".join(Path(name).parts[-3:-1])
        if avatar in histories:
            raise DataError.of(name, expected="one history an avatar", found=f"{avatar} twice")
        try:
            lines = Path(name).read_text(encoding="utf-8").splitlines()
            histories[avatar] = [json.loads(line) for line in lines if line.strip()]
        except FileNotFoundError as error:
            raise DataError.of(name, expected="a training history (.jsonl)", found="no such file") from error
        except json.JSONDecodeError as error:
            raise DataError.of(
                name, expected="one JSON object a line", found=f"text that does not parse ({error})"
            ) from error
    return histories


def _training(paths: list[str], histories: dict[str, list[dict[str, Any]]], cfg: ReportConfig) -> str:
    if not paths:
        return ""
    previews = []
    for name, avatar in zip(paths, histories, strict=True):
        # The state folder is no output of the workflow and may be gone; its last preview is a welcome extra.
        pictures = sorted((Path(name).parent / "model.pt.state" / "previews").glob("*.png"))
        if pictures:
            title, address, text = _picture(str(pictures[-1]), cfg)
            previews.append((f"{avatar}: {title}", address, f"Training preview of {avatar}: {text}"))
    shown = f"<details open><summary>Previews</summary>{pictures_section(previews)}</details>" if previews else ""
    return curves_section(histories) + shown


def _is_figure(name: str) -> bool:
    return Path(name).with_suffix(".json").is_file()


def _picture(name: str, cfg: ReportConfig) -> tuple[str, str, str]:
    """Title, embedded picture and alternative text; contact sheets keep three times the side of single pictures."""
    path = Path(name)
    title = " ".join(part for part in path.parts[-3:-1] if part not in ("", "/")) + f" {path.stem}"
    text = f"Picture of the stage {title}"
    if _is_figure(name):
        said = read_json(path.with_suffix(".json"))
        title = ". ".join(part.rstrip(".") for part in (said.get("title"), said.get("caption")) if part) or path.stem
        text = f"{title}: {', '.join(said.get('shown', [])) or 'nothing yet'}"
    picture = reduce_picture(decode_image(path), 3 * cfg.max_side)
    return title, data_uri(picture), text


def _video(name: str, page_path: str, cfg: ReportConfig) -> tuple[str, str, bool]:
    """Title, address, and whether the address holds the video itself (or leads to the file)."""
    path = Path(name)
    title = " ".join(part for part in path.parts[-3:-1] if part not in ("", "/")) + f" {path.stem}"
    try:
        size = path.stat().st_size
    except FileNotFoundError as error:
        raise DataError.of(name, expected="a video (.mp4)", found="no such file") from error
    if size > cfg.video_mb * 1e6:
        return title, os.path.relpath(path, Path(page_path).parent).replace(os.sep, "/"), False
    return title, "data:video/mp4;base64," + base64.b64encode(path.read_bytes()).decode("ascii"), True
