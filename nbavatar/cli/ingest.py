"""One camera's images, as delivered, in one frame pack.

Reads, by --layout,

  decaf     ROOT/{train,test}/videos/S/CAM.mp4, segmentations/S/CAM.mp4, cameras/S/cameras.pkl, cutIDs/S.pkl
  capture   ROOT/cameras.json, images/CAM/, masks/CAM/, alpha/CAM/, splits.json; with --images-only no masks, which
            `nbavatar masks --capture ROOT` then reads itself

and writes a frame pack (zip of PNGs and manifest.json, see `nbavatar.io.framepack`) at native size, still distorted:

  rgb       uint8 [H, W, 3]   sRGB
  person    uint8 [H, W]      matte of the whole person                       decaf, and captures with mattes
  label     uint8 [H, W]      0 background, 1 head, 2 right, 3 left hand,     captures with label masks
                              255 unknown: something else is in front
  alpha     uint8 [H, W]      coverage, 255 = full                            captures with label masks or alpha images

The manifest carries K [px, pixel centres at +0.5], cam_from_world [m], distortion, frame ids, train/test split and
uncut runs. Videos are decoded once, in order, one frame in memory; a frame count that disagrees with any other file of
the subject ends the command with one line and no output.
"""

import argparse

from nbavatar.cli.common import add_cfg_argument, progress, stage_config
from nbavatar.config.core import to_mapping
from nbavatar.config.preprocess import IngestConfig
from nbavatar.data.capture import open_capture
from nbavatar.data.decaf import read_camera
from nbavatar.data.decaf_files import find_subject
from nbavatar.data.frame_plan import manifest_of, plan_capture, plan_decaf
from nbavatar.errors import ConfigError
from nbavatar.io.framepack import FramePackWriter
from nbavatar.names import check_name
from nbavatar.preprocess.capture_masks import CameraMasks, open_masks
from nbavatar.preprocess.sources import LAYERS, capture_images, capture_layers, decaf_images
from nbavatar.provenance import run_record

__all__ = ["add_arguments", "main"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options."""
    parser.add_argument(
        "--layout", choices=("decaf", "capture"), required=True, help="how the input folder is laid out"
    )
    parser.add_argument("--root", required=True, metavar="DIR", help="dataset or capture folder")
    parser.add_argument(
        "--subject", required=True, help="subject, such as S2 (for captures: any name, kept in the record)"
    )
    parser.add_argument("--camera", required=True, help="camera id, such as 084")
    parser.add_argument("--images-only", action="store_true", help="captures: leave masks and alpha out")
    parser.add_argument("--out", required=True, metavar="ZIP", help="frame pack to write")
    add_cfg_argument(parser, IngestConfig)


def main(args: argparse.Namespace) -> None:
    """Writes the pack."""
    cfg = stage_config(args, IngestConfig)
    check_name(args.subject, "--subject", error=ConfigError)
    choice = {key: getattr(cfg, key) for key in ("start", "every", "max_frames", "test_fraction", "test_blocks")}
    if args.layout == "decaf":
        subject = find_subject(args.root, args.subject)
        camera, report = read_camera(subject, args.camera, pixel_center=cfg.pixel_center)
        plan = plan_decaf(subject, [args.camera], **choice)
        layers: tuple[str, ...] = ("rgb", "person")
        images = decaf_images(subject, camera, plan)
        names = ("videos", "segmentations", "cameras", "cutIDs")
        inputs = {str(name): path for name, path in zip(names, subject.camera_files(args.camera), strict=True)}
        report["folder"], unseen = subject.folder, False
    else:
        capture = open_capture(args.root, pixel_center=cfg.pixel_center)
        camera, report = capture.camera(args.camera), {}
        plan = plan_capture(capture, **choice)
        masks = CameraMasks(capture.root, camera, None, None)
        if not args.images_only:
            masks = open_masks(capture, camera, plan.frames)
            report["masks"] = masks.summary()
        layers = capture_layers(masks)
        images = capture_images(capture, masks, plan.frames)
        unseen = masks.mask is not None and masks.mask.unseen
        inputs = {name: capture.root / name for name in ("cameras.json", "splits.json")}
    extra = {
        "layout": args.layout,
        "subject": args.subject,
        "camera": args.camera,
        "source_frames": plan.count,
        **report,
    }
    record = run_record("ingest", config=to_mapping(cfg), inputs=inputs, extra=extra)
    meanings = {name: LAYERS[name] for name in layers}
    manifest = manifest_of(plan, camera, stage="ingest", subject=args.subject, layers=meanings, record=record)
    manifest["unseen"] = unseen
    with FramePackWriter(args.out, manifest) as pack:
        for frame, pictures in progress(images, f"ingest {args.subject}/{args.camera}", len(plan.frames)):
            for layer, picture in pictures.items():
                pack.add(layer, frame, picture)
