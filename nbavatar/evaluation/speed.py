"""How long one picture of a trained avatar takes, stage by stage (supplement B).

Every stage is timed alone on the same inputs, warm, with the device idle before and after; medians are reported,
because a busy machine only ever makes a sample longer. The stages are those of the paper's table:

    pose        billboards onto the mesh (not in the paper's table)
    raster      rasterization with neural textures; raster_rgb the same with three channels
    renderer    U-Net, per arithmetic
    compose     colour over background
    total       all of it, one picture from vertices to RGB, per arithmetic

Beside each arithmetic of torch's stand `renderer_engine` and `total_engine` where the avatar has an engine.

A baseline has its own stages (`MeshAvatar.stages`); `total` is common to all.
"""

import time
from collections.abc import Callable, Sequence
from statistics import median
from typing import Any

import numpy as np
import torch

from nbavatar.config.evaluation import EAGER, SpeedConfig
from nbavatar.data.sequences import MeshSequence
from nbavatar.data.views import View
from nbavatar.devices import peak_memory_mb
from nbavatar.evaluation.render import check_parts
from nbavatar.methods.base import MeshAvatar, Stages

__all__ = ["measure_speed"]


def measure_speed(
    avatar: MeshAvatar, sequence: MeshSequence, views: Sequence[View], config: SpeedConfig, *, device: str = "cpu",
    engine: str = EAGER,
) -> dict[str, Any]:  # fmt: skip
    """Time an avatar on real frames.

    Args:
        avatar: trained, on `device`.
        sequence: meshes.
        views: pictures to time (their sizes are used as they are).
        config: number of passes, arithmetics.
        device: where the avatar computes.
        engine: what `MeshAvatar.use_engine` returned; its stages stand beside torch's.

    Returns:
        JSON-ready: `method`, `engine`, `ms` per stage (median), `fps` of the totals, `size`, `primitives`, what
        the kind of avatar adds (`MeshAvatar.facts`), `window` (mean share of the picture that is computed),
        `peak_memory_mb`, `threads`.
    """
    check_parts(avatar, sequence)
    avatar.eval()
    staged = [_stages(avatar, sequence, view, config, device) for view in views]
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
    with torch.inference_mode():
        times = {name: _time([stages.calls[name] for stages in staged], config, device) for name in staged[0].calls}
    view = views[0]
    return {
        "method": avatar.method,
        "engine": engine,
        "ms": {name: round(value, 4) for name, value in times.items()},
        "fps": {name: round(1000.0 / value, 2) for name, value in times.items() if name.startswith("total")},
        "size": [view.width, view.height],
        "primitives": avatar.primitives,
        **avatar.facts(view.width, view.height),
        "window": round(float(np.mean([stages.window for stages in staged])), 4),
        "peak_memory_mb": round(peak_memory_mb(device), 1),
        "threads": torch.get_num_threads(),
        "frames": len(views),
        "repeats": config.repeats,
    }


def _stages(avatar: MeshAvatar, sequence: MeshSequence, view: View, config: SpeedConfig, device: str) -> Stages:
    verts = {
        part: torch.from_numpy(np.asarray(sequence.parts[part].verts[view.row], dtype=np.float32)).to(device)
        for part in avatar.parts
    }
    camera = view.viewmat.to(device), view.K.to(device), view.width, view.height
    return avatar.stages(verts, *camera, torch.ones(3, device=device), config.precisions)


def _time(calls: Sequence[Callable[[], Any]], config: SpeedConfig, device: str) -> float:
    """Median milliseconds of one call, over the views in turn."""
    samples = []
    for number in range(config.warmup + config.repeats):
        if device == "cuda":
            torch.cuda.synchronize()
        began = time.perf_counter()
        calls[number % len(calls)]()
        if device == "cuda":
            torch.cuda.synchronize()
        if number >= config.warmup:
            samples.append(1000.0 * (time.perf_counter() - began))
    return median(samples)
