"""Contents of the official model files as plain arrays.

FLAME 2020 and 2023 (`generic_model.pkl`, `flame2023.pkl`) and MANO 1.2 (`MANO_RIGHT.pkl`, `MANO_LEFT.pkl`) are
pickled dictionaries with the keys of SMPL (Loper et al. 2015). All counts come from the file; arrays that
disagree with each other are refused with one line.

    v_template    [V, 3] [m]        f              [F, 3] vertex ids, from 0
    shapedirs     [V, 3, S] [m]     posedirs       [V, 3, 9 (J - 1)] [m]
    J_regressor   [J, V] sparse     kintree_table  [2, J] row 0: parents (2^32 - 1 at the root)
    weights       [V, J]            hands_mean [45], hands_components [45, 45], hands_coeffs [n, 45]: MANO only

The landmark file (`landmark_embedding.npy`) is a dictionary: triangle ids and barycentric coordinates of 51
static landmarks, of 17 contour landmarks for each of 79 yaw angles, and of one fixed set of 68.
"""

import dataclasses
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from nbavatar.errors import DataError
from nbavatar.io.arrays import as_numbers
from nbavatar.io.pickles import read_array, read_pickle

__all__ = [
    "MANO_TIP_VERTICES",
    "LandmarkArrays",
    "ModelArrays",
    "landmark_arrays",
    "model_arrays",
    "read_flame",
    "read_landmarks",
    "read_mano",
]

MANO_TIP_VERTICES = (744, 320, 443, 554, 671)
"""Vertices at the tips of thumb, index, middle, ring and little finger of the 778-vertex hand."""

_FLAME_JOINTS, _MANO_JOINTS = 5, 16


@dataclasses.dataclass(frozen=True)
class ModelArrays:
    """Arrays of one model file, float64; see the module for their meaning."""

    name: str
    template: np.ndarray
    faces: np.ndarray
    shape_dirs: np.ndarray
    pose_dirs: np.ndarray
    joint_regressor: np.ndarray
    parents: tuple[int, ...]
    weights: np.ndarray
    hand_mean: np.ndarray | None = None
    hand_components: np.ndarray | None = None
    hand_coefficients: np.ndarray | None = None
    tip_vertices: tuple[int, ...] | None = None


@dataclasses.dataclass(frozen=True)
class LandmarkArrays:
    """Where the landmarks lie on the mesh: triangle ids int64 `[..., L]`, barycentric float64 `[..., L, 3]`.

    Attributes:
        full_faces, full_weights: the fixed set of 68 (17 contour, then 51), `[68]`, `[68, 3]`.
        static_faces, static_weights: the 51 inner landmarks.
        contour_faces, contour_weights: 17 contour landmarks for each yaw step, `[79, 17]`, `[79, 17, 3]`, or None.
    """

    full_faces: np.ndarray
    full_weights: np.ndarray
    static_faces: np.ndarray
    static_weights: np.ndarray
    contour_faces: np.ndarray | None = None
    contour_weights: np.ndarray | None = None


def read_flame(path: str | os.PathLike[str]) -> ModelArrays:
    """Reads a FLAME file.

    Raises:
        DataError: unreadable, not a FLAME model, or arrays that disagree.
    """
    arrays = model_arrays(read_pickle(os.fspath(path)), str(path))
    if len(arrays.parents) != _FLAME_JOINTS:
        raise DataError.of(
            path, "kintree_table", expected="the 5 joints of FLAME", found=f"{len(arrays.parents)} joints",
            fix="give a FLAME 2020 or 2023 model file",
        )  # fmt: skip
    return arrays


def read_mano(path: str | os.PathLike[str]) -> ModelArrays:
    """Reads a MANO file, right or left.

    Raises:
        DataError: unreadable, not a MANO model, arrays that disagree, or fingertips unknown.
    """
    arrays = model_arrays(read_pickle(os.fspath(path)), str(path))
    if len(arrays.parents) != _MANO_JOINTS:
        raise DataError.of(
            path, "kintree_table", expected="the 16 joints of MANO", found=f"{len(arrays.parents)} joints",
            fix="give MANO_RIGHT.pkl or MANO_LEFT.pkl of MANO 1.2",
        )  # fmt: skip
    if arrays.tip_vertices is None:
        raise DataError.of(
            path, "tip_vertices", expected="five vertex ids for a mesh that has not 778 vertices",
            found=f"none, with {len(arrays.template)} vertices", fix="add the key 'tip_vertices' to the model file",
        )  # fmt: skip
    return arrays


def read_landmarks(path: str | os.PathLike[str], face_count: int) -> LandmarkArrays:
    """Reads `landmark_embedding.npy` for a mesh of `face_count` triangles.

    Raises:
        DataError: unreadable, keys missing, or ids outside the mesh.
    """
    return landmark_arrays(read_array(os.fspath(path)), face_count, str(path))


def model_arrays(content: Any, where: str) -> ModelArrays:
    """Checks the dictionary of a model file and returns its arrays.

    Args:
        content: what the pickle held.
        where: file name for error lines.

    Raises:
        DataError: a key is missing, an array has the wrong shape, holds NaN, or an index is out of range.
    """
    if not isinstance(content, Mapping):
        raise DataError.of(where, expected="a dictionary of arrays", found=type(content).__name__)
    template = _array(content, "v_template", where, (None, 3))
    count = len(template)
    tree = _integers(content, "kintree_table", where, (2, None))
    joints = tree.shape[1]
    faces = _integers(content, "f", where, (None, 3))
    _in_range(faces, count, where, "f", "vertex ids")
    shape_dirs = _array(content, "shapedirs", where, (count, 3, None))
    pose_dirs = _array(content, "posedirs", where, (count, 3, 9 * (joints - 1)))
    regressor = _array(content, "J_regressor", where, (joints, count))
    weights = _array(content, "weights", where, (count, joints))
    if not np.allclose(weights.sum(1), 1, atol=1e-3):
        worst = float(np.abs(weights.sum(1) - 1).max())
        raise DataError.of(where, "weights", expected="rows that sum to 1", found=f"a row off by {worst:.3g}")
    tips = _tips(content, count, where)
    hand = [
        _array(content, key, where, shape) if key in content else None
        for key, shape in (("hands_mean", (45,)), ("hands_components", (None, 45)), ("hands_coeffs", (None, None)))
    ]
    return ModelArrays(
        where, template, faces, shape_dirs, pose_dirs, regressor, _parents(tree, where), weights, *hand, tips
    )


def landmark_arrays(content: Any, face_count: int, where: str) -> LandmarkArrays:
    """Checks the dictionary of a landmark file and returns its arrays.

    Files without the fixed set of 68 get it from the contour at yaw 0 followed by the static landmarks.

    Raises:
        DataError: a key is missing, an array has the wrong shape, or a triangle id is outside the mesh.
    """
    if not isinstance(content, Mapping):
        raise DataError.of(where, expected="a dictionary of arrays", found=type(content).__name__)

    def pair(name: str, lead: tuple[int | None, ...]) -> tuple[np.ndarray, np.ndarray]:
        key = f"{name}_lmk_faces_idx"
        raw = _numbers(content[key], where, key) if key in content else None
        squeeze = raw is not None and raw.ndim == len(lead) + 1 and raw.shape[0] == 1
        outer: tuple[int | None, ...] = (1, *lead) if squeeze else lead
        faces = _integers(content, f"{name}_lmk_faces_idx", where, outer)
        weights = _array(content, f"{name}_lmk_bary_coords", where, (*faces.shape, 3))
        _in_range(faces, face_count, where, f"{name}_lmk_faces_idx", "triangle ids")
        return (faces[0], weights[0]) if squeeze else (faces, weights)

    static = pair("static", (51,))
    contour = pair("dynamic", (None, 17)) if "dynamic_lmk_faces_idx" in content else None
    if "full_lmk_faces_idx" in content:
        full = pair("full", (68,))
    elif contour is not None:
        full = (np.concatenate([contour[0][0], static[0]]), np.concatenate([contour[1][0], static[1]]))
    else:
        raise DataError.of(where, "full_lmk_faces_idx", expected="this array, or the dynamic contour", found="neither")
    return LandmarkArrays(*full, *static, *(contour or (None, None)))


def _array(content: Mapping[str, Any], key: str, where: str, shape: tuple[int | None, ...]) -> np.ndarray:
    if key not in content:
        raise DataError.of(where, key, expected="an array of this name", found="none")
    value = content[key]
    if hasattr(value, "toarray"):
        # The shape is checked first: a sparse matrix may claim any size.
        if None in shape:
            raise DataError.of(where, key, expected="an array", found="a sparse matrix")
        _check_shape(tuple(value.shape), shape, where, key)
        value = value.toarray()
    array = _numbers(value, where, key)
    _check_shape(array.shape, shape, where, key)
    if not np.isfinite(array).all():
        raise DataError.of(
            where, key, expected="finite numbers", found=f"{int((~np.isfinite(array)).sum())} NaN or infinite"
        )
    return array


def _numbers(value: Any, where: str, key: str) -> np.ndarray:
    try:
        return np.array(as_numbers(value), dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise DataError.of(where, key, expected="an array of numbers", found=type(value).__name__) from None


def _integers(content: Mapping[str, Any], key: str, where: str, shape: tuple[int | None, ...]) -> np.ndarray:
    array = _array(content, key, where, shape)
    if not (array == np.round(array)).all():
        raise DataError.of(where, key, expected="whole numbers", found="fractions")
    return array.astype(np.int64)


def _check_shape(found: tuple[int, ...], expected: tuple[int | None, ...], where: str, key: str) -> None:
    fits = len(found) == len(expected) and all(e is None or e == n for n, e in zip(found, expected, strict=True))
    if not fits or 0 in found:
        wanted = "[" + ", ".join("any" if e is None else str(e) for e in expected) + "]"
        fix = "the file disagrees with itself or is another model; obtain the original"
        raise DataError.of(where, key, expected=f"shape {wanted}", found=list(found), fix=fix)


def _in_range(ids: np.ndarray, count: int, where: str, key: str, what: str) -> None:
    if ids.min() < 0 or ids.max() >= count:
        raise DataError.of(where, key, expected=f"{what} from 0 to {count - 1}", found=f"{ids.min()} to {ids.max()}")


def _parents(tree: np.ndarray, where: str) -> tuple[int, ...]:
    """Parents in the order of the columns; -1 at the root (stored as 2^32 - 1)."""
    order = {int(joint): column for column, joint in enumerate(tree[1])}
    parents = [-1] + [order.get(int(parent), -1) for parent in tree[0, 1:]]
    if any(not 0 <= parent < child for child, parent in enumerate(parents[1:], start=1)):
        raise DataError.of(where, "kintree_table", expected="every parent before its child", found=tree[0].tolist())
    return tuple(parents)


def _tips(content: Mapping[str, Any], count: int, where: str) -> tuple[int, ...] | None:
    if "tip_vertices" not in content:
        return MANO_TIP_VERTICES if count == 778 else None
    tips = _integers(content, "tip_vertices", where, (5,))
    _in_range(tips, count, where, "tip_vertices", "vertex ids")
    return tuple(int(t) for t in tips)
