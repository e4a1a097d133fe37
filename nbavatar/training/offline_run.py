"""Curves and previews as an offline run of Weights & Biases, beside TensorBoard's; nothing is sent anywhere.

`wandb sync <model>.state/wandb/offline-run-*` uploads it, when and where the user wants. Options, numbers, pictures and
the versions of installed packages are in it; code, repository, hardware and output are not.
"""

import hashlib
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from nbavatar.errors import require
from nbavatar.io.records import canonical_json

__all__ = ["OfflineRun"]


class OfflineRun:
    """One process's part of a training; what goes on from a checkpoint adds a part with the same id.

    Args:
        folder: where its folder `wandb` is made.
        project: of Weights & Biases.
        name: of the run, as it is listed there.
        key: JSON-ready description of the experiment; the id is made of it, and its `config` is stored.

    Raises:
        DependencyError: the package cannot be imported.
    """

    def __init__(self, folder: str, project: str, name: str, key: Mapping[str, Any]) -> None:
        self._wandb: Any = require("wandb", "wandb", "the option `wandb`")
        quiet = {"silent": True, "console": "off", "disable_git": True, "disable_code": True, "save_code": False}
        settings = self._wandb.Settings(**quiet, x_disable_stats=True, x_disable_meta=True, x_disable_machine_info=True)
        identity = hashlib.sha256(canonical_json(dict(key)).encode()).hexdigest()[:16]
        self._run = self._wandb.init(
            project=project, name=name, id=identity, dir=folder, mode="offline",
            config=dict(key.get("config", {})), settings=settings,
        )  # fmt: skip

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Logs numbers by tag; those that are not finite are left out."""
        self._run.log({tag: value for tag, value in values.items() if math.isfinite(value)}, step=step)

    def image(self, step: int, tag: str, image: np.ndarray) -> None:
        """Logs one picture, uint8 (H, W, 3)."""
        self._run.log({tag: self._wandb.Image(image)}, step=step)

    def close(self) -> None:
        """Writes what is left."""
        self._run.finish()
