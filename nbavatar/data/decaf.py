"""The arrays of the Decaf dataset as they are stored, checked; `decaf_files` says where they are.

Nothing here is computed: `decaf_tracks` turns parameters into meshes. What the release's documentation leaves open is
accepted in all plausible forms and reported: frame keys as numbers or text, distortion coefficients under any of
several names.

    cameras        K float64 [3, 3] [px], cam_from_world float64 [4, 4] [m], distortion [12] or None
    parameters     float32 [N, size] per part and name; angles [rad], translations [m]
    keypoints      float32 [N, 68 | 21, 3]  x, y [px of the full frame], confidence
    boxes          float32 [N, 4]  x0, y0, x1, y1 [px]; NaN rows where the detection failed
    contacts       bool [N, V];  deformations float32 [N, V, 3] [m], the head's own axes, to be SUBTRACTED
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nbavatar.camera.distortion import checked_coefficients
from nbavatar.camera.pinhole import Camera
from nbavatar.data.decaf_files import PARTS, DecafSubject
from nbavatar.errors import DataError, describe, did_you_mean, parsing
from nbavatar.io.arrays import as_numbers, read_array_header
from nbavatar.io.pickles import read_array, read_pickle
from nbavatar.io.video import probe_video
from nbavatar.names import check_name

__all__ = [
    "KEYPOINTS",
    "check_counts",
    "frame_counts",
    "read_boxes",
    "read_camera",
    "read_cuts",
    "read_frame_array",
    "read_keypoints",
    "read_parameters",
]

KEYPOINTS = {"head": 68, "right_hand": 21}
_DISTORTION_KEYS = (
    "distortion", "dist", "dist_coeffs", "distCoeffs", "dist_coeff", "dist_coef", "distortion_coefficients",
    "distortion_coeffs", "distortions", "distortion_params", "distCoef", "D", "d", "k",
)  # fmt: skip
_FIXED_SIZES = {
    ("head", "transl"): 3,
    ("head", "global_orient"): 3,
    ("head", "pose_params"): 6,
    ("head", "shape_params"): None,
    ("head", "expression_params"): None,
    ("right_hand", "transl"): 3,
    ("right_hand", "global_orient"): 3,
    ("right_hand", "hand_pose"): 45,
    ("right_hand", "betas"): None,
}


def read_camera(subject: DecafSubject, camera: str, *, pixel_center: float = 0.5) -> tuple[Camera, dict[str, Any]]:
    """Reads one camera's calibration, its size from the video.

    Args:
        subject: whose.
        camera: id, text of three digits.
        pixel_center: where the stored matrices put the centre of pixel (0, 0) [px]; the result has it at 0.5.

    Returns:
        the camera, and a report for the record: all keys that were found, and which one held the distortion.

    Raises:
        DataError: no such camera or video, or a calibration that is no pinhole camera.
    """
    path = subject.calibration
    check_name(camera, path, "camera", error=DataError)
    stored = read_pickle(path)
    if not isinstance(stored, Mapping):
        raise DataError.of(path, expected="a mapping of cameras", found=type(stored).__name__)
    with parsing(path, "a mapping of cameras", damaged="one with other keys"):
        by_name = {_camera_id(key): value for key, value in stored.items()}
    if camera not in by_name:
        raise DataError(f"{path}: no camera '{camera}'; {did_you_mean(camera, by_name)}")
    if camera not in subject.cameras:
        known = did_you_mean(camera, subject.cameras) if subject.cameras else "no camera has one"
        raise DataError(f"{subject.videos}: subject {subject.name} has no video {camera}.mp4; {known}")
    entry, where = by_name[camera], f"{path}: camera {camera}"
    if not isinstance(entry, Mapping):
        raise DataError.of(where, expected="a mapping with intrinsic and extrinsic", found=type(entry).__name__)
    K = _matrix(entry, "intrinsic", ((3, 3),), where)
    K = K / K[2, 2] if K[2, 2] else K
    if np.abs(K[2] - [0, 0, 1]).max() > 1e-9 or K[1, 0] != 0 or K[0, 0] <= 0 or K[1, 1] <= 0:
        raise DataError.of(where, "intrinsic", expected="[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]", found=K.tolist())
    if K[0, 1] != 0:
        raise DataError.of(where, "intrinsic", expected="no skew", found=f"a skew of {K[0, 1]}")
    pose = _matrix(entry, "extrinsic", ((4, 4), (3, 4)), where)
    pose = np.vstack([pose[:3], [0.0, 0.0, 0.0, 1.0]])
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max()
    if not off <= 1e-3 or np.linalg.det(pose[:3, :3]) < 0:
        found = f"one that is off by {off:.2g}, determinant {np.linalg.det(pose[:3, :3]):.3g}"
        raise DataError.of(where, "extrinsic", expected="a rotation", found=found)
    with parsing(where, "distortion coefficients", damaged="something else"):
        key, coefficients = _distortion(entry, where)
    info = probe_video(subject.video(camera))
    shift = 0.5 - pixel_center
    K[0, 2] += shift
    K[1, 2] += shift
    if not (0 < K[0, 2] < info.width and 0 < K[1, 2] < info.height):
        expected = f"a principal point inside the video's {info.width} x {info.height}"
        raise DataError.of(where, "intrinsic", expected=expected, found=f"({K[0, 2]:.1f}, {K[1, 2]:.1f})")
    report = {"keys": sorted(map(str, entry)), "distortion_key": key, "pixel_center": pixel_center}
    return Camera(camera, info.width, info.height, K, pose, coefficients), report


def read_parameters(subject: DecafSubject) -> dict[str, dict[str, np.ndarray]]:
    """Reads the smoothed model parameters of all frames, in numerical order of their frame keys.

    Returns:
        part -> name as stored -> float32 `[N, size]`.

    Raises:
        DataError: a key that is no frame number, a missing or misshapen field, or a number that is not finite; the
            frame and the field are named.
    """
    path = subject.parameters
    stored = read_pickle(path)
    if not isinstance(stored, Mapping) or not stored:
        raise DataError.of(path, expected="a mapping from frame to parameters", found=type(stored).__name__)
    numbers: dict[int, Any] = {}
    for key, value in stored.items():
        try:
            number = int(key)
        except (TypeError, ValueError, OverflowError):
            raise DataError.of(path, "frame key", expected="a frame number", found=describe(key)) from None
        if number in numbers:
            raise DataError.of(path, f"frame {number}", expected="each frame once", found="it twice")
        numbers[number] = value
    order = sorted(numbers)
    result: dict[str, dict[str, np.ndarray]] = {"head": {}, "right_hand": {}}
    for (part, name), size in _FIXED_SIZES.items():
        rows = [_parameter(numbers[number], part, name, f"{path}: frame {number}") for number in order]
        size = len(rows[0]) if size is None else size
        for number, row in zip(order, rows):
            if len(row) != size:
                raise DataError.of(
                    f"{path}: frame {number}", f"{part}.{name}", expected=f"{size} values", found=len(row)
                )
        with np.errstate(over="ignore"):
            values = np.stack(rows).astype(np.float32)
        bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if len(bad):
            found = "NaN" if np.isnan(values[bad[0]]).any() else "infinity"
            where = f"{path}: frame {order[bad[0]]}"
            raise DataError.of(where, f"{part}.{name}", expected="finite numbers", found=found)
        result[part][name] = values
    return result


def read_keypoints(subject: DecafSubject, part: str, camera: str) -> np.ndarray:
    """Reads landmarks of `head` or `right_hand`, float32 `[N, 68 | 21, 3]`; undetected ones get confidence 0."""
    stored = read_frame_array(subject.keypoints(part, camera), (KEYPOINTS[part], 3))
    with np.errstate(over="ignore"):
        points = stored.astype(np.float32)
    lost = ~np.isfinite(points).all(axis=-1) | (points[..., :2] < 0).all(axis=-1)
    points[lost] = 0.0
    return points


def read_boxes(subject: DecafSubject, part: str, camera: str, width: int, height: int) -> np.ndarray:
    """Reads detection boxes of `head` or `right_hand`, float32 `[N, 4]`.

    A failed detection is stored as -1; such rows, and boxes that are empty or leave the frame, become NaN. They must
    not be taken for the whole frame, which would blow up any crop made from them.
    """
    stored = read_frame_array(subject.boxes(part, camera), (4,))
    with np.errstate(invalid="ignore", over="ignore"):
        boxes = stored.astype(np.float32)
        x0, y0, x1, y1 = boxes.T
        good = (x0 >= 0) & (y0 >= 0) & (x1 <= width) & (y1 <= height) & (x1 > x0) & (y1 > y0)
    boxes[~good] = np.nan
    return boxes


def read_cuts(subject: DecafSubject) -> list[tuple[int, int]]:
    """Reads pairs (last frame before a cut, first frame after it); often there is none."""
    stored = read_pickle(subject.cut_file)
    pairs = stored.tolist() if isinstance(stored, np.ndarray) else stored
    whole = isinstance(pairs, (list, tuple)) and all(isinstance(p, (list, tuple, np.ndarray)) for p in pairs)
    if not whole or not all(len(p) == 2 for p in pairs):
        raise DataError.of(subject.cut_file, expected="a list of pairs of frame numbers", found=describe(stored))
    with parsing(subject.cut_file, "pairs of frame numbers", damaged="something else"):
        return [(int(a), int(b)) for a, b in pairs]


def read_frame_array(path: Path, shape: Sequence[int | None]) -> np.ndarray:
    """Reads an array with one row a frame; `shape` is that of a row, None for any length.

    Raises:
        DataError: missing, not numbers, or of another shape.
    """
    array = read_array(path)
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
        raise DataError.of(path, expected="an array of numbers", found=type(array).__name__)
    expected = "[frames, " + ", ".join("any" if s is None else str(s) for s in shape) + "]"
    if array.ndim != 1 + len(shape) or any(s is not None and s != n for s, n in zip(shape, array.shape[1:])):
        raise DataError.of(path, "shape", expected=expected, found=list(array.shape))
    return array


def frame_counts(subject: DecafSubject, cameras: Sequence[str]) -> dict[Path, int]:
    """Number of frames by the header of every video and array that exists, for the cameras named."""
    counts: dict[Path, int] = {}
    for camera in cameras:
        for path in (subject.video(camera), subject.matte(camera)):
            if path.is_file():
                counts[path] = probe_video(path).count
    arrays = subject.detections(cameras) + [subject.contacts(part) for part in PARTS]
    arrays += [subject.deformations, subject.head_poses]
    for path in arrays:
        if path.is_file():
            counts[path] = _header_rows(path)
    return {path: count for path, count in counts.items() if count > 0}


def check_counts(counts: Mapping[Path, int]) -> int:
    """The number of frames that all files agree on.

    Raises:
        DataError: some disagree with the majority; they are named, the first three with what they have.
    """
    common = Counter(counts.values()).most_common(1)[0][0]
    wrong = {path: count for path, count in counts.items() if count != common}
    if wrong:
        first, *others = list(wrong.items())
        more = "".join(f"; also {path}: {count}" for path, count in others[:2])
        more += f"; and {len(others) - 2} more files" if len(others) > 2 else ""
        agreed = len(counts) - len(wrong)
        expected = f"{common} as {agreed} other file{'s' if agreed > 1 else ''} of this subject"
        raise DataError.of(first[0], "frames", expected=expected, found=f"{first[1]}{more}")
    return common


def _header_rows(path: Path) -> int:
    with parsing(path, "a numpy .npy file"), open(path, "rb") as stream:
        shape, _, _ = read_array_header(stream)
    return int(shape[0]) if shape else 0


def _camera_id(key: Any) -> str:
    if isinstance(key, bytes):
        key = key.decode("latin1")
    return f"{int(key):03d}" if isinstance(key, (int, np.integer)) else str(key)


def _matrix(entry: Mapping[Any, Any], name: str, shapes: Sequence[tuple[int, int]], where: str) -> np.ndarray:
    wanted = " or ".join(f"{rows} x {columns}" for rows, columns in shapes)
    if name not in entry:
        raise DataError.of(where, name, expected=f"a {wanted} matrix", found=f"only {', '.join(map(str, entry))}")
    try:
        matrix = np.array(as_numbers(entry[name]), dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise DataError.of(where, name, expected=f"a {wanted} matrix", found=describe(entry[name])) from None
    if matrix.shape not in shapes or not np.isfinite(matrix).all():
        found = list(matrix.shape) if matrix.shape not in shapes else "one with NaN or infinity"
        raise DataError.of(where, name, expected=f"a finite {wanted} matrix", found=found)
    return matrix


def _distortion(entry: Mapping[Any, Any], where: str) -> tuple[str | None, np.ndarray | None]:
    named = [key for key in _DISTORTION_KEYS if key in entry]
    named += [key for key in entry if key not in named and "dist" in str(key).lower()]
    for key in named:
        if entry[key] is not None and as_numbers(entry[key]).size:
            return str(key), checked_coefficients(as_numbers(entry[key]), f"{where}: {key}")
    return None, None


def _parameter(frame: Any, part: str, name: str, where: str) -> np.ndarray:
    if not isinstance(frame, Mapping) or not isinstance(frame.get(part), Mapping) or name not in frame[part]:
        raise DataError.of(where, f"{part}.{name}", expected="a vector", found="none")
    try:
        return np.asarray(as_numbers(frame[part][name]), dtype=np.float64).reshape(-1)
    except (TypeError, ValueError, OverflowError):
        raise DataError.of(where, f"{part}.{name}", expected="a vector of numbers", found="something else") from None
