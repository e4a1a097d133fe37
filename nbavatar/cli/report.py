"""One self-contained HTML page: truth, render and error at a glance, tables, pictures, training curves, provenance.

    --tables     tables (.md, and .csv to download); a .csv without its .md is shown as it is
    --evals      results of `nbavatar evaluate` (.json): figures under the pictures, provenance
    --renders    frame packs of `nbavatar render`: render, error map and billboard opacity of chosen frames
    --frames     frame packs of `nbavatar crop`: the truth beside them
    --histories  training histories (.jsonl), one a trained avatar, in <subject>/<variant>/; previews in
                 model.pt.state/previews beside them are shown where they exist
    --speeds     results of `nbavatar speed`, in <subject>/<variant>.json: with the evaluations, quality against cost
    --pictures   further pictures (.png): of the refit and the contact stage, and results of `nbavatar figure`, whose
                 titles and captions (.json beside them) are shown
    --videos     results of `nbavatar video` (.mp4): played in the page up to `video_mb`, linked beyond
    --tradeoffs  results of `nbavatar tradeoff` (tradeoff.json, and savings.json and offline.json of `--savings` and
                 `--offline`), their tables and plots beside them
    --extremes   result of `nbavatar extremes` (record.json), its table and heat map beside it
    --out        index.html; needs no network and no other file

Every part may be left out; what is not given is not shown.
"""

import argparse
import base64
import csv
import os
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from urllib.parse import quote

from nbavatar.cli.common import add_cfg_argument, stage_config
from nbavatar.cli.results import read_evaluation, read_histories, read_sweep, read_timing
from nbavatar.config.evaluation import ReportConfig
from nbavatar.errors import DataError, parsing
from nbavatar.io.atomic import atomic_write
from nbavatar.io.framepack import FramePack
from nbavatar.io.images import decode_image
from nbavatar.io.records import read_record
from nbavatar.reporting.comparison import Rendered, compare_frames, to_strip
from nbavatar.reporting.markdown import markdown_to_html
from nbavatar.reporting.opening import opening_of
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
from nbavatar.reporting.pictures import data_uri, reduce_picture
from nbavatar.studies.tradeoff.section import offline_section, savings_section, tradeoff_section

__all__ = ["add_arguments", "main", "read_renders"]


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
        ("--tradeoffs", "JSON", "sweeps of speed against accuracy"),
        ("--extremes", "JSON", "kernels at their limits"),
    ):
        parser.add_argument(name, nargs="*", default=[], metavar=kind, help=text)
    parser.add_argument(
        "--size-label", default="", metavar="TEXT", help="why figures are not comparable with the paper"
    )
    parser.add_argument("--out", required=True, metavar="HTML", help="page to write")
    add_cfg_argument(parser, ReportConfig)


def main(args: argparse.Namespace) -> int:
    """Writes the page."""
    cfg = stage_config(args, ReportConfig)
    evals = [(path, read_evaluation(path)) for path in args.evals]
    speeds = [(path, read_timing(path)) for path in args.speeds]
    with ExitStack() as stack:
        renders = read_renders([stack.enter_context(FramePack(path)) for path in args.renders], evals)
        crops = [stack.enter_context(FramePack(path)) for path in args.frames]
        comparisons = compare_frames(renders, crops, frames=cfg.frames)
        judged = {(e["subject"], e["variant"], e["protocol"]["name"]): e for _, e in evals}
        opening = opening_of(renders, crops, judged, _turntables(args.videos, cfg), max_side=cfg.max_side)
    strips = {
        f"{subject}, protocol {protocol}": [to_strip(comparison, max_side=cfg.max_side) for comparison in group]
        for (subject, protocol), group in comparisons.items()
    }
    videos = [_video(path, args.out, cfg) for path in args.videos]
    played = {opening.film} if opening else set()
    histories = read_histories(args.histories)
    pictures = [(_is_figure(path), _picture(path, cfg)) for path in args.pictures]
    measured = [(Path(path).stem, content) for path, content in speeds]
    sections = [
        ("tables", "Tables", tables_section(_tables(args.tables))),
        ("pictures", "Comparison with the truth", strips_section(strips) if strips else ""),
        ("pareto", "Quality against cost", pareto_section([content for _, content in evals], measured)),
        ("tradeoff", "Speed against accuracy", "\n".join(_sweep(Path(path), cfg) for path in args.tradeoffs)),
        ("extremes", "Kernels at their limits", "\n".join(_limits(Path(path), cfg) for path in args.extremes)),
        ("figures", "Figures", pictures_section([picture for figure, picture in pictures if figure])),
        ("videos", "Videos", videos_section([video for video in videos if video[1] not in played])),
        ("training", "Training", _training(args.histories, histories, cfg)),
        ("stages", "Geometry", pictures_section([picture for figure, picture in pictures if not figure])),
        ("provenance", "Provenance", provenance_section([*evals, *speeds]) if evals or speeds else ""),
    ]
    with atomic_write(args.out) as path:
        path.write_text(page(cfg.title, args.size_label, sections, opening), encoding="utf-8")
    print(f"{args.out}: {Path(args.out).stat().st_size / 1e6:.1f} MB")
    return 0


def _tables(paths: list[str]) -> dict[str, tuple[str, str]]:
    texts: dict[str, dict[str, str]] = {}
    for name in paths:
        path = Path(name)
        with parsing(name, "a table (.md or .csv)"):
            texts.setdefault(str(path.with_suffix("")), {})[path.suffix] = path.read_text(encoding="utf-8")
    shown = {}
    for name, found in texts.items():
        path, table = Path(name), found.get(".csv", "")
        title = path.stem if ".md" in found else f"{path.parent.name} {path.stem}"
        with parsing(f"{name}.csv", "a table (.csv)"):
            shown[title] = found.get(".md") or _as_markdown(title, table), table
    return shown


def _as_markdown(title: str, table: str) -> str:
    """A table of numbers without a layout of its own, in at most four digits; the csv has all of them.

    The first column, `group`, becomes a heading wherever it changes.
    """
    head, *rows = ([_short(cell).replace("|", "\\|") for cell in row] for row in csv.reader(table.splitlines()))
    lines = [head[1:], ["---"] * (len(head) - 1)]
    for i, (group, *cells) in enumerate(rows):
        if i == 0 or group != rows[i - 1][0]:
            lines.append([f"*{group.replace('.', ': ').replace('_', ' ')}*", *[""] * (len(cells) - 1)])
        lines.append([cells[0].replace("_", " "), *(cell or "none" for cell in cells[1:])])
    return "\n".join((f"## {title}", "", *(f"| {' | '.join(row)} |" for row in lines)))


def _short(cell: str) -> str:
    try:
        return f"{float(cell):.4g}" if "." in cell else cell
    except ValueError:
        return cell


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


# Kind of a result of `nbavatar tradeoff` -> what is said of it, and the table beside it.
_SWEEPS = {
    "tradeoff": (tradeoff_section, "points.md"),
    "savings": (savings_section, "savings.md"),
    "offline": (offline_section, "offline.md"),
}


def _sweep(path: Path, cfg: ReportConfig) -> str:
    kind, result = read_sweep(path)
    tell, table = _SWEEPS[kind]
    section = tell(result, _text(path.with_name(table)))
    named = [(caption, _embedded(path.with_name(name), cfg), caption) for name, caption in section.figures]
    rows = markdown_to_html(section.table)
    if kind == "tradeoff":
        rows = f"<details><summary>All points</summary>{rows}</details>"
    # The stages before training belong to a subject, not to one of its avatars.
    title = f"{section.title}: {' '.join(path.parts[-3:-2] if kind == 'offline' else path.parts[-3:-1])}"
    return "\n".join(
        (markdown_to_html("\n\n".join([f"## {title}", *section.paragraphs])), pictures_section(named), rows)
    )


def _limits(path: Path, cfg: ReportConfig) -> str:
    text = "Verdicts of all measurements: exact, degraded within a stated bound, or refused with a reason."
    picture = pictures_section([(text, _embedded(path.with_name("heatmap.png"), cfg), text)])
    table = markdown_to_html(_text(path.with_name("table.md")).partition("\n")[2])  # the section has its heading
    return f"{picture}\n<details><summary>All cells</summary>{table}</details>"


def _text(path: Path) -> str:
    with parsing(path, "a table (.md)"):
        return path.read_text(encoding="utf-8")


def _embedded(path: Path, cfg: ReportConfig) -> str:
    return data_uri(reduce_picture(decode_image(path), 3 * cfg.max_side))


_FIGURE = {"title?": (str, None), "caption?": (str, None), "shown?": [str]}


def _is_figure(name: str) -> bool:
    return Path(name).with_suffix(".json").is_file()


def _picture(name: str, cfg: ReportConfig) -> tuple[str, str, str]:
    """Title, embedded picture and alternative text; contact sheets keep three times the side of single pictures."""
    path = Path(name)
    title = " ".join(part for part in path.parts[-3:-1] if part not in ("", "/")) + f" {path.stem}"
    text = f"Picture of the stage {title}"
    if _is_figure(name):
        said = read_record(path.with_suffix(".json"), _FIGURE)
        title = ". ".join(part.rstrip(".") for part in (said.get("title"), said.get("caption")) if part) or path.stem
        text = f"{title}: {', '.join(said.get('shown', [])) or 'nothing yet'}"
    return title, _embedded(path, cfg), text


def beside(path: Path, page_path: Path) -> str:
    """Address of a file relative to a page. A folder's name could be read as a scheme, or end the path by a # or ?."""
    return "./" + quote(os.fsencode(os.path.relpath(path, page_path.parent).replace(os.sep, "/")))


def _turntables(names: list[str], cfg: ReportConfig) -> dict[tuple[str, str], str]:
    """(subject, variant) -> address of its turntable, of those that are put into the page."""
    found = {}
    for path in map(Path, names):
        if path.stem == "turntable" and len(path.parts) > 2 and _video_size(path) <= cfg.video_mb * 1e6:
            found[path.parts[-3], path.parts[-2]] = _video_uri(path)
    return found


def _video_size(path: Path) -> int:
    try:
        return path.stat().st_size
    except FileNotFoundError as error:
        raise DataError.of(path, expected="a video (.mp4)", found="no such file") from error


def _video_uri(path: Path) -> str:
    return "data:video/mp4;base64," + base64.b64encode(path.read_bytes()).decode("ascii")


def _video(name: str, page_path: str, cfg: ReportConfig) -> tuple[str, str, bool]:
    """Title, address, and whether the address holds the video itself (or leads to the file)."""
    path = Path(name)
    title = " ".join(part for part in path.parts[-3:-1] if part not in ("", "/")) + f" {path.stem}"
    if _video_size(path) > cfg.video_mb * 1e6:
        return title, beside(path, Path(page_path)), False
    return title, _video_uri(path), True
