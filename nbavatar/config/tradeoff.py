"""Options of the trade-off between speed and quality: how an avatar is rendered, and which ways are measured.

A setting holds everything about a picture that can still be changed after training. Channels and the U-Net's width
cannot: avatars of other sizes are trained apart and join the measurement as further models.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from nbavatar.config.core import from_mapping, merge, option, to_mapping
from nbavatar.errors import ConfigError, did_you_mean

__all__ = ["ACCURATE", "LimitConfig", "OfflineConfig", "SettingConfig", "TradeoffConfig", "read_sheet", "vary"]

ACCURATE = "accurate"


@dataclass(frozen=True)
class SettingConfig:
    """How a trained avatar is rendered; the defaults leave nothing out but empty pixels."""

    resolution: float = option(1.0, "Side of the rendered picture as a share of the frame's; enlarged to it [1].",
                               min=0.05, max=1.0)  # fmt: skip
    decode: float = option(1.0, "Side at which the U-Net works as a share of the rendered picture's: features are "
                           "averaged before it, its answer is enlarged.", choices=(1.0, 0.5, 0.25))  # fmt: skip
    precision: str = option("fp32", "Arithmetic of the U-Net (autocast).", choices=("fp32", "bf16", "fp16"))
    roi: bool | None = option(None, "Work only in a window around the avatar; null: as it was trained.")
    roi_margin: float | None = option(None, "Margin of that window, in its own size; null: as trained.", min=0)
    order: str | None = option(None, "Compositing order: ray, kbuffer(n) or center; null: as trained.")
    t_min: float = option(1e-4, "A ray ends where its transmittance falls below this [1].", min=0, max=0.99)
    alpha_min: float = option(1.0 / 255.0, "Texture samples of less opacity are skipped [1].", min=0, max=0.99)
    low_pass: float = option(1.0, "Least half extent of a billboard on screen [px].", min=0)
    texels: int | None = option(None, "Texels a side that textures are resampled to; null: as trained.", min=1, max=64)
    billboards: float = option(1.0, "Share of the billboards kept, those that contribute most.", min=0.01, max=1.0)
    mips: bool = option(False, "Take smaller textures where the avatar is small on screen.")
    channels_last: bool = option(True, "Memory layout of the U-Net: channels last, else channels first.")
    threads: int | None = option(None, "Threads of the CPU; null: as many as torch takes.", min=1, max=1024)


@dataclass(frozen=True)
class LimitConfig:
    """Losses that a preset may have against the exact setting, on the same images."""

    psnr: float = option(0.1, "PSNR lost, strictly below this [dB].", min=0)
    lpips: float = option(0.002, "LPIPS gained, strictly below this [1].", min=0)


@dataclass(frozen=True)
class OfflineConfig:
    """Knobs of the stages before training."""

    contact_frames: int = option(6, "Frames of deepest contact that are solved.", min=1)
    contact_iterations: list[int] = option([1, 2, 4, 8, 16, 32], "Sweeps over all constraints in a step.", min=1)
    contact_settle: list[int] = option([0, 2, 4, 8], "Steps after the hand has arrived.", min=0)
    refit_frames: int = option(30, "Frames of the synthetic subject that is refitted.", min=4)
    refit_mesh: str = option("full", "Size of its models.", choices=("full", "tiny"))
    refit_cameras: list[int] = option([2, 3, 4, 6, 8], "Cameras of the refit.", min=2, max=64)
    refit_iterations: list[int] = option([5, 10, 20, 40, 60], "Iterations of the refit.", min=0)
    spectral_modes: list[int] = option([3, 6, 12, 24, 48], "Modes a part.", min=1, max=512)
    decimate_shares: list[float] = option([0.75, 0.5, 0.25, 0.1], "Shares of the faces kept.", min=0.01, max=1.0)
    decimate_frames: int = option(6, "Frames on which the original is compared.", min=1)


@dataclass(frozen=True)
class TradeoffConfig:
    """One sheet: the exact setting, the knobs and their values, what presets may lose, how much is measured."""

    exact: SettingConfig = option(SettingConfig, "The setting that all others are compared with.")
    knobs: dict[str, Any] = option({}, "Knob -> values, each tried alone, all else exact.")
    combinations: list[Any] = option([], "Settings tried besides, as what differs from the exact one.")
    presets: dict[str, LimitConfig] = option(
        {"balanced": LimitConfig(0.1, 0.002), "fast": LimitConfig(0.5, 0.01)},
        "Preset -> losses it may have; the fastest point within them is taken. `accurate` is the exact setting.",
    )
    greedy: bool = option(
        True, "For every preset, also join the best value of each knob, one more at a time, while it stays within."
    )
    around: bool = option(True, "Also try every knob's exact value alone in each preset found.")
    images: int = option(4, "Held-out images that are judged, evenly spaced over all given.", min=1)
    repeats: int = option(5, "Timed pictures a point, each beside one at the exact setting.", min=1)
    warmup: int = option(1, "Pictures before timing starts.", min=0)
    net: str = option("alex", "Backbone of LPIPS.", choices=("alex", "vgg"))
    importance_views: int = option(8, "Views that decide which billboards contribute.", min=1)
    offline: OfflineConfig = option(OfflineConfig, "The stages before training (`--offline`).")


_FIELDS = {field.name: field for field in fields(SettingConfig)}


def vary(setting: SettingConfig, change: Mapping[str, Any], where: str = "setting") -> SettingConfig:
    """A setting with some knobs at other values.

    Raises:
        ConfigError: an unknown knob, a wrong type, a value out of range.
    """
    return from_mapping(SettingConfig, merge(to_mapping(setting), change), where)


def read_sheet(mapping: Mapping[str, Any], where: str) -> TradeoffConfig:
    """Reads and checks a sheet: every value of every knob and every combination gives a valid setting.

    Raises:
        ConfigError: one line that names the key.
    """
    sheet = from_mapping(TradeoffConfig, mapping, where)
    for knob, values in sheet.knobs.items():
        if knob not in _FIELDS:
            raise ConfigError(f"{where}.knobs: unknown knob '{knob}'; {did_you_mean(knob, _FIELDS)}")
        if not isinstance(values, list):
            raise ConfigError.of(f"{where}.knobs.{knob}", expected="a list of values", found=type(values).__name__)
        for value in values:
            vary(sheet.exact, {knob: value}, f"{where}.knobs.{knob}")
    for number, change in enumerate(sheet.combinations):
        if not isinstance(change, Mapping):
            expected, found = "a mapping of knobs", type(change).__name__
            raise ConfigError.of(f"{where}.combinations[{number}]", expected=expected, found=found)
        vary(sheet.exact, change, f"{where}.combinations[{number}]")
    if ACCURATE in sheet.presets:
        raise ConfigError.of(f"{where}.presets", ACCURATE, expected="no limits, it is the exact setting", found="some")
    return sheet
