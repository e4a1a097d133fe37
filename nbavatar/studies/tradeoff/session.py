"""A sweep over trained avatars: what is shared by all of its points, and the log they are remembered in."""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from nbavatar.config.core import to_mapping
from nbavatar.config.tradeoff import SettingConfig, TradeoffConfig
from nbavatar.methods.billboards.avatar import Avatar
from nbavatar.methods.billboards.compression.contribution import contributions
from nbavatar.metrics.lpips import LPIPS
from nbavatar.studies.tradeoff.front import Point, describe
from nbavatar.studies.tradeoff.measure import Reference, Shot, measure_point, reference
from nbavatar.studies.tradeoff.sweep import PointLog, first_settings, run_sweep
from nbavatar.studies.tradeoff.tuned import TunedAvatar

__all__ = ["Candidate", "Session", "SweepResult", "view_contributions"]


class Candidate(NamedTuple):
    """An avatar that takes part: its name, the avatar, the digest of its file."""

    name: str
    avatar: Avatar
    digest: str


class SweepResult(NamedTuple):
    """All points, the exact one of the first model first; presets by name; whether the sweep is complete."""

    points: list[Point]
    presets: dict[str, Point]
    complete: bool


class Session:
    """Measures settings of avatars on the same held-out pictures, each only once.

    Args:
        sheet: what to measure.
        models: the avatar whose presets are sought, then others to compare.
        shots: held-out pictures.
        importance: contributions (N, F) of a model's billboards, asked for only when a setting needs them.
        net: LPIPS on the device.
        log: points already measured.
        identity: what decides a point besides model and setting (digests of data, device, code), JSON-ready.
        device: `cpu` or `cuda`.
        on_point: told about every point and whether it was measured just now.
    """

    def __init__(
        self,
        sheet: TradeoffConfig,
        models: Sequence[Candidate],
        shots: Sequence[Shot],
        importance: Callable[[Candidate], Tensor],
        net: LPIPS,
        log: PointLog,
        identity: Mapping[str, Any],
        *,
        device: str = "cpu",
        on_point: Callable[[Point, bool], None] | None = None,
    ) -> None:
        self._sheet, self._models, self._shots, self._importance = sheet, list(models), list(shots), importance
        self._net, self._log, self._identity, self._device, self._on_point = net, log, identity, device, on_point
        self._exact: tuple[TunedAvatar, list[Reference]] | None = None

    def run(self, should_stop: Callable[[], bool] | None = None) -> SweepResult:
        """Measures the sheet on the first model, and its exact setting, combinations and presets on the others."""
        first = self._models[0]
        points, presets, complete = run_sweep(
            self._sheet, lambda setting: self.point(first, setting), should_stop=should_stop
        )
        single = {knob: [] for knob in self._sheet.knobs}
        few = TradeoffConfig(exact=self._sheet.exact, knobs=single, combinations=self._sheet.combinations)
        for other in self._models[1:]:
            for setting in dict.fromkeys([*first_settings(few), *(p.setting for p in presets.values())]):
                if should_stop is not None and should_stop():
                    return SweepResult(points, presets, False)
                points.append(self.point(other, setting))
        return SweepResult(points, presets, complete)

    def point(self, model: Candidate, setting: SettingConfig) -> Point:
        """The point of a setting, remembered or measured now."""
        key = self._key(model, setting)
        known = self._log.get(key)
        if known is not None:
            point = Point.of(known, "point log")
        else:
            point = Point(model.name, describe(setting, self._sheet.exact), setting, self._measure(model, setting))
            self._log.add({"key": key, **point.to_mapping()})
        if self._on_point is not None:
            self._on_point(point, known is None)
        return point

    def _measure(self, model: Candidate, setting: SettingConfig) -> dict[str, Any]:
        exact, pictures = self._reference()
        same = model is self._models[0] and setting == self._sheet.exact
        avatar = exact if same else self.tuned(model, setting)
        return measure_point(
            avatar, exact, pictures, self._shots, self._net, repeats=self._sheet.repeats, warmup=self._sheet.warmup,
            device=self._device,
        )  # fmt: skip

    def tuned(self, model: Candidate, setting: SettingConfig) -> TunedAvatar:
        """An avatar under a setting."""
        importance = self._importance(model) if setting.billboards < 1.0 else None
        return TunedAvatar(model.avatar, setting, importance=importance)

    def _reference(self) -> tuple[TunedAvatar, list[Reference]]:
        """The first model at the exact setting, and its pictures."""
        if self._exact is None:
            exact = self.tuned(self._models[0], self._sheet.exact)
            self._exact = exact, [reference(shot.render(exact)[0], self._net) for shot in self._shots]
        return self._exact

    def _key(self, model: Candidate, setting: SettingConfig) -> str:
        values = {
            **self._identity,
            "model": model.digest,
            "beside": self._models[0].digest,
            "exact": to_mapping(self._sheet.exact),
            "setting": to_mapping(setting),
            "shots": [f"{shot.view.camera}/{shot.view.frame}" for shot in self._shots],
        }
        return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:24]


def view_contributions(avatar: Avatar, shots: Sequence[tuple[Mapping[str, Tensor], Any]], device: str) -> Tensor:
    """Contributions of all billboards to views, float (N, F).

    Args:
        avatar: trained.
        shots: vertices per part and `View` of each view; billboards of absent parts contribute nothing.
        device: where the avatar computes.
    """
    rows = []
    with torch.no_grad():
        _, alpha = avatar.textures()
        for verts, view in shots:
            posed, keep = avatar.pose(verts)
            shown = alpha if keep is None else alpha[keep]
            order = avatar.architecture.order
            size = view.width, view.height
            given = contributions(posed, shown, view.viewmat.to(device), view.K.to(device), *size, order=order)
            row = alpha.new_zeros(len(alpha))
            row[slice(None) if keep is None else keep] = given
            rows.append(row)
    return torch.stack(rows)
