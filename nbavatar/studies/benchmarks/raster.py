"""The billboard rasterizer on a full-size head and hand, measured warm and compared with the reference.

    nbavatar bench raster --json
    nbavatar bench raster --sweep results/bench/raster     tables and plots of how cost grows

Figures: medians of wall time [ms], and of processor time over all threads (`*_cpu_ms`), which other
programs on the machine disturb less; `samples` are the billboard hits blended into the image;
`max_abs_error` and `max_grad_rel_error` are against the float64 reference, off the `flipped_pixels`,
where rounding flips a decision (skip, stop, which hit is nearer), on the window `reference_window` (x, y,
width, height) of the image, at its full density; `reference_forward_ms` is for that window too; `peak_mb` is what
rendering forward and backward added to the process's memory at its largest; `compile_s` the time until the
kernels were ready;
`order_differs` the share of pixels on which the other orders differ from `ray` by more than 1/255.
On a GPU `forward_ms` is the whole public function, projection included, and `blend_ms`,
`blend_backward_ms` are the device's own time in the kernels of the blending alone (binning included),
by its event clock; `samples` are still counted by the CPU's kernels.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from nbavatar.errors import DataError, DeviceError
from nbavatar.rendering import workspace
from nbavatar.rendering.billboards import render_billboards
from nbavatar.rendering.billboards.projection import project_billboards, texture_support
from nbavatar.rendering.billboards.reference import BlendSettings, critical_pixels
from nbavatar.rendering.ordering import canonical_rank, parse_order
from nbavatar.studies.benchmarks.memory import forget_peak, memory_mb
from nbavatar.studies.benchmarks.raster_scene import RasterScene, make_scene

__all__ = ["add_arguments", "run"]

_OPTIONS: dict[str, Any] = {"near": 0.01, "alpha_min": 1.0 / 255.0, "alpha_max": 0.99, "t_min": 1e-4}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the scene's and the measurement's options."""
    parser.add_argument("--size", type=int, default=1024, help="image side [px] (default: %(default)s)")
    parser.add_argument("--billboards", type=int, default=11514, help="number of billboards (default: %(default)s)")
    parser.add_argument("--channels", type=int, default=6, help="feature channels (default: %(default)s)")
    parser.add_argument("--texels", type=int, default=16, help="texture side (default: %(default)s)")
    parser.add_argument("--order", default="ray", help="ray, center or kbuffer(n) (default: %(default)s)")
    parser.add_argument("--state", default="trained", choices=("trained", "initial"),
                        help="opacity and size of the billboards (default: %(default)s)")  # fmt: skip
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"), help="(default: %(default)s)")
    parser.add_argument("--repeats", type=int, default=7, help="runs a median is taken of (default: %(default)s)")
    parser.add_argument("--no-reference", action="store_true", help="skip the slow comparison; its figures are null")
    parser.add_argument("--window", type=int, default=256, help="side of the part of the image that is compared with "
                        "the reference, about its centre [px]; 0 for all of it (default: %(default)s)")  # fmt: skip
    parser.add_argument("--orders", action="store_true", help="also compare the orders with ray")
    parser.add_argument("--sweep", type=Path, help="folder for a sweep's table and plots")


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Measures; see the module's description for the figures.

    Raises:
        DeviceError: the device is not there.
        DataError: a number of billboards, channels, texels or pixels under 1.
    """
    for name in ("size", "billboards", "channels", "texels", "repeats"):
        if getattr(args, name) < 1:
            raise DataError.of("bench raster", f"--{name}", expected="at least 1", found=getattr(args, name))
    parse_order(args.order)
    if args.device == "cuda" and not torch.cuda.is_available():
        raise DeviceError.of("bench raster", "--device", expected="a CUDA device", found="none")
    count = None if args.billboards == 11514 else args.billboards
    scene = make_scene(
        size=args.size, billboards=count, channels=args.channels, texels=args.texels, state=args.state
    ).to(args.device)
    start = time.perf_counter()
    # GPU kernels are compiled for a number of channels, the others for all
    channels = args.channels if args.device == "cuda" else 1
    tiny = make_scene(size=8, billboards=1, channels=channels, texels=1).to(args.device)
    _render(tiny, args.order)
    figures: dict[str, Any] = {"compile_s": time.perf_counter() - start}
    figures |= measure(scene, args.order, args.repeats)
    figures |= {"reference_forward_ms": None, "max_abs_error": None, "flipped_pixels": None, "max_grad_rel_error": None,
                "reference_window": None}  # fmt: skip
    if not args.no_reference:
        window, start_at = crop(scene, args.window or args.size)
        figures |= compare(window, args.order)
        figures["reference_window"] = [start_at, start_at, window.size, window.size]
    if args.orders:
        figures["order_differs"] = order_differences(scene)
    figures |= {"threads": torch.get_num_threads(), "device": _device_name(args.device), "order": args.order,
                "billboards": len(scene.means), "channels": args.channels, "size": args.size,
                "state": args.state}  # fmt: skip
    if args.sweep is not None:
        from nbavatar.studies.benchmarks.raster_sweep import sweep

        sweep(args.sweep, args.order, args.state, args.repeats, args.device, measure)
    return figures


def _device_name(device: str) -> str:
    if device == "cuda":
        return torch.cuda.get_device_name()
    try:
        with open("/proc/cpuinfo") as handle:
            return next(line.split(":", 1)[1].strip() for line in handle if line.startswith("model name"))
    except (OSError, StopIteration):
        return "cpu"


def _render(scene: RasterScene, order: str, backend: str = "auto") -> tuple[torch.Tensor, torch.Tensor]:
    return render_billboards(
        *scene.billboards, scene.viewmat, scene.K, scene.size, scene.size, order=order, backend=backend, **_OPTIONS
    )


def _median_ms(action: Callable[[], Any], repeats: int, device: str) -> tuple[float, float]:
    """Medians of wall time and of processor time, summed over threads."""
    wall, processor = [], []
    for number in range(repeats + 1):
        start, start_processor = time.perf_counter(), time.process_time()
        action()
        if device == "cuda":
            torch.cuda.synchronize()
        if number:  # the first warms up
            wall.append(1e3 * (time.perf_counter() - start))
            processor.append(1e3 * (time.process_time() - start_processor))
    return statistics.median(wall), statistics.median(processor)


def measure(scene: RasterScene, order: str, repeats: int) -> dict[str, Any]:
    """Times of the forward and the backward pass, and what they blend and take."""
    device = scene.means.device.type
    workspace.release()  # what earlier scenes have left would hide this one's memory
    forget_peak()
    before = memory_mb("VmRSS")
    with torch.no_grad():
        forward, forward_cpu = _median_ms(lambda: _render(scene, order), repeats, device)
    leaves = [tensor.detach().clone().requires_grad_() for tensor in scene.billboards]
    tracked = RasterScene(*leaves, scene.viewmat, scene.K, scene.size)
    outputs = _render(tracked, order)
    generator = torch.Generator(device).manual_seed(0)
    grads = [torch.randn(output.shape, generator=generator, device=device) for output in outputs]
    backward, backward_cpu = _median_ms(
        lambda: torch.autograd.grad(outputs, leaves, grads, retain_graph=True), max(3, repeats // 2), device
    )
    peak = torch.cuda.max_memory_allocated() / 2**20 if device == "cuda" else memory_mb("VmHWM") - before
    device_times = _blend_times(scene, order, repeats) if device == "cuda" else {}
    samples = _samples(scene, order)
    return {
        "forward_ms": forward, "backward_ms": backward, "forward_cpu_ms": forward_cpu,
        "backward_cpu_ms": backward_cpu, "fps": 1e3 / forward, "samples": samples,
        "msamples_per_s": samples / forward / 1e3, "peak_mb": peak, **device_times,
    }  # fmt: skip


def _blend_times(scene: RasterScene, order: str, repeats: int) -> dict[str, float]:
    """Medians, by the device's clock, of blending a projected scene; CUDA graphs where they can be had.

    Replayed from a graph, the kernels follow each other without waiting for the host.
    """
    from nbavatar.rendering.billboards.cuda import blend_cuda

    projection, rank = _prepared(scene)
    textures = [tensor.detach().clone().requires_grad_() for tensor in (scene.features, scene.alpha)]
    settings = _blend_settings(scene, order)

    def forward() -> Any:
        with torch.no_grad():
            return blend_cuda(projection, rank, *textures, settings)

    def both() -> Any:
        outputs = blend_cuda(projection, rank, *textures, settings)
        return torch.autograd.grad(outputs, textures, [torch.ones_like(output) for output in outputs])

    times = [_graph_ms(action, max(5, repeats)) for action in (forward, both)]
    return {"blend_ms": times[0], "blend_backward_ms": times[1] - times[0]}


def _graph_ms(action: Callable[[], Any], repeats: int) -> float:
    """Median device time of an action's CUDA graph [ms]."""
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(3):
            action()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        action()
    times = []
    for _ in range(repeats + 1):
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        start.record()
        graph.replay()
        end.record()
        end.synchronize()
        times.append(start.elapsed_time(end))
    return statistics.median(times[1:])


def _blend_settings(scene: RasterScene, order: str) -> BlendSettings:
    return BlendSettings(
        scene.size, scene.size, parse_order(order), support=texture_support(scene.alpha.shape[-1]), **_OPTIONS
    )


@torch.no_grad()
def _prepared(scene: RasterScene) -> tuple[Any, torch.Tensor]:
    projection = project_billboards(
        *scene.billboards[:3], scene.viewmat, scene.K, near=_OPTIONS["near"], low_pass=1.0,
        support=texture_support(scene.alpha.shape[-1]),
    )  # fmt: skip
    return projection, canonical_rank(projection.depth, *scene.billboards)


def _samples(scene: RasterScene, order: str) -> int:
    from nbavatar.rendering.billboards.cpu import count_samples

    host = scene.to("cpu")
    projection, rank = _prepared(host)
    return count_samples(projection, rank, host.features, host.alpha, _blend_settings(host, order))


def crop(scene: RasterScene, side: int) -> tuple[RasterScene, int]:
    """The scene seen through a square window about the image's centre, and the window's first column and row."""
    side = min(side, scene.size)
    start = (scene.size - side) // 2
    K = scene.K.clone()
    K[:2, 2] -= start
    return RasterScene(*scene.billboards, scene.viewmat, K, side), start


def compare(scene: RasterScene, order: str) -> dict[str, Any]:
    """Values and gradients against the float64 reference on the CPU."""
    leaves = [tensor.detach().clone().requires_grad_() for tensor in scene.billboards]
    image, opacity = _render(RasterScene(*leaves, scene.viewmat, scene.K, scene.size), order)
    host = scene.to("cpu")
    wide = [tensor.detach().double().requires_grad_() for tensor in host.billboards]
    double = RasterScene(*wide, host.viewmat, host.K, host.size)
    start = time.perf_counter()
    expected, expected_opacity = _render(double, order, "reference")
    reference_ms = 1e3 * (time.perf_counter() - start)
    projection, rank = _prepared(host)
    safe = ~critical_pixels(projection, rank, host.alpha, _blend_settings(host, order))
    with torch.no_grad():
        errors = torch.cat([image.cpu() - expected, (opacity.cpu() - expected_opacity)[None]]).abs().amax(0)
    generator = torch.Generator().manual_seed(0)
    grads = [torch.randn(tensor.shape, generator=generator) * safe for tensor in (image, opacity)]
    torch.autograd.backward((image, opacity), [grad.to(image.device) for grad in grads])
    torch.autograd.backward((expected, expected_opacity), [grad.double() for grad in grads])
    relative = [
        float((a.grad.cpu().double() - b.grad).norm() / b.grad.norm())
        for a, b in zip(leaves, wide, strict=True)
        if a.grad is not None and b.grad is not None
    ]
    return {
        "reference_forward_ms": reference_ms, "max_abs_error": float((errors * safe).max()),
        "flipped_pixels": int((errors > 2e-5).sum()), "max_grad_rel_error": max(relative),
    }  # fmt: skip


@torch.no_grad()
def order_differences(scene: RasterScene) -> dict[str, float]:
    """Share of the covered pixels on which an order differs from `ray` by more than 1/255 in some channel."""
    exact, opacity = _render(scene, "ray")
    covered = int((opacity > 0).sum())
    shares = {}
    for order in ("kbuffer(16)", "kbuffer(8)", "kbuffer(4)", "kbuffer(2)", "center"):
        other, _ = _render(scene, order)
        shares[order] = float(((other - exact).abs().amax(0) > 1 / 255).sum()) / max(1, covered)
    return shares
