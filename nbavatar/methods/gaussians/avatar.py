"""What Gaussian avatars share: the Gaussians' own parameters, splatting, storage of a number that changes.

A method says where its Gaussians sit on a posed mesh (`pose`), what its children inherit (`offspring`), and which of
them must stay (`spared`).
"""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from nbavatar.math.rotations import normalize_quaternion, quaternion_to_matrix
from nbavatar.methods.base import MeshAvatar, Stages
from nbavatar.rendering.gaussians.functional import SplatImage, render_gaussians
from nbavatar.rendering.gaussians.spherical_harmonics import DEGREES, harmonic_count

__all__ = ["GaussianAvatar", "PosedGaussians"]

# Scales stay within these powers of e, in their units: a runaway step must not overflow or cover the scene.
LOG_SCALE_RANGE = (-20.0, 6.0)


class PosedGaussians(NamedTuple):
    """Gaussians in world space.

    Attributes:
        means: (M, 3) [m].
        quats: unit, wxyz (M, 4).
        scales: (M, 3) [m].
        rows: which Gaussians these are, int64 (M,), or None for all.
        opacity_logit: opacities of this pose before the sigmoid, (M,); None: the Gaussians' own.
        harmonics: of this pose, all degrees, (M, K, 3); None: the Gaussians' own.
        change: what this pose adds to the Gaussians' own numbers, (M, D); None: nothing.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    rows: Tensor | None
    opacity_logit: Tensor | None = None
    harmonics: Tensor | None = None
    change: Tensor | None = None


class GaussianAvatar(MeshAvatar):
    """Gaussians on meshes.

    Attributes:
        PARAMETERS, BUFFERS: names of what has one row a Gaussian; trained, and not.
        FACE: of the buffers, the one that names the face on which each Gaussian rides, int64 (N,).
        quat: local rotations wxyz, normalised when used, (N, 4).
        log_scale: logarithms of the local scales, (N, 3).
        opacity_logit: opacities before the sigmoid, (N,).
        colour: harmonics of degree 0, (N, 1, 3); colour_rest: of the higher degrees, (N, K - 1, 3).
        degree: degree of the harmonics that is used, int64 ().
        sh_degree: highest degree.
    """

    PARAMETERS: ClassVar[tuple[str, ...]] = ("quat", "log_scale", "opacity_logit", "colour", "colour_rest")
    BUFFERS: ClassVar[tuple[str, ...]] = ()
    FACE: ClassVar[str]
    degree: Tensor

    def __init__(
        self,
        faces: Mapping[str, Tensor],
        vertex_counts: Mapping[str, int],
        *,
        log_scale: Tensor,
        colour: Tensor,
        opacity: float,
        sh_degree: int,
        record: Mapping[str, Any] | None = None,
    ) -> None:
        """Args: log_scale (N, 3) and colour (N, 3) in degree 0 at the start, equal opacities, no rotation."""
        super().__init__(faces, vertex_counts, record)
        if sh_degree not in DEGREES:
            raise ValueError(f"harmonics of degree {sh_degree}")
        count = len(log_scale)
        quat = torch.zeros(count, 4)
        quat[:, 0] = 1.0
        self.sh_degree = sh_degree
        self.quat = nn.Parameter(quat)
        self.log_scale = nn.Parameter(log_scale.clone())
        self.opacity_logit = nn.Parameter(torch.logit(torch.full((count,), opacity, dtype=torch.float64)).float())
        self.colour = nn.Parameter(colour[:, None].clone())
        self.colour_rest = nn.Parameter(torch.zeros(count, harmonic_count(sh_degree) - 1, 3))
        self.register_buffer("degree", torch.zeros((), dtype=torch.int64))

    @property
    def primitives(self) -> int:
        """Number of Gaussians."""
        return len(self.quat)

    @abstractmethod
    def pose(self, anchor: Any) -> PosedGaussians:
        """Gaussians in world space, on the anchor of a frame; differentiable."""

    @abstractmethod
    def offspring(self, rows: Tensor, noise: Tensor) -> dict[str, Tensor]:
        """Where the children of split Gaussians start, by name of parameter or buffer, one row each.

        Args:
            rows: parents, int64 (M,), each as often as it has children.
            noise: standard normal, (M, 3), along the parent's axes.
        """

    def adapted(self, other: Any, rows: Tensor, faces: Tensor) -> dict[str, Tensor]:
        """What Gaussians of another avatar hold here instead of a copy, by name; nothing where faces say it all.

        Args:
            other: avatar of the same method.
            rows: its Gaussians, int64 (M,).
            faces: the face of this avatar on which each of them will ride, int64 (M,).
        """
        return {}

    def spared(self, removed: Tensor) -> Tensor:
        """Which Gaussians may really be removed of those that shall be, bool (N,); one always stays."""
        if len(removed) == 0 or not bool(removed.all()):
            return removed
        kept = removed.clone()
        kept[int(self.opacity_logit.detach().argmax())] = False
        return kept

    def local_scales(self) -> Tensor:
        """exp(log_scale), in the units of the method, (N, 3)."""
        return self.log_scale.clamp(*LOG_SCALE_RANGE).exp()

    def local_offsets(self, rows: Tensor, noise: Tensor) -> Tensor:
        """Points of Gaussians relative to their centres, in the method's local axes and units, (M, 3)."""
        turn = quaternion_to_matrix(normalize_quaternion(self.quat[rows]))
        return torch.einsum("nij,nj->ni", turn, self.local_scales()[rows] * noise)

    def logits(self, posed: PosedGaussians) -> Tensor:
        """Opacities of posed Gaussians before the sigmoid, (M,)."""
        if posed.opacity_logit is not None:
            return posed.opacity_logit
        return self.opacity_logit if posed.rows is None else self.opacity_logit[posed.rows]

    def appearance(self, posed: PosedGaussians) -> tuple[Tensor, Tensor]:
        """Opacities in [0, 1] (M,) and harmonics (M, K, 3) of posed Gaussians."""
        own = posed.opacity_logit is None
        opacity = torch.sigmoid(self.opacity_logit if own else posed.opacity_logit)  # pyright: ignore[reportArgumentType]
        if own and posed.rows is not None:
            opacity = opacity[posed.rows]
        if posed.harmonics is not None:
            return opacity, posed.harmonics
        colour = torch.cat((self.colour, self.colour_rest), 1)
        return opacity, colour if posed.rows is None else colour[posed.rows]

    def splat(
        self,
        posed: PosedGaussians,
        viewmat: Tensor,
        K: Tensor,
        width: int,
        height: int,
        screen_offsets: Tensor | None = None,
    ) -> SplatImage:
        """Render posed Gaussians; `screen_offsets` (M, 2) collects the gradient by the projected centres."""
        opacity, colour = self.appearance(posed)
        return render_gaussians(
            posed.means,
            posed.quats,
            posed.scales,
            opacity,
            colour,
            viewmat,
            K,
            width,
            height,
            sh_degree=int(self.degree),
            screen_offsets=screen_offsets,
        )

    def render(
        self,
        verts: Mapping[str, Tensor],
        viewmat: Tensor,
        K: Tensor,
        width: int,
        height: int,
        background: Tensor,
        *,
        frame: str | None = None,
        **options: Any,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """See `MeshAvatar.render`; no option has a meaning here."""
        image = self.splat(self.pose(self.anchor(verts, frame)), viewmat, K, width, height)
        behind = background[:, None, None] if background.ndim == 1 else background
        return image.colour + (1.0 - image.alpha) * behind, image.alpha, image.alpha

    def stages(
        self,
        verts: Mapping[str, Tensor],
        viewmat: Tensor,
        K: Tensor,
        width: int,
        height: int,
        background: Tensor,
        precisions: Sequence[str],
    ) -> Stages:
        """Stages: pose, raster, total."""
        with torch.no_grad():
            posed = self.pose(self.anchor(verts))
        return Stages(
            {
                "pose": lambda: self.pose(self.anchor(verts)),
                "raster": lambda: self.splat(posed, viewmat, K, width, height),
                "total_fp32": lambda: self.render(verts, viewmat, K, width, height, background)[0],
            },
            1.0,
        )

    def facts(self, width: int, height: int) -> dict[str, Any]:
        """Gaussians and degree of the harmonics."""
        return {"gaussians": self.primitives, "sh_degree": int(self.degree)}

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Takes over what `state_dict` gave, whatever its number of Gaussians."""
        device = self.faces.device
        if not 0 <= int(state["degree"]) <= self.sh_degree:
            raise ValueError(f"harmonics of degree {int(state['degree'])} of {self.sh_degree}")
        for name in self.PARAMETERS:
            setattr(self, name, nn.Parameter(torch.empty_like(state[name], device=device)))
        for name in self.BUFFERS:
            setattr(self, name, torch.empty_like(state[name], device=device))
        self.load_state_dict(dict(state))
