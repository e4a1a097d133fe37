"""Mends the faces of a mesh and leaves its vertices alone, so that one repair serves all frames of a sequence."""

import numpy as np

from nbavatar.errors import require
from nbavatar.mesh.consistency import signed_volume

__all__ = ["repair_faces"]


def repair_faces(verts: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Drops faces with a vertex twice and repeated faces, and turns all faces outwards (by trimesh).

    A closed component is turned by its volume. So is an open one, closed in thought by a fan at its middle, which is
    what a head with an open neck needs.

    Args:
        verts: `[V, 3]`, any unit.
        faces: int64 `[F, 3]`.

    Returns:
        faces int64 `[G, 3]`, G <= F, in their order; and what was done, one line each.
    """
    trimesh = require("trimesh", "trimesh", "repairing meshes")
    said = []
    ordered = np.sort(faces, axis=1)
    whole = (ordered[:, 0] != ordered[:, 1]) & (ordered[:, 1] != ordered[:, 2])
    if not whole.all():
        said.append(f"{int((~whole).sum())} faces with a vertex twice dropped")
    first = np.zeros(len(faces), dtype=bool)
    first[np.unique(ordered, axis=0, return_index=True)[1]] = True
    if (twice := whole & ~first).any():
        said.append(f"{int(twice.sum())} repeated faces dropped")
    kept = faces[whole & first]
    mesh = trimesh.Trimesh(np.asarray(verts, dtype=np.float64), kept, process=False)
    trimesh.repair.fix_winding(mesh)
    wound = np.array(mesh.faces, dtype=np.int64)
    labels = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(wound))
    for label in range(int(labels.max(initial=-1)) + 1):
        rows = labels == label
        if signed_volume(verts, wound[rows]) < 0:
            wound[rows] = wound[rows][:, ::-1]
    turned = int((_rotated(wound) != _rotated(kept)).any(axis=1).sum())
    if turned:
        said.append(f"{turned} faces turned outwards")
    # A face that was not turned keeps its corners as they were, first corner included.
    same = (_rotated(wound) == _rotated(kept)).all(axis=1)
    return np.where(same[:, None], kept, wound), said


def _rotated(faces: np.ndarray) -> np.ndarray:
    """Faces with their smallest vertex first, winding kept."""
    start = faces.argmin(axis=1)
    return np.stack([faces[np.arange(len(faces)), (start + step) % 3] for step in range(3)], axis=1)
