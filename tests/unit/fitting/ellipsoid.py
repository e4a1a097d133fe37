"""A painted ellipsoid and pictures of it, drawn with exact meshes, for what moves and bends meshes to pictures."""

from collections.abc import Sequence

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from nbavatar.camera.pinhole import Camera
from nbavatar.mesh.zbuffer import rasterize_mesh

SIDE = 160


def camera_at(name: str, angle: float, distortion: np.ndarray | None = None) -> Camera:
    """One on a circle of 0.6 m around the origin, looking at it."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_euler("y", angle, degrees=True).as_matrix(), [0, 0, 0.6]
    K = np.array([[400.0, 0, 83.0], [0, 405.0, 77.0], [0, 0, 1]])
    return Camera(name, SIDE, SIDE, K, pose, distortion)


def painted_ellipsoid(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices [m], faces, and colours: waves of a few millimetres to centimetres in all directions."""
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=1.0)
    rest, faces = np.asarray(sphere.vertices) * [0.07, 0.09, 0.08], np.asarray(sphere.faces)
    waves = rng.normal(size=(3, 24, 3)) * rng.uniform(60, 400, size=(3, 24, 1))
    phase = rng.uniform(0, 2 * np.pi, size=(3, 24))
    paint = [np.sin(rest @ w.T + p).sum(1) for w, p in zip(waves, phase, strict=True)]
    return rest, faces, 0.5 + 0.06 * np.stack(paint, 1)


def filmed(
    cameras: Sequence[Camera], frames: np.ndarray, faces: np.ndarray, paint: np.ndarray
) -> dict[tuple[str, int], tuple[np.ndarray, np.ndarray]]:
    """Pictures, uint8 (H, W, 3), and coverage, uint8 (H, W), of each camera and frame."""
    found = {}
    for camera in cameras:
        for row, verts in enumerate(frames):
            face, weights, _ = rasterize_mesh(verts, faces, camera.K, SIDE, SIDE, cam_from_world=camera.cam_from_world)
            colour = np.einsum("hwk,hwkc->hwc", weights, paint[faces[np.maximum(face, 0)]])
            colour[face < 0] = 0.2
            alpha = np.where(face >= 0, 255, 0).astype(np.uint8)
            found[camera.name, row] = (colour.clip(0, 1) * 255 + 0.5).astype(np.uint8), alpha
    return found
