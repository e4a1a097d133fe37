"""The pinhole camera, in the conventions of OpenCV.

x right, y down, z forward [m]; pixel (0, 0) covers `[0, 1) x [0, 1)`, its centre is (0.5, 0.5).
Functions accept NumPy arrays and torch tensors alike.
"""

import dataclasses
from typing import Any

import numpy as np

__all__ = ["Camera", "crop_intrinsics", "facing_pose", "project", "scale_intrinsics"]


@dataclasses.dataclass(frozen=True)
class Camera:
    """One calibrated camera.

    Attributes:
        name: its id, text (`084` is not a number).
        width: image width [px].
        height: image height [px].
        K: camera matrix, float64 `[3, 3]` [px].
        cam_from_world: rigid transform, float64 `[4, 4]`, translation [m].
        distortion: OpenCV coefficients (k1, k2, p1, p2, k3, ...), or None for an ideal pinhole.
    """

    name: str
    width: int
    height: int
    K: np.ndarray
    cam_from_world: np.ndarray
    distortion: np.ndarray | None = None


def project(points: Any, K: Any, cam_from_world: Any) -> tuple[Any, Any]:
    """Projects world points, without distortion.

    Args:
        points: `[..., V, 3]` [m], world.
        K: `[..., 3, 3]` [px].
        cam_from_world: `[..., 4, 4]`.

    Returns:
        pixels `[..., V, 2]` [px] and depth `[..., V]` [m]. Points with depth <= 0 are behind the camera;
        their pixels mean nothing (and are infinite at depth 0).
    """
    rotation, translation = cam_from_world[..., :3, :3], cam_from_world[..., None, :3, 3]
    camera = points @ rotation.swapaxes(-1, -2) + translation
    image = camera @ K.swapaxes(-1, -2)
    return image[..., :2] / image[..., 2:], camera[..., 2]


def facing_pose(position: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """World to camera of a camera that looks at a point, float64 `[4, 4]`.

    Args:
        position, target: of the camera and of the point, world [m], `[3]`; they differ.
        up: what is up in the picture, world `[3]`, of any length; not along the direction of view.
    """
    forward = np.asarray(target, np.float64) - np.asarray(position, np.float64)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, np.asarray(up, np.float64))
    right /= np.linalg.norm(right)
    rotation = np.stack((right, np.cross(forward, right), forward))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ np.asarray(position, np.float64)
    return pose


def crop_intrinsics(K: np.ndarray, x0: float, y0: float) -> np.ndarray:
    """Camera matrix after cutting away `x0` columns on the left and `y0` rows on top [px]."""
    result = np.array(K, dtype=np.float64)
    result[0, 2] -= x0
    result[1, 2] -= y0
    return result


def scale_intrinsics(K: np.ndarray, sx: float, sy: float) -> np.ndarray:
    """Camera matrix after resizing by `sx`, `sy` = new size / old size.

    With pixel centres at +0.5 the image plane simply scales; no half-pixel terms appear.
    """
    return np.diag([sx, sy, 1.0]) @ np.asarray(K, dtype=np.float64)
