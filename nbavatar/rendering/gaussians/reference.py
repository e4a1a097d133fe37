"""The definition of right: Gaussians blended in plain torch, float64, pixel by pixel.

Slow and simple. Memory stays bounded because the image is worked through in blocks of pixels,
forward and backward; a block's backward repeats its forward.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from nbavatar.rendering.blocks import pixel_blocks
from nbavatar.rendering.gaussians.projection import FAINTEST, Projection, support_box

__all__ = ["SplatSettings", "blend_reference", "critical_pixels"]


@dataclass(frozen=True)
class SplatSettings:
    """Numbers that steer the blending; see `render_gaussians`.

    Attributes:
        width, height: image [px].
        alpha_min, alpha_max: an alpha under the first is skipped, one over the second is capped.
        t_min: a pixel is finished before its transmittance falls under this.
    """

    width: int
    height: int
    alpha_min: float
    alpha_max: float
    t_min: float


def blend_reference(
    projection: Projection, rank: Tensor, opacities: Tensor, colours: Tensor, settings: SplatSettings
) -> tuple[Tensor, Tensor]:
    """Blends projected Gaussians front to back.

    Args:
        projection: of N Gaussians.
        rank: (N,) Gaussians in the order of blending.
        opacities: (N,) in [0, 1].
        colours: (N, 3).
        settings: see SplatSettings.

    Returns:
        Premultiplied colour (3, H, W) and alpha (H, W), float64, with gradients to
        `projection.form`, `opacities` and `colours`.
    """
    _, box = support_box(projection, opacities.detach(), settings.alpha_min)
    return _Blend.apply(projection.form, opacities, colours, box, rank, settings)


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, form, opacities, colours, box, rank, settings):
        s: SplatSettings = settings
        image = torch.zeros(4, s.height, s.width, dtype=torch.float64, device=form.device)
        for members, x, y in pixel_blocks(box, rank, s.width, s.height, 1):
            leaves = [tensor.detach()[members].double() for tensor in (form, opacities, colours)]
            image[:, y, x] = _blend_pixels(*leaves, x, y, s)
        ctx.save_for_backward(form, opacities, colours, box, rank)
        ctx.settings = s
        return image[:3].clone(), image[3].clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *grads):
        form, opacities, colours, box, rank = ctx.saved_tensors
        grad_image = torch.cat([grads[0], grads[1][None]])
        inputs = (form, opacities, colours)
        totals = [torch.zeros(tensor.shape, dtype=torch.float64, device=tensor.device) for tensor in inputs]
        s: SplatSettings = ctx.settings
        for members, x, y in pixel_blocks(box, rank, s.width, s.height, 1):
            with torch.enable_grad():
                leaves = [tensor.detach()[members].double().requires_grad_() for tensor in inputs]
                outputs = _blend_pixels(*leaves, x, y, s)
                parts = torch.autograd.grad(outputs, leaves, grad_image[:, y, x])
            for total, part in zip(totals, parts, strict=True):
                total.index_add_(0, members, part)
        cast = [total.to(tensor.dtype) for total, tensor in zip(totals, inputs, strict=True)]
        return *cast, None, None, None


def _alphas(form: Tensor, opacities: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Alpha of n Gaussians at P pixels before skipping and capping: (n, P)."""
    p, s, k, mx, my = (value[:, None] for value in form.unbind(-1))
    dx, dy = x.double() + 0.5 - mx, y.double() + 0.5 - my
    u, v = p * dx + s * dy, k * dy
    return opacities[:, None] * torch.exp(-0.5 * (u * u + v * v))


def _weights(raw: Tensor, s: SplatSettings) -> tuple[Tensor, Tensor, Tensor]:
    """Blending weights of alphas (n, P) in order, the transmittances after them, and which are hits."""
    hit = raw.detach() >= max(s.alpha_min, FAINTEST)
    alpha = torch.where(hit, raw, 0.0)
    alpha = torch.where(alpha > s.alpha_max, s.alpha_max, alpha)  # no gradient where capped
    after = torch.cumprod(1.0 - alpha, 0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    return torch.where(after >= s.t_min, before * alpha, 0.0), after, hit


def _blend_pixels(form: Tensor, opacities: Tensor, colours: Tensor, x: Tensor, y: Tensor, s: SplatSettings) -> Tensor:
    """Blends n Gaussians, given in order, at P pixels: colour and alpha (4, P)."""
    weight, _, _ = _weights(_alphas(form, opacities, x, y), s)
    return torch.cat([colours.T @ weight, weight.sum(0)[None]])


@torch.no_grad()
def critical_pixels(
    projection: Projection, rank: Tensor, opacities: Tensor, settings: SplatSettings, *, tolerance: float = 1e-5
) -> Tensor:
    """Pixels at which a rounding error of relative size `tolerance` could flip a decision.

    The decisions are: skip (alpha under `alpha_min`), cap (alpha over `alpha_max`, which turns its
    gradient off) and stop (transmittance under `t_min`). Implementations that differ by rounding
    agree closely everywhere else; here they may differ by a whole hit.

    Returns:
        (H, W) bool.
    """
    s = settings
    critical = torch.zeros(s.height, s.width, dtype=torch.bool, device=opacities.device)
    _, box = support_box(projection, opacities * (1 + tolerance), s.alpha_min)
    for members, x, y in pixel_blocks(box, rank, s.width, s.height, 1):
        raw = _alphas(projection.form[members], opacities[members].double(), x, y)
        _, after, hit = _weights(raw, s)
        least = max(s.alpha_min, FAINTEST)
        close = (raw - least).abs() <= tolerance * least
        close |= hit & ((raw - s.alpha_max).abs() <= tolerance * s.alpha_max)
        close |= hit & ((after - s.t_min).abs() <= 100 * tolerance * s.t_min)
        critical[y, x] = close.any(0)
    return critical
