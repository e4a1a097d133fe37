"""Render a trained avatar under a protocol.

--model     model.pt of `nbavatar train`
--meshes    mesh sequence (.npz) with the frames to show; the avatar's parts and faces
--frames    frame packs (.zip) of the cameras to show: their intrinsics, poses, sizes and split are used, not their
pixels
--protocol  JSON text or file, for example {"name": "nv1024", "split": "novel_view"}: novel view = training
            frames in a held-out camera; self-reenactment = held-out frames in the training cameras
--preset    accurate, balanced or fast: a setting that `nbavatar tradeoff` has measured, from --presets or from
            presets.json beside the model; it decides what the protocol says of precision, order and window
--max-ms    [ms a picture], --min-psnr [dB]: the best measured setting in time, the fastest that is good enough
--engine    what runs the U-Net on a CPU: torch, an inference engine by name, or auto for the fastest installed
--out       frame pack (.zip): frames "<camera>/<frame>", layers rgb (on the protocol's background), alpha (opacity of
            the picture) and nb_alpha (opacity of the billboards or Gaussians), uint8
"""

import argparse
from typing import Any

from nbavatar.cli.common import progress, read_mapping
from nbavatar.cli.settings import add_engine_argument, add_preset_arguments, take_engine, tuned_avatar
from nbavatar.config.core import from_mapping, to_mapping
from nbavatar.config.evaluation import EAGER, ProtocolConfig
from nbavatar.devices import device_name, lease_device
from nbavatar.errors import DataError
from nbavatar.provenance import run_record

__all__ = ["add_arguments", "main"]

_LAYERS = {
    "rgb": "colour on the protocol's background",
    "alpha": "opacity of the picture",
    "nb_alpha": "opacity of the rasterized primitives",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options of `nbavatar render`."""
    parser.add_argument("--model", required=True, metavar="PT", help="trained avatar")
    parser.add_argument("--meshes", required=True, metavar="NPZ", help="mesh sequence")
    parser.add_argument("--frames", nargs="+", required=True, metavar="ZIP", help="frame packs of the cameras to show")
    parser.add_argument("--protocol", default="{}", metavar="JSON|FILE", help="what to render (ProtocolConfig)")
    parser.add_argument("--out", required=True, metavar="ZIP", help="frame pack to write")
    parser.add_argument("--device", default="auto", choices=("auto", "cpu", "cuda"), help="where to compute")
    add_preset_arguments(parser, budget=True)
    add_engine_argument(parser, EAGER)


def main(args: argparse.Namespace) -> int:
    """Runs `nbavatar render`."""
    protocol = from_mapping(ProtocolConfig, read_mapping(args.protocol, "--protocol"), "--protocol")
    with lease_device(args.device) as device:
        count = _render(args, protocol, device)
    print(f"{args.out}: {count} pictures")
    return 0


def _render(args: argparse.Namespace, protocol: ProtocolConfig, device: str) -> int:
    from nbavatar.data.sequences import read_sequence
    from nbavatar.data.views import views_of
    from nbavatar.evaluation.protocols import select_frames
    from nbavatar.evaluation.render import render_views
    from nbavatar.io.framepack import FramePack, FramePackWriter
    from nbavatar.methods.storage import load_avatar

    avatar = load_avatar(args.model, device)
    methods, engine = (avatar.method,), take_engine(args, avatar, device)
    sequence, _ = read_sequence(args.meshes)
    packs = [FramePack(path) for path in args.frames]
    chosen = [
        select_frames(pack.frames, pack.manifest.get("split", {}), protocol.split, protocol.limit) for pack in packs
    ]
    views = views_of(packs, sequence.frames, chosen)
    size = views[0].width, views[0].height
    for view in views:
        if (view.width, view.height) != size:
            expected, found = f"{size[0]}x{size[1]} as the first camera", f"{view.width}x{view.height}"
            raise DataError.of(packs[view.pack].path, "size", expected=expected, found=found)
    avatar, tuned = tuned_avatar(args, avatar, device, size, protocol.preset)
    names = {id(view): f"{view.camera}/{view.frame}" for view in views}
    frames = list(names.values())
    inputs = {"model": args.model, "meshes": args.meshes} | {f"frames.{i}": path for i, path in enumerate(args.frames)}
    trained: dict[str, Any] = avatar.record.get("summary", {})
    manifest = {
        "stage": "render",
        "subject": packs[0].manifest["subject"],
        "camera": ",".join(dict.fromkeys(view.camera for view in views)),
        "width": size[0],
        "height": size[1],
        "K_per_frame": {names[id(view)]: view.K.double().tolist() for view in views},
        "cam_from_world": None,
        "cam_from_world_per_frame": {names[id(view)]: view.viewmat.double().tolist() for view in views},
        "distortion": None,
        "frames": frames,
        "split": dict.fromkeys(frames, "test" if protocol.split == "self_reenactment" else "train"),
        "segments": [],
        "layers": _LAYERS,
        "background": protocol.background,
        "record": run_record(
            "render",
            config=to_mapping(protocol),
            inputs=inputs,
            device=device_name(device),
            methods=methods,
            extra={
                "engine": engine,
                "training": {"config": avatar.record.get("config"), "code": avatar.record.get("code"), **trained},
            }
            | ({"tuned": tuned} if tuned else {}),
        ),
    }
    with FramePackWriter(args.out, manifest) as writer:
        pictures = render_views(avatar, sequence, views, protocol, device=device)
        for picture in progress(pictures, "render", len(views)):
            name = f"{picture.view.camera}/{picture.view.frame}"
            writer.add("rgb", name, picture.rgb)
            writer.add("alpha", name, picture.alpha)
            writer.add("nb_alpha", name, picture.nb_alpha)
    return len(frames)
