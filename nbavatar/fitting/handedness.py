"""Whether keypoints that are said to be of one hand are of that hand.

Two mistakes are told apart. A detector run on mirrored images gives pixels counted from the other side: triangulation
then fails, and succeeds with `width - x`. Keypoints of the other hand triangulate well, but that hand's model fits them
better: a hand and its mirror image differ in where the thumb is once the fingers' bending side is known.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from nbavatar.errors import DataError
from nbavatar.fitting.observe import frame_errors
from nbavatar.fitting.parts import HandPart
from nbavatar.fitting.refine import Observations, Prior, refine
from nbavatar.fitting.start import start_from_keypoints, zero_state
from nbavatar.fitting.triangulate import triangulate

__all__ = ["judge_handedness"]

_FRAMES = 8
_STEPS = 8
_MARGIN = 1.3


def judge_handedness(
    name: str,
    models: Mapping[str, HandPart],
    points: np.ndarray,
    seen: Observations,
    prior: Prior,
    *,
    threshold: float,
    noise_floor: float,
    width: np.ndarray | None,
) -> dict[str, Any]:
    """Fits a few frames with both hands' models and compares.

    Args:
        name: `right_hand` or `left_hand`, what the keypoints are said to be.
        models: side -> model; with one side only, no verdict is given.
        points: triangulated keypoints `[N, 21, 3]` [m].
        seen: observations of all frames.
        prior: prior of the named hand.
        threshold: largest error of an agreeing view [px].
        noise_floor: smallest sigma [px].
        width: image widths `[M]` [px], to try mirrored images; None to leave that out.

    Returns:
        `expected`, `found` (`right`, `left`, `mirrored images` or `undecided`), `error_px` by side.
    """
    expected = name.removesuffix("_hand")
    verdict: dict[str, Any] = {"expected": expected, "found": "undecided", "error_px": {}}
    if width is not None and _mirrored(seen, threshold, width):
        return verdict | {"found": "mirrored images"}
    views = seen.agree.sum((0, 2))
    order = torch.argsort(views, descending=True, stable=True)
    good = order[views[order] >= 2 * 16][: 4 * _FRAMES]
    if len(good) < 1 or len(models) < 2:
        return verdict
    chosen = torch.sort(good[torch.linspace(0, len(good) - 1, min(_FRAMES, len(good))).long()]).values
    few = dataclasses.replace(
        seen, pixels=seen.pixels[:, chosen], confidence=seen.confidence[:, chosen], agree=seen.agree[:, chosen]
    )
    alone = [(n, n) for n in range(len(chosen))]
    errors = {}
    for side, model in models.items():
        mano = model.mano
        shape, free = torch.zeros(model.shape_count, dtype=torch.float64), torch.zeros_like(prior.smoothness)
        mean = mano.mean_pose.expand(len(chosen), -1)
        belief = Prior(mean, _root(model, prior), shape, prior.shape_deviation, free, alone)
        try:
            start, _ = start_from_keypoints(
                model, name, zero_state(model, mano.mean_pose, len(chosen)), points[chosen.numpy()], alone
            )
        except DataError:
            return verdict
        state, _ = refine(
            model, start, belief, few, threshold=threshold, iterations=_STEPS, noise_floor=noise_floor, tolerance=1e-4
        )
        # The pose prior decides where both explain the pixels: fingers that bend backwards are another hand's.
        strain = float(((state.local - belief.local_centre) @ belief.local_root.mT).square().mean().sqrt())
        pixels = float(frame_errors(model, state, few, 10 * threshold).mean().sqrt())
        errors[side] = (pixels, strain)
    verdict["error_px"] = {side: round(pixels, 4) for side, (pixels, _) in errors.items()}
    verdict["pose_strain"] = {side: round(strain, 4) for side, (_, strain) in errors.items()}
    floor = 0.05 * threshold
    scores = {side: (pixels + floor) * (strain + 0.5) for side, (pixels, strain) in errors.items()}
    best, other = sorted(scores, key=lambda side: scores[side])[:2]
    if scores[other] > _MARGIN * scores[best]:
        verdict["found"] = best
    return verdict


def _root(model: HandPart, prior: Prior) -> torch.Tensor:
    """Pose prior of this side: the statistics of its own file, floored as in the prior of the named hand."""
    mano = model.mano
    if mano.pose_basis is None or mano.pose_deviation is None:
        return prior.local_root
    smallest = 1 / torch.linalg.matrix_norm(prior.local_root, 2)
    return mano.pose_basis / mano.pose_deviation.clamp_min(float(smallest))[:, None]


def _mirrored(seen: Observations, threshold: float, width: np.ndarray) -> bool:
    """Whether far more views agree after mirroring all images."""
    given = (seen.confidence > 0).sum()
    # Any two views agree by chance now and then, so wrong pixels agree in a third of the cases, not in none.
    if given == 0 or seen.agree.sum() > 0.75 * given:
        return False
    flipped = seen.pixels.numpy().copy()
    flipped[..., 0] = width[:, None, None] - flipped[..., 0]
    again = triangulate(
        flipped, seen.confidence.numpy(), seen.K.numpy(), seen.cam_from_world.numpy(), threshold=threshold
    )
    return bool(again.inliers.sum() > 1.3 * int(seen.agree.sum()) and again.inliers.sum() > 0.6 * int(given))
