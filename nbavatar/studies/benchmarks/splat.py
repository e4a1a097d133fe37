"""The Gaussian rasterizer on a full-size head and hand, measured warm and compared with the reference.

    nbavatar bench splat --json
    nbavatar bench splat --gaussians 100000 --size 512

One Gaussian a face of head and hand (11,514 of FLAME and MANO), as GaussianAvatars starts, or another
number spread over the same surface; colours are harmonics of degree 3. Figures: medians of wall time [ms]
of the whole function (projection, harmonics, sorting, tiles, blending), and of processor time over all
threads (`*_cpu_ms`), which other programs on the machine disturb less; `blend_ms` and `blend_backward_ms`
are the kernels alone, tiles included; `samples` are the hits blended into the image;
`max_abs_error` and `max_grad_rel_error` are against the float64 reference, off the `flipped_pixels`, where
rounding flips a decision (skip, cap, stop); `peak_mb` is what rendering forward and backward added to the
process's largest memory; `compile_s` the time until the kernels were ready.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from nbavatar.devices import device_name, peak_memory_mb
from nbavatar.errors import DataError
from nbavatar.rendering.gaussians import render_gaussians
from nbavatar.rendering.gaussians.cpu import blend_cpu, count_samples
from nbavatar.rendering.gaussians.projection import project_gaussians
from nbavatar.rendering.gaussians.reference import SplatSettings, critical_pixels
from nbavatar.rendering.ordering import canonical_rank
from nbavatar.studies.benchmarks.raster_scene import make_scene

__all__ = ["add_arguments", "run"]

_FACES = 11514
_OPTIONS = {"alpha_min": 1.0 / 255.0, "alpha_max": 0.99, "t_min": 1e-4}


@dataclass(frozen=True)
class _Scene:
    """Inputs of `render_gaussians` for an image of `size` by `size` pixels."""

    gaussians: tuple[Tensor, ...]
    viewmat: Tensor
    K: Tensor
    size: int

    def render(self, gaussians: tuple[Tensor, ...] | list[Tensor], backend: str) -> tuple[Tensor, Tensor]:
        """Colour and alpha of these Gaussians in this camera."""
        return render_gaussians(*gaussians, self.viewmat, self.K, self.size, self.size, backend=backend)[:2]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the scene's and the measurement's options."""
    parser.add_argument("--size", type=int, default=1024, help="image side [px] (default: %(default)s)")
    parser.add_argument("--gaussians", type=int, default=_FACES, help="number of Gaussians (default: %(default)s)")
    parser.add_argument("--degree", type=int, default=3, help="degree of the harmonics (default: %(default)s)")
    parser.add_argument("--repeats", type=int, default=7, help="runs a median is taken of (default: %(default)s)")
    parser.add_argument("--no-reference", action="store_true", help="skip the slow comparison; its figures are null")


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Measures; see the module's description for the figures.

    Raises:
        DataError: a number of Gaussians, pixels or repeats under 1, or a degree outside 0 to 3.
    """
    for name in ("size", "gaussians", "repeats"):
        if getattr(args, name) < 1:
            raise DataError.of("bench splat", f"--{name}", expected="at least 1", found=getattr(args, name))
    if args.degree not in range(4):
        raise DataError.of("bench splat", "--degree", expected="0 to 3", found=args.degree)
    scene = _make_scene(args.size, args.gaussians, args.degree)
    start = time.perf_counter()
    scene.render([tensor[:1] for tensor in scene.gaussians], "auto")
    figures: dict[str, Any] = {"compile_s": time.perf_counter() - start}
    figures |= _measure(scene, args.repeats)
    figures |= {"reference_forward_ms": None, "max_abs_error": None, "flipped_pixels": None, "max_grad_rel_error": None}
    if not args.no_reference:
        figures |= _compare(scene)
    return figures | {
        "threads": torch.get_num_threads(), "device": device_name("cpu"), "gaussians": args.gaussians,
        "degree": args.degree, "size": args.size,
    }  # fmt: skip


def _make_scene(size: int, count: int, degree: int) -> _Scene:
    base = make_scene(size=size, billboards=None if count == _FACES else count, channels=1, texels=1)
    generator = torch.Generator().manual_seed(0)
    thin = 0.1 * base.half_extents.amin(1, keepdim=True)
    scales = torch.cat([0.5 * base.half_extents, thin], 1)  # the square's side is four deviations
    opacities = 0.3 + 0.7 * torch.rand(count, generator=generator)
    colours = 0.2 * torch.randn(count, (degree + 1) ** 2, 3, generator=generator)
    return _Scene((base.means, base.quats, scales, opacities, colours), base.viewmat, base.K, size)


def _median_ms(action: Callable[[], Any], repeats: int) -> tuple[float, float]:
    """Medians of wall time and of processor time, summed over threads, after one run that warms up."""
    wall, processor = [], []
    for number in range(repeats + 1):
        start, start_processor = time.perf_counter(), time.process_time()
        action()
        if number:
            wall.append(1e3 * (time.perf_counter() - start))
            processor.append(1e3 * (time.process_time() - start_processor))
    return statistics.median(wall), statistics.median(processor)


def _leaves(scene: _Scene, dtype: torch.dtype) -> list[Tensor]:
    return [tensor.detach().to(dtype, copy=True).requires_grad_() for tensor in scene.gaussians]


def _measure(scene: _Scene, repeats: int) -> dict[str, Any]:
    """Times of the forward and the backward pass, and what they blend and take."""
    before = peak_memory_mb("cpu")
    with torch.no_grad():
        forward, forward_cpu = _median_ms(lambda: scene.render(scene.gaussians, "auto"), repeats)
    leaves = _leaves(scene, torch.float32)
    outputs = scene.render(leaves, "auto")
    grads = [torch.randn(output.shape, generator=torch.Generator().manual_seed(0)) for output in outputs]
    backward, backward_cpu = _median_ms(
        lambda: torch.autograd.grad(outputs, leaves, grads, retain_graph=True), max(3, repeats // 2)
    )
    peak = peak_memory_mb("cpu") - before
    means, quats, scales, opacities, colours = scene.gaussians
    settings = SplatSettings(scene.size, scene.size, **_OPTIONS)
    with torch.no_grad():
        projection = project_gaussians(
            means, quats, scales, scene.viewmat, scene.K, scene.size, scene.size, near=0.01, low_pass=0.3
        )
    rank = canonical_rank(projection.depth, means, quats, scales, colours, opacities)
    plain = colours[:, 0].abs().requires_grad_()
    with torch.no_grad():
        blend, _ = _median_ms(lambda: blend_cpu(projection, rank, opacities, plain, settings), repeats)
    blended = blend_cpu(projection, rank, opacities, plain, settings)
    behind, _ = _median_ms(lambda: torch.autograd.grad(blended, plain, grads, retain_graph=True), max(3, repeats // 2))
    samples = count_samples(projection, rank, opacities, plain, settings)
    return {
        "forward_ms": forward, "backward_ms": backward, "forward_cpu_ms": forward_cpu,
        "backward_cpu_ms": backward_cpu, "fps": 1e3 / forward, "blend_ms": blend, "blend_backward_ms": behind,
        "samples": samples, "msamples_per_s": samples / blend / 1e3, "peak_mb": peak,
    }  # fmt: skip


def _compare(scene: _Scene) -> dict[str, Any]:
    """Values and gradients against the float64 reference."""
    leaves, wide = _leaves(scene, torch.float32), _leaves(scene, torch.float64)
    outputs = scene.render(leaves, "auto")
    start = time.perf_counter()
    expected = scene.render(wide, "reference")
    reference_ms = 1e3 * (time.perf_counter() - start)
    with torch.no_grad():
        projection = project_gaussians(
            *wide[:3], scene.viewmat, scene.K, scene.size, scene.size, near=0.01, low_pass=0.3
        )
        rank = canonical_rank(projection.depth, *wide[:3], wide[4], wide[3])
        safe = ~critical_pixels(projection, rank, wide[3], SplatSettings(scene.size, scene.size, **_OPTIONS))
        errors = torch.cat([outputs[0] - expected[0], (outputs[1] - expected[1])[None]]).abs().amax(0)
    generator = torch.Generator().manual_seed(0)
    grads = [torch.randn(output.shape, generator=generator) * safe for output in outputs]
    torch.autograd.backward(outputs, grads)
    torch.autograd.backward(expected, [grad.double() for grad in grads])
    relative = [
        float((a.grad.double() - b.grad).norm() / b.grad.norm())
        for a, b in zip(leaves, wide, strict=True)
        if a.grad is not None and b.grad is not None
    ]
    return {
        "reference_forward_ms": reference_ms, "max_abs_error": float((errors * safe).max()),
        "flipped_pixels": int((errors > 2e-5).sum()), "max_grad_rel_error": max(relative),
    }  # fmt: skip
