"""Writes a complete synthetic dataset in the layout of the Decaf release, with licence-free body models.

Everything a reader of the release needs is written below --out: body models and index files in `assets/`, and for
each subject videos and mask videos (mp4) of every camera, keypoints with confidence, boxes, contacts, deformations,
parameters, cameras and cuts, in `train/` or `test/` as in the release (S1, S3, S6 in `test/`). Lengths are metres,
angles radians, pixels those of the full, distorted frame. With {"layout": "capture"} each subject is a capture of its
own instead, in --out/SUBJECT: images of pinhole cameras, exact masks, meshes with a tracker's error.

The people are made from MakeHuman's CC0 base mesh; the dents under the fingers come from a biharmonic displacement
field, not from the simulation of `nbavatar deform`, so they can serve as a reference for it. The same options and
seed give the same files.

examples:
  nbavatar synthesize --out resources/SyntheticDecaf
  nbavatar synthesize --out /tmp/tiny --cfg '{"mesh": "tiny", "subjects": ["S2"], "width": 128, "height": 72,
  "frames": 14}'
  nbavatar synthesize --out /tmp/captures --cfg '{"layout": "capture", "hair": "ponytail", "subjects": ["S2"],
  "width": 512, "height": 512, "focal": 2.3, "frames": 24}'
"""

import argparse
import os
from pathlib import Path

from nbavatar.cli.common import add_cfg_argument, progress, stage_config
from nbavatar.config.core import to_mapping
from nbavatar.config.synthetic import SynthesizeConfig

__all__ = ["add_arguments", "main"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options of the verb."""
    parser.add_argument("--out", required=True, type=Path, help="folder of the dataset; made if absent")
    parser.add_argument("--jobs", type=int, default=0, help="threads that render (default: all processors)")
    add_cfg_argument(parser, SynthesizeConfig)


def main(args: argparse.Namespace) -> int:
    """Runs the verb."""
    config = stage_config(args, SynthesizeConfig)
    from nbavatar.data.synthetic.dataset import write_dataset
    from nbavatar.provenance import run_record

    options = to_mapping(config)
    write_dataset(
        args.out,
        **{
            **options,
            "subjects": config.subjects,
            "cameras": config.cameras,
            "press": config.press * 1e-3,
        },
        workers=args.jobs or os.cpu_count() or 1,
        progress=progress,
        record=run_record("synthesize", config=options, inputs={}, device="cpu", seed=config.seed),
    )
    return 0
