"""Triangle meshes of other programs: OBJ and PLY.

Vertices keep their order and number, whatever the faces use: sequences of meshes are told apart by nothing else. PLY is
read by trimesh. OBJ is not, although trimesh keeps all vertices too (``maintain_order``) and takes a fifth of the time:
ids that count backwards are wrong there without a word if vertices follow the face, as in files of several objects, and
so is the id 0.
"""

import io
import os
from pathlib import Path

import numpy as np

from nbavatar.errors import DataError, require

__all__ = ["MESH_TYPES", "read_mesh_file"]

MESH_TYPES = (".obj", ".ply")


def read_mesh_file(path: str | os.PathLike[str]) -> tuple[np.ndarray, np.ndarray]:
    """Reads a mesh.

    Args:
        path: `.obj` (v and f; quads and polygons become fans of triangles; all else is passed over) or `.ply`
            (text or binary).

    Returns:
        vertices float64 `[V, 3]` in the file's unit, faces int64 `[F, 3]`.

    Raises:
        DataError: missing, damaged, no mesh, or a face of vertices that are not there.
    """
    path = Path(path)
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise DataError.of(path, expected="a mesh (.obj or .ply)", found="no such file") from None
    if path.suffix.lower() == ".obj":
        verts, faces = _read_obj(content, path)
    elif path.suffix.lower() == ".ply":
        verts, faces = _read_ply(content, path)
    else:
        raise DataError.of(path, expected=f"a mesh ({' or '.join(MESH_TYPES)})", found=path.suffix or "no suffix")
    if not len(verts) or not len(faces):
        found = f"{len(verts)} vertices, {len(faces)} faces"
        raise DataError.of(path, expected="vertices and faces", found=found)
    if faces.min() < 0 or faces.max() >= len(verts):
        raise DataError.of(
            path, "faces", expected=f"vertices 0 to {len(verts) - 1}", found=f"{faces.min()} to {faces.max()}"
        )
    if not np.isfinite(verts).all():
        bad = int(np.flatnonzero(~np.isfinite(verts).all(axis=1))[0])
        raise DataError.of(path, "vertices", expected="finite coordinates", found=f"NaN or infinity at vertex {bad}")
    return verts, faces


def _read_obj(content: bytes, path: Path) -> tuple[np.ndarray, np.ndarray]:
    positions: list[tuple[float, float, float]] = []
    polygons: list[tuple[int, list[bytes]]] = []
    line = b""
    try:
        for line in content.replace(b"\\\n", b" ").splitlines():
            words = line.split()
            if words[:1] == [b"v"]:
                x, y, z, *_ = words[1:]
                positions.append((float(x), float(y), float(z)))
            elif words[:1] == [b"f"]:
                polygons.append((len(positions), words[1:]))
        verts = np.array(positions, dtype=np.float64).reshape(-1, 3)
        triangles = []
        for before, corners in polygons:
            ids = [int(corner.partition(b"/")[0]) for corner in corners]
            ids = [value - 1 if value > 0 else before + value for value in ids]  # negative ones count backwards
            triangles += [(ids[0], b, c) for b, c in zip(ids[1:], ids[2:])]
        faces = np.array(triangles, dtype=np.int64).reshape(-1, 3)
    except (ValueError, IndexError, OverflowError):
        found = f"another text (read to {line[:40]!r})"
        raise DataError.of(path, expected="an OBJ mesh (v x y z, f a b c)", found=found) from None
    return verts, faces


def _read_ply(content: bytes, path: Path) -> tuple[np.ndarray, np.ndarray]:
    trimesh = require("trimesh", "trimesh", "reading PLY meshes")
    try:
        # From memory, and without a resolver: no file that this one names is opened.
        mesh = trimesh.load(io.BytesIO(content), file_type="ply", process=False, force="mesh")
        verts, faces = np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64)
    except Exception as error:  # its parser raises whatever a damaged file makes it meet
        reason = " ".join(str(error).split())[:80] or type(error).__name__
        raise DataError.of(path, expected="a PLY mesh", found=f"a damaged one ({reason})") from error
    return verts.reshape(-1, 3), faces.reshape(-1, 3)
