"""Captures of one's own: the second input layout (bring your own data).

    cameras.json                       camera -> width, height, K, R, t (world-to-camera, OpenCV) [, distortion]
    images/<camera>/<frame>.<type>     jpg, png or webp
    masks/<camera>/<frame>.png         0 background, 1 head, 2 right hand, 3 left hand, 255 unknown;
                                       or a matte of the whole person
    alpha/<camera>/<frame>.png         optional coverage
    meshes/topology.npz                head_faces, right_hand_faces, left_hand_faces: any subset [, <part>_rest]
    meshes/<frame>.npz                 head, right_hand, left_hand [m]; optional head_rigid, the head without contact
    splits.json                        frames [, train, test, cuts, test_camera] [, contact: frame -> true or false, for
                                       people only]

Lengths are metres, world axes any, pixel centres at +0.5. Every reader raises `DataError` with one line.
"""

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nbavatar.camera.distortion import checked_coefficients
from nbavatar.camera.pinhole import Camera
from nbavatar.config.cameras import parse_camera, read_rig
from nbavatar.data.pictures import find_picture
from nbavatar.data.sequences import PARTS
from nbavatar.data.splits import segments_of
from nbavatar.errors import DataError, describe, did_you_mean
from nbavatar.io.arrays import read_arrays
from nbavatar.io.pictures import read_colours
from nbavatar.io.records import read_json
from nbavatar.names import check_apart, check_name

__all__ = [
    "Capture",
    "Splits",
    "camera_of",
    "open_capture",
    "read_mesh",
    "read_rgb",
    "read_splits",
    "read_topology",
    "recentred",
]

_FAR = 10_000.0  # [m]
_COARSE = 2e-4  # [m]
_SPLITS = ("frames", "train", "test", "cuts", "test_camera", "contact")
_LIKE_SPLITS = {
    **dict.fromkeys(("val", "valid", "validation", "eval", "evaluation", "testing", "held_out", "holdout"), "test"),
    **dict.fromkeys(("training", "train_frames"), "train"),
    **dict.fromkeys(("ids", "frame_ids", "images", "timesteps", "all"), "frames"),
    **dict.fromkeys(("segments", "shots", "scenes", "breaks"), "cuts (pairs: the last frame before, the first after)"),
    **dict.fromkeys(("val_camera", "held_out_camera", "test_cameras"), "test_camera"),
}


@dataclasses.dataclass(frozen=True)
class Capture:
    """A capture whose cameras are known.

    Attributes:
        root: its folder.
        cameras: calibrated cameras by name.
        origin: where the origin of their world lies in the world of the files [m], float64 `[3]`: zero, unless that one
            is far away.
    """

    root: Path
    cameras: dict[str, Camera]
    origin: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))

    def camera(self, name: str) -> Camera:
        """The camera of this name, or one line that lists those there are."""
        if name not in self.cameras:
            raise DataError(f"{self.root / 'cameras.json'}: no camera '{name}'; {did_you_mean(name, self.cameras)}")
        return self.cameras[name]


@dataclasses.dataclass(frozen=True)
class Splits:
    """Frames in time order, the user's split if there is one, and uncut runs.

    Attributes:
        frames: ids.
        test: ids held out; empty where the user leaves the choice to us.
        segments: first and last position in `frames` of each uncut run, inclusive.
    """

    frames: list[str]
    test: list[str]
    segments: list[tuple[int, int]]


def open_capture(root: str | Path, *, pixel_center: float = 0.5) -> Capture:
    """Reads `cameras.json`; a world whose origin is far from the cameras is recentred.

    Args:
        root: folder of the capture.
        pixel_center: where the stored matrices put the centre of pixel (0, 0) [px]; the result has it at 0.5.
    """
    root = Path(root)
    path = root / "cameras.json"
    return recentred(root, {name: camera_of(name, entry, path, pixel_center) for name, entry in read_rig(path).items()})


def recentred(root: Path, cameras: Mapping[str, Camera]) -> Capture:
    """A capture whose world begins near its cameras.

    float32 keeps a tenth of a millimetre up to a kilometre only, and geodetic coordinates are millions of metres. So a
    world whose cameras are on average farther than 10 km from its origin is moved by whole metres, in float64. (Not a
    nearer one: that would be millimetres taken for metres.)
    """
    poses = [camera.cam_from_world for camera in cameras.values()]
    # Solved, not multiplied by the transpose: a rotation of few digits is not orthogonal enough over such distances.
    centres = [-np.linalg.solve(pose[:3, :3], pose[:3, 3]) for pose in poses]
    origin = np.round(np.mean(centres, axis=0)) if centres else np.zeros(3)
    if np.linalg.norm(origin) <= _FAR:
        return Capture(root, dict(cameras))
    moved = {}
    for name, camera in cameras.items():
        pose = camera.cam_from_world.copy()
        pose[:3, 3] += pose[:3, :3] @ origin
        moved[name] = dataclasses.replace(camera, cam_from_world=pose)
    return Capture(root, moved, origin)


def read_splits(root: Path) -> Splits:
    """Reads `splits.json`; a `train` list leaves out frames that are in neither list.

    Cuts are between frames of the whole list, whether they are used or not.

    Raises:
        DataError: damaged, an unknown key, ids that repeat or are not in `frames`, or cuts that are out of order.
    """
    path = root / "splits.json"
    stored = read_json(path)
    if not isinstance(stored, Mapping):
        raise DataError.of(path, expected="a mapping with frames", found=type(stored).__name__)
    for key in stored:
        if key not in _SPLITS:
            meant = _LIKE_SPLITS.get(str(key).lower())
            hint = f"did you mean {meant}?" if meant else did_you_mean(str(key), _SPLITS)
            raise DataError(f"{path}: unknown key '{key}'; {hint}")
    frames = _ids(stored, "frames", path)
    if "topology" in frames:  # meshes/topology.npz is none of a frame
        raise DataError.of(path, "frames", expected="other names than 'topology'", found="it", fix="rename the frame")
    if not frames:
        raise DataError.of(path, "frames", expected="at least one frame id", found="none")
    train, test = _ids(stored, "train", path), _ids(stored, "test", path)
    for name, ids in (("train", train), ("test", test)):
        unknown = sorted(set(ids) - set(frames))
        if unknown:
            raise DataError.of(path, name, expected="ids that are in frames", found=f"'{unknown[0]}', which is not")
    both = sorted(set(train) & set(test))
    if both:
        raise DataError.of(
            path, "test", expected="frames that are not in train", found=f"'{both[0]}', which is in both"
        )
    runs = segments_of(frames, _cuts(stored, frames, path), str(path))
    chosen = {*train, *test}
    used = [not train or frame in chosen for frame in frames]
    if set(test) >= {frame for frame, there in zip(frames, used) if there}:
        raise DataError.of(path, "train", expected="a frame to train on at least", found="all frames in test")
    place = np.concatenate([[0], np.cumsum(used)])
    kept = [(int(place[first]), int(place[last + 1]) - 1) for first, last in runs]
    return Splits(
        [frame for frame, there in zip(frames, used) if there], test, [run for run in kept if run[0] <= run[1]]
    )


def _cuts(stored: Mapping[str, Any], frames: Sequence[str], path: Path) -> list[tuple[str, str]]:
    cuts = stored.get("cuts", [])
    if not isinstance(cuts, list) or not all(isinstance(c, list) and len(c) == 2 for c in cuts):
        raise DataError.of(path, "cuts", expected="pairs of frame ids", found=describe(cuts))
    pairs, known = [(str(a), str(b)) for a, b in cuts], set(frames)
    for frame in (frame for pair in pairs for frame in pair):
        if frame not in known:
            raise DataError.of(
                path, "cuts", expected="pairs of ids that are in frames", found=f"'{frame}', which is not"
            )
    return pairs


def read_rgb(capture: Capture, camera: Camera, frame: str) -> np.ndarray:
    """Reads one image, uint8 `[H, W, 3]`, of exactly the camera's size."""
    folder = capture.root / "images" / camera.name
    path = find_picture(folder, frame)
    if path is None:
        raise DataError.of(folder / f"{frame}.jpg", expected="an image (jpg, png or webp)", found="none")
    return read_colours(path, (camera.width, camera.height))


def read_topology(root: Path) -> dict[str, tuple[np.ndarray, np.ndarray | None]]:
    """Reads faces int64 `[F, 3]` and, where stored, rest vertices float32 `[V, 3]` [m] of each part."""
    path = root / "meshes" / "topology.npz"
    arrays, _ = read_arrays(path)
    parts: dict[str, tuple[np.ndarray, np.ndarray | None]] = {}
    for part in PARTS:
        if f"{part}_faces" not in arrays:
            continue
        faces, rest = arrays[f"{part}_faces"], arrays.get(f"{part}_rest")
        if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu" or not len(faces):
            raise DataError.of(path, f"{part}_faces", expected="whole numbers [F, 3]", found=_kind(faces))
        if faces.min() < 0:
            raise DataError.of(path, f"{part}_faces", expected="vertex ids from 0", found=int(faces.min()))
        if rest is not None:
            _check_vertices(rest, faces, path, f"{part}_rest", None)
            rest = _near(rest, _far_from_origin(rest), path, f"{part}_rest")
        parts[part] = (faces.astype(np.int64), rest)
    if not parts:
        names = ", ".join(f"{part}_faces" for part in PARTS)
        raise DataError.of(path, expected=f"at least one of {names}", found=f"only {', '.join(arrays) or 'nothing'}")
    return parts


def read_mesh(
    capture: Capture, frame: str, topology: Mapping[str, tuple[np.ndarray, np.ndarray | None]]
) -> dict[str, np.ndarray]:
    """Reads one frame's vertices, float32 `[V, 3]` [m], of every part (and `head_rigid` where stored).

    They are in the world of the capture's cameras. A part that the file does not have is not in that frame, and not in
    the result; one part at least has to be.
    """
    path = capture.root / "meshes" / f"{frame}.npz"
    arrays, _ = read_arrays(path)
    if not set(topology) & set(arrays):
        found = f"only {', '.join(arrays)}" if arrays else "nothing"
        raise DataError.of(path, expected=f"vertices of {' or '.join(topology)}", found=found)
    result = {}
    for name in (*topology, "head_rigid"):
        if name in arrays and (name != "head_rigid" or "head" in topology):
            faces, rest = topology["head" if name == "head_rigid" else name]
            _check_vertices(arrays[name], faces, path, name, None if rest is None else len(rest))
            result[name] = _near(arrays[name], capture.origin, path, name)
    if "head_rigid" in result and "head" not in result:
        raise DataError.of(path, "head_rigid", expected="head beside it", found="head_rigid alone")
    if "head_rigid" in result and result["head_rigid"].shape != result["head"].shape:
        expected, found = f"{len(result['head'])} vertices as in head", len(result["head_rigid"])
        raise DataError.of(path, "head_rigid", expected=expected, found=found)
    return result


def camera_of(name: str, entry: Any, path: Path, pixel_center: float = 0.5) -> Camera:
    """The camera of one entry of `cameras.json`; `path` is named in errors, see `config.cameras.parse_camera`."""
    stored, where = parse_camera(name, entry, path), f"{path}: camera {name}"
    K, pose = np.array(stored.K), np.eye(4)
    K[:2, 2] += 0.5 - pixel_center
    if not (0 < K[0, 2] < stored.width and 0 < K[1, 2] < stored.height):
        expected = f"a principal point inside {stored.width} x {stored.height}"
        raise DataError.of(where, "K", expected=expected, found=f"({K[0, 2]:.1f}, {K[1, 2]:.1f})")
    pose[:3, :3], pose[:3, 3] = stored.R, stored.t
    lens = None if stored.distortion is None else checked_coefficients(stored.distortion, f"{where}: distortion")
    return Camera(name, stored.width, stored.height, K, pose, lens)


def _ids(stored: Mapping[str, Any], key: str, path: Path) -> list[str]:
    values = stored.get(key, [])
    if not isinstance(values, list) or not all(isinstance(v, (str, int)) for v in values):
        raise DataError.of(path, key, expected="a list of frame ids", found=repr(values)[:60])
    ids = [str(v) for v in values]
    if len(set(ids)) != len(ids):
        twice = next(v for v, count in Counter(ids).items() if count > 1)
        raise DataError.of(path, key, expected="each frame once", found=f"'{twice}' twice")
    check_apart(ids, path, key, error=DataError)
    return [check_name(frame, path, key, error=DataError) for frame in ids]


def _check_vertices(verts: np.ndarray, faces: np.ndarray, path: Path, name: str, count: int | None) -> None:
    if verts.ndim != 2 or verts.shape[1] != 3 or verts.dtype.kind not in "fiu":
        raise DataError.of(path, name, expected="numbers [V, 3]", found=_kind(verts))
    if count is not None and len(verts) != count:
        raise DataError.of(path, name, expected=f"{count} vertices as in topology.npz", found=len(verts))
    if faces.max() >= len(verts):
        expected = f"more than {int(faces.max())} vertices, as the faces of topology.npz need"
        fix = "faces count from 0" if faces.min() == 1 else ""
        raise DataError.of(path, name, expected=expected, found=len(verts), fix=fix)
    if not np.isfinite(verts).all():
        bad = int(np.flatnonzero(~np.isfinite(verts).all(axis=1))[0])
        raise DataError.of(path, name, expected="finite coordinates", found=f"NaN or infinity at vertex {bad}")


def _far_from_origin(verts: np.ndarray) -> np.ndarray:
    """What moves vertices near the origin, in whole metres; zero where they are."""
    centre = np.round(np.asarray(verts, np.float64).mean(axis=0))
    return centre if np.linalg.norm(centre) > _FAR else np.zeros(3)


def _near(verts: np.ndarray, origin: np.ndarray, path: Path, name: str) -> np.ndarray:
    """Vertices float32 `[V, 3]` seen from an origin."""
    moved = verts.astype(np.float64)
    moved -= origin
    step = float(np.spacing(np.float32(max(moved.max(), -moved.min()))))
    if verts.dtype == np.float32:
        step = max(step, float(np.spacing(np.abs(verts).max())))
    if step > _COARSE:
        fix = "are lengths metres? move the world's origin to the cameras, before anything is rounded to float32"
        found = f"a world so far from its origin that float32 rounds to {step:.2g} m"
        raise DataError.of(path, name, expected="vertices near the origin", found=found, fix=fix)
    return moved.astype(np.float32)


def _kind(array: np.ndarray) -> str:
    return f"{array.dtype} {list(array.shape)}"
