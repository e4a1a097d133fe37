"""Discrete Laplace-Beltrami operator of any triangle soup that shares vertices.

The operator is the cotangent Laplacian of the intrinsic Delaunay triangulation of the tufted double cover (Sharp and
Crane 2020, "A Laplacian for Nonmanifold Triangle Meshes"), from the package `robust_laplacian`. On a good Delaunay mesh
it is the plain cotangent Laplacian; with slivers, obtuse or zero-area triangles, borders and non-manifold edges it
stays symmetric positive semi-definite with non-positive off-diagonal entries.

libigl's `intrinsic_delaunay_cotmatrix` is the same matrix where a mesh is manifold (to 1e-15), but not where it is not:
three faces on one edge gave it a positive off-diagonal entry of 3.8.
"""

import numpy as np
import scipy.sparse

from nbavatar.errors import DataError, require

__all__ = ["robust_laplacian"]

# Intrinsic mollification: the least amount, in mean edge lengths, by which the triangle inequality must hold.
_MOLLIFY = 1e-5


def robust_laplacian(verts: np.ndarray, faces: np.ndarray) -> tuple[scipy.sparse.csc_matrix, np.ndarray]:
    """Robust Laplacian and lumped mass of a mesh.

    Args:
        verts: positions [m], shape (V, 3). Every vertex must be used by a face.
        faces: vertex ids, shape (F, 3), int64; faces that name a vertex twice are ignored, but count as use.

    Returns:
        The stiffness matrix (V, V), symmetric, positive semi-definite, rows summing to 0 [dimensionless], and the
        lumped mass, positive, shape (V,) [m^2], summing to the area of the (mollified) surface.

    Raises:
        DataError: no face with three different vertices, a vertex without a face, positions that are not finite or all
            in one place.
    """
    package = require("robust_laplacian", "robust_laplacian", "spectral coordinates")
    faces = np.asarray(faces, np.int64)
    repeated = (faces[:, 0] == faces[:, 1]) | (faces[:, 1] == faces[:, 2]) | (faces[:, 2] == faces[:, 0])
    verts = np.asarray(verts, np.float64)
    size = _checked_size(verts, faces, ~repeated)
    # The operator does not depend on place and size; the package's own arithmetic does, far out and at extreme sizes.
    unit = np.ascontiguousarray((verts - verts.mean(axis=0)) / size)
    stiffness, mass = package.mesh_laplacian(unit, np.ascontiguousarray(faces[~repeated]), mollify_factor=_MOLLIFY)
    return scipy.sparse.csc_matrix((stiffness + stiffness.T) * 0.5), mass.diagonal() * size**2


def _checked_size(verts: np.ndarray, faces: np.ndarray, proper: np.ndarray) -> float:
    """Largest extent of a mesh along an axis [m]; refuses what has no Laplacian."""
    where = "Laplacian"
    if not np.isfinite(verts).all():
        row = int(np.argwhere(~np.isfinite(verts).all(axis=1))[0, 0])
        raise DataError.of(where, "verts", expected="finite numbers", found=f"NaN or infinity at vertex {row}")
    if not proper.any():
        raise DataError.of(where, "faces", expected="a face with three different vertices", found="none")
    used = np.zeros(len(verts), bool)
    used[faces.ravel()] = True
    if not used.all():
        raise DataError.of(where, "verts", expected="every vertex used by a face",
                           found=f"vertex {int(np.argmin(used))} is not")  # fmt: skip
    size = float(np.ptp(verts, axis=0).max())
    if not size > 0:
        raise DataError.of(where, "verts", expected="a surface", found="all vertices in one place")
    return size
