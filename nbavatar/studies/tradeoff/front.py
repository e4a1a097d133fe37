"""Measured points, their fronts, and the rules that pick one of them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from statistics import median
from typing import Any

from nbavatar.config.core import from_mapping, to_mapping
from nbavatar.config.tradeoff import LimitConfig, SettingConfig
from nbavatar.errors import DataError
from nbavatar.io.forms import check_form

__all__ = [
    "POINT_FORM",
    "Point",
    "choose_preset",
    "describe",
    "losses",
    "pareto_front",
    "pick_in_budget",
    "steadied",
    "within",
]


POINT_FORM = {
    "model": str,
    "label": str,
    "setting": dict,
    "values": {
        "psnr": float,
        "lpips": float,
        "speedup": float,
        "ms": {"total": float},
        "steady_ms?": float,
    },
}
"""What `Point.to_mapping` gives, as far as others rely on it (`nbavatar.io.forms`)."""


@dataclass(frozen=True)
class Point:
    """One measured setting.

    Attributes:
        model: name of the avatar.
        label: what differs from the exact setting, in words.
        setting: how it is rendered.
        values: what `nbavatar.studies.tradeoff.measure.measure_point` gave.
    """

    model: str
    label: str
    setting: SettingConfig
    values: Mapping[str, Any]

    @property
    def speedup(self) -> float:
        """Times as fast as the exact setting, both taken in turn."""
        return float(self.values["speedup"])

    @property
    def ms(self) -> float:
        """Time of a picture [ms]: steady (`steadied`) where that is known, else as measured."""
        return float(self.values.get("steady_ms", self.values["ms"]["total"]))

    def to_mapping(self) -> dict[str, Any]:
        """JSON-ready."""
        return {"model": self.model, "label": self.label, "setting": to_mapping(self.setting), "values": self.values}

    @staticmethod
    def of(mapping: Mapping[str, Any], where: str) -> "Point":
        """The point that `to_mapping` described; DataError where it is none."""
        check_form(mapping, POINT_FORM, where)
        setting = from_mapping(SettingConfig, mapping["setting"], f"{where}, setting")
        return Point(mapping["model"], mapping["label"], setting, mapping["values"])


def describe(setting: SettingConfig, exact: SettingConfig) -> str:
    """What differs from the exact setting, such as `order=center, texels=4`; `exact` where nothing does."""
    names = [field.name for field in fields(SettingConfig)]
    changes = {name: getattr(setting, name) for name in names if getattr(setting, name) != getattr(exact, name)}
    return ", ".join(f"{name}={_short(value)}" for name, value in changes.items()) or "exact"


def losses(point: Point, exact: Point) -> tuple[float, float]:
    """PSNR lost [dB] and LPIPS gained [1] against the exact point; negative where the point is better."""
    return exact.values["psnr"] - point.values["psnr"], point.values["lpips"] - exact.values["lpips"]


def within(point: Point, exact: Point, limits: LimitConfig) -> bool:
    """Whether both losses are strictly below their limits."""
    psnr, lpips = losses(point, exact)
    return psnr < limits.psnr and lpips < limits.lpips


def steadied(points: Sequence[Point]) -> list[Point]:
    """The points with `steady_ms`: the median exact time over the whole sweep, divided by the point's speed-up.

    A machine that is busy for a while makes the points of that while slow, and the exact pictures beside them too.
    """
    base = median(point.values["exact_ms"] for point in points)
    return [replace(p, values={**p.values, "steady_ms": round(base / p.speedup, 3)}) for p in points]


def pareto_front(costs: Sequence[float], gains: Sequence[float]) -> list[int]:
    """Indices of the points that no other beats: none is as cheap and as good, and better in one of the two.

    Args:
        costs: less is better.
        gains: more is better.

    Returns:
        Ascending by cost; of equal points the first.
    """
    order = sorted(range(len(costs)), key=lambda i: (costs[i], -gains[i], i))
    front: list[int] = []
    for index in order:
        if not front or gains[index] > gains[front[-1]]:
            front.append(index)
    return front


def choose_preset(points: Iterable[Point], exact: Point, limits: LimitConfig) -> Point:
    """The fastest point within the limits, of equally fast ones the one with the least PSNR lost; or the exact one."""
    best, rank = exact, (exact.speedup, 0.0)
    for point in points:
        own = (point.speedup, -losses(point, exact)[0])
        if within(point, exact, limits) and own > rank:
            best, rank = point, own
    return best


def pick_in_budget(points: Sequence[Point], *, max_ms: float | None = None, min_psnr: float | None = None) -> Point:
    """The setting that a budget allows.

    Args:
        points: measured on one device at one picture size; not empty.
        max_ms: longest time of a picture [ms].
        min_psnr: least PSNR [dB].

    Returns:
        With `max_ms` the point of highest PSNR in time (of those as good as `min_psnr`, if that is given too); with
        `min_psnr` alone the fastest that is good enough.

    Raises:
        DataError: no point satisfies the budget; the line says what the nearest would be.
    """
    good = [p for p in points if min_psnr is None or p.values["psnr"] >= min_psnr]
    if not good:
        best = max(points, key=lambda p: p.values["psnr"])
        found = f"at most {best.values['psnr']:.2f} dB ({best.label}, {best.ms:.1f} ms)"
        raise DataError.of("--min-psnr", expected=f"a measured setting of {min_psnr:g} dB or more", found=found)
    if max_ms is None:
        return min(good, key=lambda p: (p.ms, -p.values["psnr"]))
    quick = [p for p in good if p.ms <= max_ms]
    if not quick:
        best = min(good, key=lambda p: p.ms)
        found = f"at least {best.ms:.1f} ms ({best.label}, {best.values['psnr']:.2f} dB)"
        limit = f"{max_ms:g} ms or less" + (f" and {min_psnr:g} dB or more" if min_psnr is not None else "")
        raise DataError.of("--max-ms", expected=f"a measured setting of {limit}", found=found)
    return max(quick, key=lambda p: (p.values["psnr"], -p.ms))


def _short(value: Any) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
