"""Whether meshes of one part over time are the same surface: edges that keep their lengths, seams, inside and outside.

Plain arrays in and out; lengths in metres.
"""

from collections.abc import Sequence

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
import scipy.spatial

from nbavatar.mesh.topology import boundary_edges, unreferenced_vertices

__all__ = ["edge_lengths", "edges_apart", "reference_lengths", "seam_welds", "signed_volume", "torn_edges"]

_SEAM = 1e-6  # distance of coincident vertices, as a share of the part's diagonal
_SEAM_LATER = 1e-5  # the same in the other frames
_CROWD = 32  # most vertices that are one, on average
_STRETCH = 4.0  # factor by which edges are too long
_LONG, _SHORT = (
    0.3,
    0.01,
)  # shares of the part's diagonal: edges that are torn alone, or if many are
_MOUTH = 0.01  # share of a part's edges


def edge_lengths(verts: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Lengths (E,) float64 of edges (E, 2) of vertices (V, 3)."""
    verts = np.asarray(verts, np.float64)
    return np.linalg.norm(verts[pairs[:, 0]] - verts[pairs[:, 1]], axis=1)


def reference_lengths(frames: Sequence[np.ndarray], pairs: np.ndarray) -> np.ndarray:
    """The median length (E,) of every edge over frames of vertices (V, 3); of an even number, the lower one."""
    lengths = np.sort(np.stack([edge_lengths(verts, pairs) for verts in frames]), axis=0)
    return lengths[(len(frames) - 1) // 2]


def edges_apart(lengths: np.ndarray, reference: np.ndarray) -> tuple[float, float]:
    """How far edges are from their reference, as two factors, at least 1.

    Faces deform, but half of a face's edges never change by much; those of vertices in another order, or of another
    unit, all do.

    Returns:
        the factor that half of the edges are off by or more, up or down; and the factor of their middle, which is 1 if
        as many have grown as have shrunk.
    """
    long = reference > 1e-9 * reference.max(initial=0.0)
    if not long.any():
        return 1.0, 1.0
    with np.errstate(divide="ignore"):
        change = np.log(lengths[long] / reference[long])
    return float(np.exp(np.median(np.abs(change)))), float(np.exp(np.abs(np.median(change))))


def torn_edges(lengths: np.ndarray, reference: np.ndarray, diagonal: float) -> np.ndarray:
    """Ids of edges that are many times as long as they should be.

    One that reaches over much of the part is torn. Shorter ones may be a mouth that opens: they are torn if there are
    more of them than a mouth has.
    """
    stretched = lengths > _STRETCH * reference
    many = stretched & (lengths > _SHORT * diagonal)
    if many.mean() > _MOUTH:
        return np.flatnonzero(many)
    return np.flatnonzero(stretched & (lengths > _LONG * diagonal))


def signed_volume(verts: np.ndarray, faces: np.ndarray) -> float:
    """Volume [m^3] of cones from the mean vertex over all faces; negative where faces show their backs outside.

    Exact for a closed surface; open ones (necks, wrists) lack the cone over their opening.
    """
    verts = np.asarray(verts, np.float64)
    corners = verts[faces] - verts[np.unique(faces)].mean(axis=0)
    return float(np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6)


def seam_welds(frames: Sequence[np.ndarray], faces: np.ndarray) -> np.ndarray:
    """For every vertex the one that stands for it: vertices on borders that lie together in all frames become one.

    Files with texture coordinates split their vertices along seams; as a surface the seam is none.

    Args:
        frames: vertices (V, 3) [m] of one frame or more.
        faces: vertex ids (F, 3).

    Returns:
        (V,) int64; the smallest id of those that are one. Vertices of a common face are never made one.
    """
    welded = np.arange(len(frames[0]))
    first = np.asarray(frames[0], np.float64)
    diagonal = float(np.linalg.norm(np.ptp(first, axis=0)))
    pairs = np.concatenate([_near_borders(first, faces, _SEAM * diagonal), _near_loose(first, faces, _SEAM * diagonal)])
    for verts in frames[1:]:
        if not len(pairs):
            return welded
        pairs = pairs[edge_lengths(verts, pairs) <= _SEAM_LATER * diagonal]
    graph = scipy.sparse.coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(first),) * 2)
    _, group = scipy.sparse.csgraph.connected_components(graph, directed=False)
    _, smallest, inverse = np.unique(group, return_index=True, return_inverse=True)
    stands_for = smallest[inverse.ravel()]
    corners = np.sort(stands_for[faces], axis=1)
    collapsed = (corners[:, 0] == corners[:, 1]) | (corners[:, 1] == corners[:, 2])
    collapsed &= (np.diff(np.sort(faces, axis=1), axis=1) > 0).all(axis=1)
    kept_apart = np.isin(stands_for, np.unique(stands_for[faces[collapsed]]))
    return np.where(kept_apart, welded, stands_for)


def _near_borders(verts: np.ndarray, faces: np.ndarray, reach: float) -> np.ndarray:
    """Pairs (P, 2) of border vertices nearer than `reach`; none if whole crowds of them are."""
    border = np.unique(boundary_edges(faces))
    if len(border) < 2:
        return np.zeros((0, 2), np.int64)
    tree = scipy.spatial.KDTree(verts[border])
    if tree.count_neighbors(tree, reach) > _CROWD * len(border):
        return np.zeros((0, 2), np.int64)
    return border[tree.query_pairs(reach, output_type="ndarray")]


def _near_loose(verts: np.ndarray, faces: np.ndarray, reach: float) -> np.ndarray:
    """Pairs (P, 2) of a vertex that no face uses and the one nearest to it that some do: it may have lost its faces."""
    loose = unreferenced_vertices(faces, len(verts))
    used = np.unique(faces)
    if not len(loose):
        return np.zeros((0, 2), np.int64)
    distance, index = scipy.spatial.KDTree(verts[used]).query(verts[loose])
    near = np.asarray(distance) <= reach
    return np.stack([loose[near], used[np.asarray(index)[near]]], axis=1)
