"""Presets and measured points, kept beside the avatar they were measured on.

`presets.json` next to `model.pt` holds, for each device and picture size, every measured point and the presets chosen
from them, and how much each billboard contributes (for settings that keep a share of them). It names the digest of its
model: settings of another training are refused.
"""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from nbavatar.config.core import from_mapping, to_mapping
from nbavatar.config.tradeoff import ACCURATE, LimitConfig, SettingConfig
from nbavatar.errors import DataError, did_you_mean
from nbavatar.io.forms import check_form
from nbavatar.io.records import read_json, write_json
from nbavatar.studies.tradeoff.front import POINT_FORM, Point, losses, pick_in_budget

__all__ = [
    "Chosen",
    "budget_setting",
    "preset_entry",
    "preset_setting",
    "presets_path",
    "store_presets",
    "stored_presets",
]

FORMAT = 1
_KIND = "nbavatar presets"
_FORM = {
    "model": str,
    "measured": [
        {
            "device": str,
            "size": (Ellipsis, 2, int),
            "presets": {str: {"setting": dict, "label": str, "why": str}},
            "points": [POINT_FORM],
            "importance": (None, [float]),
        }
    ],
}


class Chosen(NamedTuple):
    """A setting to render with, in words why, and the contributions it chooses billboards by (or None)."""

    setting: SettingConfig
    why: str
    importance: list[float] | None


def presets_path(model: str | os.PathLike[str]) -> Path:
    """Where the presets of a model are: `presets.json` beside it."""
    return Path(model).with_name("presets.json")


def preset_entry(name: str, point: Point, exact: Point, limits: LimitConfig | None) -> dict[str, Any]:
    """What is stored of a preset: its setting, its figures, and why it is the one."""
    if limits is None:
        rule = "the exact setting"
    else:
        rule = f"the fastest measured setting that loses less than {limits.psnr:g} dB PSNR and {limits.lpips:g} LPIPS"
        if point is exact:
            rule += "; none is faster than the exact one"
    psnr, lpips = losses(point, exact)
    return {
        "name": name,
        "setting": to_mapping(point.setting),
        "label": point.label,
        "why": f"{rule}: {point.speedup:.2f}x as fast, {0.0 - psnr:+.3f} dB, {lpips:+.4f} LPIPS, "
        f"{point.values['lpips_apart']:.4f} LPIPS from the exact pictures",
        "speedup": point.speedup,
        "psnr_lost": psnr,
        "lpips_gained": lpips,
        "diff_share": point.values["diff_share"],
        "lpips_apart": point.values["lpips_apart"],
        "ms": point.ms,
    }


def store_presets(
    path: str | os.PathLike[str],
    *,
    model: str,
    device: str,
    size: Sequence[int],
    presets: Mapping[str, Mapping[str, Any]],
    points: Sequence[Point],
    importance: Sequence[float] | None,
) -> None:
    """Writes presets, and keeps what was measured of the same model on other devices or at other sizes.

    Args:
        path: of the file.
        model: digest of `model.pt`.
        device: device with its threads.
        size: width and height of the pictures [px].
        presets: by name, from `preset_entry`.
        points: all that were measured.
        importance: largest contribution of every billboard [px], or None.
    """
    measured = []
    if Path(path).is_file():
        stored = read_json(path)
        if not isinstance(stored, dict) or stored.get("kind") != _KIND:
            fix = "move it: presets of this model are kept under this name"
            raise DataError.of(path, "kind", expected=f"'{_KIND}'", found="a file of another program", fix=fix)
        if stored.get("model") == model:
            check_form(stored, _FORM, path)
            measured = [e for e in stored["measured"] if (e["device"], e["size"]) != (device, list(size))]
    entry = {
        "device": device,
        "size": list(size),
        "presets": presets,
        "points": [point.to_mapping() for point in points],
        "importance": None if importance is None else [float(f"{value:.4g}") for value in importance],
    }
    content = {"kind": _KIND, "format": FORMAT, "model": model, "measured": [*measured, entry]}
    write_json(path, content)


def stored_presets(path: str | os.PathLike[str], model: str) -> list[str]:
    """Names of the presets that a file holds; none where it is of another model.

    Args:
        path: file of `store_presets`.
        model: digest of the model to render.

    Raises:
        DataError: no such file, or of another form.
    """
    content = read_json(path)
    if not isinstance(content, dict) or content.get("model") != model:
        return []
    return list(dict.fromkeys(name for entry in _read(path, model) for name in entry["presets"]))


def preset_setting(path: str | os.PathLike[str], name: str, *, model: str | None, device: str) -> Chosen:
    """A preset by its name; of this device where it was measured here, else of the device it was measured on.

    Args:
        path: file of `store_presets`.
        name: `accurate`, `balanced`, `fast`, or another of the sheet.
        model: digest of the model to render, or None where there is none yet (training).
        device: this device with its threads.

    Raises:
        DataError: no such file or preset, or it is of another model.
    """
    if name == ACCURATE and not Path(path).is_file():
        return Chosen(SettingConfig(), "the exact setting", None)
    measured = _read(path, model)
    measured = sorted(measured, key=lambda entry: entry["device"] != device)
    known = {preset for entry in measured for preset in entry["presets"]}
    for entry in measured:
        if name in entry["presets"]:
            chosen = entry["presets"][name]
            setting = from_mapping(SettingConfig, chosen["setting"], f"{path}, preset {name}")
            where = "" if entry["device"] == device else f" (measured on {entry['device']})"
            return Chosen(setting, f"{name}: {chosen['label']}, {chosen['why']}{where}", entry["importance"])
    raise DataError(f"{path}: no preset '{name}'; {did_you_mean(name, sorted(known))}")


def budget_setting(
    path: str | os.PathLike[str],
    *,
    model: str,
    device: str,
    size: Sequence[int],
    max_ms: float | None,
    min_psnr: float | None,
) -> Chosen:
    """The setting that fits a budget, by what was measured on this device at this picture size.

    Args:
        path, model, device: as in `preset_setting`.
        size: width and height of the pictures to render [px].
        max_ms, min_psnr: the budget (`nbavatar.studies.tradeoff.front.pick_in_budget`).

    Raises:
        DataError: nothing was measured here, or nothing fits.
    """
    measured = _read(path, model)
    fitting = [entry for entry in measured if entry["device"] == device and entry["size"] == list(size)]
    if not fitting:
        done = "; ".join(f"{e['device']} at {e['size'][0]}x{e['size'][1]}" for e in measured)
        raise DataError.of(
            path, expected=f"measurements on {device} at {size[0]}x{size[1]}", found=done,
            fix="run `nbavatar tradeoff` on these frames here first",
        )  # fmt: skip
    points = [Point.of(point, str(path)) for point in fitting[-1]["points"]]
    point = pick_in_budget(points, max_ms=max_ms, min_psnr=min_psnr)
    why = f"{point.label}: {point.ms:.1f} ms, {point.values['psnr']:.2f} dB when measured"
    return Chosen(point.setting, why, fitting[-1]["importance"])


def _read(path: str | os.PathLike[str], model: str | None) -> list[dict[str, Any]]:
    """The entries of a file, if it is of this model."""
    if not Path(path).is_file():
        raise DataError.of(
            path, expected="measured presets", found="no such file",
            fix="run `nbavatar tradeoff --model ...` first, or name another file with --presets",
        )  # fmt: skip
    content = read_json(path)
    if not isinstance(content, dict) or content.get("kind") != _KIND or content.get("format") != FORMAT:
        raise DataError.of(path, "kind", expected=f"'{_KIND}', format {FORMAT}", found="something else")
    check_form(content, _FORM, path)
    if model is not None and content["model"] != model:
        raise DataError.of(
            path, "model", expected=f"the model that is rendered ({model[:19]})", found=content["model"][:19],
            fix="it has been trained anew: run `nbavatar tradeoff` again",
        )  # fmt: skip
    return content["measured"]
