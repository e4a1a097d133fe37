"""How long one picture of a trained avatar takes, stage by stage (supplement B).

Every stage is timed alone on the same inputs, warm, with the device idle before and after; medians are reported,
because a busy machine only ever makes a sample longer. The stages are those of the paper's table:

    pose        billboards onto the mesh (not in the paper's table)
    raster      rasterization with neural textures; raster_rgb the same with three channels
    renderer    U-Net, per arithmetic
    compose     colour over background
    total       all of it, one picture from vertices to RGB, per arithmetic
"""

import time
from collections.abc import Callable, Sequence
from statistics import median
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from nbavatar.avatar.billboards import Posed
from nbavatar.avatar.model import Avatar, compose
from nbavatar.avatar.region import Region, shift_camera
from nbavatar.config.avatar import SpeedConfig
from nbavatar.data.sequences import MeshSequence
from nbavatar.data.views import View
from nbavatar.evaluation.render import check_parts
from nbavatar.raster.functional import render_billboards

__all__ = ["measure_speed", "peak_memory_mb"]


def measure_speed(
    avatar: Avatar, sequence: MeshSequence, views: Sequence[View], config: SpeedConfig, *, device: str = "cpu"
) -> dict[str, Any]:
    """Time an avatar on real frames.

    Args:
        avatar: trained, on `device`.
        sequence: meshes.
        views: pictures to time (their sizes are used as they are).
        config: number of passes, arithmetics.
        device: where the avatar computes.

    Returns:
        JSON-ready: `ms` per stage (median), `fps` of the totals, `size`, `billboards`, `channels`, `texels`, `window`
        (mean share of the picture that is decoded), `peak_memory_mb`, `threads`.
    """
    check_parts(avatar, sequence)
    avatar.eval()
    inputs = [_prepare(avatar, sequence, view, device) for view in views]
    stages: dict[str, Callable[[_Inputs], Any]] = {
        "pose": lambda x: avatar.pose(x.verts),
        "raster": lambda x: _raster(x, x.features),
        "raster_rgb": lambda x: _raster(x, x.rgb),
        "compose": lambda x: compose(x.colour, x.opacity, x.background),
    }
    precisions = config.precisions if avatar.unet is not None else ["fp32"]
    for precision in precisions:
        if avatar.unet is not None:
            stages[f"renderer_{precision}"] = lambda x, p=precision: avatar.decode(x.image, x.nb_alpha, p)
        stages[f"total_{precision}"] = lambda x, p=precision: _whole(avatar, x, p)
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
    with torch.inference_mode():
        times = {name: _time(stage, inputs, config, device) for name, stage in stages.items()}
    view = views[0]
    return {
        "ms": {name: round(value, 4) for name, value in times.items()},
        "fps": {name: round(1000.0 / value, 2) for name, value in times.items() if name.startswith("total")},
        "size": [view.width, view.height],
        "billboards": len(avatar.billboards.mu),
        "channels": avatar.architecture.channels,
        "texels": avatar.architecture.texels,
        "window": round(
            float(np.mean([x.region.width * x.region.height / (x.view.width * x.view.height) for x in inputs])), 4
        ),
        "peak_memory_mb": round(peak_memory_mb(device), 1),
        "threads": torch.get_num_threads(),
        "frames": len(views),
        "repeats": config.repeats,
    }


def peak_memory_mb(device: str) -> float:
    """Peak memory of the process [MB]: on a GPU its allocations, on the CPU the resident set."""
    if device == "cuda":
        return torch.cuda.max_memory_allocated() / 1e6
    import resource
    import sys

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak / 1e3


class _Inputs(NamedTuple):
    """Inputs of every stage for one view."""

    verts: dict[str, Tensor]
    posed: Posed
    features: Tensor
    rgb: Tensor
    alpha: Tensor
    view: View
    viewmat: Tensor
    K: Tensor
    region: Region
    order: str
    background: Tensor
    image: Tensor
    nb_alpha: Tensor
    colour: Tensor
    opacity: Tensor


def _prepare(avatar: Avatar, sequence: MeshSequence, view: View, device: str) -> _Inputs:
    with torch.no_grad():
        verts = {
            part: torch.from_numpy(np.asarray(sequence.parts[part].verts[view.row], dtype=np.float32)).to(device)
            for part in avatar.parts
        }
        posed, keep = avatar.pose(verts)
        features, alpha = avatar.textures()
        if keep is not None:
            features, alpha = features[keep], alpha[keep]
        viewmat, K, order = view.viewmat.to(device), view.K.to(device), avatar.architecture.order
        window = avatar.window(posed, keep, viewmat, K, view.width, view.height)
        rgb = features[..., [min(i, features.shape[-1] - 1) for i in range(3)]].contiguous()
        return _Inputs(
            verts, posed, features, rgb, alpha, view, viewmat, K, window.region, order, torch.ones(3, device=device),
            window.features, window.nb_alpha, window.colour, window.alpha,
        )  # fmt: skip


def _raster(inputs: _Inputs, features: Tensor) -> tuple[Tensor, Tensor]:
    means, quats, half_extents = inputs.posed
    region, K = inputs.region, shift_camera(inputs.K, inputs.region)
    return render_billboards(
        means, quats, half_extents, features, inputs.alpha, inputs.viewmat, K, region.width, region.height,
        order=inputs.order,
    )  # fmt: skip


def _whole(avatar: Avatar, inputs: _Inputs, precision: str) -> Tensor:
    size = inputs.view.width, inputs.view.height
    return avatar.render(inputs.verts, inputs.viewmat, inputs.K, *size, inputs.background, precision=precision)[0]


def _time(stage: Callable[[_Inputs], Any], inputs: Sequence[_Inputs], config: SpeedConfig, device: str) -> float:
    """Median milliseconds of one call."""
    samples = []
    for number in range(config.warmup + config.repeats):
        prepared = inputs[number % len(inputs)]
        if device == "cuda":
            torch.cuda.synchronize()
        began = time.perf_counter()
        stage(prepared)
        if device == "cuda":
            torch.cuda.synchronize()
        if number >= config.warmup:
            samples.append(1000.0 * (time.perf_counter() - began))
    return median(samples)
