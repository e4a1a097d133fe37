"""Rigid alignment of point sets, batched and robust: where a refit starts when only keypoints are known."""

import torch
from torch import Tensor

__all__ = ["align_points", "fill_frames"]


def align_points(
    source: Tensor, target: Tensor, weight: Tensor, *, scale: float, iterations: int = 10
) -> tuple[Tensor, Tensor, Tensor]:
    """Rotation and translation with `target ~ R source + t` (Kabsch 1976, reweighted after Geman and McClure).

    Args:
        source: `[L, 3]` or `[N, L, 3]` [m].
        target: `[N, L, 3]` [m]; rows with weight 0 may hold NaN.
        weight: `[N, L]`, 0 for missing points.
        scale: residual at which a point loses three quarters of its weight [m].
        iterations: reweightings.

    Returns:
        R `[N, 3, 3]`, t `[N, 3]`, and bool `[N]`: frames with three or more points that are not on a line.
    """
    weight = torch.where(torch.isfinite(target).all(-1), weight, torch.zeros_like(weight))
    target = torch.where(weight[..., None] > 0, target, torch.zeros_like(target))
    source = source.expand_as(target)
    robust = weight
    rotation = translation = valid = None
    for _ in range(iterations):
        total = robust.sum(-1, keepdim=True).clamp_min(1e-300)[..., None]
        a = (robust[..., None] * source).sum(1, keepdim=True) / total
        b = (robust[..., None] * target).sum(1, keepdim=True) / total
        covariance = (target - b).mT @ (robust[..., None] * (source - a)) / total
        left, values, right = torch.linalg.svd(covariance)
        sign = torch.ones_like(values)
        sign[:, 2] = torch.linalg.det(left @ right)
        rotation = (left * sign[:, None]) @ right
        translation = b[:, 0] - (rotation @ a.mT)[..., 0]
        residual = ((source @ rotation.mT + translation[:, None] - target) ** 2).sum(-1)
        robust = weight / (1 + residual / scale**2) ** 2
        valid = ((weight > 0).sum(-1) >= 3) & (values[:, 1] > 1e-6 * values[:, 0].clamp_min(1e-12))
    assert rotation is not None and translation is not None and valid is not None
    return rotation, translation, valid


def fill_frames(values: Tensor, valid: Tensor, segments: list[tuple[int, int]]) -> Tensor:
    """Copies the nearest valid frame into invalid ones, from the same uncut run where it has any.

    Args:
        values: `[N, ...]`.
        valid: bool `[N]`, at least one true.
        segments: first and last frame of each run.
    """
    result = values.clone()
    everywhere = torch.nonzero(valid)[:, 0]
    for first, last in segments:
        inside = everywhere[(everywhere >= first) & (everywhere <= last)]
        choice = inside if len(inside) else everywhere
        for frame in range(first, last + 1):
            if not valid[frame]:
                result[frame] = values[choice[(choice - frame).abs().argmin()]]
    return result
