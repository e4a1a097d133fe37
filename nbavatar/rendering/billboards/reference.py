"""The definition of right: billboards blended in plain torch, float64, one full sort a pixel.

Slow and simple. Memory stays bounded because the image is worked through in blocks of pixels,
forward and backward; a block's backward repeats its forward. Textures are sampled by
`torch.nn.functional.grid_sample(align_corners=True, padding_mode="zeros")`.
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from nbavatar.rendering.blocks import pixel_blocks
from nbavatar.rendering.patches import ProjectedPatches

__all__ = ["BlendSettings", "blend_reference", "critical_pixels"]

_OWN = 4  # numbers beside its features that a billboard takes at a pixel


@dataclass(frozen=True)
class BlendSettings:
    """Numbers that steer the blending; see `render_billboards`.

    Attributes:
        width, height: image [px].
        queue: -1 exact order by depth at the ray, 0 order by rank, n > 0 a queue of n hits.
        near: [m].
        alpha_min, alpha_max: a texel sample under the first is skipped, a hit is capped at the second.
        t_min: a pixel is finished once its transmittance is under this.
        support: half-width of the textures in texture coordinates.
    """

    width: int
    height: int
    queue: int
    near: float
    alpha_min: float
    alpha_max: float
    t_min: float
    support: float


def blend_reference(
    projection: ProjectedPatches, rank: Tensor, features: Tensor, alpha: Tensor, settings: BlendSettings
) -> tuple[Tensor, Tensor]:
    """Blends projected billboards front to back.

    Args:
        projection: of F billboards.
        rank: (F,) billboards in rank order.
        features: (F, T, T, C).
        alpha: (F, T, T) in [0, 1].
        settings: see BlendSettings.

    Returns:
        Premultiplied features (C, H, W) and alpha (H, W), float64, with gradients to
        `projection.plane`, `projection.fade`, `features` and `alpha`.
    """
    return _Blend.apply(projection.plane, projection.fade, features, alpha, projection.bounds, rank, settings)


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, plane, fade, features, alpha, bounds, rank, settings):
        s: BlendSettings = settings
        image = torch.zeros(features.shape[-1], s.height, s.width, dtype=torch.float64, device=plane.device)
        opacity = torch.zeros(s.height, s.width, dtype=torch.float64, device=plane.device)
        for members, x, y in pixel_blocks(bounds, rank, s.width, s.height, features.shape[-1] + _OWN):
            leaves = [tensor.detach()[members].double() for tensor in (plane, fade, features, alpha)]
            colour, cover = _blend_pixels(*leaves, x, y, s)
            image[:, y, x], opacity[y, x] = colour, cover
        ctx.save_for_backward(plane, fade, features, alpha, bounds, rank)
        ctx.settings = s
        return image, opacity

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *grads):
        plane, fade, features, alpha, bounds, rank = ctx.saved_tensors
        grad_image, grad_opacity = grads
        inputs = (plane, fade, features, alpha)
        totals = [torch.zeros(tensor.shape, dtype=torch.float64, device=tensor.device) for tensor in inputs]
        s: BlendSettings = ctx.settings
        for members, x, y in pixel_blocks(bounds, rank, s.width, s.height, features.shape[-1] + _OWN):
            with torch.enable_grad():
                leaves = [tensor.detach()[members].double().requires_grad_() for tensor in inputs]
                outputs = _blend_pixels(*leaves, x, y, s)
                parts = torch.autograd.grad(outputs, leaves, (grad_image[:, y, x], grad_opacity[y, x]))
            for total, part in zip(totals, parts, strict=True):
                total.index_add_(0, members, part)
        cast = [total.to(tensor.dtype) for total, tensor in zip(totals, inputs, strict=True)]
        return *cast, None, None, None


def _blend_pixels(
    plane: Tensor, fade: Tensor, features: Tensor, alpha: Tensor, x: Tensor, y: Tensor, s: BlendSettings
) -> tuple[Tensor, Tensor]:
    """Blends n billboards, given in rank order, at P pixels: (C, P) and (P,)."""
    hit, u, v, w, hit_alpha = _hits(plane, fade, alpha, x, y, s)
    order = _order(w, hit, s.queue)
    sorted_alpha = hit_alpha if order is None else hit_alpha.gather(0, order)
    transmittance = torch.cumprod(1.0 - sorted_alpha, 0)
    transmittance = torch.cat([torch.ones_like(transmittance[:1]), transmittance[:-1]])
    weight = torch.where(transmittance >= s.t_min, transmittance * sorted_alpha, 0.0)
    if order is not None:
        weight = torch.zeros_like(weight).scatter(0, order, weight)
    samples = _sample(features.permute(0, 3, 1, 2), u, v)
    return (samples * weight[:, None]).sum(0), weight.sum(0)


def _hits(
    plane: Tensor, fade: Tensor, alpha: Tensor, x: Tensor, y: Tensor, s: BlendSettings
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Intersections of n billboards with P rays: hit, u, v, inverse depth, alpha, each (n, P)."""
    px, py = x.double() + 0.5, y.double() + 0.5
    pu, pv, pw = (plane[:, i, 0:1] * px + plane[:, i, 1:2] * py + plane[:, i, 2:3] for i in range(3))
    with torch.no_grad():
        reach = s.support * pw
        hit = (pw > 0) & (pw <= 1.0 / s.near) & (pu.abs() <= reach) & (pv.abs() <= reach)
    pw = torch.where(hit, pw, 1.0)
    u, v = torch.where(hit, pu, 0.0) / pw, torch.where(hit, pv, 0.0) / pw
    texel = _sample(alpha[:, None], u, v)[:, 0]
    hit = hit & (texel.detach() >= s.alpha_min)
    hit_alpha = torch.where(hit, fade[:, None] * texel, 0.0)
    hit_alpha = torch.where(hit_alpha > s.alpha_max, s.alpha_max, hit_alpha)  # no gradient where capped
    return hit, u, v, pw.detach(), hit_alpha


def _sample(textures: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Samples (n, C, T, T) at (n, P) texture coordinates: (n, C, P)."""
    single = textures.shape[-1] == 1
    # One texel: grid_sample with aligned corners would ignore the coordinate; unaligned at half the
    # coordinate it is the tent max(0, 1 - |u|) max(0, 1 - |v|).
    grid = torch.stack([u, v], -1)[:, None] * (2.0 if single else 1.0)
    sampled = grid_sample(textures, grid, mode="bilinear", padding_mode="zeros", align_corners=not single)
    return sampled[:, :, 0]


@torch.no_grad()
def _order(w: Tensor, hit: Tensor, queue: int) -> Tensor | None:
    """Order in which each pixel blends its n candidates: (n, P) indices, or None for rank order."""
    if queue == 0:
        return None
    key = torch.where(hit, -w, torch.inf)
    if queue < 0 or queue >= len(w):
        return torch.sort(key, dim=0, stable=True).indices
    return _queue_order(key, hit, queue)


def _queue_order(key: Tensor, hit: Tensor, queue: int) -> Tensor:
    """Order left by a queue of `queue` hits that gives up its nearest when one more arrives."""
    count, pixels = key.shape
    columns = torch.arange(pixels, device=key.device)
    order = torch.full((count, pixels), -1, dtype=torch.int64, device=key.device)
    filled = torch.zeros(pixels, dtype=torch.int64, device=key.device)
    waiting = torch.full((queue + 1, pixels), torch.inf, dtype=key.dtype, device=key.device)
    who = torch.full((queue + 1, pixels), -1, dtype=torch.int64, device=key.device)

    def give_up(where: Tensor) -> None:
        # the nearest; of equal depths the one of lower rank
        least = waiting.amin(0)
        tied = torch.where((waiting == least) & (who >= 0), who, count)
        slot = tied.argmin(0)[where]
        order[filled[where], columns[where]] = who[slot, columns[where]]
        filled[where] += 1
        waiting[slot, columns[where]] = torch.inf
        who[slot, columns[where]] = -1

    for index in range(count):
        free = (who < 0).to(torch.int8).argmax(0)
        now = hit[index]
        waiting[free[now], columns[now]] = key[index, now]
        who[free[now], columns[now]] = index
        give_up((who >= 0).all(0))
    for _ in range(queue):
        give_up((who >= 0).any(0))
    # candidates that are no hits have alpha 0: they may stand anywhere, each exactly once
    missing = ~hit
    place = filled + torch.cumsum(missing, 0) - 1
    rows = torch.arange(count, device=key.device)[:, None].expand_as(hit)
    order[place[missing], columns.expand_as(hit)[missing]] = rows[missing]
    return order


@torch.no_grad()
def critical_pixels(
    projection: ProjectedPatches, rank: Tensor, alpha: Tensor, settings: BlendSettings, *, tolerance: float = 1e-5
) -> Tensor:
    """Pixels at which a rounding error of relative size `tolerance` could flip a decision.

    The decisions are: skip a hit (alpha under `alpha_min`), stop (transmittance under `t_min`),
    clip (depth under `near`) and which of two hits is nearer. Implementations that differ by
    rounding agree closely everywhere else; here they may differ by a whole hit.

    Returns:
        (H, W) bool.
    """
    s = settings
    critical = torch.zeros(s.height, s.width, dtype=torch.bool, device=alpha.device)
    for members, x, y in pixel_blocks(projection.bounds, rank, s.width, s.height, 1 + _OWN):
        plane, fade, textures = (t.detach()[members].double() for t in (projection.plane, projection.fade, alpha))
        open_settings = BlendSettings(s.width, s.height, s.queue, s.near / (1 + tolerance), 0.0, s.alpha_max, 0.0,
                                      s.support)  # fmt: skip
        candidate, u, v, w, _ = _hits(plane, fade, textures, x, y, open_settings)
        texel = _sample(textures[:, None], u, v)[:, 0]
        close = candidate & ((texel - s.alpha_min).abs() <= tolerance)
        close |= candidate & ((w * s.near - 1.0).abs() <= tolerance) & (texel > 0)
        hit, _, _, w, hit_alpha = _hits(plane, fade, textures, x, y, s)
        order = _order(w, hit, s.queue)
        if order is None:
            order = torch.arange(len(w), device=w.device)[:, None].expand_as(w)
        transmittance = torch.cumprod(1.0 - hit_alpha.gather(0, order), 0)
        near_stop = ((transmittance - s.t_min).abs() <= 100 * tolerance * s.t_min) & hit.gather(0, order)
        bad = close.any(0) | near_stop.any(0)
        if s.queue != 0 and len(w) > 1:
            depths = torch.sort(torch.where(hit, w, 0.0), dim=0, descending=True).values
            gap = depths[:-1] - depths[1:]
            bad |= ((gap > 0) & (gap <= tolerance * depths[:-1]) & (depths[1:] > 0)).any(0)
        critical[y, x] = bad
    return critical
