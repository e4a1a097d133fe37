"""How time and memory grow with the work: each kind of work at sizes a factor apart, exponents fitted, plots.

    nbavatar bench scaling                                # all, some minutes
    nbavatar bench scaling --only raster.pixels subjects  # some
    nbavatar bench scaling --out results/bench            # scaling.csv and scaling.png beside the figures

    raster.billboards, raster.pixels     the rasterizer, forward and backward, on the scene of `bench raster`
    decoder.pixels                       the U-Net of the run's avatars, no gradients
    step.billboards, step.pixels         a training step of the run (`bench train --config`)
    frames                               a frame pack of 64 x 64 px written and read, by its frames
    cameras                              the training views of cameras of eight frames of 64 x 64 px listed and decoded
    align.cameras                        meshes of four frames moved and bent to pictures of 256 px, by the cameras
    subjects                             the units of work of the paper's tables planned, by the subjects

Points are measured in turns, the smallest first, so that other programs disturb all of them alike. Figures of each:
median processor time [ms] at the smallest and at the largest size, what rendering it added to the process's memory at
the largest [MB], and `exponent`: the slope of log time over log size by least squares over all points, and
`exponent_at_large` over the last two, where what does not grow weighs least. 1 is linear.
"""

import argparse
import math
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from nbavatar.errors import DataError
from nbavatar.rendering import workspace
from nbavatar.studies.benchmarks.memory import forget_peak, memory_mb
from nbavatar.studies.benchmarks.scaling_sheet import write_sheet
from nbavatar.studies.benchmarks.scaling_works import WORKS

__all__ = ["Point", "add_arguments", "fitted_exponents", "run"]


class Point(NamedTuple):
    """One kind of work at one size.

    Attributes:
        work: its name; size: how much, in its own unit.
        ms: median processor time; memory_mb: added to the process's memory at its largest.
    """

    work: str
    size: int
    ms: float
    memory_mb: float


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the measurement's options."""
    parser.add_argument("--config", metavar="YAML", help="run whose avatars they are (default: captures')")
    parser.add_argument("--only", nargs="+", choices=tuple(WORKS), default=list(WORKS), help="some kinds of work")
    parser.add_argument("--repeats", type=int, default=3, help="turns a median is taken of (default: %(default)s)")
    parser.add_argument("--largest", type=int, help="leave out sizes beyond, in each work's own unit")
    parser.add_argument("--out", metavar="FOLDER", help="folder for a table and plots")


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Measures; see the module's description for the figures.

    Raises:
        DataError: no repeats, or fewer than two sizes of a work are left.
    """
    if args.repeats < 1:
        raise DataError.of("bench scaling", "--repeats", expected="at least 1", found=args.repeats)
    figures: dict[str, Any] = {"threads": torch.get_num_threads()}
    points: list[Point] = []
    for name in args.only:
        sizes = [size for size in WORKS[name].sizes if args.largest is None or size <= args.largest]
        if len(sizes) < 2:
            expected = f"at least {WORKS[name].sizes[1]}, or no exponent can be fitted"
            raise DataError.of("bench scaling", "--largest", expected=expected, found=args.largest)
        with tempfile.TemporaryDirectory() as folder:
            own = _measure(name, {size: WORKS[name].prepare(size, args.config, folder) for size in sizes}, args.repeats)
        points += own
        overall, at_large = fitted_exponents([p.size for p in own], [p.ms for p in own])
        figures |= {
            f"{name}_sizes": f"{own[0].size} to {own[-1].size} {WORKS[name].unit}",
            f"{name}_ms": f"{own[0].ms:.4g} to {own[-1].ms:.4g}",
            f"{name}_memory_mb": own[-1].memory_mb,
            f"{name}_exponent": overall,
            f"{name}_exponent_at_large": at_large,
        }
    if args.out is not None:
        write_sheet(args.out, points, {name: WORKS[name].unit for name in args.only})
    return figures


def fitted_exponents(sizes: Sequence[float], times: Sequence[float]) -> tuple[float, float]:
    """Slopes of log time over log size: by least squares over all points, and over the last two."""
    x, y = np.log(np.asarray(sizes, float)), np.log(np.asarray(times, float))
    overall = float(np.polyfit(x, y, 1)[0])
    return overall, math.log(times[-1] / times[-2]) / math.log(sizes[-1] / sizes[-2])


def _measure(name: str, calls: dict[int, Callable[[], Any]], repeats: int) -> list[Point]:
    spent: dict[int, list[float]] = {size: [] for size in calls}
    memory: dict[int, float] = {}
    for turn in range(repeats + 1):
        for size, call in calls.items():
            if turn == 0:  # compiles, and shows what it takes
                workspace.release()  # what a smaller size has left would hide this one's memory
                forget_peak()
                before = memory_mb("VmRSS")
                call()
                memory[size] = max(0.0, memory_mb("VmHWM") - before)
                continue
            began = time.process_time()
            call()
            spent[size].append(1e3 * (time.process_time() - began))
    return [Point(name, size, statistics.median(spent[size]), memory[size]) for size in calls]
