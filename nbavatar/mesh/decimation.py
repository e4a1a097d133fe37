"""Meshes of fewer faces that move as the original does, by pymeshlab (Garland and Heckbert 1997)."""

from typing import NamedTuple

import numpy as np

from nbavatar.errors import require
from nbavatar.mesh.bvh import DeformingMesh

__all__ = ["Decimated", "decimate_mesh"]

_NEAR = 1.0  # search radius around the original, in multiples of its extent


class Decimated(NamedTuple):
    """A coarser mesh, and where its vertices ride on the original.

    Attributes:
        verts: positions (W, 3) float64, in the original's unit; a little off its surface.
        faces: vertex ids, int64 (G, 3).
        face, weight: the nearest point of the original for each vertex: its face (W,) and barycentric weights (W, 3);
            `surface_points` of a moved original gives the moved vertices.
    """

    verts: np.ndarray
    faces: np.ndarray
    face: np.ndarray
    weight: np.ndarray


def decimate_mesh(verts: np.ndarray, faces: np.ndarray, count: int) -> Decimated:
    """A mesh of at most about `count` faces, borders kept; vertices that no face uses are dropped.

    Args:
        verts: positions (V, 3), any unit.
        faces: vertex ids, int (F, 3).
        count: faces to keep; all if there are no more.
    """
    pymeshlab = require("pymeshlab", "pymeshlab", "coarser meshes")
    verts = np.asarray(verts, np.float64)
    size = max(float(np.ptp(verts, axis=0).max()), np.finfo(np.float64).tiny)
    middle = verts.mean(axis=0)
    meshes = pymeshlab.MeshSet()
    # The filter's own thresholds are absolute: as if the mesh were in millimetres, and of the size of a head.
    unit = 250.0 / size
    meshes.add_mesh(pymeshlab.Mesh(unit * (verts - middle), np.asarray(faces, np.int32)))
    if count < len(faces):
        meshes.meshing_decimation_quadric_edge_collapse(
            targetfacenum=count, preserveboundary=True, preservenormal=True, optimalplacement=True
        )
    meshes.meshing_remove_unreferenced_vertices()
    mesh = meshes.current_mesh()
    coarse = np.ascontiguousarray(mesh.vertex_matrix() / unit + middle)
    _, face, weight = DeformingMesh(verts, faces).closest(coarse, _NEAR * size)
    return Decimated(coarse, np.asarray(mesh.face_matrix(), np.int64), face, weight)
