"""The options by which render, speed and train take a measured setting: `--preset`, `--max-ms`, `--min-psnr`."""

import argparse
from collections.abc import Sequence
from typing import Any

from nbavatar.config.evaluation import AUTO, ENGINES
from nbavatar.errors import ConfigError, DataError
from nbavatar.provenance import file_digest

__all__ = ["add_engine_argument", "add_preset_arguments", "take_engine", "timed_device", "tuned_avatar"]


def add_preset_arguments(parser: argparse.ArgumentParser, *, budget: bool) -> None:
    """Declares `--preset` and `--presets`, and with `budget` also `--max-ms` and `--min-psnr`."""
    parser.add_argument(
        "--preset", metavar="NAME", help="accurate, balanced, fast: a setting measured by `nbavatar tradeoff`"
    )
    parser.add_argument("--presets", metavar="JSON", help="measured settings (default: presets.json beside the model)")
    if budget:
        parser.add_argument(
            "--max-ms", type=float, metavar="MS", help="best measured setting that takes at most this time a picture"
        )
        parser.add_argument(
            "--min-psnr", type=float, metavar="DB", help="fastest measured setting of at least this PSNR"
        )


def add_engine_argument(parser: argparse.ArgumentParser, default: str) -> None:
    """Declares `--engine`."""
    own = "the fastest that is installed" if default == AUTO else "torch, by which tables are made"
    parser.add_argument(
        "--engine", default=default, choices=ENGINES, help=f"what decodes on a CPU (default: {default}, {own})"
    )


def take_engine(args: argparse.Namespace, avatar: Any, device: str) -> str:
    """Gives an avatar the engine that `--engine` names; returns its name for records.

    Raises:
        ConfigError: an engine by name on a GPU.
        DependencyError: its package is not installed.
    """
    from nbavatar.methods.billboards.engine import chosen_engine

    return avatar.use_engine(chosen_engine(args.engine, device))


def timed_device(device: str) -> str:
    """Name of a device under which its times are kept: the CPU's with its threads."""
    import torch

    from nbavatar.devices import device_name

    return device_name(device) + ("" if device == "cuda" else f", {torch.get_num_threads()} threads")


def tuned_avatar(
    args: argparse.Namespace, avatar: Any, device: str, size: Sequence[int], preset: str = ""
) -> tuple[Any, dict[str, Any] | None]:
    """The avatar under the setting that the options ask for, and what to record of it; as it is without any.

    Args:
        args: with `model`, `preset`, `presets` and, where there is a budget, `max_ms` and `min_psnr`.
        avatar: of `args.model`.
        device: `cpu` or `cuda`.
        size: width and height of the pictures [px].
        preset: of the protocol, used where the command line names none.

    Raises:
        ConfigError: a preset and a budget together.
        DataError: nothing measured that fits; the line says what to run first.
    """
    max_ms, min_psnr = getattr(args, "max_ms", None), getattr(args, "min_psnr", None)
    budget = max_ms is not None or min_psnr is not None
    name = args.preset or ("" if budget else preset)
    if not name and not budget:
        return avatar, None
    if name and budget:
        raise ConfigError.of("--preset", expected="a preset or a budget (--max-ms, --min-psnr)", found="both")
    import torch

    from nbavatar.config.core import to_mapping
    from nbavatar.studies.tradeoff.presets import budget_setting, preset_setting, presets_path
    from nbavatar.studies.tradeoff.tuned import TunedAvatar

    path = args.presets or presets_path(args.model)
    digest, here = file_digest(args.model), timed_device(device)
    if name:
        chosen = preset_setting(path, name, model=digest, device=here)
    else:
        chosen = budget_setting(path, model=digest, device=here, size=size, max_ms=max_ms, min_psnr=min_psnr)
    if chosen.importance is not None and len(chosen.importance) != len(avatar.faces):
        expected, found = f"{len(avatar.faces)} numbers, one a billboard of {args.model}", len(chosen.importance)
        raise DataError.of(path, "importance", expected=expected, found=found)
    print(chosen.why, flush=True)
    importance = None if chosen.importance is None else torch.tensor(chosen.importance)[None]
    described = {"preset": name or None, "setting": to_mapping(chosen.setting), "why": chosen.why}
    return TunedAvatar(avatar, chosen.setting, importance=importance), described
