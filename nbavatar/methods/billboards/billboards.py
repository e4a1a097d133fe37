"""Neural billboards {mu, s, q, T^NT, T^alpha}, one on every face of the mesh (paper, sections 3.1 to 3.3).

A billboard lives in the frame {T, R, k} of its face (`nbavatar.mesh.frames`), whose z axis is the surface normal:

    mu' = k R mu + T        s' = k exp(log_scale)        q' = R q

Texture coordinates (u, v) in [-1, 1]^2 sit at mu' + R(q') (u s'_x, v s'_y, 0); rows of a texture run along v,
columns along u, with the outer texel centres at +-1 (align_corners).

Initial state: mu = 0, q = identity, half extents that cover the triangle in rest pose with a margin, opacity a
Gaussian with a floor (all logits finite: a texel at -inf would never learn), features from spectral coordinates.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from nbavatar.math.rotations import matrix_to_quaternion, normalize_quaternion, quaternion_multiply
from nbavatar.mesh.frames import FaceFrames

__all__ = ["Billboards", "Posed", "gaussian_alpha_logits", "initial_half_extents", "mirrored_sight"]

# Faces whose box would be thinner than this fraction of its longer side get this fraction: slivers stay visible.
_THINNEST = 0.1
# Half extents stay within these powers of e, in face units: a runaway step must not overflow or cover the scene.
_LOG_SCALE_RANGE = (-12.0, 4.0)


class Posed(NamedTuple):
    """Billboards in world space.

    Attributes:
        means: (F, 3) [m].
        quats: unit quaternions wxyz (F, 4).
        half_extents: (F, 2) [m].
        light: what the decoder is told of the light on their faces, without gradients (F, L); L may be 0.
    """

    means: Tensor
    quats: Tensor
    half_extents: Tensor
    light: Tensor

    @property
    def planes(self) -> tuple[Tensor, Tensor, Tensor]:
        """What the rasterizer takes: means, quats, half_extents."""
        return self.means, self.quats, self.half_extents


class Billboards(nn.Module):
    """Parameters of F billboards.

    Attributes:
        mu: local offsets [k], (F, 3).
        quat: local rotations wxyz, normalised when used, (F, 4).
        log_scale: logarithm of the half extents [log k], (F, 2).
        features: neural textures T^NT, no activation, (F, T, T, C).
        alpha_logit: opacity textures before the sigmoid, (F, T, T).
    """

    def __init__(self, half_extents: Tensor, features: Tensor, alpha_logit: Tensor) -> None:
        """Start from the initial state.

        Args:
            half_extents: in units of k, float [F, 2], positive.
            features: float [F, T, T, C].
            alpha_logit: float [F, T, T], finite.
        """
        super().__init__()
        self._start(half_extents)
        self.features = nn.Parameter(features.clone())
        self.alpha_logit = nn.Parameter(alpha_logit.clone())

    def _start(self, half_extents: Tensor) -> None:
        """Parameters of place: in the middle of the faces, not turned."""
        count = len(half_extents)
        quat = torch.zeros(count, 4, dtype=half_extents.dtype)
        quat[:, 0] = 1.0
        self.mu = nn.Parameter(torch.zeros(count, 3, dtype=half_extents.dtype))
        self.quat = nn.Parameter(quat)
        self.log_scale = nn.Parameter(half_extents.log())

    def pose(self, frames: FaceFrames, anchors: Tensor | None = None, keep: Tensor | None = None) -> Posed:
        """Place the billboards on a posed mesh (paper, eq. 3 to 5); differentiable, also through the frames.

        Args:
            frames: T (F, 3) [m], R (F, 3, 3), k (F,) [m].
            anchors: quaternions of R (F, 4) if known already; saves their computation.
            keep: indices of the billboards that the frames belong to; None for all.

        Returns:
            where they are; nothing is known of their light here (L = 0).
        """
        mu, quat, log_scale = self.mu, self.quat, self.log_scale
        if keep is not None:
            mu, quat, log_scale = mu[keep], quat[keep], log_scale[keep]
        anchor = matrix_to_quaternion(frames.R) if anchors is None else anchors
        scale = frames.k[:, None]
        means = torch.einsum("fij,fj->fi", frames.R, mu) * scale + frames.T
        quats = quaternion_multiply(anchor, normalize_quaternion(quat))
        half_extents = scale * log_scale.clamp(*_LOG_SCALE_RANGE).exp()
        return Posed(means, quats, half_extents, means.new_zeros(len(means), 0))

    def alpha(self) -> Tensor:
        """Opacity textures in [0, 1], (F, T, T)."""
        return torch.sigmoid(self.alpha_logit)


def mirrored_sight(normals: Tensor, points: Tensor, viewmat: Tensor) -> Tensor:
    """Direction in which a mirror on each face would show the camera what it sees, unit, world (F, 3).

    Not part of the paper. Gloss is light from about that direction, so it wanders over hair and skin as the camera
    moves; a texture stays where it is.

    Args:
        normals: unit, world (F, 3); points: on the faces (F, 3) [m]; viewmat: world to camera (4, 4).
    """
    eye = -viewmat[:3, :3].T @ viewmat[:3, 3]
    towards = torch.nn.functional.normalize(eye - points, dim=1)
    return 2.0 * (normals * towards).sum(1, keepdim=True) * normals - towards


def initial_half_extents(verts: Tensor, faces: Tensor, frames: FaceFrames, *, margin: float) -> Tensor:
    """Half extents, in face units, of boxes around the centroids that cover the triangles.

    Args:
        verts: rest pose [m], float [V, 3].
        faces: int64 [F, 3].
        frames: frames of that rest pose.
        margin: factor on the smallest covering box (1 = the corners lie on the border of the texture).

    Returns:
        float [F, 2], positive; x along the first edge, y across it.
    """
    corners = verts[faces] - frames.T[:, None]
    local = torch.einsum("fij,fci->fcj", frames.R, corners) / frames.k[:, None, None]
    box = local[..., :2].abs().amax(dim=1)
    longest = box.amax(dim=1, keepdim=True).clamp_min(1e-3)
    return margin * torch.maximum(box, _THINNEST * longest)


def gaussian_alpha_logits(texels: int, *, sigma: float, peak: float, floor: float) -> Tensor:
    """Logits of a centred Gaussian opacity, analytic and finite everywhere.

    Args:
        texels: T, texels a side.
        sigma: standard deviation in texture coordinates (the border is at 1).
        peak: opacity at the centre, in (0, 1).
        floor: smallest opacity, in (0, peak); keeps the corners trainable.

    Returns:
        float32 [T, T].
    """
    axis = torch.linspace(-1.0, 1.0, texels, dtype=torch.float64) if texels > 1 else torch.zeros(1, dtype=torch.float64)
    squares = axis[:, None] ** 2 + axis[None, :] ** 2
    alpha = (peak * torch.exp(-0.5 * squares / sigma**2)).clamp_min(floor)
    return torch.logit(alpha).float()
