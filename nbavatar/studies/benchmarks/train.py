"""Where a training step spends its time: data, meshes, rasterizer, U-Net, losses, optimizer, and the whole step.

    nbavatar bench train --json
    nbavatar bench train --size 512 --width 16 --convs 1 --device cpu

One avatar of a full-size head and hand (11,514 billboards of FLAME and MANO), one view of --size pixels whose window
is the whole picture. Each part is run alone, forward and backward, on the same tensors as in the step; the sum of the
parts may therefore differ a little from `step_ms`. Figures: medians of wall time [ms] and, on a CPU, of processor time
over all threads (`*_cpu_ms`), which other programs disturb less; `raster_and_data_to_unet` is the ratio of the shares;
`peak_mb` the largest memory of the process or device.
"""

import argparse
import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nbavatar.config.training import TrainConfig
from nbavatar.data.synthetic.scene import full_scene
from nbavatar.data.views import Sample, View
from nbavatar.devices import device_name, lease_device, peak_memory_mb
from nbavatar.methods.billboards.avatar import Avatar
from nbavatar.methods.billboards.losses import loss_delta, loss_knn
from nbavatar.methods.billboards.options import BillboardsConfig, UNetConfig
from nbavatar.methods.billboards.region import full_region, shift_camera
from nbavatar.methods.billboards.training import BillboardTraining
from nbavatar.methods.create import create_method
from nbavatar.metrics.lpips import load_lpips
from nbavatar.optimization.adam import Adam
from nbavatar.optimization.schedule import plan_at
from nbavatar.rendering.billboards.functional import render_billboards

__all__ = ["add_arguments", "run"]

_FRAME = "f"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the model's and the measurement's options."""
    parser.add_argument("--size", type=int, default=512, help="image side [px] (default: %(default)s)")
    parser.add_argument("--width", type=int, default=48, help="U-Net width (default: %(default)s, the paper's)")
    parser.add_argument("--convs", type=int, default=2, help="U-Net convolutions a level (default: %(default)s)")
    parser.add_argument("--max-width", type=int, default=512, help="most U-Net channels (default: %(default)s)")
    parser.add_argument("--texels", type=int, default=16, help="texels a side (default: %(default)s)")
    parser.add_argument("--lpips-crop", type=int, default=256, help="side of the LPIPS crop [px]")
    parser.add_argument("--precision", default="fp32", choices=("fp32", "bf16"), help="arithmetic of the U-Net")
    parser.add_argument("--repeats", type=int, default=3, help="runs a median is taken of (default: %(default)s)")
    parser.add_argument("--device", default="auto", choices=("auto", "cpu", "cuda"), help="where to compute")


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Measures all parts of a step; returns the figures."""
    with lease_device(args.device) as device:
        return _measure(args, device)


def _measure(args: argparse.Namespace, device: str) -> dict[str, Any]:
    config = TrainConfig(
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
    method, sample, verts = _scene(args.size, config, device)
    lpips = load_lpips(config.lpips_net).to(device)
    plan = plan_at(0.5, config, args.size)
    optimizer = Adam(method.parameter_groups())
    anchor = method.avatar.anchor(verts, _FRAME)

    def step() -> None:
        optimizer.zero_grad()
        random = torch.Generator().manual_seed(0)
        method.step_loss(sample, anchor, lpips, plan, random).total.backward()
        optimizer.step()

    parts = _parts(method, sample, verts, lpips, optimizer, min(args.lpips_crop, args.size))
    figures: dict[str, Any] = {
        "device": device_name(device),
        "threads": torch.get_num_threads(),
        "size": args.size,
        "billboards": method.avatar.primitives,
        "unet_width": args.width,
        "perceptual_crop": plan.crop,
    }
    step()
    for name, call in {**parts, "step": step}.items():
        figures[f"{name}_ms"], figures[f"{name}_cpu_ms"] = _median(call, args.repeats, device)
    for name in parts:
        figures[f"{name}_share"] = figures[f"{name}_cpu_ms"] / sum(figures[f"{other}_cpu_ms"] for other in parts)
    figures["raster_and_data_to_unet"] = (figures["raster_share"] + figures["data_share"]) / figures["unet_share"]
    figures["peak_mb"] = peak_memory_mb(device)
    return figures


def _scene(size: int, config: TrainConfig, device: str) -> tuple[BillboardTraining, Sample, Mapping[str, Tensor]]:
    """Method in its initial state, a view whose avatar fills the picture, and the meshes of its frame."""
    sequence = full_scene(4, dents=False)
    verts = {name: torch.from_numpy(part.verts[2]).float() for name, part in sequence.parts.items()}
    points = torch.cat(list(verts.values()))
    centre, extent = (points.amax(0) + points.amin(0)) / 2, float((points.amax(0) - points.amin(0)).max())
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.tensor(
        [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
    )  # z is up, the face looks to -y
    viewmat[:3, 3] = -viewmat[:3, :3] @ centre + torch.tensor([0.0, 0.0, 4.0 * extent])
    focal = 3.6 * size
    K = torch.tensor([[focal, 0.0, size / 2], [0.0, focal, size / 2], [0.0, 0.0, 1.0]])
    view = View(0, "camera", _FRAME, 2, size, size, K, viewmat)
    random = torch.Generator().manual_seed(0)
    pixels = torch.rand((5, size, size), generator=random)
    pixels[3], pixels[4] = 1.0, 0.0
    method = create_method(sequence, {}, [view], config, device)
    assert isinstance(method, BillboardTraining)
    method.avatar.train()
    return (
        method,
        Sample(view, pixels, 0, 0, size, size, K),
        {name: values.to(device) for name, values in verts.items()},
    )


def _parts(
    method: BillboardTraining,
    sample: Sample,
    verts: Mapping[str, Tensor],
    lpips: Callable[[Tensor, Tensor], Tensor],
    optimizer: Adam,
    crop: int,
) -> dict[str, Callable[[], None]]:
    """Each part of a step, forward and backward, on tensors of its own."""
    avatar: Avatar = method.avatar
    device = avatar.faces.device
    side = sample.width
    view, K = sample.view.viewmat.to(device), sample.K.to(device)
    posed, _ = avatar.pose(verts, _FRAME)
    fixed = [value.detach().requires_grad_(True) for value in (*posed, *avatar.textures())]
    region = full_region(side, side, avatar.multiple)
    stored = (sample.pixels.permute(1, 2, 0).numpy() * 255).astype(np.uint8)

    def raster() -> tuple[Tensor, Tensor]:
        return render_billboards(
            *fixed, view, shift_camera(K, region), region.width, region.height, order=avatar.architecture.order
        )

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
        colour, opacity = avatar.decode(features, alpha, method.config.own.precision)
        (colour.sum() + opacity.sum()).backward()

    def meshes() -> None:
        avatar.place(avatar.anchor(verts, _FRAME))[0].means.sum().backward()

    def regularise() -> None:
        placed, _ = avatar.pose(verts, _FRAME)
        assert method.neighbours is not None
        (loss_knn(*placed, method.neighbours) + loss_delta(avatar.billboards.mu)).backward()

    return {
        "data": data,
        "meshes": meshes,
        "raster": draw,
        "unet": decode,
        "lpips": lambda: lpips(image, truth).sum().backward(),
        "regularisers": regularise,
        "optimizer": optimizer.step,
    }


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
