"""Metrics of stored renders against ground truth; needs no model and no GPU.

    --render        frame pack of `nbavatar render`: layer rgb (uint8 [H, W, 3], on the protocol's background), frame
                    ids <camera>/<frame>
    --frames        frame packs of `nbavatar crop`, one for each rendered camera: layers rgb (uint8 [H, W, 3]) and alpha
                    (uint8 [H, W]), train/test split; the truth is composited on the protocol's background
    --train-frames  frame packs of the training cameras: their mean image is one of the trivial answers
    --protocol      JSON text, a .json or .yaml file, or a name: nv1024, sr1024, nv512, sr512
    --out           JSON: means and values per image of PSNR [dB], SSIM and LPIPS (by backbone), full frame and
                    foreground; the same for the trivial answers; digests of all pixels, protocol hash, run record
    --csv           the values per image as a table

A render that lacks frames of its protocol, or holds others, is refused.
"""

import argparse
import csv
import io
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nbavatar.cli.common import add_cfg_argument, progress, read_mapping, stage_config
from nbavatar.config.core import from_mapping, merge, to_mapping
from nbavatar.config.evaluation import PROTOCOLS, EvaluateConfig, ProtocolConfig, protocol_hash
from nbavatar.devices import device_name, lease_device
from nbavatar.errors import DataError
from nbavatar.io.atomic import atomic_write
from nbavatar.io.framepack import FramePack
from nbavatar.io.records import write_json
from nbavatar.preprocess.crop import blank_unseen
from nbavatar.provenance import run_record

__all__ = ["add_arguments", "main", "read_protocol"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options of `nbavatar evaluate`."""
    parser.add_argument("--render", required=True, metavar="ZIP", help="rendered images")
    parser.add_argument("--frames", required=True, nargs="+", metavar="ZIP", help="ground-truth crops, one a camera")
    parser.add_argument("--train-frames", nargs="*", default=[], metavar="ZIP", help="crops of the training cameras")
    parser.add_argument("--protocol", required=True, metavar="JSON|FILE|NAME", help="protocol")
    parser.add_argument("--out", required=True, metavar="JSON", help="result")
    parser.add_argument("--csv", metavar="CSV", help="values per image")
    add_cfg_argument(parser, EvaluateConfig)


def read_protocol(text: str, fallback_name: str) -> ProtocolConfig:
    """A protocol from its name, JSON text or file; a known name gives the values that are not said."""
    mapping = {"name": text} if text in PROTOCOLS else read_mapping(text, "--protocol")
    base = PROTOCOLS.get(mapping.get("name") or fallback_name, ProtocolConfig(name=fallback_name))
    protocol = from_mapping(ProtocolConfig, merge(to_mapping(base), mapping), "--protocol")
    return protocol if protocol.name else replace(protocol, name=fallback_name)


def main(args: argparse.Namespace) -> int:
    """Evaluates one render and writes its result."""
    cfg = stage_config(args, EvaluateConfig)
    protocol = read_protocol(args.protocol, Path(args.out).stem)
    inputs = {"render": args.render}
    inputs |= {f"frames.{i}": path for i, path in enumerate(args.frames)}
    inputs |= {f"train_frames.{i}": path for i, path in enumerate(args.train_frames)}
    with ExitStack() as stack:
        device = stack.enter_context(lease_device(cfg.device if cfg.nets else "cpu"))
        render = stack.enter_context(FramePack(args.render))
        truths = _by_camera([stack.enter_context(FramePack(path)) for path in args.frames])
        training = _by_camera([stack.enter_context(FramePack(path)) for path in args.train_frames])
        _check_preset(render, protocol)
        result = _evaluate(render, truths, training, protocol, cfg, device)
        record = run_record(
            "evaluate",
            config={"protocol": to_mapping(protocol), "evaluate": to_mapping(cfg)},
            inputs=inputs,
            device=device_name(device),
        )
        made = render.manifest.get("record") or {}
        variant = render.manifest.get("variant") or made.get("variant") or Path(args.render).parent.name
        full = {
            "kind": "evaluation",
            "format": 1,
            "subject": render.manifest["subject"],
            "variant": variant,
            "protocol": to_mapping(protocol),
            "protocol_hash": protocol_hash(protocol, cfg),
            "cameras": sorted(truths),
            "training": _training(made.get("training") or {}),
            "train_cameras": [pack.manifest["camera"] for pack in training.values()],
            **result,
            "record": record,
        }
    write_json(args.out, full)
    if args.csv:
        with atomic_write(args.csv) as path:
            path.write_text(_csv_text(result["per_image"]), encoding="utf-8")
    shown = ", ".join(f"{name} {value:.4g}" for name, value in result["metrics"].items() if value is not None)
    left_out = f", {result['empty']} of background only left out" if result["empty"] else ""
    print(f"{args.out}: {result['count']} images{left_out}; {shown}")
    return 0


def _evaluate(
    render: FramePack,
    truths: dict[str, FramePack],
    training: dict[str, FramePack],
    protocol: ProtocolConfig,
    cfg: EvaluateConfig,
    device: str,
) -> dict[str, Any]:
    # torch is imported after the device has been leased.
    from nbavatar.evaluation.evaluate import Pair, evaluate, mean_images
    from nbavatar.evaluation.protocols import check_coverage, frames_digest, select_frames
    from nbavatar.metrics.lpips import load_lpips

    allowed = {
        camera: select_frames(pack.frames, pack.manifest.get("split", {}), protocol.split)
        for camera, pack in truths.items()
    }
    check_coverage(render.frames, allowed, protocol.limit, str(render.path))
    nets = {name: load_lpips(name).to(device) for name in cfg.nets}
    means = {}
    if cfg.trivial and training:

        def images() -> Iterator[tuple[str, Any, Any, Any]]:
            for camera, pack in training.items():
                for frame in select_frames(pack.frames, pack.manifest.get("split", {}), "novel_view", cfg.mean_frames):
                    yield camera, pack.read("rgb", frame), pack.read("alpha", frame), pack.unseen(frame)

        means = mean_images(images(), protocol.background)

    def pairs() -> Iterator[Pair]:
        for name in render.frames:
            camera, _, frame = name.partition("/")
            pack = truths[camera]
            unseen = pack.unseen(frame)
            prediction = blank_unseen(render.read("rgb", name), unseen, protocol.background)
            alpha = pack.read("alpha", frame)
            coverage = render.read("alpha", name) if "alpha" in render.layers else None
            if coverage is not None and unseen is not None:
                coverage = np.where(unseen, alpha, coverage)  # where nothing is known, nothing is wrong
            yield Pair(camera, frame, prediction, pack.read("rgb", frame), alpha, coverage, unseen)

    result = evaluate(
        progress(pairs(), f"evaluate {protocol.name}", len(render.frames)),
        background=protocol.background,
        nets=nets,
        foreground_threshold=cfg.foreground_threshold,
        means=means,
        trivial=cfg.trivial,
        device=device,
    )
    return result | {"frames": frames_digest(render.frames)}


def _training(record: dict[str, Any]) -> dict[str, Any]:
    """What a table says of how a render's avatar was trained; empty where the render does not know."""
    config = record.get("config") or {}
    method = record.get("method") or config.get("method")
    kept = {
        "method": method,
        "mode": (config.get(method) or {}).get("mode") if method else None,
        "steps": record.get("steps"),
        "train_seconds": record.get("train_seconds", record.get("seconds")),
        **{key: record.get(key) for key in ("primitives", "model_bytes", "peak_memory_mb")},
    }
    return {key: value for key, value in kept.items() if value is not None}


def _check_preset(render: FramePack, protocol: ProtocolConfig) -> None:
    """Figures say which setting they are of: the render must have the protocol's."""
    tuned = (render.manifest.get("record") or {}).get("tuned") or {}
    used = tuned.get("preset") or ("a budget" if tuned else "")
    if used != protocol.preset:
        raise DataError.of(
            render.path, "preset", expected=protocol.preset or "none, as the protocol says", found=used or "none",
            fix="render with the protocol's preset, or name the render's in the protocol",
        )  # fmt: skip


def _by_camera(packs: list[FramePack]) -> dict[str, FramePack]:
    found: dict[str, FramePack] = {}
    for pack in packs:
        camera = str(pack.manifest["camera"])
        if camera in found:
            raise DataError.of(pack.path, "camera", expected="one pack a camera", found=f"{camera} twice")
        for layer in ("rgb", "alpha"):
            if layer not in pack.layers:
                raise DataError.of(pack.path, "layers", expected=f"a layer {layer}", found=", ".join(pack.layers))
        found[camera] = pack
    return found


def _csv_text(rows: list[dict[str, Any]]) -> str:
    stream = io.StringIO()
    writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    # repr of a float is its shortest exact form; empty where a metric has no answer.
    writer.writerows(rows)
    return stream.getvalue()
