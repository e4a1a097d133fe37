"""Where a refit starts: the dataset's parameters, or a rigid alignment to triangulated keypoints."""

import dataclasses
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from nbavatar.errors import DataError
from nbavatar.fitting.parts import HandPart, HeadPart, PartModel, State
from nbavatar.fitting.refine import Prior
from nbavatar.fitting.rigid import align_points, fill_frames

__all__ = ["start_from_keypoints", "start_from_parameters", "with_anchor", "zero_state"]

_PALM = (0, 1, 4, 7, 10, 13)
"""Keypoints of the hand that move rigidly whatever the fingers do: wrist and knuckles."""

_NAMES = {
    "head": ("shape", "expression", "jaw", "global_orient", "transl"),
    "right_hand": ("betas", "hand_pose", "global_orient", "transl"),
    "left_hand": ("betas", "hand_pose", "global_orient", "transl"),
}


def start_from_parameters(model: PartModel, part: str, extras: Mapping[str, np.ndarray], frames: int) -> State | None:
    """The dataset's parameters as a state, the shape as the median over frames; None when there are none.

    Raises:
        DataError: some are there and others not, or their sizes are not those of the model.
    """
    names = [f"param.{part}.{name}" for name in _NAMES[part]]
    given = [name for name in names if name in extras]
    if not given:
        return None
    values = []
    sizes = [model.shape_count, *((model.local_count - 3, 3) if part == "head" else (model.local_count,)), 3, 3]
    for name, size in zip(names, sizes, strict=True):
        if name not in extras:
            raise DataError.of("tracks", name, expected="this array beside the other parameters", found="none")
        value = np.asarray(extras[name], dtype=np.float64)
        if value.shape != (frames, size):
            raise DataError.of("tracks", name, expected=[frames, size], found=list(value.shape))
        bad = np.flatnonzero(~np.isfinite(value).all(1))
        if len(bad):
            raise DataError.of("tracks", name, expected="finite numbers", found=f"NaN or infinity in frame {bad[0]}")
        values.append(torch.from_numpy(value))
    shape = torch.from_numpy(np.median(values[0].numpy(), axis=0))
    return HeadPart.state(shape, *values[1:]) if part == "head" else HandPart.state(shape, *values[1:])


def zero_state(model: PartModel, mean_local: Tensor, frames: int) -> State:
    """Mean shape and mean local pose `[D]`, not moved."""
    new = mean_local.new_zeros
    eye = torch.eye(3, dtype=mean_local.dtype).expand(frames, 3, 3)
    return State(eye, new(frames, 3), mean_local.expand(frames, -1).clone(), new(model.shape_count))


def start_from_keypoints(
    model: PartModel, part: str, state: State, points: np.ndarray, segments: list[tuple[int, int]]
) -> tuple[State, Tensor]:
    """Moves a state rigidly onto triangulated keypoints.

    Args:
        model: the part.
        part: its name.
        state: shape and local pose to move, rotation and translation are replaced.
        points: triangulated `[N, L, 3]` [m], NaN where missing.
        segments: uncut runs, for frames that have too few points.

    Returns:
        the state, and bool `[N]`: frames that had three points or more of their own.

    Raises:
        DataError: no frame has.
    """
    frames = len(points)
    upright = torch.eye(3, dtype=state.transl.dtype).expand(frames, 3, 3)
    level = State(upright, torch.zeros_like(state.transl), state.local, state.shape)
    chosen = list(range(points.shape[1])) if part == "head" else list(_PALM)
    source = model.keypoints(level).points[:, chosen]
    target = torch.from_numpy(points[:, chosen])
    rotation, shift, valid = align_points(source, target, torch.ones(target.shape[:2], dtype=target.dtype), scale=0.01)
    if not bool(valid.any()):
        raise DataError.of(
            "tracks", f"keypoints.{part}", expected="a frame in which three keypoints agree between cameras",
            found="none", fix="check the calibration, and that cameras and keypoints belong together",
        )  # fmt: skip
    # The model turns about a pivot of its own: R (x - p) + p + t = R x + shift.
    pivot = _pivot(model, level)
    transl = shift - pivot + (rotation @ pivot[..., None])[..., 0]
    moved = State(
        fill_frames(rotation, valid, segments), fill_frames(transl, valid, segments), state.local, state.shape
    )
    return moved, valid


def _pivot(model: PartModel, level: State) -> Tensor:
    """The point that a rotation of the state leaves in place `[N, 3]`: head centroid, or wrist."""
    if isinstance(model, HandPart):
        return model.keypoints(level).points[:, 0]
    means = [model.vertices(level.rows(slice(n, n + 64))).mean(1) for n in range(0, len(level.transl), 64)]
    return torch.cat(means)


def with_anchor(prior: Prior, state: State, deviation: float | None) -> Prior:
    """Draws a prior towards a state, so that what keypoints do not see stays about as the state has it.

    Args:
        prior: belief without a state.
        state: parameters that somebody else has fitted.
        deviation: how far their local pose may be off [rad]: the result is the product of both beliefs. None moves
            the centre to the state and keeps the deviations.
    """
    if deviation is None:
        return dataclasses.replace(prior, local_centre=state.local, shape_centre=state.shape)
    precision = prior.local_root.mT @ prior.local_root
    both = precision + torch.eye(len(precision), dtype=precision.dtype) / deviation**2
    centre = torch.linalg.solve(both, (prior.local_centre @ precision + state.local / deviation**2).mT).mT
    root = torch.linalg.cholesky(both).mT
    return dataclasses.replace(prior, local_centre=centre, local_root=root, shape_centre=state.shape)
