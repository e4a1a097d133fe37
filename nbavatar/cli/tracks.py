"""Posed meshes of a subject, from dataset parameters or a capture's own meshes.

Reads, by --layout,

  decaf     ROOT/{train,test}/params/S/params_smoothed.pkl, head_keys, right_hand_keys, head_bbs, right_hand_bbs,
            contacts, deformations, cameras, cutIDs and ROOT/assets with FLAME (generic_model.pkl) and MANO
            (mano_v1_2/models/MANO_RIGHT.pkl)
  capture   ROOT/cameras.json, meshes/topology.npz, meshes/FRAME.npz, splits.json

and writes a mesh sequence (.npz, see `nbavatar.data.sequences`):

  frames [N]                  frame ids in time order
  PART.faces int64 [F, 3]     PART.rest float32 [V, 3] [m]     PART.verts float32 [N, V, 3] [m, world]
  extras                      parameters, keypoints, boxes, contacts, cameras, split, segments

Everything is checked on the way: frame counts of all files, numbers that are not finite, shape parameters that change
over time, stored head poses that contradict the parameters. The first defect ends the command with one line and no
output.
"""

import argparse

import numpy as np

from nbavatar.cli.common import add_cfg_argument, stage_config
from nbavatar.config.core import to_mapping
from nbavatar.config.preprocess import TracksConfig
from nbavatar.data.capture import open_capture
from nbavatar.data.capture_tracks import build_capture_tracks
from nbavatar.data.decaf import read_camera
from nbavatar.data.decaf_files import find_subject
from nbavatar.data.decaf_tracks import build_tracks
from nbavatar.data.frame_plan import plan_capture, plan_decaf
from nbavatar.data.sequences import write_sequence
from nbavatar.data.splits import split_digest
from nbavatar.errors import ConfigError
from nbavatar.names import check_name
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
    parser.add_argument(
        "--cameras", nargs="*", default=None, help="cameras whose keypoints and boxes to keep; default all"
    )
    parser.add_argument("--out", required=True, metavar="NPZ", help="mesh sequence to write")
    add_cfg_argument(parser, TracksConfig)


def main(args: argparse.Namespace) -> None:
    """Writes the sequence."""
    cfg = stage_config(args, TracksConfig)
    check_name(args.subject, "--subject", error=ConfigError)
    choice = {key: getattr(cfg, key) for key in ("start", "every", "max_frames", "test_fraction", "test_blocks")}
    if args.layout == "decaf":
        subject = find_subject(args.root, args.subject)
        names = args.cameras or subject.cameras
        read = {name: read_camera(subject, name, pixel_center=cfg.pixel_center) for name in names}
        plan = plan_decaf(subject, names, **choice)
        tolerances = {"shape_tolerance": cfg.shape_tolerance, "rotation_tolerance": cfg.rotation_tolerance}
        cameras = {name: camera for name, (camera, _) in read.items()}
        sequence, report = build_tracks(subject, cameras, plan.numbers, plan.count, **tolerances)
        report["cameras"] = {name: found for name, (_, found) in read.items()}
        inputs = {"params": subject.parameters, "cameras": subject.calibration, "cutIDs": subject.cut_file}
        inputs |= {"flame": subject.assets.flame, "mano": subject.assets.mano()}
    else:
        capture = open_capture(args.root, pixel_center=cfg.pixel_center)
        plan = plan_capture(capture, **choice)
        sequence, report = build_capture_tracks(capture, plan.frames, contact=cfg.contact)
        inputs = {name: capture.root / name for name in ("cameras.json", "splits.json", "meshes/topology.npz")}
    sequence.extras["split"] = np.array([plan.split[frame] for frame in plan.frames])
    sequence.extras["segments"] = np.array(plan.segments, dtype=np.int64).reshape(-1, 2)
    extra = {"layout": args.layout, "subject": args.subject, "split_digest": split_digest(plan.split), **report}
    write_sequence(args.out, sequence, run_record("tracks", config=to_mapping(cfg), inputs=inputs, extra=extra))
