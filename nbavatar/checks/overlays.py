"""Meshes drawn over the images they belong to, to be looked at."""

from collections.abc import Mapping

import numpy as np

from nbavatar.camera.distortion import distort_vertices
from nbavatar.camera.pinhole import Camera
from nbavatar.data.sequences import PARTS
from nbavatar.mesh.zbuffer import joined_meshes, rasterize_mesh
from nbavatar.preprocess.overlay import mask_outline, shade

__all__ = ["mesh_over_image"]


def mesh_over_image(
    image: np.ndarray,
    camera: Camera,
    meshes: Mapping[str, tuple[np.ndarray, np.ndarray]],
    label: np.ndarray | None = None,
    *,
    strength: float = 0.6,
) -> np.ndarray:
    """Shaded meshes over one image, with the outline of the masks in yellow.

    Args:
        image: uint8 RGB `[H, W, 3]`, still distorted if the camera is.
        camera: its camera.
        meshes: part -> (vertices `[V, 3]` [m, world], faces `[F, 3]`).
        label: uint8 `[H, W]` whose outline to draw, if any.
        strength: 0 shows the image only, 1 the mesh only.
    """
    names = [name for name in PARTS if name in meshes]
    verts, faces, _ = joined_meshes([meshes[name] for name in names])
    verts = verts.astype(np.float64)
    part = np.concatenate([np.full(len(meshes[name][1]), PARTS.index(name) + 1, np.uint8) for name in names])
    points = verts @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    corners = np.array([[x, y] for x in (0, camera.width) for y in (0, camera.height)], dtype=np.float64)
    reach = float(np.linalg.norm((corners - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]], axis=1).max() * 1.1)
    points = distort_vertices(points, camera.distortion, reach)
    face, _, _ = rasterize_mesh(points, faces, camera.K, camera.width, camera.height)
    a, b, c = (points[faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    picture = shade(image, face, normals, part, strength=strength)
    return picture if label is None else mask_outline(picture, label)
