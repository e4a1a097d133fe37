"""Training of GaussianAvatars: its loss, rates and calendar.

    L = 0.8 L1 + 0.2 (1 - SSIM) + 0.01 mean max(0, |x_l| - 1) + mean |max(0, s_l - 0.6)|

The last two over the Gaussians that are seen; x_l and s_l in units of the triangle. The meshes are given and are not
refined further.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nbavatar.config.training import TrainConfig
from nbavatar.data.sequences import MeshSequence
from nbavatar.data.views import Sample, View
from nbavatar.methods.base import StepLoss, modelled_parts
from nbavatar.methods.gaussian_avatars.avatar import BoundAnchor, GaussianAvatars
from nbavatar.methods.gaussian_avatars.options import GaussianAvatarsConfig
from nbavatar.methods.gaussians.training import GaussianTraining, camera_extent
from nbavatar.optimization.adam import Adam
from nbavatar.optimization.schedule import Plan

__all__ = ["GaussianAvatarsTraining"]

_COLOUR_SPREAD = 1.0 / 255.0


class GaussianAvatarsTraining(GaussianTraining):
    """GaussianAvatars in training."""

    avatar: GaussianAvatars
    options: GaussianAvatarsConfig

    def __init__(self, avatar: GaussianAvatars, config: TrainConfig, extent: float) -> None:
        super().__init__(avatar, config, config.own.density, config.own.iterations, extent)

    @classmethod
    def create(
        cls,
        sequence: MeshSequence,
        coords: Mapping[str, np.ndarray],
        views: Sequence[View],
        config: TrainConfig,
        device: str,
    ) -> "GaussianAvatarsTraining":
        """See `Method.create`; spectral coordinates are not used."""
        options, parts = config.own, modelled_parts(sequence, config)
        faces = {part: torch.from_numpy(np.asarray(sequence.parts[part].faces)) for part in parts}
        random = torch.Generator().manual_seed(config.seed)
        colour = _COLOUR_SPREAD * torch.rand((sum(map(len, faces.values())), 3), generator=random)
        avatar = GaussianAvatars(
            faces,
            {part: len(sequence.parts[part].rest) for part in parts},
            colour=colour,
            opacity=options.opacity,
            sh_degree=options.sh_degree,
        ).to(device)
        return cls(avatar, config, options.extent or camera_extent(views))

    def parameter_groups(self) -> list[dict[str, Any]]:
        """See `Method.parameter_groups`; the rate of the positions grows with the scene, as published."""
        rates = self.options.rates
        place = ("position", rates.position * self.extent, self.avatar.offset, rates.position_final)
        return self.groups_of(place, rates, rates.colour_rest)

    def step_loss(
        self,
        sample: Sample,
        anchor: BoundAnchor,
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
        return StepLoss(total, {name: value.detach() for name, value in terms.items()}, seen)

    def between_steps(self, optimizer: Adam, step: int, random: torch.Generator) -> None:
        """One more degree of harmonics every so often; those that a start brought stay in use."""
        degree = min(self.options.sh_degree, int(self.calendar.now // self.options.sh_interval))
        self.avatar.degree.clamp_(min=degree)
