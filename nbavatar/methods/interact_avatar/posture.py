"""The pose of a part in a few numbers, told from its vertices alone.

Hand pose and expression are parameters of MANO and FLAME in the publication. A capture may have meshes only, and a
driven avatar gets nothing else, so both are read off the mesh: the part is laid onto its rest pose by the rigid motion
that fits best, and what is left of the vertices' displacement is projected on the principal components that it has over
the training frames. Of meshes that a linear model made, these are its parameters up to a linear map.
"""

import numpy as np
import torch
from torch import Tensor, nn

from nbavatar.physics.rigid import rigid_motion

__all__ = ["Posture", "learn_posture"]

_MOST_FRAMES = 512  # as many of them, evenly spaced, say what a part does
_NEGLIGIBLE = 1e-9  # variance of a component, in that of the first
_FARTHEST = 2.0  # a new pose counts as at most this many times as far as the farthest that was trained


class Posture(nn.Module):
    """Components of a part's displacement.

    Attributes:
        rest: vertices at rest [m], float32 (V, 3).
        mean: mean displacement [m], float32 (V, 3).
        basis: orthonormal components, rows of zeros where there are fewer, float32 (K, V, 3).
        scale: largest projection in training [m], float32 ().
    """

    rest: Tensor
    mean: Tensor
    basis: Tensor
    scale: Tensor

    def __init__(self, rest: Tensor, mean: Tensor, basis: Tensor, scale: Tensor) -> None:
        """Args: the four attributes."""
        super().__init__()
        if mean.shape != rest.shape or basis.shape[1:] != rest.shape:
            raise ValueError(f"a basis of shape {tuple(basis.shape)} for {len(rest)} vertices")
        for name, value in (("rest", rest), ("mean", mean), ("basis", basis), ("scale", scale)):
            self.register_buffer(name, value)

    @property
    def components(self) -> int:
        """K."""
        return len(self.basis)

    @torch.no_grad()
    def describe(self, verts: Tensor) -> Tensor:
        """The pose of a part, unchanged by rigid motions of it, up to rounding.

        Args:
            verts: vertices (V, 3) [m], finite.

        Returns:
            projections (K,), in units of the largest one in training and within 2 of them.
        """
        moved = self.laid(verts)[0] - self.rest - self.mean
        found = torch.einsum("kvi,vi->k", self.basis, moved) / self.scale
        return found.clamp(-_FARTHEST, _FARTHEST)

    @torch.no_grad()
    def laid(self, verts: Tensor, *others: Tensor) -> tuple[Tensor, list[Tensor]]:
        """The vertices, and other points (N, 3) with them, moved rigidly so that the vertices lie on the rest pose."""
        # In float64 on the CPU whatever the device, so that all devices see one pose.
        points = verts.double().cpu().numpy()
        turn, shift = rigid_motion(points, self.rest.double().cpu().numpy())
        moved = [
            torch.from_numpy(np.ascontiguousarray(p.double().cpu().numpy() @ turn.T + shift)).to(self.rest)
            for p in (verts, *others)
        ]
        return moved[0], moved[1:]


def learn_posture(rest: np.ndarray, verts: np.ndarray, components: int) -> Posture:
    """Principal components of a part's displacement.

    Args:
        rest: vertices at rest [m], (V, 3).
        verts: posed vertices of the training frames [m], (N, V, 3); frames that are not finite are left out.
        components: K; beyond those that the frames have, rows are zero.
    """
    finite = np.flatnonzero(np.isfinite(verts).all(axis=(1, 2)))
    if len(finite) > _MOST_FRAMES:
        finite = finite[np.linspace(0, len(finite) - 1, _MOST_FRAMES).round().astype(int)]
    base = np.asarray(rest, np.float64)
    moved = np.zeros((max(1, len(finite)), base.size))
    for row, frame in enumerate(finite):
        points = np.asarray(verts[frame], np.float64)
        turn, shift = rigid_motion(points, base)
        moved[row] = (points @ turn.T + shift - base).reshape(-1)
    mean = moved.mean(0)
    centred = moved - mean
    # Far fewer frames than coordinates: the components come from the products of frames.
    variances, mixtures = np.linalg.eigh(centred @ centred.T)
    kept = [
        i for i in np.argsort(-variances, kind="stable") if variances[i] > _NEGLIGIBLE * max(variances.max(), 1e-20)
    ]
    basis = np.zeros((components, base.size))
    for row, i in enumerate(kept[:components]):
        direction = centred.T @ mixtures[:, i]
        direction /= np.linalg.norm(direction)
        basis[row] = direction * np.sign(direction[np.abs(direction).argmax()])
    scale = float(np.abs(centred @ basis.T).max())
    shape = (-1, *base.shape)
    return Posture(
        torch.from_numpy(base.astype(np.float32)),
        torch.from_numpy(mean.reshape(base.shape).astype(np.float32)),
        torch.from_numpy(basis.reshape(shape).astype(np.float32)),
        torch.tensor(scale if scale > 0 else 1.0, dtype=torch.float32),
    )
