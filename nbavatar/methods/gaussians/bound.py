"""Gaussians bound to the triangles of a mesh, after GaussianAvatars (Qian et al., CVPR 2024).

A Gaussian keeps the triangle it was born on, and so do its children. It lives in the triangle's frame {T, R, k}
(`nbavatar.mesh.frames`: origin in the centroid, an axis along the first edge and one along the normal, k the mean of
that edge and the height over it):

    x = k R x_l + T        q = R q_l        s = k exp(s_l)

There is one Gaussian a triangle at the start, at the origin and of the triangle's size, and always at least one.
"""

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from nbavatar.math.rotations import matrix_to_quaternion, normalize_quaternion, quaternion_multiply
from nbavatar.mesh.frames import FaceFrames, face_frames
from nbavatar.methods.gaussians.avatar import GaussianAvatar, PosedGaussians

__all__ = ["BoundAnchor", "BoundGaussians", "check_binding", "placed"]


class BoundAnchor(NamedTuple):
    """Where the triangles of one frame are.

    Attributes:
        frames: face frames of all parts; quats: their rotations, wxyz (F, 4).
        shown: whether a face's part is there, bool (F,), or None for all.
    """

    frames: FaceFrames
    quats: Tensor
    shown: Tensor | None


class BoundGaussians(GaussianAvatar):
    """Gaussians bound to triangles; a method adds `method`, and what else a pose does to them.

    Attributes:
        offset: local positions [k], (N, 3).
        binding: face of each Gaussian, int64 (N,).
    """

    PARAMETERS: ClassVar[tuple[str, ...]] = ("offset", *GaussianAvatar.PARAMETERS)
    BUFFERS: ClassVar[tuple[str, ...]] = ("binding",)
    FACE: ClassVar[str] = "binding"
    binding: Tensor

    def __init__(
        self,
        faces: Mapping[str, Tensor],
        vertex_counts: Mapping[str, int],
        *,
        colour: Tensor,
        opacity: float,
        sh_degree: int,
        record: Mapping[str, Any] | None = None,
    ) -> None:
        """Args: as of `GaussianAvatar`; colour (F, 3) of the first Gaussian of each face."""
        super().__init__(
            faces,
            vertex_counts,
            log_scale=torch.zeros(len(colour), 3),
            colour=colour,
            opacity=opacity,
            sh_degree=sh_degree,
            record=record,
        )
        self.offset = nn.Parameter(torch.zeros(len(colour), 3))
        self.register_buffer("binding", torch.arange(len(colour)))

    def anchor(self, verts: Mapping[str, Tensor], frame: str | None = None) -> BoundAnchor:
        """See `MeshAvatar.anchor`."""
        points, keep = self.merged(verts)
        frames = face_frames(points, self.faces)
        shown = None
        if keep is not None:
            shown = torch.zeros(len(self.faces), dtype=torch.bool, device=self.faces.device)
            shown[keep] = True
        return BoundAnchor(frames, matrix_to_quaternion(frames.R), shown)

    def pose(self, anchor: BoundAnchor) -> PosedGaussians:
        """See `GaussianAvatar.pose`."""
        rows, binding = None, self.binding
        offset, quat, scales = self.offset, self.quat, self.local_scales()
        if anchor.shown is not None:
            rows = anchor.shown[binding].nonzero().squeeze(1)
            binding, offset, quat, scales = binding[rows], offset[rows], quat[rows], scales[rows]
        return PosedGaussians(*placed(anchor, binding, offset, quat, scales), rows)

    def offspring(self, rows: Tensor, noise: Tensor) -> dict[str, Tensor]:
        """A child sits at a random point of its parent, on the same triangle.

        (The public code forgets the parent's place and puts children at the triangle's centre.)
        """
        return {"offset": self.offset[rows] + self.local_offsets(rows, noise)}

    def spared(self, removed: Tensor) -> Tensor:
        """Where a face would lose its last Gaussian, it keeps all it has."""
        left = torch.zeros(len(self.faces), dtype=torch.int64, device=removed.device)
        left.index_add_(0, self.binding, (~removed).long())
        return removed & (left[self.binding] > 0)

    def content(self) -> dict[str, Any]:
        """Degree of the harmonics."""
        return {"sh_degree": self.sh_degree}


def placed(
    anchor: BoundAnchor, binding: Tensor, offset: Tensor, quat: Tensor, scales: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Means (M, 3) [m], rotations wxyz (M, 4) and scales (M, 3) [m] in the world.

    Args:
        anchor: the triangles of one frame.
        binding: face of each Gaussian, int64 (M,).
        offset: local positions [k], (M, 3); quat: local rotations, not normalised, (M, 4); scales: [k], (M, 3).
    """
    size = anchor.frames.k[binding][:, None]
    means = torch.einsum("nij,nj->ni", anchor.frames.R[binding], offset) * size + anchor.frames.T[binding]
    quats = quaternion_multiply(anchor.quats[binding], normalize_quaternion(quat))
    return means, quats, scales * size


def check_binding(content: Mapping[str, Any], state: Mapping[str, Tensor]) -> None:
    """Refuses a stored binding that names faces which are not there.

    Raises:
        ValueError: it does.
    """
    faces, binding = sum(len(part) for part in content["faces"].values()), state["binding"]
    if len(binding) and not (0 <= int(binding.min()) and int(binding.max()) < faces):
        raise ValueError(f"binding names faces beyond the {faces} there are")
