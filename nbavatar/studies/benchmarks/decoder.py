"""The U-Net by torch and by inference engines, in turns, on the same features.

    nbavatar bench decoder --size 512 1024             # of config/capture.yaml
    nbavatar bench decoder --form lean --width 16      # another form or width of it

Every engine that is installed (`--engine` of render, video, view and speed) decodes the same picture after torch, one
picture each at a time. Figures for each size: medians of wall time [ms], of processor time over all threads
(`*_cpu_ms`), which other programs disturb less, `*_ratio`, the median over the turns of torch's processor time by the
engine's, and `*_error`, the largest difference from torch after the sigmoids [1]. `bound_ms` is how long the
convolutions' multiply-adds would take at the rate of this machine's product of two large matrices [GFLOP/s].
"""

import argparse
import dataclasses
import os
import statistics
import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from nbavatar.devices import device_name
from nbavatar.errors import DataError
from nbavatar.methods.billboards.engine import RUNNERS, DecoderEngine, installed_engines
from nbavatar.methods.billboards.options import UNetConfig
from nbavatar.methods.billboards.unet import FORMS, UNet, macs
from nbavatar.studies.benchmarks.step_scene import training_options
from nbavatar.studies.benchmarks.turns import in_turns, median_ratio

__all__ = ["add_arguments", "run"]

_SIDE, _PRODUCTS = 1024, 5  # of the matrices that the machine is asked for; how often


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the model's and the measurement's options."""
    parser.add_argument("--config", metavar="YAML", help="run whose U-Net it is (default: captures')")
    parser.add_argument("--form", choices=FORMS, help="another form of it")
    parser.add_argument("--width", type=int, help="another width of it")
    parser.add_argument("--size", type=int, nargs="+", default=[512], help="picture sides [px] (default: 512)")
    parser.add_argument("--repeats", type=int, default=7, help="turns a median is taken of (default: %(default)s)")


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Measures; see the module's description for the figures.

    Raises:
        DataError: a side that is no multiple of the U-Net's, or no repeats.
    """
    options = training_options(args.config).own
    given = {"form": args.form, "width": args.width}
    shape: UNetConfig = dataclasses.replace(options.unet, **{k: v for k, v in given.items() if v is not None})
    torch.manual_seed(0)
    unet = UNet(options.channels + 1, **dataclasses.asdict(shape)).to(memory_format=torch.channels_last).eval()
    if args.repeats < 1 or any(side < 2 * unet.multiple or side % unet.multiple for side in args.size):
        expected = f"multiples of {unet.multiple} from {2 * unet.multiple} on, and at least 1 repeat"
        raise DataError.of(
            "bench decoder", "--size, --repeats", expected=expected, found=f"{args.size}, {args.repeats}"
        )
    engines = {kind: DecoderEngine(kind) for kind in installed_engines()}
    rate = _matrix_rate()
    figures: dict[str, Any] = {
        "device": device_name("cpu"),
        "threads": torch.get_num_threads(),
        "load": os.getloadavg()[0],
        "unet": " ".join(f"{name} {value}" for name, value in dataclasses.asdict(shape).items()),
        "engines": ", ".join(engine.name for engine in engines.values())
        or f"none of {', '.join(RUNNERS)} is installed",
        "gflops": rate,
    }
    for side in args.size:
        own = _turns(unet, engines, side, args.repeats)
        own["bound_ms"] = 2e3 * macs(unet, side, side) / (rate * 1e9)
        figures |= {f"{side}_{name}": value for name, value in own.items()}
    return figures


def _turns(unet: UNet, engines: dict[str, DecoderEngine], side: int, repeats: int) -> dict[str, float]:
    """Figures of one size."""
    features = torch.randn(1, unet.channels, side, side)
    features = features.contiguous(memory_format=torch.channels_last)
    calls: dict[str, Callable[[int], tuple[Tensor, Tensor]]] = {"eager": lambda _: unet(features)}
    calls |= {kind: lambda _, own=engine: own(unet, features) for kind, engine in engines.items()}
    figures = {}
    with torch.inference_mode():
        found = {kind: call(0) for kind, call in calls.items()}  # prepares them, too
        turns = in_turns(calls, repeats)
    for kind in calls:
        figures[f"{kind}_ms"] = statistics.median(turns.wall[kind])
        figures[f"{kind}_cpu_ms"] = statistics.median(turns.spent[kind])
    for kind in engines:
        figures[f"{kind}_ratio"] = median_ratio(turns.spent["eager"], turns.spent[kind])
        pairs = zip(found["eager"], found[kind], strict=True)
        figures[f"{kind}_error"] = max(float((a - b).abs().amax()) for a, b in pairs)
    return figures


def _matrix_rate() -> float:
    """Floating-point operations a second of a product of two large matrices [GFLOP/s], by processor time and thread."""
    a, b = torch.rand(_SIDE, _SIDE), torch.rand(_SIDE, _SIDE)
    best = float("inf")
    for _ in range(_PRODUCTS):
        used = time.process_time()
        torch.mm(a, b)
        best = min(best, time.process_time() - used)
    return 2e-9 * _SIDE**3 / best * torch.get_num_threads()
