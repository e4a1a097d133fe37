"""Triangle meshes for other programs: OBJ, PLY and GLB, with colours and contact. Reading is in `io.meshfiles`."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nbavatar.io.atomic import atomic_write
from nbavatar.io.gltf import Shape, write_glb
from nbavatar.io.plyfiles import write_ply

__all__ = ["MESH_FORMATS", "write_shapes"]

MESH_FORMATS = ("obj", "ply", "glb")


def write_shapes(
    path: str | os.PathLike[str], shapes: Sequence[Shape], contact: Sequence[np.ndarray], comment: str
) -> None:
    """Writes the first frame of some meshes as one file, of the type that its suffix names.

    OBJ has one object a part and colours behind the coordinates, as most programs read them; PLY has the columns
    red, green, blue and contact (0 or 1); GLB has one node a part and the colours.

    Args:
        path: `.obj`, `.ply` or `.glb`.
        shapes: the meshes, with colours; the first of their frames is written.
        contact: bool [V] for each.
        comment: one line about where this comes from.
    """
    suffix = Path(path).suffix
    if suffix == ".glb":
        write_glb(path, [_first(shape) for shape in shapes], fps=25.0, extras={"comment": comment})
    elif suffix == ".ply":
        verts = np.concatenate([shape.positions[0] for shape in shapes]).astype(np.float32)
        colours = np.concatenate([shape.colours for shape in shapes if shape.colours is not None])
        columns: dict[str, np.ndarray] = {axis: verts[:, i] for i, axis in enumerate("xyz")}
        columns |= {name: colours[:, i] for i, name in enumerate(("red", "green", "blue"))}
        columns["contact"] = np.concatenate(contact).astype(np.uint8)
        write_ply(path, columns, np.concatenate(_numbered(shapes)), [comment])
    else:
        with atomic_write(path) as temporary, open(temporary, "w", encoding="utf-8") as stream:
            stream.write(f"# {comment}\n")
            for shape, faces in zip(shapes, _numbered(shapes), strict=True):
                assert shape.colours is not None
                rows = np.concatenate((shape.positions[0], shape.colours / 255.0), axis=1)
                stream.write(f"o {shape.name}\n")
                np.savetxt(stream, rows, fmt=["v %.9g", *["%.9g"] * 2, *["%.4f"] * 3])
                np.savetxt(stream, faces + 1, fmt="f %d %d %d")


def _first(shape: Shape) -> Shape:
    return Shape(shape.name, shape.positions[:1], shape.faces, colours=shape.colours)


def _numbered(shapes: Sequence[Shape]) -> list[np.ndarray]:
    """Faces of each mesh in the vertex numbers of all."""
    starts = np.cumsum([0, *(shape.positions.shape[1] for shape in shapes)])
    return [np.asarray(shape.faces) + start for shape, start in zip(shapes, starts)]
