"""Pictures of meshes from chosen sides, for people to look at: shaded, coloured by vertex values."""

from collections.abc import Callable

import numpy as np

from nbavatar.mesh.zbuffer import rasterize_mesh

__all__ = ["draw_mesh", "look_from", "signed_colors", "vertex_normals"]


def vertex_normals(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area-weighted unit normals, (V, 3) float64; 0 where a vertex has no face or its faces cancel."""
    verts = np.asarray(verts, np.float64)
    a, b, c = (np.ascontiguousarray(verts[faces[:, k]].T) for k in range(3))
    b, c, corners = b - a, c - a, faces.ravel()
    cross = (b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0])
    normals = np.stack([np.bincount(corners, np.repeat(axis, 3), minlength=len(verts)) for axis in cross], axis=1)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)


def look_from(
    points: np.ndarray, direction: np.ndarray, up: np.ndarray, size: int, zoom: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """A distant camera that sees all points.

    Args:
        points: what must be in the picture [m], shape (P, 3).
        direction: from the scene towards the camera, shape (3,).
        up: what is up in the picture, shape (3,).
        size: side of the square picture [px].
        zoom: above 1 cuts the borders.

    Returns:
        Intrinsics (3, 3) and world-to-camera (4, 4).
    """
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    radius = max(float(np.linalg.norm(points - centre, axis=1).max()), 1e-9)
    z = -np.asarray(direction, np.float64) / np.linalg.norm(direction)
    x = np.cross(z, np.asarray(up, np.float64))
    x /= np.linalg.norm(x)
    rotation = np.stack((x, np.cross(z, x), z))
    distance = 8.0 * radius
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ (centre - distance * z)
    focal = 0.5 * size * distance / radius * zoom
    return np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]]), pose


def signed_colors(values: np.ndarray) -> np.ndarray:
    """Blue (-1), white (0), red (+1) for values in [-1, 1]; (V,) to float64 (V, 3) in [0, 1]."""
    t = np.clip(np.nan_to_num(values), -1, 1)[:, None]
    blue, white, red = np.array([0.15, 0.3, 0.75]), np.array([0.96, 0.96, 0.96]), np.array([0.75, 0.15, 0.15])
    return np.where(t < 0, white + (blue - white) * -t, white + (red - white) * t)


def draw_mesh(
    verts: np.ndarray,
    faces: np.ndarray,
    colors: np.ndarray | Callable[[np.ndarray, np.ndarray], np.ndarray],
    K: np.ndarray,
    pose: np.ndarray,
    size: int,
) -> np.ndarray:
    """Shaded picture of a mesh on white.

    Args:
        verts: positions [m], shape (V, 3), finite.
        faces: vertex ids, shape (F, 3).
        colors: sRGB in [0, 1], per vertex (V, 3), or per pixel given by a function of (face ids (P,), weights (P, 3)).
        K: intrinsics (3, 3) [px].
        pose: world-to-camera (4, 4).
        size: side of the picture [px].

    Returns:
        uint8 (size, size, 3).
    """
    face, weight, _ = rasterize_mesh(verts, faces, K, size, size, cam_from_world=pose)
    seen = face >= 0
    ids, weights = face[seen], weight[seen].astype(np.float64)
    normals = np.einsum("pc,pci->pi", weights, vertex_normals(verts, faces)[faces[ids]])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    towards = -pose[2, :3]
    shade = 0.35 + 0.65 * np.abs(normals @ towards)
    pixels = colors(ids, weights) if callable(colors) else np.einsum("pc,pci->pi", weights, colors[faces[ids]])
    image = np.ones((size, size, 3))
    image[seen] = pixels * shade[:, None]
    return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)
