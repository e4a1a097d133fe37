"""Where one looks from: a free camera of the browser, or one of the capture."""

import dataclasses
import math

import numpy as np

__all__ = ["Eye", "free_eye", "pose_of", "view_angle"]


@dataclasses.dataclass(frozen=True)
class Eye:
    """A pinhole camera, and the shape of the canvas that its picture is put on.

    Attributes:
        K: intrinsics (3, 3) [px] of a picture of width x height.
        cam_from_world: (4, 4).
        width, height: nominal size [px].
        aspect: width to height of the canvas.
        camera: name of the capture's camera, or empty.
    """

    K: np.ndarray
    cam_from_world: np.ndarray
    width: int
    height: int
    aspect: float
    camera: str = ""

    def scaled(self, side: int) -> "Eye":
        """The same view with a longer side of at most `side` pixels."""
        scale = side / max(self.width, self.height)
        width, height = max(8, round(self.width * scale)), max(8, round(self.height * scale))
        K = np.diag([width / self.width, height / self.height, 1.0]) @ self.K
        return dataclasses.replace(self, K=K, width=width, height=height)


def free_eye(wxyz: np.ndarray, position: np.ndarray, fov: float, width: int, height: int) -> Eye:
    """The camera of a canvas.

    Args:
        wxyz: rotation camera to world, unit quaternion; axes as OpenCV's.
        position: of the camera, world [m].
        fov: vertical angle of view [rad].
        width, height: canvas [px].
    """
    w, x, y, z = np.asarray(wxyz, np.float64) / np.linalg.norm(wxyz)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.T, -rotation.T @ np.asarray(position, np.float64)
    focal = 0.5 * height / math.tan(0.5 * fov)
    return Eye(
        np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]]), pose, width, height, width / height
    )


def pose_of(cam_from_world: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position [m], direction of view and upward direction of a camera, each (3,), world."""
    rotation = cam_from_world[:3, :3]
    return -rotation.T @ cam_from_world[:3, 3], rotation[2], -rotation[1]


def view_angle(K: np.ndarray, width: int, height: int, aspect: float) -> float:
    """Vertical angle [rad] of a canvas into which a camera's whole picture fits."""
    needed = max(height, width / aspect)
    return 2.0 * math.atan(0.5 * needed / K[1, 1])
