"""PLY files to write, by trimesh: vertices with named columns, and triangles. Binary, little endian.

Reading is in `nbavatar.io.meshfiles`.
"""

import os
import re
from collections.abc import Mapping, Sequence

import numpy as np

from nbavatar.errors import require
from nbavatar.io.atomic import atomic_write

__all__ = ["write_ply"]


def write_ply(
    path: str | os.PathLike[str],
    columns: Mapping[str, np.ndarray],
    faces: np.ndarray | None = None,
    comments: Sequence[str] = (),
) -> None:
    """Writes a PLY file.

    Args:
        path: the file.
        columns: property -> one number a vertex, [V]; x, y and z come first, and are written as float32; the others are
            float32, float64, uint8 or int32, in the order of the file.
        faces: vertex ids, int [F, 3], or None for points.
        comments: lines of the header, ASCII.
    """
    trimesh = require("trimesh", "trimesh", "writing PLY files")
    if len({np.shape(value) for value in columns.values()}) != 1 or list(columns)[:3] != ["x", "y", "z"]:
        found = {name: np.shape(value) for name, value in columns.items()}
        raise ValueError(f"columns must be x, y, z and others, all [V], found {found}")
    verts = np.stack([columns[axis] for axis in "xyz"], axis=1)
    shape = trimesh.PointCloud(verts) if faces is None else trimesh.Trimesh(verts, faces, process=False)
    shape.vertex_attributes = {name: np.asarray(columns[name]) for name in list(columns)[3:]}
    content = shape.export(file_type="ply", vertex_normal=False)
    # trimesh writes its own address as the only comment.
    lines = b"".join(b"comment " + " ".join(line.split()).encode("ascii", "replace") + b"\n" for line in comments)
    with atomic_write(path) as temporary:
        temporary.write_bytes(re.sub(rb"comment .*\n", lambda _: lines, content, count=1))
