"""Connectivity of triangle meshes: checks, edges, components, borders, adjacency.

Plain integer arrays in and out. Nothing here needs a manifold mesh; what a mesh is not is reported by `mesh_defects`.
Borders, adjacency and components are libigl's. Border loops are ours: where holes touch in a vertex, those of libigl
leave edges out (a sphere that has lost 380 of 1280 faces at random: 563 of its 802 border edges), and a hole that is
not closed makes the inside test wrong. libigl has no list of defects.
"""

from types import ModuleType
from typing import NamedTuple

import numpy as np
import scipy.sparse

from nbavatar.errors import DataError, require

__all__ = [
    "MeshDefects",
    "boundary_edges",
    "boundary_loops",
    "edges",
    "mesh_defects",
    "unreferenced_vertices",
    "validate_mesh",
    "vertex_adjacency",
    "vertex_components",
]


class MeshDefects(NamedTuple):
    """What is unusual about a mesh; empty arrays where nothing is.

    Attributes:
        unreferenced: vertex ids that no face uses, shape (A,).
        repeated_vertex: face ids with the same vertex twice, shape (B,).
        duplicate: face ids that repeat the vertex set of an earlier face, shape (C,).
        zero_area: face ids with a height under 1e-6 of their longest edge, shape (D,).
        border: edges with one face, shape (E, 2).
        non_manifold: edges with three faces or more, shape (G, 2).
        inconsistent: edges whose two faces run through them in the same direction, shape (H, 2).
    """

    unreferenced: np.ndarray
    repeated_vertex: np.ndarray
    duplicate: np.ndarray
    zero_area: np.ndarray
    border: np.ndarray
    non_manifold: np.ndarray
    inconsistent: np.ndarray


def validate_mesh(verts: np.ndarray, faces: np.ndarray, where: str) -> None:
    """Refuses arrays that are no triangle mesh.

    Args:
        verts: positions [m], shape (V, 3) or (N, V, 3), any real dtype. NaN is refused.
        faces: vertex ids, shape (F, 3), any integer dtype.
        where: name of the mesh for the error message, such as a file and a part.

    Raises:
        DataError: one line that names the array, what was expected and what was found.
    """
    verts, faces = np.asanyarray(verts), np.asanyarray(faces)
    if verts.ndim not in (2, 3) or verts.shape[-1] != 3 or verts.dtype.kind != "f":
        raise DataError.of(where, "verts", expected="float (V, 3) or (N, V, 3)", found=f"{verts.dtype} {verts.shape}")
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
        raise DataError.of(where, "faces", expected="integers (F, 3)", found=f"{faces.dtype} {faces.shape}")
    if len(faces) and (faces.min() < 0 or faces.max() >= verts.shape[-2]):
        raise DataError.of(
            where,
            "faces",
            expected=f"ids from 0 to {verts.shape[-2] - 1}",
            found=f"{faces.min()} to {faces.max()}",
            fix="the faces belong to another mesh, or count from 1",
        )
    if not np.isfinite(verts).all():
        bad = np.argwhere(~np.isfinite(verts).all(axis=-1))[0]
        at = f"vertex {bad[-1]}" if verts.ndim == 2 else f"frame {bad[0]}, vertex {bad[1]}"
        raise DataError.of(where, "verts", expected="finite numbers", found=f"NaN or infinity at {at}")


def edges(faces: np.ndarray) -> np.ndarray:
    """Undirected edges, each once, (E, 2) int64 with the smaller id first, in lexicographic order."""
    return _edge_counts(faces)[0]


def boundary_edges(faces: np.ndarray) -> np.ndarray:
    """Edges that exactly one face uses, (E, 2) int64, in the direction of that face, in no particular order."""
    return np.asarray(_igl().boundary_facets(np.ascontiguousarray(faces, np.int64))[0], np.int64).reshape(-1, 2)


def boundary_loops(faces: np.ndarray) -> list[np.ndarray]:
    """Closed borders (neck, wrist, holes) as vertex ids in order, longest first.

    Each border edge is used once. Where a vertex has several outgoing border edges (holes that touch in it), the one to
    the smallest id is taken first. A chain that does not close (non-manifold input) is returned open.
    """
    following: dict[int, list[int]] = {}
    for a, b in sorted(map(tuple, boundary_edges(faces).tolist()), reverse=True):
        following.setdefault(a, []).append(b)
    loops = []
    while following:
        start = min(following)
        loop, here = [start], start
        while here in following:
            there = following[here].pop()
            if not following[here]:
                del following[here]
            here = there
            if here == start:
                break
            loop.append(here)
        loops.append(np.array(loop, np.int64))
    return sorted(loops, key=lambda loop: (-len(loop), loop[0]))


def vertex_adjacency(faces: np.ndarray, n_verts: int) -> scipy.sparse.csr_array:
    """Symmetric 0/1 matrix (V, V) of vertices that share an edge; sorted indices."""
    pairs = edges(faces)
    rows, columns = np.concatenate((pairs, pairs[:, ::-1])).T
    matrix = scipy.sparse.csr_array((np.ones(len(rows)), (rows, columns)), shape=(n_verts, n_verts))
    matrix.sort_indices()
    return matrix


def vertex_components(faces: np.ndarray, n_verts: int) -> np.ndarray:
    """Connected component of each vertex.

    Two faces are connected when they share a vertex.

    Returns:
        (V,) int64: components count from 0 in order of their smallest vertex id; -1 for vertices without a face.
    """
    used = np.unique(faces)
    component = np.full(n_verts, -1, np.int64)
    if len(used):
        # libigl numbers components by their smallest vertex, and vertices without a face among them.
        label = np.asarray(_igl().vertex_components(np.ascontiguousarray(faces, np.int64))).ravel()
        component[used] = np.unique(label[used], return_inverse=True)[1]
    return component


def unreferenced_vertices(faces: np.ndarray, n_verts: int) -> np.ndarray:
    """Ids of vertices that no face uses, (A,) int64."""
    used = np.zeros(n_verts, bool)
    used[faces.ravel()] = True
    return np.flatnonzero(~used)


def mesh_defects(verts: np.ndarray, faces: np.ndarray) -> MeshDefects:
    """Lists what is unusual about a mesh (V, 3), (F, 3): none of it is an error here."""
    a, b, c = verts[faces[:, 0]], verts[faces[:, 1]], verts[faces[:, 2]]
    longest = np.max([((p - q) ** 2).sum(1) for p, q in ((a, b), (b, c), (c, a))], axis=0)
    double_area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    repeated = (faces[:, 0] == faces[:, 1]) | (faces[:, 1] == faces[:, 2]) | (faces[:, 2] == faces[:, 0])
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    pairs, counts = _edge_counts(faces[~repeated])
    directed, directed_counts = np.unique(_directed(faces[~repeated]), axis=0, return_counts=True)
    twice = np.unique(np.sort(directed[directed_counts > 1], axis=1), axis=0)
    return MeshDefects(
        unreferenced=unreferenced_vertices(faces, len(verts)),
        repeated_vertex=np.flatnonzero(repeated),
        duplicate=np.setdiff1d(np.arange(len(faces)), first),
        zero_area=np.flatnonzero(double_area <= 1e-6 * longest),
        border=pairs[counts == 1],
        non_manifold=pairs[counts > 2],
        inconsistent=twice,
    )


def _directed(faces: np.ndarray) -> np.ndarray:
    """The three directed edges of all faces, (3F, 2) int64: first edges, second edges, third edges."""
    faces = np.asarray(faces, np.int64)
    return np.concatenate((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]))


def _edge_counts(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.unique(np.sort(_directed(faces), axis=1), axis=0, return_counts=True)


def _igl() -> ModuleType:
    # Imported where it is needed only: `check` and `masks` start without it.
    return require("igl", "libigl", "the connectivity of meshes")
