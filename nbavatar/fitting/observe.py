"""Keypoints of a mesh sequence as observations of a refit, and how well a state explains them."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from nbavatar.camera.distortion import undistort_pixels
from nbavatar.errors import DataError
from nbavatar.fitting.parts import PartModel, State
from nbavatar.fitting.refine import Observations, reproject
from nbavatar.fitting.triangulate import Triangulation, triangulate

__all__ = ["KEYPOINT_COUNTS", "error_table", "explained", "frame_errors", "keypoint_cameras", "observe"]

KEYPOINT_COUNTS = {"head": 68, "right_hand": 21, "left_hand": 21}
_CONTOUR = 17


def keypoint_cameras(extras: Mapping[str, np.ndarray], part: str) -> list[str]:
    """Cameras that have keypoints of a part, sorted."""
    prefix = f"keypoints.{part}."
    return sorted(name[len(prefix) :] for name in extras if name.startswith(prefix))


def observe(
    extras: Mapping[str, np.ndarray],
    part: str,
    cameras: Sequence[str],
    frames: int,
    *,
    threshold: float,
    contour_weight: float = 1.0,
) -> tuple[Observations, Triangulation]:
    """Collects keypoints, removes lens distortion, and triangulates.

    Args:
        extras: `keypoints.<part>.<camera>` `[N, L, 3]` (x, y [px, distorted], confidence) and
            `camera.<camera>.{K, cam_from_world, distortion}`.
        part: `head`, `right_hand` or `left_hand`.
        cameras: which to use.
        frames: N.
        threshold: largest error of an agreeing view [px].
        contour_weight: factor on the confidence of the head's contour landmarks.

    Returns:
        observations (confidences cut to [0, 1]), and the triangulated points `[N, L, 3]`.

    Raises:
        DataError: shapes that disagree, a camera without calibration, or keypoints that are not numbers.
    """
    count = KEYPOINT_COUNTS[part]
    pixels, confidence, matrices, poses = [], [], [], []
    for camera in cameras:
        name = f"keypoints.{part}.{camera}"
        values = np.asarray(extras[name], dtype=np.float64)
        if values.shape != (frames, count, 3):
            raise DataError.of("tracks", name, expected=[frames, count, 3], found=list(values.shape))
        for key in ("K", "cam_from_world"):
            if f"camera.{camera}.{key}" not in extras:
                raise DataError.of(
                    "tracks", f"camera.{camera}.{key}", expected="the camera's calibration", found="none"
                )
        K = np.asarray(extras[f"camera.{camera}.K"], dtype=np.float64)
        distortion = extras.get(f"camera.{camera}.distortion")
        given = np.isfinite(values).all(-1) & (values[..., 2] > 0)
        xy = np.where(given[..., None], values[..., :2], K[:2, 2])
        if distortion is not None and np.any(distortion):
            xy = undistort_pixels(xy, K, np.asarray(distortion, dtype=np.float64))
        given &= np.isfinite(xy).all(-1)
        weight = np.where(given, np.clip(values[..., 2], 0, 1), 0.0)
        if part == "head":
            weight[:, :_CONTOUR] *= contour_weight
        pixels.append(np.where(given[..., None], xy, 0.0))
        confidence.append(weight)
        matrices.append(K)
        poses.append(np.asarray(extras[f"camera.{camera}.cam_from_world"], dtype=np.float64))
    stacked = [np.stack(values) for values in (pixels, confidence, matrices, poses)]
    points = triangulate(*stacked, threshold=threshold)
    tensors = [torch.from_numpy(np.ascontiguousarray(values)) for values in stacked]
    agree = torch.from_numpy(points.inliers)
    return Observations(tensors[0], tensors[1], agree, tensors[2], tensors[3]), points


def error_table(part: PartModel, state: State, seen: Observations, threshold: float) -> np.ndarray:
    """How well a state explains the keypoints, per camera.

    Args:
        part: model.
        state: pose and shape.
        seen: keypoints.
        threshold: error beyond which a keypoint counts as unexplained [px].

    Returns:
        float64 `[M, 4]`: median error and 95th percentile over explained keypoints [px], share of unexplained
        keypoints, number of keypoints. NaN where a camera has none.
    """
    errors = _errors(part, state, seen)
    table = np.full((len(seen.K), 4), np.nan)
    for row, (error, weight) in enumerate(zip(errors, seen.confidence, strict=True)):
        values = error[weight > 0].numpy()
        near = values[values < threshold]
        table[row, 3] = len(values)
        if len(values):
            table[row, 2] = 1 - len(near) / len(values)
        if len(near):
            table[row, :2] = np.median(near), np.percentile(near, 95)
    return table


def explained(part: PartModel, state: State, seen: Observations, threshold: float) -> np.ndarray:
    """Per keypoint, uint8 `[M, N, L]`: 0 not detected, 1 farther than `threshold` [px] from the fit, 2 near it."""
    near = _errors(part, state, seen) < threshold
    return torch.where(seen.confidence > 0, 1 + near.to(torch.uint8), 0).to(torch.uint8).numpy()


def frame_errors(part: PartModel, state: State, seen: Observations, threshold: float) -> Tensor:
    """Mean truncated squared error of each frame `[N]` [px^2], over the views that agree; `threshold^2` without any."""
    squared = _errors(part, state, seen).square().clamp_max(threshold**2)
    weight = seen.confidence * seen.agree
    total = weight.sum((0, 2))
    mean = (weight * squared).sum((0, 2)) / total.clamp_min(1e-12)
    return torch.where(total > 0, mean, torch.full_like(mean, threshold**2))


def _errors(part: PartModel, state: State, seen: Observations) -> Tensor:
    """Pixel errors `[M, N, L]`; infinite behind a camera."""
    result = []
    for first in range(0, len(state.transl), 256):
        rows = slice(first, first + 256)
        image, camera = reproject(part.keypoints(state.rows(rows)).points, seen.K, seen.cam_from_world)
        error = (image - seen.pixels[:, rows]).norm(dim=-1)
        result.append(torch.where(camera[..., 2] > 1e-3, error, torch.full_like(error, torch.inf)))
    return torch.cat(result, 1)
