"""Training of Gaussians that are bound to triangles: the loss, rates and calendar of GaussianAvatars.

    L = 0.8 L1 + 0.2 (1 - SSIM) + 0.01 mean max(0, |x_l| - 1) + mean |max(0, s_l - 0.6)|

The last two over the Gaussians that are seen; x_l and s_l in units of the triangle. The meshes are given and are not
refined further.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nbavatar.config.training import TrainConfig
from nbavatar.data.sequences import MeshSequence
from nbavatar.data.views import Sample
from nbavatar.methods.base import StepLoss, modelled_parts
from nbavatar.methods.gaussians.avatar import PosedGaussians
from nbavatar.methods.gaussians.bound import BoundGaussians
from nbavatar.methods.gaussians.options import BoundConfig
from nbavatar.methods.gaussians.training import GaussianTraining
from nbavatar.optimization.adam import Adam
from nbavatar.optimization.schedule import Plan

__all__ = ["BoundTraining", "first_gaussians"]

_COLOUR_SPREAD = 1.0 / 255.0


class BoundTraining(GaussianTraining):
    """Bound Gaussians in training."""

    avatar: BoundGaussians
    options: BoundConfig

    def __init__(self, avatar: BoundGaussians, config: TrainConfig, extent: float) -> None:
        super().__init__(avatar, config, config.own.density, config.own.iterations, extent)

    def parameter_groups(self) -> list[dict[str, Any]]:
        """See `Method.parameter_groups`; the rate of the positions grows with the scene, as published."""
        rates = self.options.rates
        place = ("position", rates.position * self.extent, self.avatar.offset, rates.position_final)
        return self.groups_of(place, rates, rates.colour_rest)

    def step_loss(
        self,
        sample: Sample,
        anchor: Any,
        lpips: Callable[[Tensor, Tensor], Tensor] | None,
        plan: Plan,
        random: torch.Generator,
    ) -> StepLoss:
        """See `Method.step_loss`."""
        options = self.options
        pair, seen, posed = self.picture(sample, anchor, self.background(options.background, random))
        visible = seen.radii > 0
        rows = visible.nonzero().squeeze(1) if posed.rows is None else posed.rows[visible]
        terms = {"mse": pair.mse().detach(), "l1": pair.l1(), "dssim": pair.dssim()}
        total = (1.0 - options.weight_ssim) * terms["l1"] + options.weight_ssim * terms["dssim"]
        if len(rows) > 0:
            away = self.avatar.offset[rows].norm(dim=1) - options.threshold_position
            large = self.avatar.local_scales()[rows] - options.threshold_scale
            terms["position"] = away.clamp_min(0.0).mean()
            terms["scale"] = large.clamp_min(0.0).norm(dim=1).mean()
            total = total + options.weight_position * terms["position"] + options.weight_scale * terms["scale"]
        total = self.pose_loss(total, terms, posed)
        return StepLoss(total, {name: value.detach() for name, value in terms.items()}, seen)

    def pose_loss(self, total: Tensor, terms: dict[str, Tensor], posed: PosedGaussians) -> Tensor:
        """The loss with what a method adds about the pose's changes; its terms are put among the others."""
        return total

    def between_steps(self, optimizer: Adam, step: int, random: torch.Generator) -> None:
        """One more degree of harmonics every so often; those that a start brought stay in use."""
        degree = min(self.options.sh_degree, int(self.calendar.now // self.options.sh_interval))
        self.avatar.degree.clamp_(min=degree)


def first_gaussians(sequence: MeshSequence, config: TrainConfig) -> tuple[dict[str, Any], torch.Generator]:
    """Arguments of a `BoundGaussians` with one grey Gaussian a face, and the generator that coloured them.

    Args:
        sequence: meshes; faces and rest poses are used.
        config: training options; the same seed gives the same bits.
    """
    parts = modelled_parts(sequence, config)
    faces = {part: torch.from_numpy(np.asarray(sequence.parts[part].faces)) for part in parts}
    random = torch.Generator().manual_seed(config.seed)
    arguments = {
        "faces": faces,
        "vertex_counts": {part: len(sequence.parts[part].rest) for part in parts},
        "colour": _COLOUR_SPREAD * torch.rand((sum(map(len, faces.values())), 3), generator=random),
        "opacity": config.own.opacity,
        "sh_degree": config.own.sh_degree,
    }
    return arguments, random
