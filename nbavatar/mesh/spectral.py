"""Spectral coordinates: the lowest eigenfunctions of the Laplacian, as smooth coordinates on a surface.

They are the initial values of the neural textures (NBAvatar, supplement, "Spectral initialization"). Each connected
component is solved on its own; the constant eigenfunction is dropped. `nbavatar.mesh.texels` carries them over to
billboards.
"""

import dataclasses
import itertools
from typing import Any

import numpy as np

__all__ = ["SpectralCoordinates", "spectral_coordinates"]

# Neighbouring eigenvalues closer than this, relative, share a group whose basis is chosen by a fixed rule: within it
# the solver's own choice depends on rounding.
_DEGENERATE = 1e-6
# Below this, a normalised odd moment is called zero and the next sign rule decides.
_SIGN = 1e-4
# The same for a product of three moments, each of them small on a nearly round shape; rounding stays under 1e-12.
_HANDED = 1e-7
# Extra eigenvectors, so that a group cut by the last channel is seen whole.
_SPARE = 3


@dataclasses.dataclass(frozen=True)
class SpectralCoordinates:
    """Eigenfunctions of a mesh with V vertices and P components, K channels.

    Attributes:
        coords: one channel per mode, scaled within each component to a largest ``|value|`` of 1, (V, K) float64
            [dimensionless]; 0 at unreferenced vertices and in channels that a small component does not have.
        eigenvalues: (P, K) float64 [1/m^2], ascending; inf where a component has no such mode.
        component: component of each vertex, (V,) int64, -1 for unreferenced vertices.
        residual: ``|L phi - lambda M phi| / |lambda M phi|`` in the norm of M^-1, (P, K) float64 [dimensionless].
        group: near-degenerate group of each mode, (P, K) int64: equal numbers mean eigenvalues that are too close to
            tell their functions apart.
    """

    coords: np.ndarray
    eigenvalues: np.ndarray
    component: np.ndarray
    residual: np.ndarray
    group: np.ndarray


def spectral_coordinates(verts: np.ndarray, faces: np.ndarray, modes: int) -> SpectralCoordinates:
    """Solves L phi = lambda M phi for the lowest non-constant modes of every component.

    L is the robust cotangent Laplacian, M the lumped mass. The result does not depend on rigid motion, on the numbering
    of vertices and faces, or on the run. Signs follow invariant odd moments: the mean cube of the function; where that
    vanishes (functions antisymmetric on a symmetric shape), the handedness of the function's moments in space. Where
    eigenvalues coincide (sphere, disc), the basis of the group follows the coordinate axes of `verts`, in order, and so
    does not turn with the mesh; `group` names such modes. Coincident border vertices (seams) are welded.

    Args:
        verts: rest positions [m], shape (V, 3), finite.
        faces: vertex ids, shape (F, 3).
        modes: number K of channels.

    Returns:
        `SpectralCoordinates`.
    """
    from nbavatar.mesh.topology import vertex_components

    verts, faces = np.asarray(verts, np.float64), np.asarray(faces, np.int64)
    welded = _weld_seams(verts, faces)
    solved_faces = welded[faces]
    component = vertex_components(solved_faces, len(verts))
    count = component.max(initial=-1) + 1
    coords = np.zeros((len(verts), modes))
    eigenvalues = np.full((count, modes), np.inf)
    residual = np.zeros((count, modes))
    group = np.tile(np.arange(modes), (count, 1))
    face_component = component[solved_faces[:, 0]]
    for p in range(count):
        ids = np.flatnonzero(component == p)
        local = np.zeros(len(verts), np.int64)
        local[ids] = np.arange(len(ids))
        solved = _solve_component(verts[ids], local[solved_faces[face_component == p]], modes)
        found = len(solved[0])
        eigenvalues[p, :found], residual[p, :found], group[p, :found] = solved[0], solved[2], solved[3]
        coords[ids, :found] = solved[1]
    return SpectralCoordinates(coords[welded], eigenvalues, component[welded], residual, group)


def _weld_seams(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """For every vertex the one that stands for it: border vertices at exactly the same place become one."""
    from nbavatar.mesh.topology import boundary_edges

    welded = np.arange(len(verts))
    border = np.unique(boundary_edges(faces))
    if len(border):
        _, first, inverse = np.unique(verts[border], axis=0, return_index=True, return_inverse=True)
        welded[border] = border[first[inverse.ravel()]]
    return welded


def _solve_component(
    verts: np.ndarray, faces: np.ndarray, modes: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Eigenvalues (k), coordinates (n, k), residuals (k), groups (k) of one component, k = min(modes, n - 1)."""
    import scipy.sparse

    from nbavatar.mesh.laplacian import robust_laplacian

    kept = min(modes, len(verts) - 1)
    centred = verts - verts.mean(axis=0)
    size = np.sqrt((centred**2).sum(axis=1).mean()) or 1.0
    centred = centred / size
    stiffness, mass = robust_laplacian(centred, faces)
    # A vertex of zero-area faces only has no mass of its own; a floor keeps the problem definite.
    mass = np.maximum(mass, 1e-12 * mass.mean())
    scale = 1.0 / np.sqrt(mass)
    symmetric = (scipy.sparse.diags(scale) @ stiffness @ scipy.sparse.diags(scale)).tocsc()
    values, vectors = _smallest(symmetric, min(kept + 1 + _SPARE, len(verts)))
    phi = scale[:, None] * vectors
    # Rounding leaves a trace of the constant in every mode; the mass-weighted mean takes it out.
    phi = phi[:, 1:] - (mass @ phi[:, 1:]) / mass.sum()
    values = values[1:]
    close = np.diff(values) <= _DEGENERATE * np.abs(values[1:])
    group = np.concatenate(([0], np.cumsum(~close)))[: len(values)]
    for g in np.unique(group[:kept]):
        members = np.flatnonzero(group == g)
        if len(members) > 1:
            phi[:, members] = _fixed_basis(phi[:, members], mass, centred)
        else:
            phi[:, members] *= _sign(phi[:, members[0]], mass, centred)
    phi, values, group = phi[:, :kept], values[:kept], group[:kept]
    gap = stiffness @ phi - mass[:, None] * phi * values
    weight = (1.0 / mass)[:, None]
    force = mass[:, None] * phi * values
    residual = np.sqrt((gap**2 * weight).sum(0) / np.maximum((force**2 * weight).sum(0), 1e-300))
    return values / size**2, phi / np.abs(phi).max(axis=0), residual, group


def _smallest(matrix: Any, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The `count` smallest eigenpairs of a sparse, symmetric, positive semi-definite matrix, ascending."""
    import scipy.linalg
    import scipy.sparse.linalg

    n = matrix.shape[0]
    if n <= max(128, 3 * count):
        values, vectors = scipy.linalg.eigh(matrix.toarray(), subset_by_index=(0, count - 1))
        return values, vectors
    # The shift lies just under 0, small against the first eigenvalue (about 1 in these units, where the surface has
    # unit size): the factorised matrix is positive definite.
    shift = -1e-2
    factor = scipy.sparse.linalg.splu(
        scipy.sparse.csc_matrix(matrix - shift * scipy.sparse.eye(n)),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    solve: Any = scipy.sparse.linalg.LinearOperator
    inverse = solve(matrix.shape, matvec=factor.solve, dtype=np.float64)
    values, vectors = scipy.sparse.linalg.eigsh(
        matrix, count, sigma=shift, OPinv=inverse, v0=np.sin(1.0 + np.arange(n)), tol=0
    )
    order = np.argsort(values)
    return values[order], vectors[:, order]


def _probes(points: np.ndarray) -> np.ndarray:
    """Polynomials of the position, in a fixed order, (n, 19)."""
    x, y, z = points.T
    cubic = [
        x * x * x,
        x * x * y,
        x * x * z,
        x * y * y,
        x * y * z,
        x * z * z,
        y * y * y,
        y * y * z,
        y * z * z,
        z * z * z,
    ]
    return np.stack([x, y, z, x * y, y * z, z * x, x * x, y * y, z * z, *cubic], axis=1)


def _fixed_basis(phi: np.ndarray, mass: np.ndarray, points: np.ndarray) -> np.ndarray:
    """An M-orthonormal basis of span(phi) that does not depend on the basis given.

    Gram-Schmidt over the projections of polynomials of the position, in order; those that the span hardly contains are
    left out.
    """
    probes = _probes(points)
    probes = probes / np.sqrt(mass @ probes**2)
    pieces = phi.T @ (mass[:, None] * probes)
    chosen: list[np.ndarray] = []
    for piece in [*pieces.T, *np.eye(phi.shape[1])]:
        for other in chosen:
            piece = piece - (piece @ other) * other
        norm = np.linalg.norm(piece)
        if norm > 1e-3:
            chosen.append(piece / norm)
        if len(chosen) == phi.shape[1]:
            break
    return phi @ np.stack(chosen, axis=1)


def _sign(phi: np.ndarray, mass: np.ndarray, points: np.ndarray) -> float:
    """+1 or -1, by the first odd moment that does not vanish."""
    cube = (mass @ phi**3) / (mass @ np.abs(phi) ** 3)
    if abs(cube) > _SIGN:
        return float(np.sign(cube))
    centre = points - (mass @ points) / mass.sum()
    size = np.sqrt(mass @ (centre**2).sum(1))
    norm = np.sqrt(mass @ phi**2)
    unit, f, r = mass / mass.sum(), phi / norm * np.sqrt(mass.sum()), centre / size * np.sqrt(mass.sum())
    radius = (r**2).sum(1)
    # Vectors that turn with the mesh, odd and even in phi: the handedness of one odd and two even ones is an odd number
    # that does not turn.
    odd = [(unit * weight) @ r for weight in (f, f * radius, f**3, f * radius**2)]
    even = [(unit * weight) @ r for weight in (f**2, radius, f**2 * radius, f**4, radius**2)]
    for vector in odd:
        for pair in itertools.combinations(even, 2):
            handed = np.linalg.det(np.stack((vector, *pair)))
            if abs(handed) > _HANDED:
                return float(np.sign(handed))
    probes = _probes(centre)
    moments = (mass * phi) @ probes / np.maximum(norm * np.sqrt(mass @ probes**2), 1e-300)
    large = np.flatnonzero(np.abs(moments) > _SIGN)
    return float(np.sign(moments[large[0]])) if len(large) else 1.0
