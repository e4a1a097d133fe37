"""`cameras.json` of a capture: the one parser, for the Snakefile and for every stage alike.

Standard library only. `nbavatar.data.capture` makes cameras of what is returned here.
"""

import dataclasses
import json
import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

from nbavatar.errors import ConfigError, DataError, describe, did_you_mean, parsing
from nbavatar.names import check_apart, check_name

__all__ = ["StoredCamera", "choose_camera", "parse_camera", "read_rig", "stored_test_camera"]

_NEEDED = ("width", "height", "K", "R", "t")
_OPTIONAL = ("distortion", "camera_model")
_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "FULL_OPENCV")

# What other tools call the same thing.
_ALIASES = {
    "distortion": (
        "dist", "distcoef", "distcoeff", "distcoefs", "distcoeffs", "distcoefficients", "distortioncoef",
        "distortioncoefs", "distortioncoeffs", "distortioncoefficients", "distortionparams", "distortionparameters",
        "distortions", "d", "k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "radial", "radialdistortion", "tangential",
        "tangentialdistortion", "lens",
    ),
    "K": (
        "k", "intrinsic", "intrinsics", "cameramatrix", "calibrationmatrix", "kmatrix", "fx", "fy", "cx", "cy", "flx",
        "fly", "f", "focal", "focallength", "params",
    ),
    "R": ("r", "rot", "rotation", "rotationmatrix", "rvec", "quaternion", "qvec"),
    "t": ("t", "tvec", "trans", "transl", "translation", "t_vec"),
    "width": ("w", "imagewidth", "imgwidth"),
    "height": ("h", "imageheight", "imgheight"),
    "camera_model": ("model", "cameratype", "type", "projection", "distortionmodel", "fisheye", "isfisheye"),
}  # fmt: skip
_POSES = (
    "extrinsic",
    "extrinsics",
    "camfromworld",
    "worldtocamera",
    "w2c",
    "worldtocam",
    "viewmatrix",
    "viewmat",
    "rt",
)
_INVERSE_POSES = ("c2w", "camtoworld", "cameratoworld", "worldfromcam", "pose", "transform", "transformmatrix")
_PLACES = ("position", "center", "centre", "c", "campos", "origin", "location")


@dataclasses.dataclass(frozen=True)
class StoredCamera:
    """One camera as the file has it.

    Attributes:
        width, height: image size [px].
        K: 3 x 3 camera matrix without skew [px].
        R, t: rotation and translation [m] from world to camera, OpenCV axes.
        distortion: coefficients in OpenCV's order, or None.
    """

    width: int
    height: int
    K: list[list[float]]
    R: list[list[float]]
    t: list[float]
    distortion: list[float] | None

    @property
    def centre(self) -> list[float]:
        """Where the camera stands [m], world."""
        return [-sum(self.R[row][axis] * self.t[row] for row in range(3)) for axis in range(3)]


def read_rig(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Reads the file; its entries are left as they are, for `parse_camera`.

    A byte-order mark is skipped.

    Raises:
        DataError: missing, no JSON, no mapping of cameras, or a name that is there twice.
    """
    with parsing(path, "a JSON file", damaged="text that does not parse"), open(path, encoding="utf-8-sig") as stream:
        stored = json.load(stream, object_pairs_hook=_Pairs)
    if not isinstance(stored, _Pairs) or not stored:
        found = "an empty mapping" if stored == [] and isinstance(stored, _Pairs) else type(stored).__name__
        raise DataError.of(path, expected="a mapping from camera name to its calibration", found=found)
    cameras = _mapping(stored, str(path))
    check_apart(cameras, path, "camera", error=DataError)
    return cameras


def parse_camera(name: str, entry: Any, path: str | os.PathLike[str]) -> StoredCamera:
    """Checks one entry of the file.

    Args:
        name: of the camera.
        entry: `width`, `height`, `K`, `R`, `t` and, where there is any, `distortion`; `camera_model` may be given if it
            is one that these keys describe.
        path: the file, for error lines.

    Raises:
        DataError: a name that is none, a key that is missing or unknown, or a value that describes no pinhole camera.
    """
    where = f"{path}: camera {check_name(name, path, 'camera', error=DataError)}"
    if not isinstance(entry, Mapping):
        raise DataError.of(where, expected=", ".join(_NEEDED), found=type(entry).__name__)
    _check_keys(entry, where)
    for key in ("width", "height"):
        if not isinstance(entry[key], int) or isinstance(entry[key], bool) or entry[key] < 1:
            raise DataError.of(where, key, expected="a whole number of pixels", found=describe(entry[key]))
    K, R = _matrix(entry["K"], where, "K"), _matrix(entry["R"], where, "R")
    last = max(abs(x - y) for x, y in zip(K[2], (0, 0, 1)))
    if last > 1e-9 or K[1][0] != 0 or K[0][1] != 0 or min(K[0][0], K[1][1]) <= 0:
        raise DataError.of(where, "K", expected="[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]", found=K)
    _check_rotation(R, where)
    t = _flat(entry["t"])
    if t is None or len(t) != 3:
        raise DataError.of(where, "t", expected="3 finite numbers", found=describe(entry["t"]))
    distortion = None
    if entry.get("distortion") is not None:
        distortion = _flat(entry["distortion"])
        if distortion is None:
            found = describe(entry["distortion"])
            raise DataError.of(where, "distortion", expected="finite numbers, in OpenCV's order", found=found)
    model = str(entry.get("camera_model", "OPENCV")).upper()
    if model not in _MODELS:
        expected, found = " or ".join(_MODELS), describe(entry["camera_model"])
        fix = "other lenses are not supported: undistort the images to pinhole ones"
        raise DataError.of(where, "camera_model", expected=expected, found=found, fix=fix)
    if model.endswith("PINHOLE") and distortion and any(distortion):
        raise DataError.of(where, "distortion", expected=f"none for a camera_model {model}", found=distortion)
    return StoredCamera(entry["width"], entry["height"], K, R, t, distortion)


def choose_camera(wanted: str | int, names: Sequence[str] | Mapping[str, Any], where: str) -> str:
    """The name of the camera that is meant by `wanted`.

    YAML and command lines make numbers of camera ids: 84 may be `084`, and 8 may have been written `010`. A number
    means the one camera whose name reads like that.

    Raises:
        ConfigError: no such camera, or several.
    """
    if isinstance(wanted, str):
        if wanted not in names:
            raise ConfigError(f"{where}: unknown camera '{wanted}'; {did_you_mean(wanted, names)}")
        return wanted
    meant = [name for name in names if name.isdecimal() and wanted in _readings(name)]
    if len(meant) != 1:
        found = " and ".join(f"'{name}'" for name in meant) or f"none; {did_you_mean(str(wanted), names)}"
        fix = "write the camera's name in quotes, as text"
        raise ConfigError.of(where, expected=f"one camera that {wanted} can mean", found=found, fix=fix)
    return meant[0]


def stored_test_camera(folder: str | os.PathLike[str], names: Sequence[str] | Mapping[str, Any]) -> str:
    """The camera that a capture itself holds out: `test_camera` of its `splits.json`, empty where it names none.

    Raises:
        DataError: the file is no JSON, or the camera is none of `names`.
    """
    path = os.path.join(folder, "splits.json")
    try:
        with open(path, encoding="utf-8-sig") as stream:
            stored = json.load(stream)
    except FileNotFoundError:
        return ""
    except (ValueError, RecursionError) as error:
        raise DataError.of(path, expected="JSON", found=f"text that does not parse ({error})") from error
    camera = stored.get("test_camera", "") if isinstance(stored, dict) else ""
    if camera != "" and camera not in list(names):
        found, fix = describe(camera), did_you_mean(str(camera), names)
        raise DataError.of(path, "test_camera", expected="a camera of cameras.json", found=found, fix=fix)
    return camera


def _readings(name: str) -> set[int]:
    """Numbers that YAML or a command line makes of an id of digits: decimal, and octal after a leading zero."""
    octal = len(name) > 1 and name.startswith("0") and not set(name) & {"8", "9"}
    return {int(name)} | ({int(name, 8)} if octal else set())


class _Pairs(list[tuple[str, Any]]):
    """A JSON object with all its keys, those that repeat included."""


def _mapping(pairs: "_Pairs", where: str) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for key, value in pairs:
        if key in result:
            raise DataError.of(where, key, expected="each key once", found="it twice")
        result[key] = _mapping(value, f"{where}: {key}") if isinstance(value, _Pairs) else value
    return result


def _check_keys(entry: Mapping[str, Any], where: str) -> None:
    known = (*_NEEDED, *_OPTIONAL)
    for key in entry:
        if key not in known:
            raise DataError(f"{where}: unknown key '{key}'; {_hint(str(key))}")
    for key in _NEEDED:
        if key not in entry:
            raise DataError.of(where, key, expected="this key", found=f"only {', '.join(map(str, entry)) or 'none'}")


def _hint(key: str) -> str:
    plain = "".join(c for c in key.lower() if c.isalnum())
    for meant, others in _ALIASES.items():
        if plain in others:
            more = {
                "distortion": " (a list, in OpenCV's order: k1, k2, p1, p2, k3, ...)",
                "K": " ([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])",
                "R": " (a 3 x 3 matrix, world to camera)",
                "t": " (world to camera)",
            }.get(meant, "")
            return f"did you mean {meant}?{more}"
    if plain in _POSES:
        return "did you mean R and t? (the first three columns and the last one)"
    if plain in _INVERSE_POSES:
        return "did you mean R and t, of world to camera? (the inverse of camera to world)"
    if plain in _PLACES:
        return "did you mean t? (t = -R position)"
    return did_you_mean(key, (*_NEEDED, *_OPTIONAL))


def _matrix(value: Any, where: str, key: str) -> list[list[float]]:
    rows = value if isinstance(value, list) and len(value) == 3 else []
    matrix = [[_number(x) for x in row] for row in rows if isinstance(row, list) and len(row) == 3]
    if len(matrix) != 3 or any(x is None for row in matrix for x in row):
        raise DataError.of(where, key, expected="3 x 3 finite numbers", found=describe(value))
    return [[x for x in row if x is not None] for row in matrix]


def _flat(value: Any) -> list[float] | None:
    """Numbers in a list, a row or a column; None if it is none of them."""
    if isinstance(value, list) and value and all(isinstance(row, list) for row in value):
        if len(value) > 1 and any(len(row) != 1 for row in value):
            return None
        value = [x for row in value for x in row]
    if not isinstance(value, list):
        return None
    numbers = [_number(x) for x in value]
    return None if any(x is None for x in numbers) else [x for x in numbers if x is not None]


def _number(value: Any) -> float | None:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def _check_rotation(R: list[list[float]], where: str) -> None:
    off = max(
        abs(sum(R[i][k] * R[j][k] for k in range(3)) - (1.0 if i == j else 0.0)) for i in range(3) for j in range(3)
    )
    determinant = sum(
        R[0][i] * (R[1][(i + 1) % 3] * R[2][(i + 2) % 3] - R[1][(i + 2) % 3] * R[2][(i + 1) % 3]) for i in range(3)
    )
    if off > 1e-3 or determinant < 0:
        found = f"a matrix that is off by {off:.2g}, determinant {determinant:.3g}"
        raise DataError.of(where, "R", expected="a rotation", found=found)
