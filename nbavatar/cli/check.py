"""Validate a capture, or a Decaf folder, before any time is spent on it.

  nbavatar check CAPTURE [--out DIR]      reads every file of a capture (cameras.json, images, masks, alpha, meshes,
                                          splits.json), prints one line per defect and ends with exit code 2 if there
                                          is any. With --out, writes DIR/CAMERA.png, the meshes over that camera's
                                          images with the masks outlined in yellow, and DIR/overview.png: look at them.
  nbavatar check --layout decaf ROOT      lists in one message which files of the dataset and of the body models are
                                          missing, where to get them and where to put them. If none is, reads every
                                          subject and says how far its stored landmarks lie from the projected models,
                                          with and without the lens; with --out, writes DIR/SUBJECT.png.

Lengths are metres, cameras map world to camera (OpenCV axes), pixel centres lie at +0.5.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from nbavatar.cli.common import progress
from nbavatar.config.preprocess import MATTE_THRESHOLD
from nbavatar.data.capture import read_mesh, read_rgb
from nbavatar.data.capture_check import CaptureReport, check_capture
from nbavatar.data.capture_masks import CameraMasks
from nbavatar.data.decaf import CAMERAS, DecafSubject, find_subject
from nbavatar.data.decaf_check import SubjectReport, check_subject
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
    parser.add_argument("--out", metavar="DIR", help="folder for overlays")


def main(args: argparse.Namespace) -> int:
    """Prints what is wrong; 2 if anything is."""
    root = Path(args.path)
    if args.layout == "decaf":
        wanted = {s: [c for c in args.cameras if (s, c) != ("S5", "111")] for s in args.subjects}
        missing = missing_files(root, wanted)
        if missing:
            print(missing_message(root, missing), file=sys.stderr)
            return 2
        return _check_decaf(root, wanted, Path(args.out) if args.out else None)
    report = check_capture(root, progress)
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
    return 2 if report.defects else 0


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
    from nbavatar.data.overlays import mesh_over_image
    from nbavatar.image.overlay import contact_sheet
    from nbavatar.io.video import read_video

    assert report.sequence is not None
    meshes = {name: (part.verts[0], part.faces) for name, part in report.sequence.parts.items()}
    rows = []
    for name, camera in progress(report.cameras.items(), f"overlays {subject.name}"):
        image = next(read_video(subject.file("videos", f"{name}.mp4")))
        matte = next(read_video(subject.file("segmentations", f"{name}.mp4"), gray=True))
        over = mesh_over_image(image, camera, meshes, (matte > MATTE_THRESHOLD).astype(np.uint8))
        rows.append([(f"{subject.name} {name} frame 0", image), ("meshes, outline of the matte", over)])
    with atomic_write(path) as temporary:
        temporary.write_bytes(encode_png(contact_sheet(rows, cell=640), level=6))


def _outlined(masks: CameraMasks | None, frame: str) -> np.ndarray | None:
    """What is outlined in a picture: labels, or 1 where a matte is above the threshold."""
    if masks is None:
        return None
    if masks.mask is not None and masks.mask.kind == "label":
        return masks.read_mask(frame)
    matte = masks.read_coverage(frame) if masks.mask is None else masks.read_mask(frame)
    return None if matte is None else (matte > MATTE_THRESHOLD).astype(np.uint8)


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
                mesh = read_mesh(capture, frame, report.topology)
            except DataError:
                continue
            label = _outlined(report.masks.get(camera.name), frame)
            meshes = {part: (mesh[part], faces) for part, (faces, _) in report.topology.items() if part in mesh}
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
