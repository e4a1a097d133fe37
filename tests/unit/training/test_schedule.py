"""Schedules as functions of progress."""

import pytest

from nbavatar.config.training import TrainConfig
from nbavatar.optimization.schedule import plan_at, total_steps


def test_paper_schedule_is_the_supplements() -> None:
    config = TrainConfig(schedule="paper")
    assert total_steps(config) == 400_000
    assert plan_at(0.0, config, 1024) == (1, 1.0, None, True)
    assert plan_at(39_999 / 400_000, config, 1024).crop is None
    assert plan_at(40_000 / 400_000, config, 1024).crop == 256
    end = plan_at(1.0, config, 1024)
    assert end.rate == 1.0 and end.shrink == 1


def test_fast_schedule_goes_from_coarse_to_fine_and_ends_slow() -> None:
    config = TrainConfig(coarse_until=[0.1, 0.35], coarse_side=64, final_rate=0.05, decay_from=0.4)
    shrinks = [plan_at(p, config, 256).shrink for p in (0.0, 0.09, 0.1, 0.34, 0.35, 1.0)]
    assert shrinks == [4, 4, 2, 2, 1, 1]
    assert [plan_at(p, config, 128).shrink for p in (0.0, 0.2, 0.5)] == [2, 2, 1]
    assert plan_at(0.0, config, 100).shrink == 1
    rates = [plan_at(p, config, 256).rate for p in (0.0, 0.4, 0.7, 1.0)]
    assert rates[0] == rates[1] == 1.0 and rates[2] == pytest.approx(0.525) and rates[3] == pytest.approx(0.05)


def test_crops_wait_for_full_resolution() -> None:
    config = TrainConfig(coarse_until=[0.5], lpips_full_until=0.1, coarse_side=64)
    assert plan_at(0.3, config, 256).crop is None
    assert plan_at(0.6, config, 256).crop == 256


def test_lpips_may_be_rare_and_late() -> None:
    config = TrainConfig(lpips_every=3, lpips_from=0.2)
    assert [plan_at(0.5, config, 256, step).perceptual for step in range(6)] == [True, False, False] * 2
    assert not plan_at(0.1, config, 256, 0).perceptual
