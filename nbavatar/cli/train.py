"""Train an avatar on meshes: neural billboards and the U-Net that decodes them, or a baseline (option `method`).

    --frames    frame packs (.zip) of the training cameras, as `nbavatar crop` writes them: layers rgb (uint8 [H, W,
                3]), alpha and label (uint8 [H, W]), intrinsics [px] and world-to-camera transforms [m]; frames whose
                split is "train" are used
    --meshes    mesh sequence (.npz): faces, rest pose and posed vertices per part [m], world, one row a frame
    --spectral  spectral coordinates (.npz): `<part>.coords` float32 [V, K]
    --light     far lights of the studio (.npz, `nbavatar light`), for billboards: what reaches each face is told to the
                U-Net
    --start     model.pt of an earlier training or of another subject; what fits of it is taken over, part by part, and
                a line says what does not
    --out       model.pt, one file; opens with torch.load(weights_only=True)

Beside the model, `<out>.state/` holds the last checkpoint, events.jsonl (losses, PSNR on the training views, speed),
previews/ (truth, render, billboard alpha, features), both again as tensorboard/ and, with {"wandb": "PROJECT"}, as an
offline run of Weights & Biases in wandb/. Stopped at any moment, the same command goes on from there. A
state that belongs to other inputs, options or code is moved aside.
"""

import argparse
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from nbavatar.cli.common import add_cfg_argument, stage_config
from nbavatar.config.core import from_mapping, merge, to_mapping
from nbavatar.config.training import TrainConfig, own_options
from nbavatar.devices import device_name, lease_device, peak_memory_mb
from nbavatar.errors import ConfigError, DataError, require
from nbavatar.io.arrays import read_arrays
from nbavatar.io.atomic import atomic_write
from nbavatar.names import check_name
from nbavatar.provenance import run_record

__all__ = ["add_arguments", "main"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options of `nbavatar train`."""
    parser.add_argument("--frames", nargs="+", required=True, metavar="ZIP", help="frame packs of the training cameras")
    parser.add_argument("--meshes", required=True, metavar="NPZ", help="mesh sequence")
    parser.add_argument(
        "--spectral", metavar="NPZ", help="spectral coordinates; needed for init=spectral and refinement"
    )
    parser.add_argument(
        "--light", nargs="?", const="", metavar="NPZ", help="lights of the studio; with nothing after it, none"
    )
    parser.add_argument(
        "--start", nargs="?", const="", metavar="PT",
        help="avatar to start from, in place of the option `start`; with nothing after it, none",
    )  # fmt: skip
    parser.add_argument("--out", required=True, metavar="PT", help="model file to write")
    parser.add_argument("--history", metavar="JSONL", help="copy of the events to write when training is done")
    parser.add_argument("--device", default="auto", choices=("auto", "cpu", "cuda"), help="where to compute")
    parser.add_argument("--max-minutes", type=float, metavar="MIN", help="time budget instead of a number of steps")
    parser.add_argument("--preset", metavar="NAME", help="take order, precision and window from a measured preset")
    parser.add_argument("--presets", metavar="JSON", help="presets.json of an avatar like this one")
    add_cfg_argument(parser, TrainConfig)


def main(args: argparse.Namespace) -> int:
    """Runs `nbavatar train`; 143 when it was told to terminate (its state is saved)."""
    config = stage_config(args, TrainConfig)
    if args.preset:
        config = _with_preset(args.preset, args.presets, config)
    if args.max_minutes is not None:
        config = replace(config, max_minutes=args.max_minutes)
    if args.start is not None:
        config = replace(config, start=args.start)
    if config.wandb:
        check_name(config.wandb, "option", "wandb", error=ConfigError)
        require("wandb", "wandb", "the option `wandb`")  # before anything is read or trained
    inputs = {f"frames.{i}": path for i, path in enumerate(args.frames)} | {"meshes": args.meshes}
    if args.spectral:
        inputs["spectral"] = args.spectral
    if args.light:
        inputs["light"] = args.light
    if config.start:
        inputs["start"] = config.start
    for name, path in inputs.items():
        if not Path(path).is_file():
            raise DataError.of(path, expected=f"a file (--{name.partition('.')[0]})", found="no such file")
    if config.start and Path(args.out).is_file() and Path(args.out).samefile(config.start):
        fix = "name another file: this one would be replaced"
        raise ConfigError.of(args.out, "--out", expected="a file to write", found="the option start", fix=fix)
    with lease_device(args.device) as device:
        if device == "cuda":
            from nbavatar.cli.gpu_verdict import require_right_gpu  # provenance: neutral, it only looks

            line = require_right_gpu(device)
            if line is not None:
                print(line, file=sys.stderr)
        record = run_record(
            "train",
            config=own_options(to_mapping(config)),
            inputs=inputs,
            device=device_name(device),
            seed=config.seed,
            methods=(config.method,),
        )
        summary = _train(args, config, record, device)
    if not summary["finished"]:
        print(f"stopped at step {summary['steps']}; the same command goes on from there", file=sys.stderr)
        return 143
    last = summary["last"]
    shown = ", ".join(
        f"{name} {last[name]:.4g}" for name in ("psnr", "mse", "lpips", "nb") if last.get(name) is not None
    )
    print(f"{args.out}: {summary['steps']} steps in {summary['seconds']:.1f} s, {summary['skipped']} skipped; {shown}")
    return 0


def _with_preset(name: str, path: str | None, cfg: TrainConfig) -> TrainConfig:
    """Training options with what a measured preset says of order, precision and window.

    Args:
        name: preset.
        path: presets.json of `nbavatar tradeoff`, of an avatar like the one to be trained.
        cfg: options so far.
    """
    from nbavatar.studies.tradeoff.presets import preset_setting  # provenance: neutral, what it gives becomes options

    if path is None:
        raise ConfigError.of("--presets", expected="a file, there is no model yet to look beside", found="none")
    setting = preset_setting(path, name, model=None, device="").setting
    taken = {key: getattr(setting, key) for key in ("order", "precision", "roi", "roi_margin")}
    options = {cfg.method: {key: value for key, value in taken.items() if value is not None}}
    return from_mapping(type(cfg), merge(to_mapping(cfg), options), f"--preset {name}")


def _train(args: argparse.Namespace, config: TrainConfig, record: dict[str, Any], device: str) -> dict[str, Any]:
    """Reads all inputs, trains, and writes the model last."""
    # torch is imported after the device has been leased.
    import torch

    from nbavatar.data.lights import read_light
    from nbavatar.data.sequences import read_sequence
    from nbavatar.data.views import ViewStore, check_views, views_of
    from nbavatar.io.framepack import FramePack
    from nbavatar.methods.create import create_method
    from nbavatar.methods.start import start_from
    from nbavatar.methods.storage import load_avatar, save_avatar
    from nbavatar.training.loop import train
    from nbavatar.training.state import RunFolder

    sequence, _ = read_sequence(args.meshes)
    coords = _read_coords(args.spectral, list(sequence.parts))
    packs = [FramePack(path) for path in args.frames]
    views = views_of(packs, sequence.frames, [pack.split("train") for pack in packs], layers=("rgb", "alpha"))
    posed = {part: mesh.verts for part, mesh in sequence.parts.items()}
    check_views(packs, views, posed, mesh_file=args.meshes)
    light = read_light(args.light) if args.light else None
    method = create_method(sequence, coords, views, config, device, light)
    avatar, net, lpips = method.avatar, method.lpips_net(), None
    if net is not None:
        from nbavatar.metrics.lpips import load_lpips

        lpips = load_lpips(net).to(device)
    taken = None
    if config.start:
        # Where a training goes on, its state takes the place of all of this; the record says it all the same.
        taken = start_from(method, load_avatar(config.start, device), config.start)
        record["start"] = taken._asdict()
    key = {name: record[name] for name in ("code", "inputs")}
    # These change no result: of a start, its digest is among the inputs.
    key["config"] = {name: value for name, value in record["config"].items() if name not in ("wandb", "start")}
    with RunFolder(f"{args.out}.state", key, wandb=config.wandb) as folder:
        if folder.moved_to is not None:
            print(
                f"an earlier state belongs to other inputs, options or code; moved to {folder.moved_to}",
                file=sys.stderr,
            )
        if taken is not None and not folder.begun:
            left = f"; not {', '.join(taken.left)}" if taken.left else ""
            print(f"{config.start}: took over {', '.join(taken.over)}{left}", file=sys.stderr)
        bar, stop = _Bar(Path(args.out).name), _TerminationFlag()
        meshes = {part: torch.from_numpy(sequence.parts[part].verts) for part in avatar.parts}
        summary = train(
            method,
            ViewStore(packs, views, avatar.parts, config.cache_mb * 1_000_000),
            len(views),
            meshes,
            lpips,
            config,
            folder,
            device=device,
            on_step=bar.step,
            should_stop=stop.is_set,
        )
        bar.close()
        if summary["finished"]:
            avatar = method.finish(meshes, views)
            summary["primitives"] = avatar.primitives
            summary |= {"train_seconds": summary["seconds"], "peak_memory_mb": round(peak_memory_mb(device), 1)}
            avatar.record = {**record, "summary": summary, "threads": torch.get_num_threads()}
            if args.history:
                with atomic_write(args.history) as temporary:
                    temporary.write_bytes((folder.path / "events.jsonl").read_bytes())
            save_avatar(args.out, avatar)
    return summary


def _read_coords(path: str | None, parts: list[str]) -> dict[str, Any]:
    if path is None:
        return {}
    arrays, _ = read_arrays(path)
    coords = {part: arrays[f"{part}.coords"] for part in parts if f"{part}.coords" in arrays}
    if not coords:
        found = ", ".join(sorted(arrays)) or "nothing"
        raise DataError.of(path, "<part>.coords", expected=f"coordinates of {', '.join(parts)}", found=found)
    return coords


class _TerminationFlag:
    """Turns SIGTERM into a question the loop asks between steps."""

    def __init__(self) -> None:
        self._set = False
        signal.signal(signal.SIGTERM, self._handle)

    def _handle(self, *_: Any) -> None:
        self._set = True

    def is_set(self) -> bool:
        """Whether the process was asked to end."""
        return self._set


class _Bar:
    """Progress bar on standard error with steps a second and the time left."""

    def __init__(self, name: str) -> None:
        from tqdm import tqdm

        form = "{desc}: {percentage:3.0f}%|{bar}| {postfix} [{elapsed}]"
        self._bar = tqdm(desc=name, total=1.0, dynamic_ncols=True, mininterval=0.5, bar_format=form)
        self._first: tuple[float, int, float] | None = None

    def step(self, step: int, progress: float, values: dict[str, float]) -> None:
        """Shows one step."""
        now = time.monotonic()
        if self._first is None:
            self._first = now, step, progress
        began, first, done = self._first
        spent = max(now - began, 1e-9)
        rate = (step - first) / spent
        left = (1.0 - progress) * spent / (progress - done) if progress > done else float("inf")
        shown = f"step {step}, {rate:.2f} it/s, {left:.0f} s left" if step > first else f"step {step}"
        if "psnr" in values:
            shown += f", psnr {values['psnr']:.2f}, loss {values['loss']:.4f}"
        self._bar.set_postfix_str(shown, refresh=False)
        self._bar.update(progress - self._bar.n)

    def close(self) -> None:
        """Ends the bar's line."""
        self._bar.close()
