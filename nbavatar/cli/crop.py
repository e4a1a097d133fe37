"""Training images of one camera: lens distortion removed, cropped to a square, resized.

Reads the frame packs of `nbavatar ingest` (rgb) and `nbavatar masks` (label, alpha; without --masks they are taken
from the first), and for box crops the mesh sequence with the tracked boxes. Writes a frame pack:

  rgb       uint8 [S, S, 3]   sRGB
  label     uint8 [S, S]      0 background, 1 head, 2 right hand, 3 left hand, 255 nothing is known
                              (something is in front, or outside the native image)
  alpha     uint8 [S, S]      coverage

with K [px] of the cropped images (K_per_frame where boxes move), distortion null, and everything else as it was.
Kinds: `center`, the largest centred square (the paper's 1024 protocol); `box`, a square over the tracked head and hand
over the whole sequence, with a margin (the paper's 512 protocol), or per frame; `full`, the whole frame.
"""

import argparse
import contextlib
import dataclasses
from typing import Any

import numpy as np

from nbavatar.cli.common import add_cfg_argument, progress, stage_config
from nbavatar.config.core import to_mapping
from nbavatar.config.preprocess import CropConfig
from nbavatar.data.sequences import read_sequence
from nbavatar.errors import ConfigError, DataError
from nbavatar.io.framepack import FramePack, FramePackWriter, mark_unseen, unseen_in
from nbavatar.preprocess.crop import Window, resize_area, resize_labels, resize_unseen
from nbavatar.preprocess.cropping import crop_extent, frame_boxes, plan_crop
from nbavatar.preprocess.foreground import estimate_foreground
from nbavatar.preprocess.sources import LAYERS, camera_of
from nbavatar.provenance import run_record

__all__ = ["add_arguments", "main"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options."""
    parser.add_argument("--frames", required=True, metavar="ZIP", help="frame pack of `nbavatar ingest`")
    parser.add_argument("--masks", metavar="ZIP", help="frame pack of `nbavatar masks`; default: labels of --frames")
    parser.add_argument("--meshes", metavar="NPZ", help="mesh sequence; needed for box crops")
    parser.add_argument("--out", required=True, metavar="ZIP", help="frame pack to write")
    add_cfg_argument(parser, CropConfig)


def main(args: argparse.Namespace) -> None:
    """Writes the pack."""
    cfg = stage_config(args, CropConfig)
    inputs = {name: getattr(args, name) for name in ("frames", "masks", "meshes") if getattr(args, name)}
    with contextlib.ExitStack() as stack:
        pack = stack.enter_context(FramePack(args.frames))
        masks = stack.enter_context(FramePack(args.masks)) if args.masks else pack
        _check(pack, masks)
        manifest, frames = pack.manifest, pack.frames
        camera = camera_of(pack)
        if not cfg.undistort:
            camera = dataclasses.replace(camera, distortion=None)
        boxes, source, missing = None, None, []
        if cfg.kind == "box":
            if not args.meshes:
                raise ConfigError("--meshes is needed for crops of kind box")
            sequence, _ = read_sequence(args.meshes)
            boxes, source, missing = frame_boxes(sequence, camera, frames, fill=cfg.per_frame)
        options = {key: getattr(cfg, key) for key in ("kind", "size", "pad", "per_frame", "multiple")}
        plan = plan_crop(camera, frames, boxes=boxes, **options)
        extra = {"subject": manifest["subject"], "camera": camera.name, "boxes": source, "missing_boxes": missing,
                 "outside": crop_extent(plan, camera), "window": list(plan.windows[frames[0]])}  # fmt: skip
        record = run_record("crop", config=to_mapping(cfg), inputs=inputs, extra=extra)
        layers = {name: LAYERS[name] for name in ("rgb", "label", "alpha")}
        target: dict[str, Any] = {**manifest, "stage": "crop", "layers": layers, "record": record, "distortion": None,
                                  "width": plan.size, "height": plan.size, "K": plan.K[frames[0]].tolist(),
                                  "unseen": False}  # fmt: skip
        if plan.moving:
            target["K_per_frame"] = {frame: plan.K[frame].tolist() for frame in frames}
        with FramePackWriter(args.out, target) as out:
            window, outside = None, np.zeros(0, bool)
            for frame in progress(frames, f"crop {manifest['subject']}/{camera.name}", len(frames)):
                if window is None or (window.x0, window.y0, window.side) != plan.windows[frame]:
                    window = Window(*plan.windows[frame], camera.K, camera.distortion)
                    outside = window.unseen(camera.height, camera.width, plan.size)
                given, unseen = masks.read("label", frame), outside
                label = window.cut(given, labels=True)
                if (hidden := unseen_in(given)).any():
                    covered = window.cut(np.where(hidden, np.uint8(255), np.uint8(0))) > 0
                    label[covered] = 0
                    unseen = outside | resize_unseen(covered, plan.size)
                alpha = window.cut(masks.read("alpha", frame))
                rgb = window.cut(pack.read("rgb", frame))
                rgb = resize_area(rgb, plan.size)
                label, alpha = resize_labels(label, alpha, plan.size)
                out.manifest["unseen"] |= bool(unseen.any())
                mark_unseen(label, alpha, unseen)
                out.add("rgb", frame, estimate_foreground(rgb, alpha) if cfg.edge_color else rgb)
                out.add("label", frame, label)
                out.add("alpha", frame, alpha)


def _check(pack: FramePack, masks: FramePack) -> None:
    for layer, source in (("rgb", pack), ("label", masks), ("alpha", masks)):
        if layer not in source.layers:
            fix = "run `nbavatar masks` and give its result by --masks" if source is pack and layer != "rgb" else ""
            raise DataError.of(source.path, "layers", expected=layer, found=", ".join(source.layers), fix=fix)
    for key in ("subject", "camera", "width", "height", "frames"):
        if pack.manifest[key] != masks.manifest[key]:
            here, there = pack.manifest[key], masks.manifest[key]
            expected, found = (f"{len(v)} frames" if isinstance(v, list) else v for v in (here, there))
            raise DataError.of(masks.path, key, expected=f"{expected} as in {pack.path}", found=found)
