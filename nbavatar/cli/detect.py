"""Keypoints of face and hands in recorded images, for captures that bring none.

MediaPipe's face and hand networks (Apache-2.0), run by OpenCV on the CPU. Their files are data of the package
mediapipe 0.10.21, which is neither installed nor imported; its wheel is enough:

  pip download --no-deps --only-binary=:all: --python-version 3.11 mediapipe==0.10.21
  nbavatar detect --frames packs/*.zip --models mediapipe-0.10.21-*.whl --out keypoints.npz --sheet keypoints.png
  nbavatar fit --tracks keypoints.npz --frames packs/*.zip --assets ASSETS --out meshes.npz --sheet fit.png

Reads
  --frames   frame packs (.zip, `nbavatar ingest`) of at least two cameras, with the same frames: layer rgb, and where
             there is one, label (or person), which tells where to search and which hand is which
  --models   the wheel, or the folder it is installed in; default: the installed package
and writes
  --out      arrays (.npz) that `nbavatar fit --tracks` reads:
             frames [N]                         frame ids
             keypoints.head.<camera>            float32 [N, 68, 3]  x, y [px, distorted full frame], confidence
             keypoints.right_hand.<camera>      float32 [N, 21, 3]  the same; joints in MANO's order; also left_hand
             camera.<camera>.{K [3, 3], cam_from_world [4, 4], distortion, size [width, height]}
             segments [R, 2], split [N]         uncut runs; train or test
             A confidence of 0 is a missing point. A part that no two cameras see at the same time is left out.
  --sheet    picture (.png) with the points over the images: look at it before fitting

Confidence is the network's certainty that there is a face or a hand, for faces times how well the point corresponds to
a landmark of FLAME (contour 0.1, brows 0.6, others 1) and how far the surface there is turned towards the camera.
Where there are no label masks, the network tells right from left hands; images must not be mirrored.
"""

import argparse
import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from nbavatar.cli.common import add_cfg_argument, progress, stage_config
from nbavatar.config.core import to_mapping
from nbavatar.config.detection import DetectConfig
from nbavatar.data.detector_models import read_detector_models
from nbavatar.detection.sheet import draw_keypoints, sheet_frames
from nbavatar.detection.stage import COUNTS, Detector, keep_parts
from nbavatar.errors import ConfigError, DataError
from nbavatar.io.arrays import write_arrays
from nbavatar.io.atomic import atomic_write
from nbavatar.io.framepack import FramePack
from nbavatar.io.images import encode_png
from nbavatar.provenance import run_record

__all__ = ["add_arguments", "main"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options."""
    parser.add_argument("--frames", nargs="+", required=True, metavar="ZIP", help="frame packs of the cameras to use")
    parser.add_argument("--models", metavar="WHL|DIR", help="wheel of mediapipe 0.10.21, or where it is installed")
    parser.add_argument("--out", required=True, metavar="NPZ", help="keypoints to write")
    parser.add_argument("--sheet", metavar="PNG", help="picture of the keypoints to write")
    add_cfg_argument(parser, DetectConfig)


def main(args: argparse.Namespace) -> None:
    """Detects and writes."""
    cfg = stage_config(args, DetectConfig)
    if not cfg.parts:
        raise ConfigError.of("--cfg", "parts", expected="at least one part", found="none")
    with contextlib.ExitStack() as stack:
        packs = _open_packs([stack.enter_context(FramePack(path)) for path in args.frames])
        models = read_detector_models(args.models)
        manifest = next(iter(packs.values())).manifest
        frames: list[str] = manifest["frames"]
        segments = manifest.get("segments", [[0, len(frames) - 1]])
        detector = Detector(models, cfg)
        keypoints: dict[str, dict[str, np.ndarray]] = {part: {} for part in COUNTS if part in cfg.parts}
        for camera, pack in packs.items():
            run = detector.run(_images(pack), [first for first, _ in segments])
            rows = list(progress(run, f"detect {manifest['subject']}/{camera}", len(frames)))
            for part, cameras in keypoints.items():
                cameras[camera] = np.stack([row[part] for row in rows])
        arrays, report = keep_parts(keypoints, cfg.least_share)
        sheet = _sheet(packs, frames, arrays, cfg) if args.sheet else None
    arrays["frames"] = np.array(frames)
    arrays["segments"] = np.array(segments, dtype=np.int64).reshape(-1, 2)
    if manifest.get("split"):
        arrays["split"] = np.array([manifest["split"].get(frame, "train") for frame in frames])
    for camera, pack in packs.items():
        arrays |= _camera_arrays(camera, pack)
    for part, found in report.items():
        counts = ", ".join(f"{camera} {count}" for camera, count in found["frames"].items())
        state = "" if found["kept"] else "; left out"
        print(f"{part}: in {found['frames_in_two_cameras']} of {len(frames)} frames by two cameras ({counts}){state}")
    inputs = {camera: pack.path for camera, pack in packs.items()}
    record = run_record("detect", config=to_mapping(cfg), inputs=inputs, extra={"detect": report})
    write_arrays(args.out, arrays, record)
    if sheet is not None:
        with atomic_write(args.sheet) as temporary:
            temporary.write_bytes(encode_png(sheet))


def _open_packs(opened: Sequence[FramePack]) -> dict[str, FramePack]:
    """Camera -> pack, checked: recorded images, one pack a camera, the same frames in all."""
    packs: dict[str, FramePack] = {}
    for pack in opened:
        camera = str(pack.manifest["camera"])
        if "rgb" not in pack.layers:
            raise DataError.of(pack.path, "layers", expected="rgb", found=", ".join(pack.layers) or "none")
        if "K" not in pack.manifest:
            fix = "give the packs of `nbavatar ingest`, not crops"
            raise DataError.of(pack.path, "K", expected="one camera matrix for all frames", found="none", fix=fix)
        if camera in packs:
            raise DataError.of(
                pack.path, "camera", expected="one pack for each camera", found=f"{camera} in {packs[camera].path} too"
            )
        first = next(iter(packs.values()), pack)
        for key in ("frames", "segments"):
            ours, theirs = pack.manifest.get(key), first.manifest.get(key)
            if ours != theirs:
                raise DataError.of(
                    pack.path, key, expected=f"the same as in {first.path}",
                    found=f"others ({len(ours or ())} against {len(theirs or ())})",
                )  # fmt: skip
        packs[camera] = pack
    if len(packs) < 2:
        fix = "one camera gives no depth"
        raise DataError.of("--frames", expected="packs of two cameras or more", found=len(packs), fix=fix)
    return packs


def _images(pack: FramePack) -> Iterator[tuple[np.ndarray, np.ndarray | None, bool]]:
    """(image, mask or None, whether it has labels) of every frame, one in memory."""
    layer = next((name for name in ("label", "person") if name in pack.layers), None)
    for frame in pack.frames:
        image = pack.read("rgb", frame)
        mask = None if layer is None else pack.read(layer, frame)
        yield image, mask, layer == "label"


def _camera_arrays(camera: str, pack: FramePack) -> dict[str, np.ndarray]:
    """Calibration, as `nbavatar tracks` writes it."""
    distortion = pack.manifest.get("distortion")
    return {
        f"camera.{camera}.K": np.array(pack.manifest["K"], dtype=np.float64),
        f"camera.{camera}.cam_from_world": pack.cam_from_world,
        f"camera.{camera}.distortion": np.zeros(12) if distortion is None else np.array(distortion, dtype=np.float64),
        f"camera.{camera}.size": np.array([pack.manifest["width"], pack.manifest["height"]]),
    }


def _sheet(packs: dict[str, FramePack], frames: list[str], arrays: dict[str, Any], cfg: DetectConfig) -> np.ndarray:
    rows = []
    for number in sheet_frames(len(frames), cfg.sheet_frames):
        row = []
        for camera, pack in packs.items():
            names = {part: f"keypoints.{part}.{camera}" for part in COUNTS}
            found = {part: arrays[name][number] for part, name in names.items() if name in arrays}
            row.append((f"{camera}  frame {frames[number]}", pack.read("rgb", frames[number]), found))
        rows.append(row)
    return draw_keypoints(rows, cfg.sheet_tile)
