"""Adaptive density: Gaussians that the pictures pull at are doubled or split, faint and huge ones removed.

After Kerbl et al. 2023, section 5: the gradient by the projected centre, averaged over the views that saw a Gaussian,
says where there are too few; small ones are doubled, large ones replaced by two children of 1 / 1.6 their size.
Every change is one gather over rows, applied alike to parameters, Adam's moments and the binding to the mesh, so the
three cannot drift apart.
"""

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from nbavatar.methods.gaussians.avatar import GaussianAvatar
from nbavatar.optimization.adam import Adam

__all__ = ["Statistics", "densify", "rearrange", "remove", "reset_opacity"]

_CHILDREN = 2
_SHRINK = 0.8 * _CHILDREN
_RESET_OPACITY = 0.01


class Statistics:
    """What was seen of each Gaussian since the last change.

    Attributes:
        gradient: sum of the gradients' lengths, (N,); views: in how many views, (N,); radius: largest on screen [px].
    """

    def __init__(self, count: int, device: torch.device | str = "cpu") -> None:
        self.gradient, self.views, self.radius = (torch.zeros(count, device=device) for _ in range(3))

    def observe(self, gradient: Tensor, radii: Tensor, rows: Tensor | None, width: int, height: int) -> None:
        """Add one view.

        Args:
            gradient: of the loss by the projected centres [1/px], (M, 2).
            radii: on screen [px], (M,); 0 for those not seen.
            rows: which Gaussians these are, int64 (M,), or None for all.
            width, height: of the picture [px]; gradients are counted per half picture.
        """
        seen = radii > 0
        half = gradient.new_tensor([0.5 * width, 0.5 * height])
        lengths = torch.where(seen, (gradient * half).norm(dim=1), 0.0)
        if rows is None:
            rows = torch.arange(len(radii), device=radii.device)
        self.gradient[rows] += lengths
        self.views[rows] += seen.to(self.views.dtype)
        self.radius[rows] = torch.maximum(self.radius[rows], radii)

    def mean(self) -> Tensor:
        """Mean gradient of each Gaussian over the views that saw it, (N,)."""
        return self.gradient / self.views.clamp_min(1.0)

    def state_dict(self) -> dict[str, Tensor]:
        """The three sums."""
        return {"gradient": self.gradient, "views": self.views, "radius": self.radius}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Takes over what `state_dict` gave."""
        self.gradient, self.views, self.radius = (
            state[name].to(self.gradient.device).clone() for name in ("gradient", "views", "radius")
        )


@torch.no_grad()
def rearrange(
    avatar: GaussianAvatar,
    optimizer: Adam,
    source: Tensor,
    fresh: Tensor,
    values: Mapping[str, Tensor] | None = None,
) -> None:
    """Give an avatar new rows.

    Args:
        avatar: whose parameters and buffers are replaced.
        optimizer: whose parameters they are.
        source: Gaussian that each new row copies, int64 (N',).
        fresh: rows that are new and start without moments, bool (N',).
        values: by name, what the fresh rows hold instead of a copy, in their order.
    """
    values = values or {}
    for name in avatar.PARAMETERS:
        old = getattr(avatar, name)
        rows = old.detach()[source].clone()
        if name in values:
            rows[fresh] = values[name].to(rows.dtype)
        new = nn.Parameter(rows)
        optimizer.replace(old, new, source, fresh)
        setattr(avatar, name, new)
    for name in avatar.BUFFERS:
        rows = getattr(avatar, name)[source].clone()
        if name in values:
            rows[fresh] = values[name].to(rows.dtype)
        setattr(avatar, name, rows)


@torch.no_grad()
def densify(
    avatar: GaussianAvatar,
    optimizer: Adam,
    gradient: Tensor,
    sizes: Tensor,
    random: torch.Generator,
    *,
    threshold: float,
    split_above: float,
    most: int | None = None,
) -> Tensor:
    """Double and split.

    Args:
        avatar, optimizer: changed in place.
        gradient: mean gradient of every Gaussian, (N,).
        sizes: its longest axis in the world [m], (N,).
        random: CPU generator of the children's places.
        threshold: Gaussians with at least this gradient are densified.
        split_above: those larger than this are split, the others doubled [m].
        most: largest number of Gaussians; those with the strongest gradients come first.

    Returns:
        source: Gaussian that each new row came from, int64 (N',).
    """
    count = len(gradient)
    chosen = (gradient >= threshold).nonzero().squeeze(1)
    if most is not None and count + len(chosen) > most:
        order = torch.sort(gradient[chosen], descending=True, stable=True).indices
        chosen = chosen[order[: max(0, most - count)]].sort().values
    large = sizes[chosen] > split_above
    doubled, split = chosen[~large], chosen[large]
    stays = torch.ones(count, dtype=torch.bool, device=gradient.device)
    stays[split] = False
    parents = split.repeat(_CHILDREN)
    kept = stays.nonzero().squeeze(1)
    source = torch.cat((kept, doubled, parents))
    fresh = torch.arange(len(source), device=source.device) >= len(kept)
    noise = torch.randn((len(parents), 3), generator=random).to(gradient.device)
    values: dict[str, Tensor] = {}
    for name, rows in avatar.offspring(parents, noise).items():
        values[name] = torch.cat((getattr(avatar, name)[doubled], rows.to(getattr(avatar, name).dtype)))
    smaller = avatar.log_scale[parents] - math.log(_SHRINK)
    values["log_scale"] = torch.cat((avatar.log_scale[doubled], smaller))
    rearrange(avatar, optimizer, source, fresh, values)
    return source


@torch.no_grad()
def remove(avatar: GaussianAvatar, optimizer: Adam, unwanted: Tensor) -> Tensor:
    """Remove Gaussians, except those that the method spares.

    Args:
        avatar, optimizer: changed in place.
        unwanted: bool (N,).

    Returns:
        source: Gaussian that each remaining row was, int64 (N',).
    """
    source = (~avatar.spared(unwanted)).nonzero().squeeze(1)
    if len(source) < len(unwanted):
        rearrange(avatar, optimizer, source, torch.zeros(len(source), dtype=torch.bool, device=source.device))
    return source


@torch.no_grad()
def reset_opacity(avatar: GaussianAvatar, optimizer: Adam) -> None:
    """Bring all opacities down to 0.01 at most, and forget their moments: what is not needed stays faint."""
    ceiling = math.log(_RESET_OPACITY / (1.0 - _RESET_OPACITY))
    old: Any = avatar.opacity_logit
    new = nn.Parameter(old.detach().clamp_max(ceiling).clone())
    optimizer.replace(old, new, None, torch.ones(len(old), dtype=torch.bool, device=old.device))
    avatar.opacity_logit = new
