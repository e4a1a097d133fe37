"""Robust triangulation of keypoints from many calibrated views.

Every pair of cameras proposes a point (linear triangulation on normalised rays, Hartley and Sturm 1997); each
proposal is scored over all cameras by the truncated squared reprojection error (MSAC, Torr and Zisserman 2000); the
best one is refined by Gauss-Newton on its inliers with Geman-McClure weights. With 8 cameras all 28 pairs are tried, so
the result is deterministic, and right as long as two good views agree and no more bad ones do.
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np

__all__ = ["Triangulation", "triangulate"]

_CHUNK = 20_000


class Triangulation(NamedTuple):
    """Points from views.

    Attributes:
        points: float64 `[..., 3]` [m], world; NaN where fewer than two views agree, or where their rays are so nearly
            one line that a pixel would move the point by more than its distance.
        inliers: bool `[M, ...]`, the views that agree with the point.
        error: float64 `[...]` [px], root mean square reprojection error over the inliers; NaN without a point.
    """

    points: np.ndarray
    inliers: np.ndarray
    error: np.ndarray


def triangulate(
    pixels: np.ndarray,
    confidence: np.ndarray,
    K: np.ndarray,
    cam_from_world: np.ndarray,
    *,
    threshold: float,
    refinements: int = 5,
) -> Triangulation:
    """Triangulates each keypoint from the views that agree.

    Args:
        pixels: ideal (undistorted) pixels `[M, ..., 2]` [px].
        confidence: `[M, ...]`, 0 for a missing detection.
        K: `[M, 3, 3]` [px].
        cam_from_world: `[M, 4, 4]`.
        threshold: largest reprojection error of an agreeing view [px].
        refinements: Gauss-Newton steps after the choice of views.
    """
    cameras, shape = len(K), pixels.shape[1:-1]
    flat = np.asarray(pixels, np.float64).reshape(cameras, -1, 2)
    weight = np.asarray(confidence, np.float64).reshape(cameras, -1)
    # A comparison with NaN is false: what is not a positive number, in pixels or confidence, is no detection.
    weight = np.where(np.isfinite(flat).all(-1) & (weight > 0) & np.isfinite(weight), weight, 0.0)
    flat = np.where(weight[..., None] > 0, flat, 0.0)
    project = np.asarray(K, np.float64) @ np.asarray(cam_from_world, np.float64)[:, :3]
    points = np.full((flat.shape[1], 3), np.nan)
    inliers = np.zeros(weight.shape, dtype=bool)
    error = np.full(flat.shape[1], np.nan)
    for first in range(0, flat.shape[1], _CHUNK):
        part = slice(first, first + _CHUNK)
        points[part], inliers[:, part], error[part] = _solve(
            flat[:, part], weight[:, part], project, threshold, refinements
        )
    return Triangulation(points.reshape(*shape, 3), inliers.reshape(cameras, *shape), error.reshape(shape))


def _solve(
    pixels: np.ndarray, weight: np.ndarray, project: np.ndarray, threshold: float, refinements: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    cameras, count = weight.shape
    best = np.full((count, 3), np.nan)
    best_score = np.full(count, np.inf)
    for a, b in combinations(range(cameras), 2):
        seen = np.flatnonzero((weight[a] > 0) & (weight[b] > 0))
        if not len(seen):
            continue
        candidate = _linear(pixels[[a, b]][:, seen], project[[a, b]])
        squared = np.minimum(_squared(candidate, pixels[:, seen], project), threshold**2)
        score = (weight[:, seen] * squared).sum(0)
        # Both views of the pair must agree with their own point; crossing rays behind a camera do not.
        good = (squared[a] < threshold**2) & (squared[b] < threshold**2)
        better = good & (score < best_score[seen])
        best[seen[better]], best_score[seen[better]] = candidate[better], score[better]
    found = np.isfinite(best_score)
    point = np.where(found[:, None], best, 0.0)
    inliers = found & (weight > 0) & (_squared(point, pixels, project) < threshold**2)
    for _ in range(refinements):
        point = np.where(found[:, None], _refine(point, pixels, weight * inliers, project, threshold), 0.0)
    squared = _squared(point, pixels, project)
    inliers = found & (weight > 0) & (squared < threshold**2)
    views = inliers.sum(0)
    kept = found & (views >= 2)
    kept[kept] = _determined(point[kept], inliers[:, kept], project)
    inliers &= kept
    with np.errstate(invalid="ignore", divide="ignore"):
        error = np.sqrt(np.where(inliers, squared, 0).sum(0) / views)
    return np.where(kept[:, None], point, np.nan), inliers, np.where(kept, error, np.nan)


def _determined(points: np.ndarray, inliers: np.ndarray, project: np.ndarray) -> np.ndarray:
    """Whether an error of one pixel moves each point by less than its distance from the nearest of its views."""
    jacobian, depth = _jacobian(points, inliers, project)
    normal = np.einsum("mn,mnki,mnkj->nij", inliers.astype(np.float64), jacobian, jacobian)
    weakest = np.linalg.eigvalsh(normal)[:, 0]
    return weakest * np.where(inliers, depth, np.inf).min(0, initial=np.inf) ** 2 > 1.0


def _linear(pixels: np.ndarray, project: np.ndarray) -> np.ndarray:
    """Two-view linear triangulation: the least-squares solution of four equations, inhomogeneous in the point."""
    rows, sides = [], []
    for xy, matrix in zip(pixels, project, strict=True):
        for axis in range(2):
            row = xy[:, axis, None] * matrix[2] - matrix[axis]
            row = row / np.linalg.norm(row[:, :3], axis=1, keepdims=True).clip(1e-12)
            rows.append(row[:, :3])
            sides.append(-row[:, 3])
    left, right = np.stack(rows, 1), np.stack(sides, 1)
    normal = left.transpose(0, 2, 1) @ left
    # A tiny ridge: rays that are parallel give a far point instead of a singular matrix.
    normal = normal + 1e-15 * np.eye(3)
    return np.linalg.solve(normal, left.transpose(0, 2, 1) @ right[..., None])[..., 0]


def _project(points: np.ndarray, project: np.ndarray) -> np.ndarray:
    """Homogeneous pixels `[M, n, 3]`."""
    return points @ project[:, :, :3].transpose(0, 2, 1) + project[:, None, :, 3]


def _squared(points: np.ndarray, pixels: np.ndarray, project: np.ndarray) -> np.ndarray:
    """Squared reprojection errors `[M, n]` [px^2]; infinite behind the camera."""
    image = _project(points, project)
    depth = image[..., 2]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        squared = ((image[..., :2] / depth[..., None] - pixels) ** 2).sum(-1)
    return np.where(depth > 1e-6, squared, np.inf)


def _refine(
    points: np.ndarray, pixels: np.ndarray, weight: np.ndarray, project: np.ndarray, scale: float
) -> np.ndarray:
    """One Gauss-Newton step with Geman-McClure weights of width `scale` [px]."""
    jacobian, depth = _jacobian(points, weight > 0, project)
    residual = _project(points, project)[..., :2] / depth[..., None] - pixels
    robust = weight / (1 + (residual**2).sum(-1) / scale**2) ** 2
    normal = np.einsum("mn,mnki,mnkj->nij", robust, jacobian, jacobian)
    right = np.einsum("mn,mnki,mnk->ni", robust, jacobian, residual)
    ridge = 1e-12 * np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1e-300
    return points - np.linalg.solve(normal + ridge * np.eye(3), right[..., None])[..., 0]


def _jacobian(points: np.ndarray, seen: np.ndarray, project: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivative of the pixels by the points, `[M, n, 2, 3]` [px/m], and depths `[M, n]` [m], 1 where not seen."""
    image = _project(points, project)
    depth = np.where(seen, image[..., 2], 1.0)
    xy = image[..., :2] / depth[..., None]
    return (project[:, None, :2, :3] - xy[..., None] * project[:, None, 2:, :3]) / depth[..., None, None], depth
