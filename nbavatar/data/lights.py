"""The light of a recording's studio on disk (`.npz`), as `nbavatar light` estimates it and `nbavatar train` takes it.

    directions   float32 [K, 3]   towards the lights, unit, world
    weights      float32 [K]      how strong each is, not negative; 4 in all, so that a face that nothing hides and
                                  that is turned at random gets 1 in the mean

No lights at all (K = 0) say that the brightness of what was recorded does not follow a light that stands still.
"""

import os
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from nbavatar.errors import DataError
from nbavatar.io.arrays import read_arrays, write_arrays

__all__ = ["Light", "read_light", "write_light"]


class Light(NamedTuple):
    """Far lights.

    Attributes:
        directions: towards them, unit, world, float32 (K, 3).
        weights: float32 (K,), 4 in all.
    """

    directions: np.ndarray
    weights: np.ndarray


def write_light(path: str | os.PathLike[str], light: Light, record: Mapping[str, Any]) -> None:
    """Writes the light and its record."""
    arrays = {name: np.asarray(value, np.float32) for name, value in light._asdict().items()}
    units = {"frame of reference": "world", "sum of the weights": 4, "format": 1}
    write_arrays(path, arrays, {"units": units, **record})


def read_light(path: str | os.PathLike[str]) -> Light:
    """Reads the light.

    Raises:
        DataError: missing, damaged, shapes that disagree, a direction that is no unit vector, a negative weight.
    """
    arrays, _ = read_arrays(path, required=Light._fields)
    directions, weights = (arrays[name] for name in Light._fields)
    if directions.dtype.kind != "f" or directions.ndim != 2 or directions.shape[1:] != (3,):
        found = f"{directions.dtype} {list(directions.shape)}"
        raise DataError.of(path, "directions", expected="real numbers [K, 3]", found=found)
    if weights.dtype.kind != "f" or weights.shape != directions.shape[:1]:
        found = f"{weights.dtype} {list(weights.shape)}"
        raise DataError.of(path, "weights", expected=f"real numbers [{len(directions)}]", found=found)
    with np.errstate(over="ignore", invalid="ignore"):
        long = np.abs(np.linalg.norm(directions.astype(np.float64), axis=1) - 1.0)
    if not (long < 1e-3).all():
        raise DataError.of(path, "directions", expected="unit vectors", found="another length or NaN")
    if not (np.isfinite(weights).all() and (weights >= 0).all()):
        raise DataError.of(
            path, "weights", expected="finite numbers from 0 up", found="a negative one, NaN or infinity"
        )
    return Light(directions.astype(np.float32), weights.astype(np.float32))
