"""Time rasterization and neural rendering of a trained avatar.

    --model    model.pt of `nbavatar train`
    --meshes   mesh sequence (.npz)
    --frames   frame packs (.zip): cameras and picture sizes; pixels are not read
    --preset   accurate, balanced or fast: time a setting that `nbavatar tradeoff` has measured (--presets, or
               presets.json beside the model)
    --engine   an inference engine whose U-Net and whole picture are timed beside torch's (auto: the best installed)
    --out      JSON: median milliseconds per stage (pose, raster with neural textures and with RGB, U-Net per
               arithmetic and by the engine, compose, total; a baseline has fewer), frames a second, picture size,
               number of primitives, size of the model, what its training took, peak memory, device, engine, threads

Run it alone on its device. Figures of small test subjects carry their picture size and number of billboards, and
compare with nothing else.
"""

import argparse
import os

from nbavatar.cli.common import add_cfg_argument, stage_config
from nbavatar.cli.settings import add_engine_argument, add_preset_arguments, take_engine, tuned_avatar
from nbavatar.config.core import to_mapping
from nbavatar.config.evaluation import AUTO, SpeedConfig
from nbavatar.devices import device_name, lease_device
from nbavatar.io.records import write_json
from nbavatar.provenance import run_record

__all__ = ["add_arguments", "main"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options of `nbavatar speed`."""
    parser.add_argument("--model", required=True, metavar="PT", help="trained avatar")
    parser.add_argument("--meshes", required=True, metavar="NPZ", help="mesh sequence")
    parser.add_argument("--frames", nargs="+", required=True, metavar="ZIP", help="frame packs of the cameras to time")
    parser.add_argument("--out", required=True, metavar="JSON", help="record to write")
    parser.add_argument("--device", default="auto", choices=("auto", "cpu", "cuda"), help="where to compute")
    add_preset_arguments(parser, budget=False)
    add_engine_argument(parser, AUTO)
    add_cfg_argument(parser, SpeedConfig)


def main(args: argparse.Namespace) -> int:
    """Runs `nbavatar speed`."""
    config = stage_config(args, SpeedConfig)
    with lease_device(args.device) as device:
        from nbavatar.data.sequences import read_sequence
        from nbavatar.data.views import views_of
        from nbavatar.evaluation.protocols import select_frames
        from nbavatar.evaluation.speed import measure_speed
        from nbavatar.io.framepack import FramePack
        from nbavatar.methods.storage import load_avatar

        avatar = load_avatar(args.model, device)
        methods, engine = (avatar.method,), take_engine(args, avatar, device)
        sequence, _ = read_sequence(args.meshes)
        packs = [FramePack(path) for path in args.frames]
        wanted = max(1, config.frames // len(packs))
        chosen = [select_frames(pack.frames, {}, "all", wanted) for pack in packs]
        views = views_of(packs, sequence.frames, chosen)[: config.frames]
        avatar, tuned = tuned_avatar(args, avatar, device, (views[0].width, views[0].height))
        result = measure_speed(avatar, sequence, views, config, device=device, engine=engine)
        width, height = result["size"]
        result["model_mb"] = round(os.path.getsize(args.model) / 1e6, 3)
        trained = avatar.record.get("summary", {})
        for name in ("model_bytes", "train_seconds", "steps"):
            result[name] = trained.get(name)
        result["train_peak_memory_mb"] = trained.get("peak_memory_mb")
        if tuned:
            result["tuned"] = tuned
        inputs = {"model": args.model, "meshes": args.meshes} | {f"frames.{i}": p for i, p in enumerate(args.frames)}
        record = run_record(
            "speed", config=to_mapping(config), inputs=inputs, device=device_name(device), methods=methods
        )
    write_json(args.out, record | {"speed": result})
    totals = ", ".join(f"{name} {value:.1f} FPS" for name, value in result["fps"].items())
    what = f"{width}x{height}, {result['primitives']} primitives, raster {result['ms']['raster']:.2f} ms"
    print(f"{args.out}: {what}, {totals}")
    return 0
