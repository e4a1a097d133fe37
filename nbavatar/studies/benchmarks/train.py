"""Where a training step spends its time: data, meshes, rasterizer, U-Net, losses, optimizer, and the whole step.

    nbavatar bench train --json
    nbavatar bench train --size 512 --width 16 --convs 1 --device cpu
    nbavatar bench train --size 256 --config config/capture.yaml     # as that run trains; sizes are its own
    nbavatar bench train --size 256 --config config/capture.yaml --against '{unet: {form: paper}}'

With --against, options of the billboards that another training differs by, its steps are made in turns with those of
the first: `against_cpu_ms`, and `against_ratio`, the median over the turns of its processor time by the first's.

One avatar of a full-size head and hand (11,514 billboards of FLAME and MANO), one view of --size pixels whose window
is the whole picture. Each part is run alone, forward and backward, on the same tensors as in the step; the sum of the
parts may therefore differ a little from `step_ms`. Figures: medians of wall time [ms] and, on a CPU, of processor time
over all threads (`*_cpu_ms`), which other programs disturb less; `raster_and_data_to_unet` is the ratio of the shares;
`peak_mb` the largest memory of the process or device.
"""

import argparse
import dataclasses
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nbavatar.config.core import from_mapping, merge, to_mapping
from nbavatar.config.training import TrainConfig
from nbavatar.config.yamlfiles import parse_yaml
from nbavatar.devices import device_name, lease_device, peak_memory_mb
from nbavatar.errors import ConfigError, describe
from nbavatar.methods.billboards.avatar import Avatar
from nbavatar.methods.billboards.losses import loss_delta, loss_knn
from nbavatar.methods.billboards.options import BillboardsConfig, UNetConfig
from nbavatar.methods.billboards.region import full_region, shift_camera
from nbavatar.methods.photometric import loss_dssim, loss_l1
from nbavatar.rendering.billboards.functional import render_billboards
from nbavatar.studies.benchmarks.step_scene import FRAME, StepScene, training_options

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the model's and the measurement's options."""
    parser.add_argument("--config", metavar="YAML", help="run whose training it is, such as config/capture.yaml")
    parser.add_argument("--size", type=int, default=512, help="image side [px] (default: %(default)s)")
    parser.add_argument("--width", type=int, default=48, help="U-Net width (default: %(default)s, the paper's)")
    parser.add_argument("--convs", type=int, default=2, help="U-Net convolutions a level (default: %(default)s)")
    parser.add_argument("--max-width", type=int, default=512, help="most U-Net channels (default: %(default)s)")
    parser.add_argument("--texels", type=int, default=16, help="texels a side (default: %(default)s)")
    parser.add_argument("--lpips-crop", type=int, default=256, help="side of the LPIPS crop [px]")
    parser.add_argument("--precision", default="fp32", choices=("fp32", "bf16"), help="arithmetic of the U-Net")
    parser.add_argument("--against", metavar="YAML", help="options of another training, whose steps alternate")
    parser.add_argument("--repeats", type=int, default=3, help="runs a median is taken of (default: %(default)s)")
    parser.add_argument("--device", default="auto", choices=("auto", "cpu", "cuda"), help="where to compute")


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Measures all parts of a step; returns the figures."""
    with lease_device(args.device) as device:
        return _measure(args, device)


def _measure(args: argparse.Namespace, device: str) -> dict[str, Any]:
    config = _options(args)
    scene = StepScene(args.size, config, device)
    method, plan = scene.method, scene.plan()
    parts = _parts(scene, min(config.lpips_crop, args.size))
    figures: dict[str, Any] = {
        "device": device_name(device),
        "threads": torch.get_num_threads(),
        "size": args.size,
        "billboards": method.avatar.primitives,
        "unet_width": config.own.unet.width,
        "perceptual_crop": plan.crop,
    }
    scene.step()
    for name, call in {**parts, "step": scene.step}.items():
        figures[f"{name}_ms"], figures[f"{name}_cpu_ms"] = _median(call, args.repeats, device)
    for name in parts:
        figures[f"{name}_share"] = figures[f"{name}_cpu_ms"] / sum(figures[f"{other}_cpu_ms"] for other in parts)
    figures["raster_and_data_to_unet"] = (figures["raster_share"] + figures["data_share"]) / figures["unet_share"]
    figures["peak_mb"] = peak_memory_mb(device)
    if args.against is not None:
        other = StepScene(args.size, _differing(config, args.against), device)
        figures |= _turns(scene.stepping(), other.stepping(), args.repeats, device)
    return figures


def _differing(config: TrainConfig, text: str) -> TrainConfig:
    """The options with some of the method's changed.

    Raises:
        ConfigError: no YAML mapping, an unknown option, or a value out of range.
    """
    changes = parse_yaml(text, "--against")
    if not isinstance(changes, dict):
        raise ConfigError.of("--against", expected="options of the billboards as a mapping", found=describe(text))
    own = from_mapping(type(config.own), merge(to_mapping(config.own), changes), "--against")
    return dataclasses.replace(config, **{config.method: own})


def _turns(first: Callable[[], None], other: Callable[[], None], repeats: int, device: str) -> dict[str, float]:
    """Figures of two kinds of steps, one of each at a time; both kinds of a capture's steps, with LPIPS and without."""
    times: list[tuple[float, float]] = []
    for call in (first, other):
        call()
    for _ in range(2 * repeats):
        own, others = (_median(call, 1, device)[1] for call in (first, other))
        times.append((own, others))
    return {
        "own_cpu_ms": statistics.median(own for own, _ in times),
        "against_cpu_ms": statistics.median(others for _, others in times),
        "against_ratio": statistics.median(others / own for own, others in times),
    }


def _options(args: argparse.Namespace) -> TrainConfig:
    """Those of a run's file where one is named, else the paper's with the sizes that are asked for."""
    if args.config is not None:
        config = training_options(args.config)
        own = dataclasses.replace(config.own, roi=False, precision=args.precision)
        return dataclasses.replace(config, billboards=own)
    return TrainConfig(
        lpips_crop=args.lpips_crop,
        schedule="paper",
        billboards=BillboardsConfig(
            texels=args.texels,
            unet=UNetConfig(width=args.width, convs=args.convs, max_width=args.max_width),
            init="random",
            roi=False,
            precision=args.precision,
        ),
    )


def _parts(scene: StepScene, crop: int) -> dict[str, Callable[[], None]]:
    """Each part of a step, forward and backward, on tensors of its own."""
    method, sample, verts = scene.method, scene.sample, scene.verts
    lpips, options = scene.lpips, method.options
    avatar: Avatar = method.avatar
    device = avatar.faces.device
    side = sample.width
    view, K = sample.view.viewmat.to(device), sample.K.to(device)
    posed, _ = avatar.pose(verts, FRAME)
    textures, cover = avatar.textures()
    fixed = [value.detach().requires_grad_(True) for value in (*posed.planes, textures, cover)]
    told = avatar.light_and_gloss(posed, view).detach()
    region = full_region(side, side, avatar.multiple)
    stored = (sample.pixels.permute(1, 2, 0).numpy() * 255).astype(np.uint8)

    def raster() -> tuple[Tensor, Tensor]:
        return render_billboards(
            *fixed, view, shift_camera(K, region), region.width, region.height, order=avatar.architecture.order,
            uniform=told,
        )  # fmt: skip

    features, alpha = (value.detach().requires_grad_(True) for value in raster())
    image = torch.rand((1, 3, crop, crop), device=device, requires_grad=True)
    truth = torch.rand((1, 3, crop, crop), device=device)

    def data() -> None:
        # What `ViewStore.sample` does with a kept frame, and the way to the device.
        pixels = stored.astype(np.float32) / 255.0
        pixels[..., :3] *= pixels[..., 3:4]
        torch.from_numpy(np.ascontiguousarray(pixels.transpose(2, 0, 1))).to(device)

    def draw() -> None:
        values, opacity = raster()
        (values.sum() + opacity.sum()).backward()

    def decode() -> None:
        colour, opacity = avatar.decode(features, alpha, options.precision)
        (colour.sum() + opacity.sum()).backward()

    def meshes() -> None:
        avatar.place(avatar.anchor(verts, FRAME))[0].means.sum().backward()

    def regularise() -> None:
        loss = loss_delta(avatar.billboards.mu)
        if method.neighbours is not None:
            loss = loss + loss_knn(*avatar.pose(verts, FRAME)[0].planes, method.neighbours)
        loss.backward()

    def compare() -> None:
        (options.weight_l1 * loss_l1(picture, target) + options.weight_dssim * loss_dssim(picture, target)).backward()

    parts = {"data": data, "meshes": meshes, "raster": draw, "unet": decode}
    if method.neighbours is not None or options.weight_delta > 0:
        parts["regularisers"] = regularise
    if options.weight_dssim > 0:
        picture, target = torch.rand((3, side, side), device=device, requires_grad=True), sample.pixels[:3].to(device)
        parts["colours"] = compare
    if lpips is not None:
        parts["lpips"] = lambda: lpips(image, truth).sum().backward()
    return {**parts, "optimizer": scene.update}


def _median(call: Callable[[], None], repeats: int, device: str) -> tuple[float, float]:
    """Wall and processor time [ms]; on a GPU the second is the wall time too."""
    wall, processor = [], []
    for _ in range(repeats):
        _wait(device)
        began, used = time.perf_counter(), time.process_time()
        call()
        _wait(device)
        wall.append(1e3 * (time.perf_counter() - began))
        processor.append(1e3 * (time.process_time() - used))
    middle = statistics.median(wall)
    return middle, middle if device.startswith("cuda") else statistics.median(processor)


def _wait(device: str) -> None:
    if device.startswith("cuda"):
        torch.cuda.synchronize()
