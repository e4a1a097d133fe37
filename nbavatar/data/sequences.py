"""Sequences of posed meshes: what ingestion, refit and contact hand to training and rendering.

One `.npz` per subject:

    frames            text    [N]         frame ids in time order
    <part>.faces      int64   [F, 3]      counter-clockwise seen from outside
    <part>.rest       float32 [V, 3] [m]  the subject's shape, canonical and undeformed
    <part>.verts      float32 [N, V, 3] [m]  world

Parts are `head`, `right_hand`, `left_hand`, in this order, then `shell`: what the head's mesh lacks (`nbavatar shell`),
which rides with the head and has the head's label in masks. Whatever a scene lacks is absent. All other
arrays are extras of the stage that wrote them, named `<what>.<part>...`.
"""

import dataclasses
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from nbavatar.errors import DataError
from nbavatar.io.arrays import read_arrays, write_arrays
from nbavatar.names import check_name

__all__ = ["PARTS", "SHELL", "MeshSequence", "Part", "read_sequence", "write_sequence"]

PARTS = ("head", "right_hand", "left_hand")
"""Parts that have a label in masks, 1, 2 and 3."""

SHELL = "shell"
"""Part without a label of its own: it belongs to the head."""

_ALL = (*PARTS, SHELL)


@dataclasses.dataclass(frozen=True)
class Part:
    """One body part over time; see the module for shapes, dtypes and units."""

    faces: np.ndarray
    rest: np.ndarray
    verts: np.ndarray


@dataclasses.dataclass(frozen=True)
class MeshSequence:
    """Posed meshes of all parts, and the extras of the stage that made them."""

    frames: list[str]
    parts: dict[str, Part]
    extras: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)

    def index(self, frames: Sequence[str]) -> list[int]:
        """Positions of frame ids.

        Raises:
            DataError: a frame is not in the sequence.
        """
        where = {frame: i for i, frame in enumerate(self.frames)}
        for frame in frames:
            if frame not in where:
                raise DataError.of("mesh sequence", f"frame {frame}", expected="a mesh for it", found="none")
        return [where[frame] for frame in frames]

    def subset(self, frames: Sequence[str]) -> "MeshSequence":
        """The same sequence with these frames only; extras with one row a frame are cut alike."""
        rows, total = self.index(frames), len(self.frames)
        parts = {name: Part(p.faces, p.rest, p.verts[rows]) for name, p in self.parts.items()}
        fixed = ("camera.", "segments", "stiffness.")
        extras = {
            name: value[rows] if value.shape[:1] == (total,) and not name.startswith(fixed) else value
            for name, value in self.extras.items()
            if name != "segments"
        }
        return MeshSequence(list(frames), parts, extras)


def write_sequence(path: str | os.PathLike[str], sequence: MeshSequence, record: Mapping[str, Any]) -> None:
    """Writes a sequence; see the module for the layout. Refuses shapes that disagree."""
    arrays: dict[str, np.ndarray] = {"frames": np.array(sequence.frames, dtype=np.str_)}
    for name in _ALL:
        if name in sequence.parts:
            part = sequence.parts[name]
            arrays[f"{name}.faces"] = np.asarray(part.faces, dtype=np.int64)
            arrays[f"{name}.rest"] = np.asarray(part.rest, dtype=np.float32)
            arrays[f"{name}.verts"] = np.asarray(part.verts, dtype=np.float32)
    unknown = set(sequence.parts) - set(_ALL)
    clash = set(arrays) & set(sequence.extras)
    if unknown or clash:
        raise ValueError(f"unknown parts {sorted(unknown)}, extras that clash {sorted(clash)}")
    _check(str(path), arrays)
    units = {"length": "m", "frame of reference": "world, OpenCV cameras", "format": 1}
    write_arrays(path, {**arrays, **sequence.extras}, {"units": units, **record})


def read_sequence(path: str | os.PathLike[str]) -> tuple[MeshSequence, dict[str, Any]]:
    """Reads a sequence and its record.

    Raises:
        DataError: missing, damaged, no part at all, shapes that disagree, faces that are no whole numbers, vertices
            that are no finite real numbers (a part that is not in a frame is NaN there, all of it).
    """
    arrays, record = read_arrays(path, required=("frames",))
    _check(str(path), arrays)
    parts = {
        name: Part(arrays[f"{name}.faces"], arrays[f"{name}.rest"], arrays[f"{name}.verts"])
        for name in _ALL
        if f"{name}.verts" in arrays
    }
    core = {"frames"} | {f"{name}.{key}" for name in _ALL for key in ("faces", "rest", "verts")}
    extras = {name: value for name, value in arrays.items() if name not in core}
    frames = [check_name(str(frame), path, "frames", error=DataError) for frame in arrays["frames"]]
    return MeshSequence(frames, parts, extras), record


def _check(path: str, arrays: Mapping[str, np.ndarray]) -> None:
    names = arrays["frames"]
    if names.ndim != 1 or names.dtype.kind != "U" or not len(names):
        raise DataError.of(path, "frames", expected="frame ids, text [N]", found=_kind(names))
    if len(np.unique(names)) != len(names):
        raise DataError.of(path, "frames", expected="each frame once", found="one twice")
    present = [name for name in _ALL if f"{name}.verts" in arrays]
    if not present:
        raise DataError.of(path, expected=f"at least one part of {', '.join(PARTS)}", found="none")
    for name in present:
        for key in ("faces", "rest"):
            if f"{name}.{key}" not in arrays:
                raise DataError.of(path, f"{name}.{key}", expected="this array", found="none")
        _check_part(path, name, *(arrays[f"{name}.{key}"] for key in ("faces", "rest", "verts")), len(names))


def _check_part(path: str, name: str, faces: np.ndarray, rest: np.ndarray, verts: np.ndarray, count: int) -> None:
    for key, array, kinds, expected in (
        ("faces", faces, "iu", "whole numbers [F, 3]"),
        ("rest", rest, "f", "real numbers [V, 3]"),
        ("verts", verts, "f", "real numbers [N, V, 3]"),
    ):
        if array.dtype.kind not in kinds:
            raise DataError.of(path, f"{name}.{key}", expected=expected, found=_kind(array))
    if verts.shape != (count, *rest.shape) or rest.ndim != 2 or rest.shape[1] != 3:
        expected = f"[{count}, V, 3] with V of the rest shape {list(rest.shape)}"
        raise DataError.of(path, f"{name}.verts", expected=expected, found=list(verts.shape))
    if faces.ndim != 2 or faces.shape[1:] != (3,) or not len(faces):
        raise DataError.of(path, f"{name}.faces", expected="[F, 3] with at least one face", found=list(faces.shape))
    if faces.min() < 0 or faces.max() >= len(rest):
        expected = f"vertex ids from 0 to {len(rest) - 1}"
        raise DataError.of(path, f"{name}.faces", expected=expected, found=f"{faces.min()} to {faces.max()}")
    if not np.isfinite(rest).all():
        bad = int(np.flatnonzero(~np.isfinite(rest).all(axis=1))[0])
        raise DataError.of(path, f"{name}.rest", expected="finite numbers", found=f"NaN or infinity at vertex {bad}")
    # A part that is not in a frame is NaN there, all of it.
    finite = np.isfinite(verts).reshape(count, -1)
    broken = np.flatnonzero(~(finite.all(axis=1) | np.isnan(verts).reshape(count, -1).all(axis=1)))
    if len(broken):
        frame, vertex = int(broken[0]), int(np.flatnonzero(~finite[broken[0]])[0]) // 3
        found = f"NaN or infinity at frame {frame}, vertex {vertex}"
        expected = "finite numbers, or NaN at all vertices of a frame without the part"
        raise DataError.of(path, f"{name}.verts", expected=expected, found=found)


def _kind(array: np.ndarray) -> str:
    return f"{array.dtype} {list(array.shape)}"
