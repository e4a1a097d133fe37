"""PLY files to write: vertices with named columns, and triangles. Binary, little endian; everything reads that.

Reading is in `nbavatar.io.meshfiles`.
"""

import os
from collections.abc import Mapping, Sequence

import numpy as np

from nbavatar.io.atomic import atomic_write

__all__ = ["write_ply"]

_TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int"}


def write_ply(
    path: str | os.PathLike[str],
    columns: Mapping[str, np.ndarray],
    faces: np.ndarray | None = None,
    comments: Sequence[str] = (),
) -> None:
    """Writes a PLY file.

    Args:
        path: the file.
        columns: property -> one number a vertex, [V]; float32, float64, uint8 or int32, in the order of the file.
        faces: vertex ids, int [F, 3], or None for points.
        comments: lines of the header, ASCII.
    """
    arrays = {name: np.asarray(value) for name, value in columns.items()}
    counts = {len(value) for value in arrays.values()}
    if len(counts) != 1 or any(value.ndim != 1 for value in arrays.values()):
        raise ValueError(f"columns must be [V] with one V, found {[value.shape for value in arrays.values()]}")
    kinds = {name: value.dtype.str[1:] for name, value in arrays.items()}
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {' '.join(line.split())}" for line in comments]
    lines += [f"element vertex {counts.pop()}", *(f"property {_TYPES[kinds[name]]} {name}" for name in arrays)]
    if faces is not None:
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    rows = np.zeros(len(next(iter(arrays.values()))), np.dtype([(name, f"<{kind}") for name, kind in kinds.items()]))
    for name, value in arrays.items():
        rows[name] = value
    with atomic_write(path) as temporary, open(temporary, "wb") as stream:
        stream.write(("\n".join([*lines, "end_header"]) + "\n").encode("ascii", "replace"))
        stream.write(rows.tobytes())
        if faces is not None:
            corners = np.zeros(len(faces), np.dtype([("count", "u1"), ("ids", "<i4", (3,))]))
            corners["count"], corners["ids"] = 3, faces
            stream.write(corners.tobytes())
