"""Which points of a face mesh the face itself hides."""

import numpy as np

from nbavatar.detection.correspondence import FACE_POINTS

__all__ = ["facing"]

_NEIGHBOURS = 12


def facing(mesh: np.ndarray) -> np.ndarray:
    """Cosine between the outward normal at each of the 68 landmarks and the direction to the camera, float64 `[68]`.

    A detector draws the far side of a turned face where it cannot see it; such points have a negative cosine. The
    normal is that of the plane through the nearest vertices, pointing away from the middle of the mesh.

    Args:
        mesh: `[468, 3]` x, y, depth, all in pixels, depth growing away from the camera.
    """
    points = np.stack([mesh[list(ids)].mean(0) for ids in FACE_POINTS])
    squared = ((points[:, None] - mesh[None]) ** 2).sum(-1)
    near = mesh[np.argpartition(squared, _NEIGHBOURS, axis=1)[:, :_NEIGHBOURS]]
    near = near - near.mean(1, keepdims=True)
    normal = np.linalg.eigh(near.transpose(0, 2, 1) @ near)[1][..., 0]
    outward = ((points - mesh.mean(0)) * normal).sum(1)
    return np.where(outward < 0, 1.0, -1.0) * normal[:, 2]
