"""Training options of the billboards without their block, which most tests have no need to spell out."""

import dataclasses
from typing import Any

from nbavatar.config.core import from_mapping
from nbavatar.config.training import TrainConfig
from nbavatar.methods.billboards.options import BillboardsConfig

__all__ = ["train_config", "train_options"]

_OWN = {field.name for field in dataclasses.fields(BillboardsConfig)}


def train_options(options: dict[str, Any]) -> dict[str, Any]:
    """Options as `--cfg` takes them, those of the billboards moved into their block."""
    own = {key: value for key, value in options.items() if key in _OWN}
    return {**{key: value for key, value in options.items() if key not in _OWN}, "billboards": own}


def train_config(base: Any = None, **options: Any) -> Any:
    """`TrainConfig` with some options of training and of the billboards, over those of `base`."""
    base = TrainConfig() if base is None else base
    own = {key: value for key, value in options.items() if key in _OWN}
    shared = {key: value for key, value in options.items() if key not in _OWN}
    billboards = dataclasses.replace(
        base.billboards, **{key: _read(BillboardsConfig, key, value) for key, value in own.items()}
    )
    return dataclasses.replace(base, billboards=billboards, **shared)


def _read(cls: Any, key: str, value: Any) -> Any:
    return getattr(from_mapping(cls, {key: value}, "options"), key)
