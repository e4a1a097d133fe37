"""Deformation transfer between meshes of one topology.

After Sumner and Popovic, "Deformation Transfer for Triangle Meshes", SIGGRAPH 2004, in the form of Botsch et al. 2006:
each face of the target has an affine deformation S from its rest to its pose; the source's vertices x are those whose
faces deform most alike,

    min_x  sum_f area_f || G_f x - S_f Q_f ||^2

with G_f the gradient over source face f in its own tangent basis Q_f. The normal matrix is the source's cotangent
Laplacian: factored once, then three back-substitutions a frame. Several connected components (eyeballs, teeth) would
drift apart, because gradients know no position; triangles are stretched between each of them and the main one, the
same in source and target, and carry their mutual place. What is left free, one translation, puts the main component's
centroid where the target's is.

    rest, posed   float64 [V, 3], [N, V, 3] [m]; both rests upright alike (they are aligned rigidly here)

Limitations: O(V) memory per frame, scipy's sparse LU; faces without area are left out.
"""

from collections.abc import Iterator

import numpy as np

__all__ = ["DeformationTransfer", "rigid_rotation"]

# Links of each further component to the main one, and how much they weigh beside a face of mean area.
_LINKS, _LINK_WEIGHT = 12, 0.3


def rigid_rotation(points: np.ndarray, onto: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) that turns `points` (V, 3) about their centroid nearest to `onto` (Kabsch 1976)."""
    u, _, vt = np.linalg.svd((points - points.mean(0)).T @ (onto - onto.mean(0)))
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    return (u @ flip @ vt).T


class DeformationTransfer:
    """Transfers poses of a target mesh to a source mesh of the same faces.

    Args:
        source_rest: (V, 3) [m].
        target_rest: (V, 3) [m].
        faces: int64 (F, 3) of both.
    """

    def __init__(self, source_rest: np.ndarray, target_rest: np.ndarray, faces: np.ndarray) -> None:
        from scipy.sparse import coo_matrix, diags
        from scipy.sparse.linalg import splu

        target = np.asarray(target_rest, np.float64)
        source = np.asarray(source_rest, np.float64)
        source = (source - source.mean(0)) @ rigid_rotation(source, target).T + target.mean(0)
        faces = np.asarray(faces, np.int64)
        faces = faces[(_area(source, faces) > 1e-14) & (_area(target, faces) > 1e-14)]
        self._main, links = _links(source, target, faces)
        used = np.concatenate((faces, links))
        self._faces, self._source = used, source
        self._target_inverse = np.linalg.inv(_corner_frames(target, used))
        edges, tangent = _tangent(source, used)
        inverse = np.linalg.inv(edges)
        self._tangent = tangent
        weights = _area(source, used)
        weights[len(faces) :] = _LINK_WEIGHT * weights[: len(faces)].mean()
        count = len(used)
        # Rows 2 f and 2 f + 1: derivatives of x over face f along its two tangents.
        rows = np.repeat(np.arange(2 * count).reshape(count, 2), 3, axis=1).ravel()
        columns = np.tile(used, (1, 2)).ravel()
        values = np.stack(
            [np.stack((-inverse[:, 0, k] - inverse[:, 1, k], inverse[:, 0, k], inverse[:, 1, k]), 1) for k in (0, 1)], 1
        ).ravel()
        gradient = coo_matrix((values, (rows, columns)), shape=(2 * count, len(source))).tocsr()
        self._project = (gradient.T @ diags(np.repeat(weights, 2))).tocsr()
        normal = (self._project @ gradient).tocsc()
        # A touch of weight holds what no face holds: the free translation, and vertices without faces.
        loose = 1e-9 * normal.diagonal().mean()
        self._loose = loose
        self._solver = splu((normal + diags(np.full(len(source), loose))).tocsc())

    def poses(self, posed: np.ndarray) -> Iterator[np.ndarray]:
        """The source in every pose of the target, (V, 3) float64 [m]; frames that are not finite stay so.

        Args:
            posed: the target's vertices (N, V, 3) [m].
        """
        for frame in posed:
            points = np.asarray(frame, np.float64)
            if not np.isfinite(points).all():
                yield np.full_like(points, np.nan)
                continue
            deformation = _corner_frames(points, self._faces) @ self._target_inverse
            wanted = np.einsum("fij,fkj->fki", deformation, self._tangent).reshape(-1, 3)
            # Pulled, if only by a hair, towards the rigidly moved rest: isolated vertices go along.
            turn = rigid_rotation(self._source[self._main], points[self._main])
            moved = (self._source - self._source[self._main].mean(0)) @ turn.T + points[self._main].mean(0)
            solved = self._solver.solve(self._project @ wanted + self._loose * moved)
            yield solved + points[self._main].mean(0) - solved[self._main].mean(0)


def _area(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (verts[faces[:, i]] for i in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def _corner_frames(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Two edges and the normal, whose length follows the edges' scale, as columns (F, 3, 3)."""
    a, b, c = (verts[faces[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    # Collapsed in this pose: any direction does, and the least-squares fit outvotes it.
    normal = np.where(length > 1e-20, normal / np.sqrt(np.maximum(length, 1e-20)), 0.0)
    return np.stack((b - a, c - a, normal), axis=2)


def _tangent(verts: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges in an orthonormal tangent basis, (F, 2, 2) with edges as columns, and that basis, (F, 2, 3)."""
    a, b, c = (verts[faces[:, i]] for i in range(3))
    first = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    basis = np.stack((first, np.cross(normal, first)), axis=1)
    edges = np.stack((b - a, c - a), axis=2)
    return basis @ edges, basis


def _links(source: np.ndarray, target: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices of the main component, and triangles that join every other component to it."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    pairs = np.concatenate((faces[:, :2], faces[:, 1:]))
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(source), len(source)))
    _, component = connected_components(graph, directed=False)
    with_faces = np.zeros(len(source), bool)
    with_faces[faces.ravel()] = True
    sizes = np.bincount(component[with_faces])
    main = np.flatnonzero((component == sizes.argmax()) & with_faces)
    links = []
    for other in np.flatnonzero(sizes > 0):
        if other == sizes.argmax():
            continue
        members = np.flatnonzero((component == other) & with_faces)
        chosen = members[np.linspace(0, len(members) - 1, min(_LINKS, len(members))).round().astype(int)]
        _, near = cKDTree(source[main]).query(source[chosen], k=min(3, len(main)))
        near = main[np.atleast_2d(near)]
        links += [np.column_stack((chosen, near[:, 0], near[:, i])) for i in range(1, near.shape[1])]
    triangles = np.concatenate(links) if links else np.zeros((0, 3), np.int64)
    good = (_area(source, triangles) > 1e-12) & (_area(target, triangles) > 1e-12)
    return main, triangles[good]
