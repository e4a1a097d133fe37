"""Which settings are measured, and a log of those that have been.

    1. the exact setting; every value of every knob alone; the combinations of the sheet
    2. for every preset, the best value of each knob joined one more at a time while the point stays within limits
    3. the presets that result, each with one knob put back to its exact value

The log is one JSON line a point, keyed by a digest of everything that decides it: a sweep that was killed goes on
where it stopped, and one with a longer sheet measures only what is new.
"""

import dataclasses
import json
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from nbavatar.config.tradeoff import SettingConfig, TradeoffConfig, vary
from nbavatar.io.atomic import no_links, storage_errors
from nbavatar.studies.tradeoff.front import Point, choose_preset, within

__all__ = ["PointLog", "first_settings", "knob_of", "run_sweep"]

_GAIN = 1.03  # a knob that wins less than this alone is not worth joining
_STEP = 1.01  # and once joined it has to win this much more

Measure = Callable[[SettingConfig], Point]


class PointLog:
    """Lines of a file, each a JSON mapping with a `key`; appended one by one, read back whole.

    Args:
        path: of the file; made with the first line. An unfinished last line (a kill while writing) is dropped.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._path = Path(path)
        self._lines: dict[str, dict[str, Any]] = {}
        content = self._path.read_bytes() if self._path.is_file() else b""
        whole = content[: content.rfind(b"\n") + 1]
        if whole != content:
            with open(self._path, "r+b", opener=no_links) as stream:
                stream.truncate(len(whole))
        for line in whole.splitlines():
            try:
                entry = json.loads(line)
                self._lines[entry["key"]] = entry
            except (ValueError, KeyError, TypeError, RecursionError):
                continue  # measured again

    def get(self, key: str) -> dict[str, Any] | None:
        """The line of a key, if there is one."""
        return self._lines.get(key)

    def add(self, entry: dict[str, Any]) -> None:
        """Appends a line; it is on disk when this returns."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with storage_errors(self._path), open(self._path, "a", encoding="utf-8", opener=no_links) as stream:
            stream.write(json.dumps(entry, sort_keys=True) + "\n")
            stream.flush()
            os.fsync(stream.fileno())
        self._lines[entry["key"]] = entry


def first_settings(sheet: TradeoffConfig) -> Iterator[SettingConfig]:
    """The exact setting, single knobs, combinations; each once."""
    seen = []
    changes: list[Mapping[str, Any]] = [{}]
    changes += [{knob: value} for knob, values in sheet.knobs.items() for value in values]
    changes += sheet.combinations
    for change in changes:
        setting = vary(sheet.exact, change)
        if setting not in seen:
            seen.append(setting)
            yield setting


def run_sweep(
    sheet: TradeoffConfig, measure: Measure, *, should_stop: Callable[[], bool] | None = None
) -> tuple[list[Point], dict[str, Point], bool]:
    """Measures a sheet.

    Args:
        sheet: what to measure.
        measure: gives the point of a setting, measured or remembered.
        should_stop: asked before every point; the sweep then ends early.

    Returns:
        points, the exact one first; presets by name, `accurate` not among them; whether the sweep is complete.
    """
    points: dict[SettingConfig, Point] = {}
    stopped = False

    def take(setting: SettingConfig) -> Point | None:
        nonlocal stopped
        if setting not in points:
            stopped = stopped or (bool(points) and should_stop is not None and should_stop())
            if stopped:
                return None
            points[setting] = measure(setting)
        return points[setting]

    for setting in first_settings(sheet):
        take(setting)
    exact = points[sheet.exact]
    for limits in sheet.presets.values():
        if sheet.greedy:
            _join(sheet, exact, limits, points, take)
    if sheet.around:
        for limits in sheet.presets.values():
            preset = choose_preset(points.values(), exact, limits)
            for knob in _changed(preset.setting, sheet.exact):
                take(dataclasses.replace(preset.setting, **{knob: getattr(sheet.exact, knob)}))
    chosen = {name: choose_preset(points.values(), exact, limits) for name, limits in sheet.presets.items()}
    return list(points.values()), chosen, not stopped


def knob_of(point: Point, exact: SettingConfig) -> str | None:
    """The one knob in which a point's setting differs from the exact one, or None."""
    changed = _changed(point.setting, exact)
    return changed[0] if len(changed) == 1 else None


def _join(sheet: TradeoffConfig, exact: Point, limits: Any, points: Mapping, take: Callable) -> None:
    """Joins the best value of each knob, the most rewarding first, while the point stays within the limits."""
    best: dict[str, Point] = {}
    for point in points.values():
        knob = knob_of(point, sheet.exact)
        if knob is None or point.speedup < _GAIN or not within(point, exact, limits):
            continue
        if knob not in best or point.speedup > best[knob].speedup:
            best[knob] = point
    current = exact
    for knob, single in sorted(best.items(), key=lambda item: -item[1].speedup):
        trial = take(dataclasses.replace(current.setting, **{knob: getattr(single.setting, knob)}))
        if trial is None:
            return
        if within(trial, exact, limits) and trial.speedup > _STEP * current.speedup:
            current = trial


def _changed(setting: SettingConfig, exact: SettingConfig) -> list[str]:
    names = [field.name for field in dataclasses.fields(SettingConfig)]
    return [name for name in names if getattr(setting, name) != getattr(exact, name)]
