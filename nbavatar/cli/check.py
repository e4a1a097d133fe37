"""Validate a capture, or a Decaf folder, before any time is spent on it.

  nbavatar check CAPTURE [--out DIR]      reads every file of a capture (cameras.json, images, masks, alpha, meshes,
                                          splits.json), prints one line per defect and ends with exit code 2 if there
                                          is any. With --out, writes DIR/CAMERA.png, the meshes over that camera's
                                          images with the masks outlined in yellow, and DIR/overview.png: look at them.
  nbavatar check --layout decaf ROOT      lists in one message which files of the dataset and of the body models are
                                          missing, where to get them and where to put them.

Lengths are metres, cameras map world to camera (OpenCV axes), pixel centres lie at +0.5.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from nbavatar.cli.common import progress
from nbavatar.data.capture import read_coverage, read_mask, read_mesh, read_rgb
from nbavatar.data.capture_check import CaptureReport, check_capture
from nbavatar.data.decaf import CAMERAS
from nbavatar.data.decaf_inventory import missing_files, missing_message
from nbavatar.io.atomic import atomic_write
from nbavatar.io.images import encode_png

__all__ = ["add_arguments", "main"]

_CELL = 320
_ROWS = 4


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options."""
    parser.add_argument("path", metavar="PATH", help="folder of the capture, or of the Decaf dataset")
    parser.add_argument("--layout", choices=("capture", "decaf"), default="capture", help="how the folder is laid out")
    parser.add_argument(
        "--subjects", nargs="+", default=["S1", "S2", "S3", "S4"], help="decaf: subjects that are needed"
    )
    parser.add_argument("--cameras", nargs="+", default=list(CAMERAS), help="decaf: cameras that are needed")
    parser.add_argument("--out", metavar="DIR", help="capture: folder for overlays")


def main(args: argparse.Namespace) -> int:
    """Prints what is wrong; 2 if anything is."""
    root = Path(args.path)
    if args.layout == "decaf":
        wanted = {s: [c for c in args.cameras if (s, c) != ("S5", "111")] for s in args.subjects}
        missing = missing_files(root, wanted)
        if missing:
            print(missing_message(root, missing), file=sys.stderr)
            return 2
        print(f"{root}: all files of {', '.join(args.subjects)} are there")
        return 0
    report = check_capture(root, progress)
    if args.out and report.capture is not None:
        _write_overlays(report, Path(args.out))
    for line in report.notes:
        print(f"note: {line}")
    for camera, share in report.overlap.items():
        print(f"camera {camera}: meshes and masks overlap by {share:.1%} (intersection over union)")
    for line in report.defects:
        print(f"nbavatar check: error: {line}", file=sys.stderr)
    count = len(report.defects)
    print(f"{root}: {len(report.frames)} frames, {count} defect{'' if count == 1 else 's'}")
    return 2 if report.defects else 0


def _write_overlays(report: CaptureReport, out: Path) -> None:
    """One sheet a camera, and an overview; frames that cannot be read are left out (they are defects already)."""
    from nbavatar.data.overlays import mesh_over_image
    from nbavatar.errors import DataError
    from nbavatar.image.overlay import contact_sheet

    capture = report.capture
    assert capture is not None
    chosen = [report.frames[i] for i in np.unique(np.linspace(0, len(report.frames) - 1, _ROWS).astype(int))]
    overview = []
    for camera in progress(capture.cameras.values(), "overlays"):
        rows = []
        for frame in chosen:
            try:
                image = read_rgb(capture, camera, frame)
                mesh = read_mesh(capture.root, frame, report.topology)
                mask, alpha = read_mask(capture, camera, frame), read_coverage(capture, camera, frame)
            except DataError:
                continue
            label = mask[1] if mask else alpha
            if label is not None and label.max(initial=0) > 3:
                label = (label > 127).astype(np.uint8)
            meshes = {part: (mesh[part], faces) for part, (faces, _) in report.topology.items()}
            over = mesh_over_image(image, camera, meshes, label)
            rows.append([(f"{camera.name} {frame}", image), ("meshes, outline of masks", over)])
        if rows:
            with atomic_write(out / f"{camera.name}.png") as path:
                path.write_bytes(encode_png(contact_sheet(rows, cell=max(_CELL, 480)), level=6))
            overview.append((camera.name, rows[len(rows) // 2][1][1]))
    if overview:
        lines = [overview[i : i + 4] for i in range(0, len(overview), 4)]
        with atomic_write(out / "overview.png") as path:
            path.write_bytes(encode_png(contact_sheet(lines, cell=_CELL), level=6))
