"""Optional backend for CUDA: the package gsplat (Apache-2.0), behind the same function.

It splats as this package does (same formulas, same clamp of the Jacobian, 16-pixel tiles in order of
depth) in float32, with three differences. Its threshold (1/255) and stop (1e-4) are built in, and so is its
cap: 0.99 from version 1.6 on, 0.999 before. Gaussians of equal depth are put in order by their places in
the arrays. Gradients are summed by atomic additions, so their last digits change from run to run.
"""

from typing import Any

import torch
from torch import Tensor

from nbavatar.errors import DataError, require
from nbavatar.rendering.gaussians.reference import SplatSettings

__all__ = ["render_gsplat"]

_TILE = 16  # pixels
_ALPHA_MIN, _T_MIN = 1.0 / 255.0, 1e-4
_SIGMAS = 3.0


def render_gsplat(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colours: Tensor,
    viewmat: Tensor,
    K: Tensor,
    settings: SplatSettings,
    *,
    near: float,
    low_pass: float,
    screen_offsets: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Renders with gsplat; arguments as `render_gaussians`, with plain colours (N, 3).

    Returns:
        Colour (3, H, W), alpha (H, W) and radii (N,), float32.

    Raises:
        DependencyError: gsplat is not installed.
        DataError: a setting that gsplat has not, or a skewed camera.
    """
    gsplat: Any = require("gsplat", "gsplat", "the splatting backend 'gsplat'")
    s = settings
    for name, value, fixed in (("alpha_min", s.alpha_min, _ALPHA_MIN), ("t_min", s.t_min, _T_MIN)):
        if abs(value - fixed) > 1e-9:
            raise DataError.of("render_gaussians", name, expected=f"{fixed:.6g} with backend 'gsplat'", found=value)
    if float(K[0, 1]) != 0:
        raise DataError.of("render_gaussians", "K", expected="no skew with backend 'gsplat'", found=float(K[0, 1]))
    means, quats, scales, opacities, colours = (t.float() for t in (means, quats, scales, opacities, colours))
    if len(means) == 0:
        empty = means.sum() + colours.sum()
        return (empty + means.new_zeros(3, s.height, s.width), means.new_zeros(s.height, s.width), means.new_zeros(0))
    boxes, centres, depths, conics, _ = gsplat.fully_fused_projection(
        means, None, quats, scales, viewmat.detach().float()[None], K.detach().float()[None], s.width, s.height,
        eps2d=low_pass, near_plane=near,
    )  # fmt: skip
    if screen_offsets is not None:
        centres = centres + screen_offsets.float()[None]
    across, down = -(-s.width // _TILE), -(-s.height // _TILE)
    _, entries, members = gsplat.isect_tiles(centres, boxes, depths, _TILE, across, down)
    starts = gsplat.isect_offset_encode(entries, 1, across, down)
    image, alpha = gsplat.rasterize_to_pixels(
        centres, conics, colours[None], opacities[None], s.width, s.height, _TILE,
        starts.reshape(1, down, across), members,
    )  # fmt: skip
    return image[0].permute(2, 0, 1), alpha[0, ..., 0], _radii(boxes[0], conics[0])


@torch.no_grad()
def _radii(boxes: Tensor, conics: Tensor) -> Tensor:
    """Three deviations along the longer axis [px], where gsplat found a box: (N, 2) or (N,), by version."""
    seen = (boxes > 0).reshape(len(boxes), -1).all(-1)
    xx, xy, yy = torch.where(seen[:, None], conics, torch.tensor([1.0, 0.0, 1.0], device=conics.device)).unbind(-1)
    least = 0.5 * (xx + yy) - (0.25 * (xx - yy).square() + xy * xy).sqrt()
    return torch.where(seen, _SIGMAS / least.clamp_min(1e-30).sqrt(), 0.0)
