"""Vertex functions carried over to the textures of billboards.

Apart from the eigensolver, because training needs this and not SciPy.
"""

import numpy as np
import torch

from nbavatar.mesh.frames import face_frames

__all__ = ["texel_values"]


def texel_values(
    coords: np.ndarray, verts: np.ndarray, faces: np.ndarray, half_extents: np.ndarray, texels: int, bound: float = 1.0
) -> np.ndarray:
    """Values of vertex functions at the texels of one billboard a face, in its initial place.

    Each function is linear on its triangle (barycentric interpolation) and is continued linearly over the triangle's
    plane. Texel (row i, column j) of face f lies at T + k R (u sx, v sy, 0) with `face_frames` of the rest pose,
    u = -1 + 2 j / (texels - 1) and v alike from i: rows grow with v, columns with u, corners aligned.

    Args:
        coords: vertex functions, shape (V, K).
        verts: rest positions [m], shape (V, 3).
        faces: vertex ids, shape (F, 3).
        half_extents: billboard half sides in face units (multiples of k), shape (F, 2).
        texels: texels a side, at least 2.
        bound: how far outside the range of the triangle's three values a texel may go, in multiples of that range. It
            matters on slivers, where the continuation is steep.

    Returns:
        float32 (F, texels, texels, K).
    """
    frames = face_frames(torch.from_numpy(np.asarray(verts, np.float64)), torch.from_numpy(np.asarray(faces, np.int64)))
    corners = np.asarray(verts, np.float64)[faces] - frames.T.numpy()[:, None]
    local = (corners @ frames.R.numpy())[..., :2] / frames.k.numpy()[:, None, None]
    values = np.asarray(coords, np.float64)[faces]
    mean = values.mean(axis=1)
    # Least squares of three points by a plane through their mean: exact for a proper triangle; the ridge, 1e-10 of its
    # size, only acts where the triangle has no extent in a direction.
    square = np.einsum("fci,fcj->fij", local, local)
    ridge = 1e-10 * np.trace(square, axis1=1, axis2=2) + np.finfo(np.float64).tiny
    slope = np.linalg.solve(
        square + ridge[:, None, None] * np.eye(2), np.einsum("fci,fck->fik", local, values - mean[:, None])
    )
    steps = np.linspace(-1.0, 1.0, texels)
    half_extents = np.asarray(half_extents, np.float64)
    u = (steps * half_extents[:, :1])[:, None, :, None]
    v = (steps * half_extents[:, 1:])[:, :, None, None]
    out = mean[:, None, None] + u * slope[:, None, None, 0] + v * slope[:, None, None, 1]
    low, high = values.min(axis=1), values.max(axis=1)
    reach = bound * (high - low)
    return np.clip(out, (low - reach)[:, None, None], (high + reach)[:, None, None]).astype(np.float32)
