"""An mp4 of an avatar: a turntable, or a sequence of meshes that drives it. Or of pictures that exist already.

    --model    model.pt of `nbavatar train`
    --meshes   mesh sequence (.npz): of the subject itself, or of `nbavatar reenact`
    --camera   frame pack (.zip) of `nbavatar crop`: its camera is the one that looks, or that the turntable starts from
    --kind     turntable: one frame, the camera going around it; driven: every frame, the camera at rest
    --render   instead of all these: a frame pack of `nbavatar render`, whose pictures become the frames
    --out      mp4 (VP9, or mp4v by option), and a record beside it: <out>.json

Needs OpenCV (package opencv-contrib-python-headless, extra `pipeline`) to encode; rendering itself does not, so a
node without it can run `nbavatar render`, and this command elsewhere with --render. One picture is in memory at a time.
"""

import argparse
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from nbavatar.cli.common import add_cfg_argument, progress, stage_config
from nbavatar.cli.settings import add_engine_argument, take_engine
from nbavatar.config.core import to_mapping
from nbavatar.config.evaluation import AUTO, EAGER, VideoConfig
from nbavatar.devices import device_name, lease_device
from nbavatar.errors import ConfigError, DataError, did_you_mean
from nbavatar.io.records import write_json
from nbavatar.io.video import VideoWriter
from nbavatar.provenance import run_record

if TYPE_CHECKING:
    import numpy as np

__all__ = ["add_arguments", "main"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options of `nbavatar video`."""
    parser.add_argument("--model", metavar="PT", help="trained avatar")
    parser.add_argument("--meshes", metavar="NPZ", help="mesh sequence")
    parser.add_argument("--camera", metavar="ZIP", help="frame pack of the camera that looks")
    parser.add_argument("--render", metavar="ZIP", help="pictures to encode as they are")
    parser.add_argument("--kind", default="driven", choices=("driven", "turntable"), help="what moves")
    parser.add_argument("--frame", metavar="ID", help="turntable: which frame; the middle one by default")
    parser.add_argument("--device", default="auto", choices=("auto", "cpu", "cuda"), help="where to compute")
    parser.add_argument("--out", required=True, metavar="MP4", help="video to write")
    add_engine_argument(parser, AUTO)
    add_cfg_argument(parser, VideoConfig)


def main(args: argparse.Namespace) -> int:
    """Runs `nbavatar video`."""
    given = {name: getattr(args, name) for name in ("model", "meshes", "camera", "render") if getattr(args, name)}
    if set(given) not in ({"render"}, {"model", "meshes", "camera"}):
        found = ", ".join(f"--{name}" for name in given) or "none"
        raise ConfigError.of("nbavatar video", expected="--model, --meshes and --camera, or --render", found=found)
    if Path(args.out).suffix != ".mp4":
        raise ConfigError.of("--out", expected="a name that ends in .mp4", found=args.out)
    cfg = stage_config(args, VideoConfig)
    with lease_device("cpu" if args.render else args.device) as device:
        engine, count, pictures = (EAGER, *_stored(args, cfg)) if args.render else _rendered(args, cfg, device)
        with VideoWriter(args.out, cfg.fps, cfg.codec) as writer:
            for picture in progress(pictures, f"video {args.kind}", count):
                writer.add(picture)
        config = to_mapping(cfg) | {"kind": args.kind, "frame": args.frame, "engine": engine}
        record = run_record("video", config=config, inputs=given, device=device_name(device))
    write_json(f"{args.out}.json", {"kind": "video", "frames": count, "record": record})
    print(f"{args.out}: {count} frames, {count / cfg.fps:.1f} s, {Path(args.out).stat().st_size / 1e6:.1f} MB")
    return 0


def _stored(args: argparse.Namespace, cfg: VideoConfig) -> tuple[int, Iterator["np.ndarray"]]:
    from nbavatar.io.framepack import FramePack

    pack = FramePack(args.render)
    names = pack.frames[: cfg.max_frames]

    def pictures() -> Iterator["np.ndarray"]:
        with pack:
            for name in names:
                yield pack.read("rgb", name)

    return len(names), pictures()


def _rendered(args: argparse.Namespace, cfg: VideoConfig, device: str) -> tuple[str, int, Iterator["np.ndarray"]]:
    from nbavatar.config.evaluation import ProtocolConfig
    from nbavatar.data.sequences import read_sequence
    from nbavatar.evaluation.orbit import driven_views, turntable_views
    from nbavatar.evaluation.render import check_parts, render_views
    from nbavatar.io.framepack import FramePack
    from nbavatar.methods.storage import load_avatar

    avatar = load_avatar(args.model, device)
    engine = take_engine(args, avatar, device)
    sequence, _ = read_sequence(args.meshes)
    check_parts(avatar, sequence)
    with FramePack(args.camera) as pack:
        manifest, camera = pack.manifest, pack.cam_from_world
        K = pack.intrinsics(pack.frames[0])
        per_frame = {frame: pack.intrinsics(frame) for frame in pack.frames} if manifest.get("K_per_frame") else {}
    if args.kind == "turntable":
        row = len(sequence.frames) // 2
        if args.frame is not None:
            if args.frame not in sequence.frames:
                raise DataError.of(args.meshes, f"frame {args.frame}", expected="a frame of the sequence",
                                   found="none", fix=did_you_mean(args.frame, sequence.frames))  # fmt: skip
            row = sequence.frames.index(args.frame)
        count = max(1, round(cfg.seconds * cfg.fps))
        views = turntable_views(sequence, row, manifest, K, camera, count, arc=math.radians(cfg.arc))
    else:
        rows = list(range(len(sequence.frames)))[: cfg.max_frames]
        # A reenactment's frames are another subject's: per-frame crops of this camera say nothing about them.
        own = per_frame if "driver" not in sequence.extras else {}
        views = driven_views(sequence, rows, manifest, K, camera)
        views = [view._replace(K=view.K.new_tensor(own[view.frame])) if view.frame in own else view for view in views]
    pictures = render_views(avatar, sequence, views, ProtocolConfig(), device=device)
    return engine, len(views), (picture.rgb for picture in pictures)
