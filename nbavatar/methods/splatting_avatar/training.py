"""Training of SplattingAvatar: its loss, rates and calendar, in two modes (`nbavatar.methods.splatting_avatar.avatar`).

    L = L1 + 10 MSE + 0.01 LPIPS (inside the true silhouette) + mean size of the Gaussians that are large and stretched

In the mode `released` heights are trained up to the first walk only: the public code's optimizer then holds a copy of
them that the model no longer has.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from nbavatar.config.training import TrainConfig
from nbavatar.data.lights import Light
from nbavatar.data.sequences import MeshSequence
from nbavatar.data.views import Sample, View
from nbavatar.methods.base import StepLoss, modelled_parts
from nbavatar.methods.gaussians.losses import Pair
from nbavatar.methods.gaussians.training import GaussianTraining
from nbavatar.methods.splatting_avatar.avatar import EmbeddedAnchor, SplattingAvatar
from nbavatar.methods.splatting_avatar.options import SplattingAvatarConfig
from nbavatar.optimization.adam import Adam
from nbavatar.optimization.schedule import Plan

__all__ = ["SplattingAvatarTraining", "nearest_distances", "sample_surface"]

_LPIPS_SIDE = 32  # the smallest picture the perceptual nets take
_NEIGHBOURS = 3
_WALK_FLOOR = 10  # in a shortened training, fewest steps between walks


class SplattingAvatarTraining(GaussianTraining):
    """SplattingAvatar in training."""

    avatar: SplattingAvatar
    options: SplattingAvatarConfig

    def __init__(self, avatar: SplattingAvatar, config: TrainConfig) -> None:
        super().__init__(avatar, config, config.own.density, config.own.iterations, config.own.extent)

    @classmethod
    def create(
        cls,
        sequence: MeshSequence,
        coords: Mapping[str, np.ndarray],
        views: Sequence[View],
        config: TrainConfig,
        device: str,
        light: Light | None = None,
    ) -> "SplattingAvatarTraining":
        """See `Method.create`; spectral coordinates are not used."""
        options, parts = config.own, modelled_parts(sequence, config)
        meshes = [sequence.parts[part] for part in parts]
        first = np.cumsum([0, *(len(mesh.rest) for mesh in meshes)])
        rest = torch.from_numpy(np.concatenate([np.asarray(mesh.rest, np.float32) for mesh in meshes]))
        faces = torch.from_numpy(np.concatenate([np.asarray(m.faces) + n for m, n in zip(meshes, first, strict=False)]))
        random = torch.Generator().manual_seed(config.seed)
        face, bary = sample_surface(rest, faces, options.samples, random, by_area=options.mode == "paper")
        points = (bary[..., None] * rest[faces[face]]).sum(1)
        avatar = SplattingAvatar(
            {part: torch.from_numpy(np.asarray(mesh.faces)) for part, mesh in zip(parts, meshes, strict=True)},
            {part: len(mesh.rest) for part, mesh in zip(parts, meshes, strict=True)},
            rest=rest,
            face=face,
            bary=bary,
            log_scale=nearest_distances(points).log()[:, None].expand(-1, 3),
            opacity=options.opacity,
            sh_degree=options.sh_degree,
            mode=options.mode,
        ).to(device)
        return cls(avatar, config)

    def lpips_net(self) -> str | None:
        """See `Method.lpips_net`."""
        return self.config.lpips_net if self.options.weight_lpips > 0 else None

    def parameter_groups(self) -> list[dict[str, Any]]:
        """See `Method.parameter_groups`."""
        rates = self.options.rates
        place = ("embedding", rates.embedding, self.avatar.uvd, rates.embedding_final)
        return self.groups_of(place, rates, rates.colour)

    def step_loss(
        self,
        sample: Sample,
        anchor: EmbeddedAnchor,
        lpips: Callable[[Tensor, Tensor], Tensor] | None,
        plan: Plan,
        random: torch.Generator,
    ) -> StepLoss:
        """See `Method.step_loss`."""
        options = self.options
        self.avatar.uvd.requires_grad_(not self._frozen())
        pair, seen, posed = self.picture(sample, anchor, self.background(options.background, random))
        terms = {"mse": pair.mse(), "l1": pair.l1()}
        total = terms["l1"] + options.weight_mse * terms["mse"]
        if lpips is not None and plan.perceptual and options.weight_lpips > 0:
            terms["lpips"] = _masked_lpips(lpips, pair)
            # Rarer but heavier: the mean pull is the same.
            total = total + options.weight_lpips * self.config.lpips_every * terms["lpips"]
        longest, shortest = posed.scales.amax(1), posed.scales.amin(1)
        stretched = (longest > options.threshold_scale) & (longest > options.threshold_ratio * shortest)
        if options.weight_scale > 0 and bool(stretched.any()):
            terms["scale"] = longest[stretched].mean()
            total = total + options.weight_scale * terms["scale"]
        return StepLoss(total, {name: value.detach() for name, value in terms.items()}, seen)

    def between_steps(self, optimizer: Adam, step: int, random: torch.Generator) -> None:
        """Every so often, walk."""
        if self.options.mode == "paper" and self.calendar.due(self.options.walk_interval, _WALK_FLOOR):
            self.walk_all(optimizer)

    @torch.no_grad()
    def walk_all(self, optimizer: Adam) -> None:
        """Turn the steps u, v of all Gaussians into walks on the surface; u, v and their moments become 0."""
        avatar = self.avatar
        rows = torch.arange(avatar.primitives, device=avatar.face.device)
        avatar.face, avatar.bary = avatar.walked(rows, avatar.pending_change())
        avatar.uvd[:, :2] = 0.0
        moments = optimizer.moments(avatar.uvd)
        for moment in moments or ():
            moment[:, :2] = 0.0

    def _frozen(self) -> bool:
        """Whether the embedding is no longer trained: the released code loses it at the first walk."""
        return self.options.mode == "released" and self.calendar.now >= self.options.walk_interval


def sample_surface(
    rest: Tensor, faces: Tensor, count: int, random: torch.Generator, *, by_area: bool
) -> tuple[Tensor, Tensor]:
    """Random points on a mesh.

    Args:
        rest: vertices [m], (V, 3); faces: (F, 3).
        count: number of points.
        random: CPU generator.
        by_area: faces in proportion to their areas, else all alike.

    Returns:
        face int64 (N,) and barycentric coordinates (N, 3), uniform in each face.
    """
    weights = torch.ones(len(faces), dtype=torch.float64)
    if by_area:
        a, b, c = (rest.double()[faces[:, i]] for i in range(3))
        weights = torch.linalg.cross(b - a, c - a).norm(dim=1)
    limits = weights.cumsum(0)
    drawn = torch.rand(count, generator=random, dtype=torch.float64) * limits[-1]
    face = torch.searchsorted(limits, drawn, right=True).clamp_max(len(faces) - 1)
    # Square root: a uniform point of a triangle is nearer to its far side (Osada et al. 2002).
    root, share = torch.rand((2, count), generator=random)
    root = root.sqrt()
    return face, torch.stack((1.0 - root, root * (1.0 - share), root * share), dim=1)


def nearest_distances(points: Tensor) -> Tensor:
    """Root of the mean squared distance to the three nearest other points [m], (N,); the scale Gaussians start at."""
    most = min(_NEIGHBOURS + 1, len(points))
    result = []
    for block in points.split(2048):  # bounds the distance matrix
        distances = torch.cdist(block, points, compute_mode="donot_use_mm_for_euclid_dist")
        result.append(distances.topk(most, largest=False).values[:, 1:].square())
    squares = torch.cat(result)
    return squares.mean(1).clamp_min(1e-7).sqrt() if squares.shape[1] > 0 else torch.full((len(points),), 1e-3)


def _masked_lpips(lpips: Callable[[Tensor, Tensor], Tensor], pair: Pair) -> Tensor:
    """LPIPS inside the true silhouette, weighted by the box's share of the picture (elsewhere both are black)."""
    height, width = pair.alpha.shape
    lacking = max(0, _LPIPS_SIDE - width), max(0, _LPIPS_SIDE - height)
    share = min(1.0, (height + lacking[1]) * (width + lacking[0]) / pair.pixels)
    image, truth = (F.pad((x * pair.alpha)[None], (0, lacking[0], 0, lacking[1])) for x in (pair.image, pair.truth))
    return share * lpips(image, truth)[0]
