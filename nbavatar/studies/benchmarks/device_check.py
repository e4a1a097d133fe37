"""Whether a device computes the right thing, and how fast: what `nbavatar doctor --gpu` says in one line.

Billboards are rendered and differentiated on the device and by the float64 reference on the CPU, in every order, with
textures and channels of several sizes, closed as after training and translucent as before it. Off the pixels on which
rounding may flip a decision, values must agree to 2e-5 and gradients to 1e-4 of their norm: the tolerances of the
kernels' tests, some hundred times what float32 leaves. Then a frame of a full-size avatar is timed.
"""

import statistics
import time
from collections.abc import Callable
from typing import Any

import torch

from nbavatar.devices import device_name
from nbavatar.errors import NBAvatarError
from nbavatar.methods.billboards.unet import UNet
from nbavatar.rendering.billboards import render_billboards
from nbavatar.studies.benchmarks.raster import compare
from nbavatar.studies.benchmarks.raster_scene import make_scene

__all__ = ["CASES", "check_device", "verdict"]

CASES = (
    ("initial", "ray", 6, 6),
    ("trained", "ray", 16, 6),
    ("trained", "kbuffer(4)", 8, 24),
    ("trained", "center", 16, 3),
)
"""State, order, texels and channels of the scenes that are compared."""
_VALUE, _GRADIENT = 2e-5, 1e-4
_FLIPPED = 0.05  # of the pixels may be decided otherwise: billboards that are spread at random cross each other
_ERRORS = ("value_error", "gradient_error", "flipped_pixels")
_SIDE, _BILLBOARDS = 32, 300  # of these scenes
_UNET: dict[str, Any] = {"width": 16, "convs": 1, "max_width": 96}  # of captures


def check_device(device: str, *, size: int = 1024, repeats: int = 5) -> dict[str, Any]:
    """Compares and times.

    Args:
        device: `cpu` or `cuda`.
        size: side of the frame that is timed [px]; a multiple of 32.
        repeats: frames a median is taken of.

    Returns:
        JSON-ready: `device`, `right`, `cases` (of each, its name, whether it is right, and `value_error`,
        `gradient_error`, `flipped_pixels`, or `failed` with the error's line), `size`, and, where all is right,
        `raster_ms`, `raster_backward_ms`, `decoder_ms` and `frame_ms`, medians.
    """
    cases = [_case(device, *case) for case in CASES]
    found: dict[str, Any] = {
        "device": device_name(device),
        "right": all(case["right"] for case in cases),
        "cases": cases,
        "size": size,
    }
    return found | (_times(device, size, repeats) if found["right"] else {})


def verdict(found: dict[str, Any]) -> str:
    """One line about what `check_device` found."""
    if not found["right"]:
        wrong = next(case for case in found["cases"] if not case["right"])
        errors = ", ".join(f"{name.replace('_', ' ')} {wrong.get(name)}" for name in _ERRORS)
        why = wrong.get("failed") or errors
        return f"{found['device']}: WRONG in {wrong['name']}: {why}; use --device cpu, and please report this line"
    worst = max(case["gradient_error"] for case in found["cases"])
    side = found["size"]
    return (
        f"{found['device']}: right in all {len(found['cases'])} scenes (largest error of a gradient {worst:.1e}); "
        f"{side}x{side} px: raster {found['raster_ms']:.2f} ms, backward {found['raster_backward_ms']:.2f} ms, "
        f"decoder {found['decoder_ms']:.2f} ms, frame {found['frame_ms']:.2f} ms"
    )


def _case(device: str, state: str, order: str, texels: int, channels: int) -> dict[str, Any]:
    """One scene, compared; what goes wrong on the device is a finding."""
    name = f"{order}, {texels} x {texels} texels, {channels} channels, {state}"
    scene = make_scene(size=_SIDE, billboards=_BILLBOARDS, texels=texels, channels=channels, state=state)
    try:
        errors = compare(scene.to(device), order)
    except (NBAvatarError, RuntimeError, ArithmeticError) as error:
        line = (str(error).splitlines() or [type(error).__name__])[0]
        return {"name": name, "right": False, "failed": line}
    value, gradient, flipped = (errors[key] for key in ("max_abs_error", "max_grad_rel_error", "flipped_pixels"))
    # Comparisons that a NaN fails, too.
    right = value <= _VALUE and gradient <= _GRADIENT and flipped <= _FLIPPED * _SIDE**2
    numbers = zip(_ERRORS, (value, gradient, flipped), strict=True)
    return {"name": name, "right": right} | {key: number if number == number else None for key, number in numbers}


def _times(device: str, size: int, repeats: int) -> dict[str, float]:
    scene = make_scene(size=size).to(device)
    inputs = [tensor.requires_grad_(True) for tensor in scene.billboards]
    unet = UNet(scene.features.shape[-1] + 1, **_UNET).to(device).to(memory_format=torch.channels_last).eval()

    def raster() -> tuple[torch.Tensor, torch.Tensor]:
        return render_billboards(*inputs, scene.viewmat, scene.K, size, size)

    def both() -> Any:
        features, alpha = raster()
        return torch.autograd.grad(features.sum() + alpha.sum(), inputs)

    with torch.no_grad():
        drawn, alpha = raster()
        features = torch.cat((drawn, alpha[None]))[None].contiguous(memory_format=torch.channels_last)
        forward = _median_ms(raster, repeats, device)
        decoder = _median_ms(lambda: unet(features), repeats, device)

        def frame() -> Any:
            colours, opacity = raster()
            return unet(torch.cat((colours, opacity[None]))[None].contiguous(memory_format=torch.channels_last))

        whole = _median_ms(frame, repeats, device)
    step = _median_ms(both, repeats, device)
    return {"raster_ms": forward, "raster_backward_ms": step - forward, "decoder_ms": decoder, "frame_ms": whole}


def _median_ms(call: Callable[[], Any], repeats: int, device: str) -> float:
    times = []
    for number in range(repeats + 1):
        _wait(device)
        began = time.perf_counter()
        call()
        _wait(device)
        if number:  # the first compiles
            times.append(1e3 * (time.perf_counter() - began))
    return statistics.median(times)


def _wait(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()
