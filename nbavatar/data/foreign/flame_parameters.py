"""VHAP's `flame_param/*.npz`, posed by our FLAME.

    shape [300], expr [1, 100]               coefficients
    rotation, neck_pose, jaw_pose [1, 3], eyes_pose [1, 6]   axis-angle [rad]
    translation [1, 3]                       [m], after the pose
    static_offset, dynamic_offset [1, V, 3]  optional [m]: added to the template before anything else

The offsets of VHAP's own teeth (120 vertices behind FLAME's) are dropped: FLAME's file has no such vertices. The meshes
of VHAP's other mode have them.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from nbavatar.bodymodels.files import read_flame
from nbavatar.bodymodels.flame import Flame
from nbavatar.data.foreign.mesh_files import FrameFiles
from nbavatar.errors import DataError
from nbavatar.io.arrays import read_arrays

__all__ = ["FlameSequence"]

_TEETH = 120
_WIDTHS = {"shape": 300, "expr": 100, "rotation": 3, "neck_pose": 3, "jaw_pose": 3, "eyes_pose": 6, "translation": 3}
_OFFSETS = ("static_offset", "dynamic_offset")


class FlameSequence:
    """Heads of some parameter files, in double precision until they are stored.

    Args:
        model: FLAME's model file, with all 300 + 100 directions.
        files: frame -> parameters.

    Raises:
        DataError: the model or a file is damaged, or they do not fit each other.
    """

    def __init__(self, model: Path, files: Mapping[str, Path]) -> None:
        self._arrays, self._files = read_flame(model), FrameFiles(files)
        self._flame = Flame.build(self._arrays, shape_count=300, expression_count=100, dtype=torch.float64)
        self.notes: list[str] = []
        first = next(iter(files.values()))
        stored, _ = read_arrays(first)
        extra = {key: stored[key].size // 3 for key in _OFFSETS if key in stored}
        if any(count == len(self._arrays.template) + _TEETH for count in extra.values()):
            self.notes.append(f"{first.parent}: the offsets of VHAP's {_TEETH} vertices of teeth are dropped")
        self._rest = self._pose(self._read(first), rest=True)

    def topology(self) -> Mapping[str, tuple[np.ndarray, np.ndarray | None]]:
        """See `Meshes`; at rest is the first frame's shape with its static offset, without expression and pose."""
        return {"head": (self._arrays.faces, self._rest)}

    def vertices(self, frame: str) -> Mapping[str, np.ndarray]:
        """See `Meshes`."""
        path = self._files.get(frame)
        return {} if path is None else {"head": self._pose(self._read(path))}

    def _read(self, path: Path) -> dict[str, np.ndarray]:
        """Parameters, float64, flat but for the offsets `[V, 3]` of FLAME's own vertices."""
        arrays, _ = read_arrays(path, required=tuple(_WIDTHS))
        result: dict[str, np.ndarray] = {}
        for key, width in _WIDTHS.items():
            value = arrays[key]
            if value.dtype.kind not in "fiu" or value.shape not in ((width,), (1, width)):
                expected = f"numbers [1, {width}]"
                raise DataError.of(path, key, expected=expected, found=f"{value.dtype} {list(value.shape)}")
            result[key] = _double(value).reshape(width)
        count = len(self._arrays.template)
        for key in _OFFSETS:
            if key not in arrays:
                continue
            value = arrays[key]
            shapes = [lead + (total, 3) for lead in ((), (1,)) for total in (count, count + _TEETH)]
            if value.dtype.kind not in "fiu" or value.shape not in shapes:
                expected = f"numbers [1, {count}, 3] as FLAME has vertices, or [1, {count + _TEETH}, 3] with teeth"
                raise DataError.of(path, key, expected=expected, found=f"{value.dtype} {list(value.shape)}")
            result[key] = _double(value).reshape(-1, 3)[:count]
        for key, value in result.items():
            if not np.isfinite(value).all():
                raise DataError.of(path, key, expected="finite numbers", found="NaN or infinity")
        return result

    def _pose(self, values: Mapping[str, np.ndarray], *, rest: bool = False) -> np.ndarray:
        """Vertices float64 `[V, 3]` of one frame, or of its subject at rest."""
        mesh = self._flame.mesh
        for key in _OFFSETS:
            if key in values and not (rest and key == "dynamic_offset"):
                offset = torch.from_numpy(values[key])
                joints = torch.from_numpy(self._arrays.joint_regressor) @ offset
                mesh = dataclasses.replace(
                    mesh, template=mesh.template + offset, joint_template=mesh.joint_template + joints
                )
        given = {key: torch.from_numpy(values[key] * (key == "shape" or not rest))[None] for key in _WIDTHS}
        posed = dataclasses.replace(self._flame, mesh=mesh).forward(
            given["shape"], given["expr"], given["jaw_pose"], root=given["rotation"], neck=given["neck_pose"],
            eyes=given["eyes_pose"],
        )  # fmt: skip
        return (posed.verts[0] + given["translation"][0]).numpy()


def _double(value: np.ndarray) -> np.ndarray:
    """The numbers in double precision; what is no number stays none, without a warning."""
    with np.errstate(invalid="ignore"):
        return value.astype(np.float64)
