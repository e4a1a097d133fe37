"""Training of the paper's avatar as a `Method`: rates of the supplement, the loss of section 3.4."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nbavatar.config.training import TrainConfig
from nbavatar.data.lights import Light
from nbavatar.data.sequences import MeshSequence
from nbavatar.data.views import Sample, View
from nbavatar.errors import ConfigError
from nbavatar.methods.base import MeshAvatar, Method, StepLoss, Taken
from nbavatar.methods.billboards.avatar import Anchor, Avatar
from nbavatar.methods.billboards.compression.footprint import largest_footprints, texels_of
from nbavatar.methods.billboards.compression.prune import prune
from nbavatar.methods.billboards.compression.reduce import size_textures
from nbavatar.methods.billboards.initial import initial_avatar, neighbour_graph
from nbavatar.methods.billboards.objective import step_loss
from nbavatar.methods.billboards.offsets import SmoothOffsets
from nbavatar.methods.billboards.options import BillboardsConfig
from nbavatar.methods.billboards.start import take_over
from nbavatar.optimization.adam import Adam
from nbavatar.optimization.schedule import Plan

__all__ = ["BillboardTraining", "parameter_groups", "shared_gradient"]

_SAMPLED_VIEWS = 200  # a billboard shows for many frames, so a sample of the views finds it


class BillboardTraining(Method):
    """Neural billboards and their U-Net.

    Attributes:
        neighbours: of every billboard, int64 (F, K), or None when the term is off.
        offsets: smooth fields that move the billboards too, or None.
    """

    avatar: Avatar
    options: BillboardsConfig

    def __init__(
        self, avatar: Avatar, neighbours: Tensor | None, config: TrainConfig, offsets: SmoothOffsets | None = None
    ) -> None:
        super().__init__(avatar, config)
        self.neighbours, self.offsets = neighbours, offsets
        share = self.options.texel_sharing
        if share > 0:
            for textures in (avatar.billboards.features, avatar.billboards.alpha_logit):
                textures.register_hook(lambda gradient: shared_gradient(gradient, share))

    @classmethod
    def create(
        cls,
        sequence: MeshSequence,
        coords: Mapping[str, np.ndarray],
        views: Sequence[View],
        config: TrainConfig,
        device: str,
        light: Light | None = None,
    ) -> "BillboardTraining":
        """See `Method.create`."""
        options: BillboardsConfig = config.own
        if max(options.weight_mse, options.weight_l1, options.weight_dssim) == 0:
            weights = "--cfg.billboards: weight_mse, weight_l1, weight_dssim"
            raise ConfigError.of(weights, expected="one above 0, or no colour is learnt", found="three zeros")
        if options.gloss and not options.normals:
            raise ConfigError.of("--cfg.billboards.gloss", expected="false without `normals`", found="true")
        frames = [sequence.frames[row] for row in sorted({view.row for view in views})]
        avatar = initial_avatar(sequence, coords, frames, config, light).to(device)
        neighbours = neighbour_graph(avatar, sequence, config)
        offsets = SmoothOffsets(avatar, sequence, coords) if options.rates.offset > 0 else None
        return cls(avatar, None if neighbours is None else neighbours.to(device), config, offsets)

    def take_over(self, other: MeshAvatar, parts: Sequence[str]) -> Taken:
        """See `Method.take_over`."""
        assert isinstance(other, Avatar)
        return take_over(self.avatar, other, parts)

    def lpips_net(self) -> str | None:
        """See `Method.lpips_net`."""
        return self.config.lpips_net if self.options.weight_lpips > 0 else None

    def parameter_groups(self) -> list[dict[str, Any]]:
        """See `Method.parameter_groups`."""
        groups = parameter_groups(self.avatar, self.config)
        if self.offsets is not None:
            rates = self.options.rates
            field = {"name": "offset", "params": [self.offsets.coefficients], "final": rates.position_final}
            groups.append({**field, "lr": rates.offset * self.config.rate_factor})
        return groups

    def step_loss(
        self,
        sample: Sample,
        anchor: Anchor,
        lpips: Callable[[Tensor, Tensor], Tensor] | None,
        plan: Plan,
        random: torch.Generator,
    ) -> StepLoss:
        """See `Method.step_loss`."""
        return StepLoss(*step_loss(self.avatar, sample, anchor, self.neighbours, lpips, plan, self.config, random))

    def after_step(self, optimizer: Adam, aux: Any, step: int, progress: float, random: torch.Generator) -> None:
        """See `Method.after_step`."""
        if self.offsets is not None:
            self.offsets.apply()
        if self.avatar.refinement is not None:
            self.avatar.refinement.centre()

    def finish(self, meshes: Mapping[str, Tensor], views: Sequence[View]) -> Avatar:
        """Fewer billboards and smaller textures, where the options say so."""
        avatar, options = self.avatar, self.options
        if options.prune_margin is not None:
            avatar = prune(avatar, meshes, views, margin=options.prune_margin, most_views=_SAMPLED_VIEWS)
        if options.texture_density is not None:
            footprints = largest_footprints(avatar, meshes, views, most_views=_SAMPLED_VIEWS)
            avatar = size_textures(avatar, texels_of(footprints, options.texture_density))
        return avatar


def shared_gradient(gradient: Tensor, share: float) -> Tensor:
    """Gradient of textures (F, T, T, ...) with the mean over each billboard's texels added `share` times.

    Not part of the paper. A view touches few texels of a billboard, so each of them alone learns from few views; what
    they have in common, the colour of the place, is learnt from all. The direction is still one of descent: the
    gradient is multiplied by a positive definite matrix.
    """
    return gradient + share * gradient.mean((1, 2), keepdim=True)


def parameter_groups(avatar: Avatar, config: TrainConfig) -> list[dict[str, Any]]:
    """Groups with the rates of the supplement (`Method.parameter_groups`)."""
    billboards, rates = avatar.billboards, config.own.rates
    groups: list[dict[str, Any]] = [
        {"name": "position", "lr": rates.position, "params": [billboards.mu], "final": rates.position_final},
        {"name": "rotation", "lr": rates.rotation, "params": [billboards.quat]},
        {"name": "scale", "lr": rates.scale, "params": [billboards.log_scale]},
        {
            "name": "features",
            "lr": rates.features if config.own.deferred else rates.colour,
            "params": [billboards.features],
        },
        {"name": "alpha", "lr": rates.alpha, "params": [billboards.alpha_logit]},
    ]
    if avatar.unet is not None:
        network, matrices = list(avatar.unet.parameters()), []
        if config.own.unet_optimizer == "muon":
            matrices = avatar.unet.hidden_weights()
            own = {id(weight) for weight in matrices}
            network = [parameter for parameter in network if id(parameter) not in own]
        renderer = {"name": "renderer", "lr": rates.renderer, "params": network, "clip": config.own.clip}
        groups.append(renderer)
        if matrices:
            groups.append({**renderer, "params": matrices, "muon": True})
    if avatar.refinement is not None:
        groups.append({"name": "refine", "lr": config.own.refine.rate, "params": list(avatar.refinement.parameters())})
    return [{**group, "lr": group["lr"] * config.rate_factor} for group in groups]
