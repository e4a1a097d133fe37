"""Fronts, presets and budgets against brute force and hand-made tables."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nbavatar.config.tradeoff import LimitConfig, SettingConfig
from nbavatar.errors import DataError
from nbavatar.studies.tradeoff.front import (
    Point,
    choose_preset,
    describe,
    losses,
    pareto_front,
    pick_in_budget,
    steadied,
    within,
)

LIMITS = LimitConfig(psnr=0.1, lpips=0.002)


def point(label: str, speedup: float, psnr: float, lpips: float, *, exact_ms: float = 100.0) -> Point:
    values = {
        "speedup": speedup,
        "psnr": psnr,
        "lpips": lpips,
        "exact_ms": exact_ms,
        "diff_share": 0.1,
        "lpips_apart": 0.01,
    }
    return Point("full", label, SettingConfig(), values | {"ms": {"total": exact_ms / speedup}})


EXACT = point("exact", 1.0, 30.0, 0.050)


@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=1, max_size=14))
def test_the_front_is_what_no_other_point_beats(pairs: list[tuple[int, int]]) -> None:
    costs, gains = [float(c) for c, _ in pairs], [float(g) for _, g in pairs]
    front = pareto_front(costs, gains)
    # Brute force, by the definition, over values (equal points count once).
    beaten = {i for i, (c, g) in enumerate(pairs) if any(a <= c and b >= g and (a, b) != (c, g) for a, b in pairs)}
    assert {pairs[i] for i in front} == {p for i, p in enumerate(pairs) if i not in beaten}
    assert len({pairs[i] for i in front}) == len(front)
    assert [costs[i] for i in front] == sorted(costs[i] for i in front)


def test_balanced_is_the_fastest_point_strictly_within_its_limits() -> None:
    points = [
        EXACT,
        point("best", 3.0, 29.95, 0.0510),
        point("at the PSNR limit", 4.0, 29.9, 0.050),
        point("over the LPIPS limit", 5.0, 30.0, 0.0525),
        point("slow", 2.0, 31.0, 0.040),
    ]
    assert choose_preset(points, EXACT, LIMITS).label == "best"
    assert choose_preset(points, EXACT, LimitConfig(psnr=0.5, lpips=0.01)).label == "over the LPIPS limit"


def test_equally_fast_points_are_told_apart_by_quality() -> None:
    points = [EXACT, point("worse", 2.0, 29.95, 0.05), point("better", 2.0, 29.99, 0.05)]
    assert choose_preset(points, EXACT, LIMITS).label == "better"


def test_without_a_faster_point_the_exact_setting_is_the_preset() -> None:
    assert choose_preset([EXACT, point("slower", 0.9, 32.0, 0.01)], EXACT, LIMITS) is EXACT


def test_losses_are_negative_where_a_point_is_better() -> None:
    psnr, lpips = losses(point("", 2.0, 30.5, 0.040), EXACT)
    assert psnr == pytest.approx(-0.5) and lpips == pytest.approx(-0.010)
    assert within(point("", 2.0, 30.5, 0.040), EXACT, LIMITS)


def test_a_budget_takes_the_best_in_time_or_the_fastest_that_is_good_enough() -> None:
    points = [EXACT, point("half", 2.0, 29.5, 0.06), point("quick", 5.0, 27.0, 0.1), point("odd", 2.5, 29.0, 0.06)]
    assert pick_in_budget(points, max_ms=60.0).label == "half"
    assert pick_in_budget(points, max_ms=45.0).label == "odd"
    assert pick_in_budget(points, max_ms=1000.0).label == "exact"
    assert pick_in_budget(points, min_psnr=29.2).label == "half"
    assert pick_in_budget(points, min_psnr=20.0).label == "quick"
    assert pick_in_budget(points, max_ms=60.0, min_psnr=29.0).label == "half"


@pytest.mark.parametrize(
    ("budget", "words"),
    [
        ({"max_ms": 5.0}, "at least 20.0 ms"),
        ({"min_psnr": 40.0}, "at most 30.00 dB"),
        ({"max_ms": 30.0, "min_psnr": 29.0}, "30 ms or less and 29 dB or more"),
    ],
)
def test_a_budget_that_nothing_fits_says_what_comes_nearest(budget: dict[str, float], words: str) -> None:
    points = [EXACT, point("quick", 5.0, 27.0, 0.1)]
    with pytest.raises(DataError, match=words) as caught:
        pick_in_budget(points, **budget)
    assert "\n" not in str(caught.value)


def test_steady_times_do_not_depend_on_when_the_machine_was_busy() -> None:
    # The same two settings, measured while all took twice as long.
    calm = [point("exact", 1.0, 30, 0), point("a", 2.0, 30, 0, exact_ms=100.0)]
    busy = [point("exact", 1.0, 30, 0), point("a", 2.0, 30, 0, exact_ms=200.0)]
    assert [p.ms for p in steadied(calm)] == [100.0, 50.0]
    assert steadied(busy)[1].ms / steadied(busy)[0].ms == pytest.approx(0.5)


def test_a_label_names_what_differs() -> None:
    assert describe(SettingConfig(), SettingConfig()) == "exact"
    assert describe(SettingConfig(roi=True, t_min=0.01), SettingConfig()) == "roi=on, t_min=0.01"


def test_a_point_survives_its_json() -> None:
    assert Point.of(EXACT.to_mapping(), "log") == EXACT
    with pytest.raises(DataError, match="log"):
        Point.of({"model": "full"}, "log")
