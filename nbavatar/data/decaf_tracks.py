"""Decaf parameters to posed meshes and everything later stages want to know beside them.

Heads are posed RIGIDLY here, that is without the dent of the hand; the release's own dents are kept as reference,
already turned into world axes and sign, so that `head_with_contact = head + deformation.head`. Extras of the result,
besides those of `sequences`:

    param.<part>.<name>            float32 [N, size]     parameters under this package's names
    keypoints.<part>.<camera>      float32 [N, L, 3]     x, y [px, distorted full frame], confidence
    boxes.<part>.<camera>          float32 [N, 4]        x0 y0 x1 y1 [px, distorted full frame], NaN = not detected
    contact.<part>                 bool    [N, V]        the release's contact labels
    deformation.head               float32 [N, V, 3] [m] the release's dents, world axes, to be added
    camera.<camera>.<K | cam_from_world | distortion | size>
    split, segments                `train` or `test` [N]; first and last position of each uncut run [R, 2]
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nbavatar.camera.pinhole import Camera
from nbavatar.data.decaf import (
    KEYPOINTS,
    read_boxes,
    read_frame_array,
    read_keypoints,
    read_parameters,
)
from nbavatar.data.decaf_files import PARTS, DecafSubject
from nbavatar.data.sequences import MeshSequence, Part
from nbavatar.errors import DataError, parsing
from nbavatar.io.arrays import as_numbers
from nbavatar.io.pickles import read_array, read_pickle

__all__ = ["build_tracks", "frame_id"]

_PARAM_NAMES = {
    "head": {"shape_params": "shape", "expression_params": "expression", "global_orient": "global_orient",
             "transl": "transl"},
    "right_hand": {"betas": "betas", "global_orient": "global_orient", "hand_pose": "hand_pose", "transl": "transl"},
}  # fmt: skip
_BATCH = 64


def frame_id(number: int) -> str:
    """Frame id of a video frame, counted from 0: six digits, so that text order is time order."""
    return f"{number:06d}"


def build_tracks(
    subject: DecafSubject,
    cameras: Mapping[str, Camera],
    frames: Sequence[int],
    count: int,
    *,
    shape_tolerance: float,
    rotation_tolerance: float,
) -> tuple[MeshSequence, dict[str, Any]]:
    """Poses head and hand for the chosen frames and collects the extras (without `split` and `segments`).

    Args:
        subject: whose.
        cameras: the cameras whose keypoints and boxes are wanted.
        frames: numbers of the chosen frames, increasing.
        count: number of frames of the videos; the parameters must have as many.
        shape_tolerance: largest deviation of a frame's shape from the subject's own [1].
        rotation_tolerance: largest element-wise deviation of the stored head poses' rotations from `global_orient` [1].

    Returns:
        the sequence, and a report for the record: what was checked and found, and which files were absent.

    Raises:
        DataError: anything missing, misshapen, not finite, or in disagreement with something else.
    """
    import torch

    from nbavatar.bodymodels.files import read_flame, read_mano
    from nbavatar.bodymodels.flame import Flame, jaw_of_pose_params
    from nbavatar.bodymodels.mano import Mano

    parameter_file = subject.parameters
    parameters = read_parameters(subject)
    found = len(parameters["head"]["transl"])
    if found != count:
        raise DataError.of(parameter_file, "frames", expected=f"{count} as in the videos and arrays", found=found)
    own, report = _own_shape(subject, parameters, shape_tolerance)
    report["pose_params_root_max_rad"] = float(np.abs(parameters["head"]["pose_params"][:, :3]).max())
    absent: list[str] = []
    report["head_pose_rotation_error"] = _check_head_poses(subject, parameters, count, rotation_tolerance, absent)
    chosen = {part: {name: values[frames] for name, values in of.items()} for part, of in parameters.items()}

    head, hand = chosen["head"], chosen["right_hand"]
    flame_file, mano_file = subject.assets.flame, subject.assets.mano()
    flame = Flame.build(
        read_flame(flame_file),
        shape_count=head["shape_params"].shape[1],
        expression_count=head["expression_params"].shape[1],
    )
    mano = Mano.build(read_mano(mano_file))
    betas = mano.mesh.shape_dirs.shape[-1]
    if hand["betas"].shape[1] != betas:
        width = hand["betas"].shape[1]
        raise DataError.of(parameter_file, "right_hand.betas", expected=f"{betas} as in {mano_file}", found=width)

    def tensor(values: np.ndarray) -> "torch.Tensor":
        return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))

    head_verts, hand_verts = [], []
    with torch.inference_mode():
        for first in range(0, len(frames), _BATCH):
            h = {name: tensor(values[first : first + _BATCH]) for name, values in head.items()}
            r = {name: tensor(values[first : first + _BATCH]) for name, values in hand.items()}
            jaw = jaw_of_pose_params(h["pose_params"])
            posed = flame.forward_decaf(
                h["shape_params"], h["expression_params"], jaw, h["global_orient"], h["transl"]
            )  # fmt: skip
            head_verts.append(posed.numpy())
            hand_verts.append(mano.forward(r["betas"], r["hand_pose"], r["global_orient"], r["transl"]).verts.numpy())
        zero_expression = torch.zeros(1, head["expression_params"].shape[1])
        head_rest = flame.forward(tensor(own["head"])[None], zero_expression, torch.zeros(1, 3)).verts[0].numpy()
        hand_rest = (
            mano.forward(tensor(own["right_hand"])[None], torch.zeros(1, 45), torch.zeros(1, 3)).verts[0].numpy()
        )
    parts = {
        "head": Part(flame.faces, head_rest, np.concatenate(head_verts)),
        "right_hand": Part(mano.faces, hand_rest, np.concatenate(hand_verts)),
    }
    extras: dict[str, np.ndarray] = {"param.head.jaw": head["pose_params"][:, 3:6]}
    for part, names in _PARAM_NAMES.items():
        extras |= {f"param.{part}.{ours}": chosen[part][theirs] for theirs, ours in names.items()}
    extras |= _detections(subject, cameras, frames, count)
    extras |= _contacts(subject, parts, head["global_orient"], frames, count, absent)
    for name, camera in cameras.items():
        extras[f"camera.{name}.K"] = camera.K
        extras[f"camera.{name}.cam_from_world"] = camera.cam_from_world
        extras[f"camera.{name}.distortion"] = np.zeros(12) if camera.distortion is None else camera.distortion
        extras[f"camera.{name}.size"] = np.array([camera.width, camera.height])
    report["absent"] = absent
    return MeshSequence([frame_id(number) for number in frames], parts, extras), report


def _own_shape(
    subject: DecafSubject, parameters: Mapping[str, Mapping[str, np.ndarray]], tolerance: float
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The subject's shape, from `accurate_shapes` or else the median over frames; all frames must agree with it."""
    path = subject.own_shape
    stored = read_pickle(path) if path.is_file() else None
    shapes: dict[str, np.ndarray] = {}
    report: dict[str, Any] = {"shape_source": "accurate_shapes" if stored is not None else "median over frames"}
    for part, name in (("head", "shape_params"), ("right_hand", "betas")):
        frames = parameters[part][name]
        shape = np.median(frames, axis=0)
        if stored is not None:
            try:
                shape = np.asarray(as_numbers(stored[part][name]), dtype=np.float32).reshape(-1)
            except (KeyError, TypeError, ValueError):
                raise DataError.of(path, f"{part}.{name}", expected="a vector", found="none") from None
            if shape.shape != frames.shape[1:] or not np.isfinite(shape).all():
                expected = f"{frames.shape[1]} finite values as in the frames' parameters"
                raise DataError.of(path, f"{part}.{name}", expected=expected, found=f"{len(shape)} values")
        off = np.abs(frames - shape).max(axis=1)
        worst = int(off.argmax())
        report[f"shape_deviation.{part}"] = float(off[worst])
        if off[worst] > tolerance:
            where = f"{subject.parameters}: frame {worst}"
            expected = f"the subject's own shape ({path if stored is not None else 'the median over frames'})"
            fix = "if that is meant, raise shape_tolerance of the tracks stage"
            found = f"a deviation of {off[worst]:.3g}, more than {tolerance:g}"
            raise DataError.of(where, f"{part}.{name}", expected=expected, found=found, fix=fix)
        shapes[part] = shape.astype(np.float32)
    return shapes, report


def _check_head_poses(
    subject: DecafSubject,
    parameters: Mapping[str, Mapping[str, np.ndarray]],
    count: int,
    tolerance: float,
    absent: list[str],
) -> float | None:
    """Largest difference between stored head rotations and those of `global_orient`, over all frames."""
    import torch

    from nbavatar.math.rotations import axis_angle_to_matrix

    path = subject.head_poses
    if not path.is_file():
        absent.append(str(path.relative_to(subject.root)))
        return None
    stored = _rows(read_frame_array(path, (4, 4)), path, count)
    rotation = axis_angle_to_matrix(torch.from_numpy(parameters["head"]["global_orient"].astype(np.float64))).numpy()
    off = np.abs(stored[:, :3, :3] - rotation).max(axis=(1, 2))
    worst = int(np.nan_to_num(off, nan=np.inf).argmax())
    if not off[worst] <= tolerance:
        expected = "the rotation of head.global_orient in params_smoothed.pkl"
        fix = "parameters and head poses belong to different frames or subjects"
        raise DataError.of(
            f"{path}: frame {worst}", expected=expected, found=f"a difference of {off[worst]:.3g}", fix=fix
        )
    return float(off[worst])


def _detections(
    subject: DecafSubject, cameras: Mapping[str, Camera], frames: Sequence[int], count: int
) -> dict[str, np.ndarray]:
    result = {}
    for part in KEYPOINTS:
        for name, camera in cameras.items():
            keys, boxes = (
                read_keypoints(subject, part, name),
                read_boxes(subject, part, name, camera.width, camera.height),
            )
            result[f"keypoints.{part}.{name}"] = _rows(keys, subject.keypoints(part, name), count)[frames]
            result[f"boxes.{part}.{name}"] = _rows(boxes, subject.boxes(part, name), count)[frames]
    return result


def _contacts(
    subject: DecafSubject,
    parts: Mapping[str, Part],
    global_orient: np.ndarray,
    frames: Sequence[int],
    count: int,
    absent: list[str],
) -> dict[str, np.ndarray]:
    """Contact labels and dents of the chosen frames; files that are not there are noted, not missed."""
    import torch

    from nbavatar.math.rotations import axis_angle_to_matrix

    result: dict[str, np.ndarray] = {}
    vertices = {name: len(part.rest) for name, part in parts.items()}
    for part in PARTS:
        path = subject.contacts(part)
        if not path.is_file():
            absent.append(str(path.relative_to(subject.root)))
            continue
        labels = _rows(read_frame_array(path, (vertices[part],)), path, count)[frames] != 0
        if part == "head":
            labels[:, _vertex_ids(subject.assets.neck_of_contacts, vertices[part])] = False
        result[f"contact.{part}"] = labels
    path = subject.deformations
    if not path.is_file():
        absent.append(str(path.relative_to(subject.root)))
        return result
    dents = _rows(read_frame_array(path, (vertices["head"], 3)), path, count)[frames].astype(np.float32)
    bad = np.flatnonzero(~np.isfinite(dents).all(axis=(1, 2)))
    if len(bad):
        raise DataError.of(f"{path}: frame {frames[bad[0]]}", expected="finite numbers", found="NaN or infinity")
    dents[:, _vertex_ids(subject.assets.neck_of_dents, vertices["head"])] = 0.0
    rotation = axis_angle_to_matrix(torch.from_numpy(global_orient.astype(np.float64))).numpy().astype(np.float32)
    result["deformation.head"] = -np.einsum("nij,nvj->nvi", rotation, dents)
    return result


def _vertex_ids(path: Path, vertices: int) -> np.ndarray:
    with parsing(path, "vertex ids"):
        ids = as_numbers(read_array(path)).reshape(-1)
    if ids.dtype.kind not in "iuf" or (len(ids) and (ids.min() < 0 or ids.max() >= vertices)):
        found = f"{ids.min()} to {ids.max()}" if ids.dtype.kind in "iuf" else str(ids.dtype)
        raise DataError.of(path, expected=f"vertex ids from 0 to {vertices - 1}", found=found)
    return ids.astype(np.int64)


def _rows(array: np.ndarray, path: Any, count: int) -> np.ndarray:
    if len(array) != count:
        raise DataError.of(path, "frames", expected=f"{count} as in the other files of this subject", found=len(array))
    return array
