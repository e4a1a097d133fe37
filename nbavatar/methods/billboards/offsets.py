"""Smooth offsets: billboards move along their normals in large patches, not only one by one.

Not part of the paper. What a body model leaves out (hair, above all) lies a centimetre or two off the mesh, over
thousands of billboards. Each of them alone learns slowly to go there, from the few pixels it covers, and views that
were not trained on then show the silhouette of the mesh. Here the gradients of the offsets are also summed over smooth
fields (the spectral modes of the mesh and a constant), a handful of numbers that all views agree on.

Nothing is added to the avatar: the field is a second way for the optimizer to move the offsets mu,

    mu_z += (B dc) / k_rest        B modes at the face centroids (F, K), dc the step of the K coefficients [m]

so a trained avatar has the same parameters with and without it, and held-out poses profit like any other.
"""

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor, nn

from nbavatar.data.sequences import MeshSequence
from nbavatar.errors import DataError
from nbavatar.mesh.frames import face_frames
from nbavatar.methods.billboards.avatar import Avatar

__all__ = ["SmoothOffsets", "offset_basis"]


def offset_basis(rest: np.ndarray, faces: np.ndarray, coords: np.ndarray) -> np.ndarray:
    """Smooth fields over the largest connected component of a mesh, a constant first; zero on the others (eyeballs).

    Args:
        rest: rest pose [m], float (V, 3).
        faces: int64 (F, 3).
        coords: spectral coordinates (V, K).

    Returns:
        float32 (F, K + 1), root mean square 1 over the component's vertices before they are averaged to the faces.
    """
    component = _components(faces, len(rest))
    inside = component == np.bincount(component[faces[:, 0]]).argmax()
    fields = np.concatenate([np.ones((len(rest), 1)), coords], axis=1) * inside[:, None]
    scale = np.sqrt((fields**2).sum(0) / inside.sum())
    fields = fields / np.maximum(scale, 1e-6)
    return fields[faces].mean(1).astype(np.float32)


def _components(faces: np.ndarray, count: int) -> np.ndarray:
    """Connected component of each vertex, by its smallest vertex; without scipy, which a training does not load."""
    label = np.arange(count)
    while True:
        before = label.copy()
        np.minimum.at(label, faces, label[faces].min(1, keepdims=True))
        label = label[label]
        if np.array_equal(label, before):
            return label


class SmoothOffsets:
    """Moves the offsets of an avatar by smooth fields.

    Attributes:
        coefficients: what the optimizer steps, always zero between steps, float (K,) [m].
    """

    def __init__(self, avatar: Avatar, sequence: MeshSequence, coords: Mapping[str, np.ndarray]) -> None:
        """Args: avatar in its initial state; meshes in rest pose; spectral coordinates per part (V, K).

        Raises:
            DataError: a part has no coordinates.
        """
        blocks, sizes = [], []
        for part in avatar.parts:
            if part not in coords:
                raise DataError.of("spectral coordinates", f"{part}.coords", expected="this array", found="none")
            mesh = sequence.parts[part]
            blocks.append(torch.from_numpy(offset_basis(mesh.rest, mesh.faces, np.asarray(coords[part]))))
            sizes.append(face_frames(torch.from_numpy(np.asarray(mesh.rest)).float(), torch.from_numpy(mesh.faces)).k)
        device = avatar.faces.device
        self._mu = avatar.billboards.mu
        self._fields = (torch.block_diag(*blocks) / torch.cat(sizes)[:, None]).to(device)
        self.coefficients = nn.Parameter(torch.zeros(self._fields.shape[1], device=device))
        # The gradient reaches the coefficients whenever it reaches the offsets.
        self._mu.register_hook(self._collect)

    def _collect(self, gradient: Tensor) -> None:
        self.coefficients.grad = self._fields.T @ gradient[:, 2]

    @torch.no_grad()
    def apply(self) -> None:
        """Hand the coefficients' step over to the offsets."""
        self._mu[:, 2] += self._fields @ self.coefficients
        self.coefficients.zero_()
