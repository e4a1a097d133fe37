"""Cells of the renderer in half precision, against float64: activations beyond 65504, tiny ones, black."""

import math
from typing import Any

import torch
from torch import Tensor

from nbavatar.methods.billboards.architecture import Architecture
from nbavatar.methods.billboards.avatar import Avatar
from nbavatar.methods.billboards.billboards import Billboards
from nbavatar.studies.extremes.cells import Limit, Sample, cell
from nbavatar.studies.extremes.compare import gradient_error, gradients, relative

__all__: list[str] = []

_SIDE = 32
_ORACLE = "the same network in float64"
_SCALES = (1.0, 1e-3, 1e-8, 0.0, 10.0, 1e3, 1e5, 1e7, 1e30)
_QUICK = (1.0, 0.0, 1e7)


def _avatar(channels: int = 6) -> Avatar:
    torch.manual_seed(0)
    architecture = Architecture(
        channels=channels,
        texels=2,
        deferred=True,
        unet_width=8,
        unet_depth=3,
        unet_max_width=32,
        unet_convs=1,
        roi=False,
        roi_margin=0.0,
        order="ray",
    )
    billboards = Billboards(torch.ones(1, 2), torch.zeros(1, 2, 2, channels), torch.zeros(1, 2, 2))
    return Avatar(architecture, {"head": torch.tensor([[0, 1, 2]])}, {"head": 3}, billboards)


def _inputs(scale: float, channels: int = 6) -> tuple[Tensor, Tensor]:
    random = torch.Generator().manual_seed(1)
    alpha = (torch.rand(_SIDE, _SIDE, generator=random) - 0.3).clamp(0, 1)
    return scale * torch.randn(channels, _SIDE, _SIDE, generator=random) * alpha, alpha


def _decode(scale: float, precision: str, *, constant: bool = False) -> Sample:
    avatar = _avatar()
    features, alpha = _inputs(scale)
    if constant:
        features, alpha = torch.full_like(features, scale), torch.ones_like(alpha)
    probe = torch.randn(4, _SIDE, _SIDE, generator=torch.Generator().manual_seed(2))
    outputs: list[Tensor] = []

    def loss(module: Avatar, precision: str):
        def run(values: Tensor, cover: Tensor) -> Tensor:
            colour, opacity = module.decode(values, cover, precision)
            outputs.append(torch.cat((colour, opacity[None])))
            return (outputs[-1] * probe.to(colour.dtype)).sum()

        return run

    _, found = gradients(loss(avatar, precision), [features, alpha])
    double = _avatar().double()
    assert double.unet is not None and avatar.unet is not None
    double.unet.load_state_dict(avatar.unet.double().state_dict())
    _, true = gradients(loss(double, "fp32"), [features.double(), alpha.double()])
    # A sigmoid that is saturated has gradients of 1e-160, of which no format but the oracle's knows.
    least = [1e-4 / max(float(values.norm()), 1.0) for values in (features, alpha)]
    errors = [gradient_error([f], [t], least=floor) for f, t, floor in zip(found, true, least, strict=True)]
    return Sample(relative(outputs[0], outputs[1]), math.nan if any(map(math.isnan, errors)) else max(errors))


def _cell(precision: str, condition: str, **more: Any):
    axis = "largest feature [1]"
    return cell("halfprecision", f"decode {precision}", condition, axis, _SCALES, quick=_QUICK, oracle=_ORACLE, **more)


_SATURATED = "activations of 1e5 and more: decided by the last digits"


@_cell("fp32", "magnitude of the features", limits=(Limit(lambda scale: float(scale) >= 1e5, 1e-4, 1e-2, _SATURATED),))
def _single(scale: float) -> Sample:
    return _decode(scale, "fp32")


@_cell("fp32", "constant image", limits=(Limit(lambda scale: float(scale) >= 1e5, 1e-4, 1.5, _SATURATED),))
def _single_constant(scale: float) -> Sample:
    return _decode(scale, "fp32", constant=True)


@_cell(
    "bf16",
    "magnitude of the features",
    limits=(
        Limit(lambda scale: float(scale) >= 1e3, 0.1, 2.0, _SATURATED),
        Limit(lambda scale: True, 2e-2, 0.3, "bf16 has 8 bits"),
    ),
)
def _brain(scale: float) -> Sample:
    return _decode(scale, "bf16")


# Beyond 65504 the network itself falls back to float32, so that the errors become small again.
@_cell("fp16", "magnitude of the features", limits=(Limit(lambda scale: True, 5e-3, 0.2, "fp16 has 11 bits"),))
def _half(scale: float) -> Sample:
    return _decode(scale, "fp16")


@_cell("fp16", "constant image", limits=(Limit(lambda scale: True, 5e-3, 1.5, "fp16 has 11 bits"),))
def _half_constant(scale: float) -> Sample:
    return _decode(scale, "fp16", constant=True)
