"""The surface of a hull's pieces: marching cubes, which faces belong to a piece, smoothing, decimation."""

import numpy as np

from nbavatar.fitting.hull import Grid
from nbavatar.mesh.bvh import DeformingMesh
from nbavatar.mesh.topology import boundary_edges, vertex_adjacency, vertex_components

__all__ = ["decimated", "face_areas", "piece_surface", "smoothed"]

_BLUR = 1.0  # Gaussian of the hull's depth before its surface is taken [cells]
_SMOOTHING = 10  # steps of Taubin's filter
_SHRINK, _GROW = 0.5, -0.53  # its two factors


def piece_surface(
    grid: Grid, depth: np.ndarray, kept: np.ndarray, mesh: DeformingMesh, gap: float, area: float
) -> tuple[np.ndarray, np.ndarray]:
    """The hull's surface around the cells that are kept, open where it comes to the mesh.

    What would close it there is hidden by the mesh.

    Args:
        grid: cells; depth: how far inside the hull each is, in [-1, 1], 0 at its surface; kept: bool; of its shape.
        mesh: of the part; gap: height above it from which a vertex belongs to the surface [m].
        area: least area of a connected piece [m^2].

    Returns:
        vertices (W, 3) [m] and faces (G, 3), counter-clockwise seen from outside; maybe none.
    """
    import igl
    import scipy.ndimage

    depth = np.pad(scipy.ndimage.gaussian_filter(depth, _BLUR, mode="nearest"), 1, constant_values=-1.0)
    z, y, x = np.meshgrid(*(np.arange(count) - 0.5 for count in depth.shape[::-1]), indexing="ij")
    corners = grid.low + np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1) * grid.edge
    verts, faces, _ = igl.marching_cubes(-depth.transpose(2, 1, 0).ravel(), corners, *depth.shape, 0.0)
    near = scipy.ndimage.binary_dilation(kept, np.ones((3, 3, 3)))
    cell = np.clip(np.floor((verts - grid.low) / grid.edge).astype(int), 0, np.array(grid.shape) - 1)
    wanted = near[cell[:, 0], cell[:, 1], cell[:, 2]]
    inside = np.flatnonzero(wanted)
    wanted[inside] = mesh.signed(np.ascontiguousarray(verts[inside]), np.inf)[0] > gap
    faces = faces[wanted[faces].all(1)]
    if len(faces):
        piece = vertex_components(faces, len(verts))[faces[:, 0]]
        faces = faces[np.bincount(piece, face_areas(verts, faces))[piece] >= area]
    return _used(verts, faces)


def smoothed(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Vertices after Taubin's filter (1995): steps towards the neighbours' mean and back, which do not shrink.

    Border vertices follow their neighbours on the border only.
    """
    import scipy.sparse

    border = boundary_edges(faces)
    ties = vertex_adjacency(faces, len(verts)).tolil()
    rim = np.unique(border)
    ties[rim] = 0
    ties = ties.tocsr()
    pairs = np.concatenate([border, border[:, ::-1]])
    ties += scipy.sparse.csr_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=ties.shape)
    mean = scipy.sparse.diags_array(1.0 / np.maximum(ties.sum(1), 1.0)) @ ties
    for _ in range(_SMOOTHING):
        for factor in (_SHRINK, _GROW):
            verts = verts + factor * (mean @ verts - verts)
    return verts


def decimated(verts: np.ndarray, faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """At most about `count` faces: edges collapse whose loss moves the surface least (Garland and Heckbert 1997)."""
    import igl

    if len(faces) <= count:
        return verts, faces
    found = igl.qslim(np.asfortranarray(verts), np.asfortranarray(faces.astype(np.int32)), count)
    return _used(np.ascontiguousarray(found[0]), np.ascontiguousarray(found[1]))


def face_areas(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Areas (F,) [m^2]."""
    a, b, c = (verts[faces[:, k]] for k in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def _used(verts: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Without vertices that no face uses."""
    ids, renumbered = np.unique(faces, return_inverse=True)
    return verts[ids], renumbered.reshape(-1, 3).astype(np.int64)
