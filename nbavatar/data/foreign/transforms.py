"""Frames of `transforms.json`, the file of instant-ngp, nerfstudio and VHAP.

A frame has `file_path`, `transform_matrix` (camera to world, OpenGL axes: x right, y up, z back) and the intrinsics
`fl_x fl_y cx cy w h` [px], `k1 k2 k3 p1 p2`, `camera_model`, which the top level may hold for all frames.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nbavatar.data.foreign.source import Lens
from nbavatar.errors import DataError
from nbavatar.io.records import read_json

__all__ = ["frame_lens", "read_transforms"]

_MODELS = {
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV": ("k1", "k2", "k3", "p1", "p2"),
}
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")


def read_transforms(path: Path) -> tuple[Mapping[str, Any], list[Mapping[str, Any]]]:
    """The top level and the frames.

    Raises:
        DataError: not JSON, or no list of frames in it.
    """
    top = read_json(path)
    if not isinstance(top, Mapping) or not isinstance(top.get("frames"), list):
        raise DataError.of(path, "frames", expected="a list of frames", found=repr(top)[:60])
    for number, frame in enumerate(top["frames"]):
        if not isinstance(frame, Mapping):
            raise DataError.of(path, f"frames[{number}]", expected="a mapping", found=repr(frame)[:60])
    return top, top["frames"]


def frame_lens(
    top: Mapping[str, Any], frame: Mapping[str, Any], where: str, size: tuple[int, int], *, pixel_center: float = 0.5
) -> Lens:
    """Calibration of one frame; its own values win over those of the top level.

    Args:
        top, frame: of `read_transforms`.
        where: file and frame, for errors.
        size: width and height of the picture [px], which `w` and `h` have to agree with.
        pixel_center: where the file puts the centre of pixel (0, 0) [px].

    Raises:
        DataError: a value is missing, no number or out of range; another size; a lens that is neither a pinhole's nor
            of OpenCV's polynomial model.
    """
    values = {**top, **frame}
    width, height = (_number(values, key, where, float(side)) for key, side in zip(("w", "h"), size))
    if (width, height) != size:
        raise DataError.of(
            where, "w, h", expected=f"{size[0]} x {size[1]} as its picture", found=f"{width:g} x {height:g}",
            fix="the calibration has to be that of the pictures as they are stored",
        )  # fmt: skip
    fx = _focal(values, "x", where, width, None)
    fy = _focal(values, "y", where, height, fx)
    shift = 0.5 - pixel_center
    cx, cy = (_number(values, key, where, side / 2) for key, side in (("cx", width), ("cy", height)))
    K = np.array([[fx, 0, cx + shift], [0, fy, cy + shift], [0, 0, 1]])
    return Lens(*size, K, np.linalg.inv(_pose(frame, where)), _distortion(values, where))


def _pose(frame: Mapping[str, Any], where: str) -> np.ndarray:
    """World from camera, OpenCV axes."""
    expected = "4 x 4 finite numbers (camera to world)"
    try:
        matrix = np.array(frame["transform_matrix"], dtype=np.float64)
    except KeyError:
        raise DataError.of(where, "transform_matrix", expected=expected, found="none") from None
    except (TypeError, ValueError):
        found = repr(frame["transform_matrix"])[:60]
        raise DataError.of(where, "transform_matrix", expected=expected, found=found) from None
    if matrix.shape == (3, 4):
        matrix = np.concatenate([matrix, [[0.0, 0.0, 0.0, 1.0]]])
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or (matrix[3] != [0, 0, 0, 1]).any():
        raise DataError.of(where, "transform_matrix", expected=expected, found=str(matrix.tolist())[:80])
    off = float(np.abs(matrix[:3, :3] @ matrix[:3, :3].T - np.eye(3)).max())
    if off > 1e-3 or np.linalg.det(matrix[:3, :3]) < 0:
        found = f"one that is off by {off:.2g}, determinant {np.linalg.det(matrix[:3, :3]):.3g}"
        raise DataError.of(where, "transform_matrix", expected="a rotation in its first three columns", found=found)
    return matrix * np.array([1.0, -1.0, -1.0, 1.0])


def _focal(values: Mapping[str, Any], axis: str, where: str, side: float, other: float | None) -> float:
    """Focal length [px], from itself, the angle of view [rad], or that of the other axis."""
    key, angle = f"fl_{axis}", f"camera_angle_{axis}"
    if values.get(key) is None and values.get(angle) is not None:
        view = _number(values, angle, where)
        if not 0 < view < math.pi:
            raise DataError.of(where, angle, expected="an angle between 0 and pi [rad]", found=view)
        return side / 2 / math.tan(view / 2)
    focal = _number(values, key, where, other)
    if focal <= 0:
        raise DataError.of(where, key, expected="a focal length above 0 [px]", found=focal)
    return focal


def _distortion(values: Mapping[str, Any], where: str) -> np.ndarray | None:
    k1, k2, k3, k4, p1, p2 = (_number(values, key, where, 0.0) for key in _COEFFICIENTS)
    model = values.get("camera_model", "OPENCV")
    if values.get("is_fisheye"):
        model = "OPENCV_FISHEYE"
    if not isinstance(model, str) or model not in _MODELS:
        raise DataError.of(
            where, "camera_model", expected=f"one of {', '.join(_MODELS)}", found=repr(model)[:40],
            fix="undistort the pictures to a pinhole camera first",
        )  # fmt: skip
    given = dict(zip(_COEFFICIENTS, (k1, k2, k3, k4, p1, p2)))
    for key, value in given.items():
        if value and key not in _MODELS[model]:
            kept = ", ".join(_MODELS[model]) or "no coefficients"
            raise DataError.of(where, key, expected=f"{kept}, as {model} has", found=f"{key} = {value:g}")
    return np.array([k1, k2, p1, p2, k3]) if any(given.values()) else None


def _number(values: Mapping[str, Any], key: str, where: str, default: float | None = None) -> float:
    value = values.get(key)
    if value is None and default is not None:
        return default
    try:
        number = float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else math.nan
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise DataError.of(where, key, expected="a number", found="none" if value is None else repr(value)[:60])
    return number
