"""The loss of one training step: the terms of the paper on one view (sections 3.3, 3.4 and 4.1).

Colours are compared by squared error, as in the paper, or by L1 and D-SSIM (`weight_mse`, `weight_l1`, `weight_dssim`).
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from nbavatar.config.training import TrainConfig
from nbavatar.data.views import Sample
from nbavatar.methods.base import compose
from nbavatar.methods.billboards.avatar import Anchor, Avatar, Window
from nbavatar.methods.billboards.losses import loss_delta, loss_dice, loss_dice_haha, loss_knn
from nbavatar.methods.billboards.options import BillboardsConfig
from nbavatar.methods.photometric import loss_dssim, loss_l1, loss_mse
from nbavatar.optimization.schedule import Plan

__all__ = ["Target", "step_loss", "target_in"]

_LPIPS_SIDE = 32  # the smallest picture the perceptual nets take, and a multiple of their strides


class Target(NamedTuple):
    """Ground truth in a window: premultiplied colour (3, h, w), coverage (h, w), ignored share (h, w), coverage
    missed.
    """

    colour: Tensor
    alpha: Tensor
    ignored: Tensor
    missed: Tensor


def target_in(window: Window, sample: Sample) -> Target:
    """Cut the ground truth to the window of a rendering.

    Outside the stored rectangle is background. Where a window reaches over the picture's border there is no truth, and
    it is ignored.
    """
    region = window.region
    planes = window.alpha.new_zeros((5, region.height, region.width))
    _, _, own_rows, own_columns = region.overlap(sample.width, sample.height)
    planes[4] = 1.0
    planes[4, own_rows, own_columns] = 0.0
    pixels = sample.pixels.to(planes.device, non_blocking=True)
    height, width = pixels.shape[-2:]
    x0, y0 = max(sample.x0, region.x0), max(sample.y0, region.y0)
    x1 = min(sample.x0 + width, region.x0 + region.width)
    y1 = min(sample.y0 + height, region.y0 + region.height)
    inside = pixels.new_zeros(())
    if x1 > x0 and y1 > y0:
        part = pixels[:, y0 - sample.y0 : y1 - sample.y0, x0 - sample.x0 : x1 - sample.x0]
        planes[:, y0 - region.y0 : y1 - region.y0, x0 - region.x0 : x1 - region.x0] = part
        inside = part[3].square().sum()
    missed = (pixels[3].square().sum() - inside).clamp_min(0.0)
    return Target(planes[:3], planes[3], planes[4], missed)


def step_loss(
    avatar: Avatar,
    sample: Sample,
    anchor: Anchor,
    neighbours: Tensor | None,
    lpips: Callable[[Tensor, Tensor], Tensor] | None,
    plan: Plan,
    config: TrainConfig,
    random: torch.Generator,
) -> tuple[Tensor, dict[str, Tensor], Window]:
    """Render one view and compare it.

    Args:
        avatar: the model.
        sample: the view, at the resolution of the stage.
        anchor: where its frame's billboards ride.
        neighbours: int64 [F, K], or None when the neighbour term is off.
        lpips: perceptual distance of two batches, or None when its weight is 0.
        plan: settings of this step.
        config: weights of the terms.
        random: CPU generator of background and crop; always drawn from in the same order.

    Returns:
        total loss, its unweighted terms (detached), and the rendered window.
    """
    options: BillboardsConfig = config.own
    device = avatar.faces.device
    background = torch.rand(3, generator=random).to(device)
    corner = torch.rand(2, generator=random).tolist()
    posed, keep = avatar.place(anchor)
    window = avatar.window(
        posed,
        keep,
        sample.view.viewmat.to(device),
        sample.K.to(device),
        sample.width,
        sample.height,
        precision=options.precision,
    )
    target = target_in(window, sample)
    truth = target.colour + (1.0 - target.alpha) * background[:, None, None]
    image = compose(window.colour, window.alpha, background)
    # Pixels of parts that are not in the model, that are covered, or beyond the picture say nothing about the model.
    image = torch.lerp(image, truth, target.ignored)
    nb_alpha = torch.lerp(window.nb_alpha, target.alpha, target.ignored)

    pixels = sample.width * sample.height
    terms, weights = _colours(image, truth, pixels, options)
    if lpips is not None and plan.perceptual:
        terms["lpips"] = _perceptual(lpips, image, truth, plan.crop, corner, pixels)
        # Rarer but heavier: the mean pull is the same.
        weights["lpips"] = options.weight_lpips * config.lpips_every
    if options.weight_nb > 0:
        if options.dice == "milletari":
            terms["nb"] = loss_dice(nb_alpha, target.alpha, missed=target.missed)
        else:
            terms["nb"] = loss_dice_haha(nb_alpha, target.alpha)
        weights["nb"] = options.weight_nb
    if neighbours is not None and options.weight_knn > 0 and keep is None:
        terms["knn"] = loss_knn(posed.means, posed.quats, posed.half_extents, neighbours)
        weights["knn"] = options.weight_knn
    if options.weight_delta > 0:
        terms["delta"] = loss_delta(avatar.billboards.mu)
        weights["delta"] = options.weight_delta
    if avatar.refinement is not None:
        terms["refine"] = anchor.penalty
        weights["refine"] = options.refine.weight
    total = torch.stack([weight * terms[name] for name, weight in weights.items()]).sum()
    return total, {name: value.detach() for name, value in terms.items()}, window


def _colours(
    image: Tensor, truth: Tensor, pixels: int, options: BillboardsConfig
) -> tuple[dict[str, Tensor], dict[str, float]]:
    """Terms that compare two pictures pixel by pixel or window by window, and the weights of those that count."""
    terms = {"mse": loss_mse(image, truth, pixels=pixels)}
    weights = {"mse": options.weight_mse, "l1": options.weight_l1, "dssim": options.weight_dssim}
    weights = {name: weight for name, weight in weights.items() if weight > 0}
    if "l1" in weights:
        terms["l1"] = loss_l1(image, truth, pixels=pixels)
    if "dssim" in weights:
        terms["dssim"] = loss_dssim(image, truth, pixels=pixels)
    return terms, weights


def _perceptual(
    lpips: Callable[[Tensor, Tensor], Tensor],
    image: Tensor,
    truth: Tensor,
    crop: int | None,
    corner: list[float],
    pixels: int,
) -> Tensor:
    """LPIPS of the window or of a crop in it, weighted by the window's share of the picture.

    LPIPS is a mean over pixels and zero where both pictures are plain background, so this equals (up to borders)
    LPIPS of the whole picture, and in expectation that of a random crop of it.
    """
    height, width = image.shape[-2:]
    share = min(1.0, height * width / pixels)
    if crop is not None and (crop < height or crop < width):
        h, w = min(crop, height), min(crop, width)
        top, left = int(corner[0] * (height - h + 1)), int(corner[1] * (width - w + 1))
        image = image[:, top : top + h, left : left + w]
        truth = truth[:, top : top + h, left : left + w]
    lacking = (max(0, _LPIPS_SIDE - image.shape[-1]), max(0, _LPIPS_SIDE - image.shape[-2]))
    if any(lacking):
        image, truth = (F.pad(x, (0, lacking[0], 0, lacking[1])) for x in (image, truth))
    return share * lpips(image[None], truth[None])[0]
