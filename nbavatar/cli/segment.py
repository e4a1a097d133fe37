"""Masks for a capture that has none.

  nbavatar segment CAPTURE --method sam3 --model DIR      head and hands, by SAM 3 and words: labels 0..3, 255
  nbavatar segment CAPTURE --method person --model WHL    the whole person, by a small network: mattes 0..255, which the
                                                          stage `masks` cuts by the meshes

Reads cameras.json, splits.json and images/CAMERA/FRAME of the capture, and writes
  --out      CAMERA/FRAME.png; by default the capture's own masks/. A camera that has masks there is refused: nothing is
             replaced
  --sheet    CAMERA.png, the masks' outlines over some frames (default: CAPTURE/segment): look at them; and CAMERA.json,
             how they were made

sam3 needs the package transformers (pip install 'nbavatar[segment]') and SAM 3's weights in a folder; they are not ours
to give: accept their licence, then `hf download facebook/sam3 --local-dir DIR`. It follows what the prompts name
through every uncut run; use a GPU. person needs a file of 0.2 MB that the wheel of mediapipe 0.10.21 carries, which is
neither installed nor imported:

  pip download --no-deps --only-binary=:all: --python-version 3.11 mediapipe==0.10.21

Limits: person expects one person near the camera. Right and left are told apart by sam3's prompts only: look at the
pictures.
"""

import argparse
import contextlib
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from nbavatar.camera.pinhole import Camera
from nbavatar.cli.common import add_cfg_argument, progress, stage_config
from nbavatar.config.core import to_mapping
from nbavatar.config.detection import SegmentConfig
from nbavatar.config.preprocess import MATTE_THRESHOLD
from nbavatar.data.capture import Capture, Splits, open_capture, read_rgb, read_splits
from nbavatar.devices import lease_device
from nbavatar.errors import ConfigError, DataError
from nbavatar.io.atomic import atomic_write
from nbavatar.io.framepack import parts_in
from nbavatar.io.images import encode_png
from nbavatar.io.records import write_json
from nbavatar.preprocess.overlay import contact_sheet, mask_outline
from nbavatar.provenance import run_record

__all__ = ["add_arguments", "main"]

Segmenter = Callable[[Iterator[np.ndarray]], Iterator[np.ndarray]]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options."""
    parser.add_argument("capture", metavar="CAPTURE", help="folder of the capture")
    parser.add_argument("--method", choices=("sam3", "person"), required=True, help="what makes the masks")
    parser.add_argument("--model", metavar="PATH", help="sam3: folder of the weights; person: wheel of mediapipe")
    parser.add_argument("--cameras", nargs="+", metavar="NAME", help="cameras to segment; default all")
    parser.add_argument("--out", metavar="DIR", help="where CAMERA/FRAME.png go; default CAPTURE/masks")
    parser.add_argument("--sheet", metavar="DIR", help="where the pictures go; default CAPTURE/segment")
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="where sam3 runs")
    add_cfg_argument(parser, SegmentConfig)


def main(args: argparse.Namespace) -> None:
    """Writes masks and pictures, camera by camera."""
    cfg = stage_config(args, SegmentConfig)
    capture = open_capture(args.capture)
    splits = read_splits(capture.root)
    cameras = [capture.camera(name) for name in args.cameras or capture.cameras]
    out = Path(args.out) if args.out else capture.root / "masks"
    sheets = Path(args.sheet) if args.sheet else capture.root / "segment"
    for camera in cameras:
        _refuse_taken(out / camera.name, "masks")
        _refuse_taken(sheets / f"{camera.name}.png", "a picture")
    with _segmenter(args, cfg) as segment:
        for camera in cameras:
            shown = _write_camera(capture, splits, camera, segment, out, cfg, args.method == "sam3")
            rows = [shown[i : i + 3] for i in range(0, len(shown), 3)]
            with atomic_write(sheets / f"{camera.name}.png") as path:
                path.write_bytes(encode_png(contact_sheet(rows, cell=cfg.sheet_tile), level=6))
            write_json(sheets / f"{camera.name}.json", _record(args, cfg, capture))
    print(f"{out}: masks of {len(cameras)} cameras; look at {sheets}")


def _record(args: argparse.Namespace, cfg: SegmentConfig, capture: Capture) -> dict[str, Any]:
    model = Path(args.model) if args.model else None
    if model is not None and model.is_dir():
        model = next(iter(sorted(model.glob("*.safetensors"))), None)
    inputs = {name: capture.root / name for name in ("cameras.json", "splits.json")}
    inputs |= {} if model is None else {"model": model}
    return run_record("segment", config=to_mapping(cfg), inputs=inputs, extra={"method": args.method})


@contextlib.contextmanager
def _segmenter(args: argparse.Namespace, cfg: SegmentConfig) -> Iterator[Segmenter]:
    """What makes masks of the pictures of one uncut run."""
    if args.method == "person":
        from nbavatar.data.detector_models import read_matting_model
        from nbavatar.detection.matting import PersonMatting

        matting = PersonMatting(read_matting_model(args.model), refine=cfg.refine)
        yield lambda images: map(matting.matte, images)
        return
    from nbavatar.detection.sam3 import LABELS, Sam3

    words = [text for text in cfg.prompts.values() if text]
    unknown = sorted(set(cfg.prompts) - set(LABELS))
    parts = [part for part, text in cfg.prompts.items() if text and part != "covered"]
    if unknown or not parts or len(set(words)) < len(words):
        expected = f"different words for some of {', '.join(LABELS)}, a part among them"
        raise ConfigError.of("--cfg", "prompts", expected=expected, found=str(cfg.prompts))
    if not args.model:
        raise ConfigError.of("--model", expected="the folder of SAM 3's weights", found="none")
    with lease_device(args.device) as device:
        yield Sam3(Path(args.model), cfg.prompts, device).run


def _write_camera(
    capture: Capture,
    splits: Splits,
    camera: Camera,
    segment: Segmenter,
    out: Path,
    cfg: SegmentConfig,
    *,
    labelled: bool,
) -> list[tuple[str, np.ndarray]]:
    """Writes all masks of a camera, labels or mattes, or none; returns captioned pictures of some."""
    frames = splits.frames
    chosen = {frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, cfg.sheet_frames).astype(int))}
    temporary = out / f".{camera.name}.{os.getpid()}.tmp"
    shown, empty = [], 0
    try:
        temporary.mkdir(parents=True)
        for frame, image, mask in progress(
            _masks(capture, splits, camera, segment), f"segment {camera.name}", len(frames)
        ):
            label = mask if labelled else (mask > MATTE_THRESHOLD).astype(np.uint8)
            empty += not (parts_in(mask) if labelled else mask).any()
            (temporary / f"{frame}.png").write_bytes(encode_png(mask))
            if frame in chosen:
                shown.append((f"{camera.name} {frame}", mask_outline(image, label)))
        if empty == len(frames):
            fix = "try other prompts, or the other method"
            raise DataError.of(f"{capture.root}: camera {camera.name}", expected="a person", found="none", fix=fix)
        os.replace(temporary, out / camera.name)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    if empty:
        print(f"note: camera {camera.name}: nothing found in {empty} of {len(frames)} frames")
    return shown


def _masks(
    capture: Capture, splits: Splits, camera: Camera, segment: Segmenter
) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """(frame, picture, mask), one in memory at a time."""
    for first, last in splits.segments:
        last_seen: list[np.ndarray] = []

        def pictures(frames: list[str], seen: list[np.ndarray]) -> Iterator[np.ndarray]:
            for frame in frames:
                seen[:] = [read_rgb(capture, camera, frame)]
                yield seen[0]

        frames = splits.frames[first : last + 1]
        for frame, mask in zip(frames, segment(pictures(frames, last_seen))):
            yield frame, last_seen[0], mask


def _refuse_taken(path: Path, what: str) -> None:
    if path.is_file() or (path.is_dir() and any(path.iterdir())):
        fix = "move it away, or write elsewhere with --out and --sheet"
        raise DataError.of(path, expected=f"no {what} yet", found=f"{what}, which stay as they are", fix=fix)
