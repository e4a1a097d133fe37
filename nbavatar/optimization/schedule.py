"""What changes while an avatar trains, as pure functions of progress p in [0, 1].

    paper   one resolution; LPIPS on the whole image for the first tenth, then on random crops; only the rate of
            the billboard offsets decays, exponentially to 0.01 (supplement, 'Optimization details')
    fast    the same, plus: coarse to fine (the U-Net is warm-started at low resolution, where a step costs little),
            and a cosine decay of all rates at the end

Progress is step / steps, or elapsed / budget where a time budget is given; the latter follows the clock, so two runs
under a time budget are not bit-identical.
"""

import math
from typing import NamedTuple

from nbavatar.config.training import STEPS, TrainConfig

__all__ = ["Plan", "plan_at", "total_steps"]


class Plan(NamedTuple):
    """Settings of one step.

    Attributes:
        shrink: images are this many times smaller (a power of two).
        rate: factor on all learning rates.
        crop: side of the LPIPS crop [px], or None for the whole image.
        perceptual: whether LPIPS is computed, where the method has it in its loss.
    """

    shrink: int
    rate: float
    crop: int | None
    perceptual: bool


def total_steps(config: TrainConfig) -> int:
    """Number of optimization steps when no time budget is given."""
    return config.steps if config.steps is not None else STEPS[config.schedule]


def plan_at(progress: float, config: TrainConfig, side: int, step: int = 0) -> Plan:
    """Settings at a point of the training.

    Args:
        progress: p in [0, 1].
        config: training options.
        side: shorter side of the full-resolution images [px].
        step: number of the step, for terms that are not computed in each.
    """
    progress = min(max(progress, 0.0), 1.0)
    shrink, rate = 1, 1.0
    if config.schedule == "fast":
        ahead = sum(progress < until for until in config.coarse_until)
        while ahead > 0 and side // (2 * shrink) >= config.coarse_side:
            shrink, ahead = 2 * shrink, ahead - 1
        if progress > config.decay_from:
            turn = (progress - config.decay_from) / max(1.0 - config.decay_from, 1e-9)
            rate = config.final_rate + (1.0 - config.final_rate) * 0.5 * (1.0 + math.cos(math.pi * turn))
    crop = None if progress < config.lpips_full_until or shrink > 1 else config.lpips_crop
    perceptual = step % config.lpips_every == 0 and progress >= config.lpips_from
    return Plan(shrink, rate, crop, perceptual)
