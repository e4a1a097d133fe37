"""Cameras that go around an avatar, for turntables."""

import math
from collections.abc import Mapping

import numpy as np
import torch

from nbavatar.camera.pinhole import facing_pose
from nbavatar.data.sequences import MeshSequence
from nbavatar.data.views import View

__all__ = ["driven_views", "focus", "turntable_views"]


def focus(sequence: MeshSequence, row: int) -> np.ndarray:
    """The point to turn about: the middle of the first part that is there in a frame, float64 (3,) [m]."""
    for part in sequence.parts.values():
        verts = np.asarray(part.verts[row], np.float64)
        if np.isfinite(verts).all():
            return (verts.min(axis=0) + verts.max(axis=0)) / 2
    raise ValueError(f"frame {sequence.frames[row]} has no part")


def _view(manifest: Mapping, K: np.ndarray, frame: str, row: int, cam_from_world: np.ndarray) -> View:
    return View(
        0,
        str(manifest["camera"]),
        frame,
        row,
        int(manifest["width"]),
        int(manifest["height"]),
        torch.tensor(K, dtype=torch.float32),
        torch.tensor(cam_from_world, dtype=torch.float32),
    )


def turntable_views(
    sequence: MeshSequence,
    row: int,
    manifest: Mapping,
    K: np.ndarray,
    cam_from_world: np.ndarray,
    count: int,
    *,
    arc: float = 2 * math.pi,
) -> list[View]:
    """Views of one frame from a camera on a circle.

    The circle goes through the given camera, around its own vertical (y down) through the avatar's middle;
    the camera keeps its height and looks at that middle, which lies at the centre of every picture.

    Args:
        sequence: meshes.
        row: frame.
        manifest: camera's name and size.
        K: intrinsics (3, 3) [px]; cam_from_world: (4, 4), the camera to start from.
        count: views.
        arc: how far to go [rad]; below 2 pi it swings out and back around the start, without a jump at the end.
    """
    pose = np.asarray(cam_from_world, np.float64)
    centre = focus(sequence, row)
    up = -pose[1, :3]
    start = -pose[:3, :3].T @ pose[:3, 3] - centre
    central = np.array(K, np.float64)
    central[:2, 2] = manifest["width"] / 2, manifest["height"] / 2
    views = []
    for number in range(count):
        share = number / count
        angle = 2 * math.pi * share if arc >= 2 * math.pi else 0.5 * arc * math.sin(2 * math.pi * share)
        position = centre + _turned(start, up, angle)
        views.append(_view(manifest, central, sequence.frames[row], row, facing_pose(position, centre, up)))
    return views


def driven_views(
    sequence: MeshSequence, rows: list[int], manifest: Mapping, K: np.ndarray, cam_from_world: np.ndarray
) -> list[View]:
    """Views of chosen frames from one fixed camera; arguments as in `turntable_views`."""
    return [_view(manifest, K, sequence.frames[row], row, cam_from_world) for row in rows]


def _turned(vector: np.ndarray, axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation about a unit axis (Rodrigues)."""
    axis = axis / np.linalg.norm(axis)
    cosine, sine = math.cos(angle), math.sin(angle)
    return vector * cosine + np.cross(axis, vector) * sine + axis * (axis @ vector) * (1 - cosine)
