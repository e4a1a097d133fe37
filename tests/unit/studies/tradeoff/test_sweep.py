"""The design of a sweep with a made-up machine, and its log under kills."""

import dataclasses
import json

import pytest

from nbavatar.config.core import to_mapping
from nbavatar.config.tradeoff import SettingConfig, read_sheet
from nbavatar.errors import ConfigError
from nbavatar.studies.tradeoff.front import Point, describe
from nbavatar.studies.tradeoff.sweep import PointLog, first_settings, knob_of, run_sweep

SHEET = {
    "knobs": {"order": ["center", "kbuffer(4)"], "decode": [0.5], "texels": [4, 2]},
    "combinations": [{"order": "center", "texels": 4}],
}


def machine(setting: SettingConfig) -> Point:
    """A world where knobs act apart: speed-ups multiply, losses add."""
    speed, psnr, lpips = 1.0, 0.0, 0.0
    for knob, value, factor, decibel, distance in (
        ("order", "center", 1.5, 0.02, 0.0005),
        ("order", "kbuffer(4)", 1.2, 0.01, 0.0001),
        ("decode", 0.5, 2.0, 0.07, 0.0012),
        ("texels", 4, 1.1, 0.05, 0.0001),
        ("texels", 2, 1.4, 0.8, 0.02),
    ):
        if getattr(setting, knob) == value:
            speed, psnr, lpips = speed * factor, psnr + decibel, lpips + distance
    values = {"speedup": speed, "psnr": 30 - psnr, "lpips": 0.05 + lpips, "exact_ms": 100.0, "diff_share": 0.0}
    return Point("full", describe(setting, SettingConfig()), setting, values | {"ms": {"total": 100 / speed}})


def test_first_come_exact_then_single_knobs_then_combinations() -> None:
    sheet = read_sheet(SHEET, "sheet")
    settings = list(first_settings(sheet))
    assert settings[0] == SettingConfig() and len(settings) == 7 and len(set(settings)) == 7
    points = [machine(setting) for setting in settings]
    assert [knob_of(p, sheet.exact) for p in points] == [None, "order", "order", "decode", "texels", "texels", None]


def test_the_best_of_each_knob_is_joined_while_the_limits_hold() -> None:
    sheet = read_sheet(SHEET, "sheet")
    asked: list[SettingConfig] = []

    def measure(setting: SettingConfig) -> Point:
        asked.append(setting)
        return machine(setting)

    points, presets, complete = run_sweep(sheet, measure)
    assert complete and len(asked) == len(set(asked)) == len(points)
    # By hand: decode (2.0) and center (1.5) lose 0.09 dB and 0.0017; texels 4 would make it 0.14 dB.
    assert (presets["balanced"].setting.decode, presets["balanced"].setting.order) == (0.5, "center")
    assert presets["balanced"].setting.texels is None and presets["balanced"].speedup == pytest.approx(3.0)
    assert presets["fast"].setting == SettingConfig(decode=0.5, order="center", texels=4)
    # Around the fast preset, each of its knobs is put back alone.
    for knob in ("decode", "order", "texels"):
        assert dataclasses.replace(presets["fast"].setting, **{knob: getattr(SettingConfig(), knob)}) in asked


def test_a_killed_sweep_goes_on_and_gives_what_an_unbroken_one_gives(tmp_path) -> None:
    sheet = read_sheet(SHEET, "sheet")
    whole, presets, _ = run_sweep(sheet, machine)
    measured: list[str] = []

    def remembering(log: PointLog, die_after: int | None):
        def measure(setting: SettingConfig) -> Point:
            key = json.dumps(to_mapping(setting), sort_keys=True)
            known = log.get(key)
            if known is not None:
                return Point.of(known, "log")
            if die_after is not None and len(measured) >= die_after:
                raise KeyboardInterrupt
            point = machine(setting)
            measured.append(key)
            log.add({"key": key, **point.to_mapping()})
            return point

        return measure

    path = tmp_path / "points.jsonl"
    for stop in (1, 4, 5):
        with pytest.raises(KeyboardInterrupt):
            run_sweep(sheet, remembering(PointLog(path), stop))
        # The kill may come in the middle of a line.
        with open(path, "a") as stream:
            stream.write('{"key": "unfin')
    again, presets_again, complete = run_sweep(sheet, remembering(PointLog(path), None))
    assert complete and again == whole and presets_again == presets
    assert len(measured) == len(set(measured)) == len(whole)
    assert all(json.loads(line) for line in path.read_text().splitlines())


def test_a_sweep_that_runs_out_of_time_says_so_and_has_presets() -> None:
    count = iter(range(100))
    points, presets, complete = run_sweep(read_sheet(SHEET, "sheet"), machine, should_stop=lambda: next(count) >= 3)
    assert not complete and len(points) == 4 and set(presets) == {"balanced", "fast"}


@pytest.mark.parametrize(
    ("sheet", "words"),
    [
        ({"knobs": {"ordr": ["ray"]}}, "unknown knob 'ordr'; did you mean 'order'"),
        ({"knobs": {"decode": [0.3]}}, "one of 1.0, 0.5, 0.25"),
        ({"knobs": {"decode": 0.5}}, "a list of values"),
        ({"combinations": [{"texels": "four"}]}, "combinations"),
        ({"presets": {"accurate": {"psnr": 1.0}}}, "exact setting"),
    ],
)
def test_a_wrong_sheet_is_refused_in_one_line(sheet: dict, words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        read_sheet(sheet, "sheet")
    assert words in str(caught.value) and "\n" not in str(caught.value)
