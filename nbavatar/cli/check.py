"""Validate a capture, or a Decaf folder, before any time is spent on it.

  nbavatar check CAPTURE [--out DIR]      reads every file of a capture (cameras.json, images, masks, alpha, meshes,
                                          splits.json), prints one line per defect and ends with exit code 2 if there
                                          is any. With --out, writes DIR/CAMERA.png, the meshes over that camera's
                                          images with the masks outlined in yellow, and DIR/overview.png: look at them.
                                          The workflow does this first of all, with --overview and --record.
  nbavatar check --layout decaf ROOT      says in one line what is there of the dataset: whole, partial, packed,
                                          elsewhere, or nothing; then which files of it and of the body models are
                                          missing, where to get them and where to put them. If none is, reads every
                                          subject and says how far its stored landmarks lie from the projected models,
                                          with and without the lens; with --out, writes DIR/SUBJECT.png.

Lengths are metres, cameras map world to camera (OpenCV axes), pixel centres lie at +0.5.
"""

import argparse
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from nbavatar.checks.capture import CaptureReport, check_capture
from nbavatar.checks.decaf import SubjectReport, check_subject
from nbavatar.checks.decaf_inventory import missing_files, missing_message
from nbavatar.checks.decaf_state import state_line
from nbavatar.cli.common import add_cfg_argument, progress, stage_config
from nbavatar.config.core import to_mapping
from nbavatar.config.preprocess import MATTE_THRESHOLD, CheckConfig
from nbavatar.config.sheets import read_subjects
from nbavatar.data.capture import read_mesh, read_rgb
from nbavatar.data.decaf_files import CAMERAS, DecafSubject, find_subject
from nbavatar.errors import ConfigError, DataError, did_you_mean
from nbavatar.io.atomic import atomic_write
from nbavatar.io.images import encode_png
from nbavatar.io.records import write_json
from nbavatar.names import check_name
from nbavatar.preprocess.supplied_masks import supplied_masks
from nbavatar.provenance import run_record

__all__ = ["add_arguments", "main"]

_CELL = 320
_ROWS = 4


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options."""
    parser.add_argument("path", metavar="PATH", help="folder of the capture, or of the Decaf dataset")
    parser.add_argument("--layout", choices=("capture", "decaf"), default="capture", help="how the folder is laid out")
    parser.add_argument("--subjects", nargs="+", help="decaf: subjects that are needed (default: S1 to S4)")
    parser.add_argument("--cameras", nargs="+", default=list(CAMERAS), help="decaf: cameras that are needed")
    parser.add_argument("--sheet", metavar="TSV", help="decaf: sheet of the subjects and cameras that are needed")
    parser.add_argument("--out", metavar="DIR", help="folder for overlays")
    parser.add_argument("--overview", metavar="PNG", help="capture: one picture of all cameras, if there is no defect")
    parser.add_argument("--record", metavar="JSON", help="capture: what was found, if there is no defect")
    parser.add_argument(
        "--supplied", metavar="DIR", default="", help="capture: masks that are used in place of its own"
    )
    parser.add_argument("--subject", default="", help="capture: whose masks are taken from --supplied")
    parser.add_argument(
        "--pixel-center", type=float, default=0.5, choices=(0.0, 0.5), metavar="0|0.5",
        help="capture: where its camera matrices put the centre of pixel (0, 0) [px]; default 0.5",
    )  # fmt: skip
    add_cfg_argument(parser, CheckConfig)


def main(args: argparse.Namespace) -> int:
    """Prints what is wrong; 2 if anything is."""
    root = Path(args.path)
    if args.layout == "decaf":
        wanted = _wanted(args)
        missing = missing_files(root, wanted)
        if missing:
            print(f"nbavatar check: error: {state_line(root, wanted, missing)}", file=sys.stderr)
            print(missing_message(root, missing), file=sys.stderr)
            return 2
        return _check_decaf(root, wanted, Path(args.out) if args.out else None)
    cfg = stage_config(args, CheckConfig)
    if args.subject:
        check_name(args.subject, "--subject", error=ConfigError)
    report = check_capture(
        root,
        progress if sys.stderr.isatty() else lambda items, _: items,
        pixel_center=args.pixel_center,
        supplied=args.supplied,
        subject=args.subject,
    )
    if args.out and report.capture is not None and report.frames:
        _write_overlays(report, Path(args.out))
    for line in report.notes:
        print(f"note: {line}")
    for camera, share in report.overlap.items():
        print(f"camera {camera}: meshes and masks overlap by {share:.1%} (intersection over union)")
    for line in report.defects:
        print(f"nbavatar check: error: {line}", file=sys.stderr)
    count = len(report.defects)
    print(f"{root}: {len(report.frames)} frames, {count} defect{'' if count == 1 else 's'}")
    if report.defects and cfg.stop:
        return 2
    if args.overview:
        _write_sheet(_overview(report), Path(args.overview))
    if args.record:
        inputs = {name: root / name for name in ("cameras.json", "splits.json") if (root / name).is_file()}
        found = {"frames": len(report.frames), "defects": report.defects, "notes": report.notes}
        found |= {"overlap": report.overlap, "astray": report.astray, "folder": os.path.realpath(root)}
        write_json(args.record, run_record("check", config=to_mapping(cfg), inputs=inputs, extra=found))
    return 0


def _wanted(args: argparse.Namespace) -> dict[str, list[str]]:
    """Cameras by subject: of the sheet, or those named; S5 has no camera 111 in the release."""
    if args.sheet:
        sheet = read_subjects(args.sheet, args.path)
        for name in args.subjects or ():
            if name not in sheet:
                raise ConfigError(f"{args.sheet}: unknown subject '{name}'; {did_you_mean(name, sheet)}")
        return {name: list(one.cameras) for name, one in sheet.items() if name in (args.subjects or sheet)}
    subjects = args.subjects or ["S1", "S2", "S3", "S4"]
    return {s: [c for c in args.cameras if (s, c) != ("S5", "111")] for s in subjects}


def _check_decaf(root: Path, wanted: dict[str, list[str]], out: Path | None) -> int:
    """Reads every subject and compares its landmarks with the posed models; 2 if anything is wrong."""
    count = 0
    for name, cameras in wanted.items():
        subject = find_subject(root, name)
        report = check_subject(subject, cameras)
        count += len(report.defects)
        for line in report.notes:
            print(f"note: {line}")
        for r in report.reprojection:
            lens = f"{r.with_lens:.2f} px with the lens, {r.without_lens:.2f} px without"
            offset = f"median offset ({r.offset[0]:+.2f}, {r.offset[1]:+.2f}) px"
            print(f"{name} camera {r.camera}: {r.part} landmarks to projected model: {lens}; {offset}")
        for line in report.defects:
            print(f"nbavatar check: error: {line}", file=sys.stderr)
        if out is not None and report.sequence is not None:
            _write_decaf_sheet(subject, report, out / f"{name}.png")
    print(f"{root}: all files of {', '.join(wanted)} are there, {count} defect{'' if count == 1 else 's'}")
    return 2 if count else 0


def _write_decaf_sheet(subject: DecafSubject, report: SubjectReport, path: Path) -> None:
    """The first frame of every camera, bare and under the posed meshes as the lens sees them."""
    from nbavatar.checks.overlays import mesh_over_image
    from nbavatar.io.video import read_video
    from nbavatar.preprocess.overlay import contact_sheet

    assert report.sequence is not None
    meshes = {name: (part.verts[0], part.faces) for name, part in report.sequence.parts.items()}
    rows = []
    for name, camera in progress(report.cameras.items(), f"overlays {subject.name}"):
        image = next(read_video(subject.video(name)))
        matte = next(read_video(subject.matte(name), gray=True))
        over = mesh_over_image(image, camera, meshes, (matte > MATTE_THRESHOLD).astype(np.uint8))
        rows.append([(f"{subject.name} {name} frame 0", image), ("meshes, outline of the matte", over)])
    with atomic_write(path) as temporary:
        temporary.write_bytes(encode_png(contact_sheet(rows, cell=640), level=6))


def _outlined(report: CaptureReport, name: str, frame: str) -> np.ndarray | None:
    """What is outlined in a picture: labels, or 1 where a matte is above the threshold."""
    masks = report.masks.get(name)
    if report.supplied.folder and report.capture is not None:
        folder, subject = report.supplied
        if (meaning := report.meanings.get(name)) is None:
            return None
        own, _ = supplied_masks(folder, subject, report.capture.cameras[name], [frame], (), meaning)
        mask, labelled = next(own), meaning.kind == "label"
    elif masks is None:
        return None
    else:
        labelled = masks.mask is not None and masks.mask.kind == "label"
        mask = masks.read_coverage(frame) if masks.mask is None else masks.read_mask(frame)
    return mask if mask is None or labelled else (mask > MATTE_THRESHOLD).astype(np.uint8)


def _write_overlays(report: CaptureReport, out: Path) -> None:
    """One sheet a camera, and an overview; frames that cannot be read are left out (they are defects already)."""
    assert report.capture is not None
    chosen = [report.frames[i] for i in np.unique(np.linspace(0, len(report.frames) - 1, _ROWS).astype(int))]
    for name in report.capture.cameras:
        rows = [
            [(f"{name} {frame}", image), ("meshes, outline of masks", over)]
            for frame, image, over in _overlays(report, name, chosen)
        ]
        if rows:
            _write_sheet(rows, out / f"{name}.png", cell=max(_CELL, 480))
    overview = _overview(report)
    if overview:
        # A camera may have this name.
        taken = "overview" in report.capture.cameras
        _write_sheet(overview, out / ("overview_of_all.png" if taken else "overview.png"))


def _overview(report: CaptureReport) -> list[list[tuple[str, np.ndarray]]]:
    """The frame in the middle, or the nearest that can be read, of every camera; four in a row."""
    middle = sorted(range(len(report.frames)), key=lambda i: abs(i - len(report.frames) // 2))[:_ROWS]
    cells = []
    for name in report.capture.cameras if report.capture is not None else ():
        shown = next(_overlays(report, name, [report.frames[i] for i in middle]), None)
        if shown is not None:
            cells.append((f"{name} {shown[0]}", shown[2]))
    return [cells[i : i + 4] for i in range(0, len(cells), 4)]


def _overlays(report: CaptureReport, name: str, frames: list[str]) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """(frame, image, image under its meshes with the outline of its mask) of the frames that can be read."""
    from nbavatar.checks.overlays import mesh_over_image

    assert report.capture is not None
    camera = report.capture.cameras[name]
    for frame in frames:
        try:
            image = read_rgb(report.capture, camera, frame)
            mesh = read_mesh(report.capture, frame, report.topology)
        except DataError:
            continue
        label = _outlined(report, name, frame)
        meshes = {part: (mesh[part], faces) for part, (faces, _) in report.topology.items() if part in mesh}
        yield frame, image, mesh_over_image(image, camera, meshes, label)


def _write_sheet(rows: list[list[tuple[str, np.ndarray]]], path: Path, cell: int = _CELL) -> None:
    from nbavatar.preprocess.overlay import contact_sheet

    with atomic_write(path) as temporary:
        temporary.write_bytes(encode_png(contact_sheet(rows, cell=cell), level=6))
