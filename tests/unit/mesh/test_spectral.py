"""Spectral coordinates against closed forms, a 1D solver and a dense solver, and their invariances."""

import igl
import numpy as np
import pytest
import scipy.linalg
import torch

from nbavatar.mesh.frames import face_frames
from nbavatar.mesh.laplacian import robust_laplacian
from nbavatar.mesh.spectral import spectral_coordinates
from nbavatar.mesh.texels import texel_values
from tests.unit.mesh.shapes import grid, sphere, torus


def _bump(verts: np.ndarray) -> np.ndarray:
    """Breaks every symmetry, smoothly."""
    x, y, z = verts.T
    return (
        verts
        * [1.0, 1.25, 1.6]
        * (1 + 0.25 * np.sin(1.3 * x + 0.4) * np.cos(0.9 * y - 0.3) + 0.2 * z * x + 0.15 * y)[:, None]
    )


def _rotation(seed: int) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.linalg.det(q)


def test_sphere_has_l_times_l_plus_one_with_multiplicity():
    radius = 0.1
    result = spectral_coordinates(*sphere(4, radius), modes=24)
    # 2 562 vertices: the second-order error of linear elements is 0.1 % at l = 1 and grows with l(l+1).
    exact = np.repeat([2.0, 6, 12, 20], [3, 5, 7, 9]) / radius**2
    np.testing.assert_allclose(result.eigenvalues[0], exact, rtol=8e-3)
    # l = 1, 2 are irreducible under the icosahedral group: exactly degenerate, and reported as such.
    assert result.group[0, :3].tolist() == [0, 0, 0] and len(set(result.group[0, 3:8].tolist())) == 1
    # The fixed basis of l = 1 follows the axes.
    verts, _ = sphere(4, radius)
    np.testing.assert_allclose(result.coords[:, :3], verts / radius, atol=2e-3)


def test_rectangle_has_the_neumann_spectrum():
    width, height = 1.0, 0.73
    result = spectral_coordinates(*grid(41, 31, width, height), modes=6)
    exact = np.sort([np.pi**2 * ((m / width) ** 2 + (n / height) ** 2) for m in range(5) for n in range(5)])[1:7]
    np.testing.assert_allclose(result.eigenvalues[0], exact, rtol=5e-3)
    first = result.coords[:, 0].reshape(41, 31)
    np.testing.assert_allclose(np.abs(first[:, 0]), np.abs(np.cos(np.pi * np.linspace(0, 1, 41))), atol=5e-3)


def test_torus_agrees_with_its_one_dimensional_equation():
    """phi = cos(m a) f(b) separates: (w f')' / (minor^2 w) - m^2 f / w^2 = -lambda f with w = R + r cos b."""
    major, minor, n = 1.0, 0.4, 400
    b = 2 * np.pi * np.arange(n) / n
    step = 2 * np.pi / n
    w, half = major + minor * np.cos(b), major + minor * np.cos(b + step / 2)
    values = []
    for m in range(5):
        matrix = np.zeros((n, n))
        i = np.arange(n)
        matrix[i, i] = (half + np.roll(half, 1)) / step**2 / minor**2 + m**2 / w
        matrix[i, (i + 1) % n] = matrix[(i + 1) % n, i] = -half / step**2 / minor**2
        lowest = scipy.linalg.eigh(matrix, np.diag(w), eigvals_only=True, subset_by_index=(0, 3))
        values += list(lowest) * (1 if m == 0 else 2)
    exact = np.sort(values)[1:9]
    result = spectral_coordinates(*torus(128, 56, major, minor), modes=8)
    np.testing.assert_allclose(result.eigenvalues[0], exact, rtol=6e-3)


def test_residual_and_orthonormality():
    verts, faces = sphere(3)
    verts = _bump(verts)
    result = spectral_coordinates(verts, faces, modes=24)
    assert result.residual.max() < 1e-8
    stiffness, mass = robust_laplacian(verts, faces)
    phi = result.coords / np.sqrt(mass @ result.coords**2)
    np.testing.assert_allclose(phi.T @ (mass[:, None] * phi), np.eye(24), atol=1e-8)
    np.testing.assert_allclose(mass @ phi, 0, atol=1e-10)
    # Independent residual, with matrices assembled in the original units.
    gap = stiffness @ phi - mass[:, None] * phi * result.eigenvalues[0]
    assert np.linalg.norm(gap, axis=0).max() < 1e-8 * np.linalg.norm(stiffness @ phi, axis=0).min()
    np.testing.assert_allclose(np.abs(result.coords).max(axis=0), 1.0)


def test_agrees_with_a_dense_solver_on_libigls_matrices():
    verts, faces = sphere(3)
    verts = verts * [1.0, 1.2, 1.45]
    stiffness = -igl.cotmatrix(verts, faces).toarray()
    mass = igl.massmatrix(verts, faces, igl.MASSMATRIX_TYPE_BARYCENTRIC).diagonal()
    values = scipy.linalg.eigh(stiffness, np.diag(mass), eigvals_only=True, subset_by_index=(1, 6))
    result = spectral_coordinates(verts, faces, modes=6)
    # Not the same triangulation (ours is intrinsic Delaunay), hence not the same digits.
    np.testing.assert_allclose(result.eigenvalues[0], values, rtol=5e-3)


@pytest.mark.parametrize("symmetric", [False, True])
def test_invariant_under_rigid_motion_and_scale(symmetric):
    verts, faces = sphere(3)
    # The symmetric shape is mirror-symmetric about x = 0, like a face; no symmetry beyond that.
    x, y, z = verts.T
    verts = verts * (1 + 0.3 * y + 0.2 * z * y + 0.2 * z**3 + 0.35 * x**2)[:, None] if symmetric else _bump(verts)
    result = spectral_coordinates(verts, faces, modes=12)
    moved = spectral_coordinates(0.1 * verts @ _rotation(4).T + [3.0, -2, 5], faces, modes=12)
    assert len(np.unique(result.group)) == 12
    np.testing.assert_allclose(moved.eigenvalues, result.eigenvalues / 0.01, rtol=1e-7)
    np.testing.assert_allclose(moved.coords, result.coords, atol=1e-5)


@pytest.mark.parametrize("shape", ["bumpy", "sphere"])
def test_invariant_under_renumbering(shape):
    verts, faces = sphere(3)
    verts = _bump(verts) if shape == "bumpy" else verts
    result = spectral_coordinates(verts, faces, modes=8)
    rng = np.random.default_rng(1)
    order = rng.permutation(len(verts))
    back = np.argsort(order)
    shuffled = np.stack([np.roll(f, rng.integers(3)) for f in back[faces][rng.permutation(len(faces))]])
    again = spectral_coordinates(verts[order], shuffled, modes=8)
    np.testing.assert_allclose(again.coords[back], result.coords, atol=1e-6)


def test_two_runs_give_the_same_bytes():
    verts, faces = sphere(3)
    first, second = (spectral_coordinates(_bump(verts), faces, modes=6) for _ in range(2))
    assert first.coords.tobytes() == second.coords.tobytes()


def test_components_are_solved_alone_and_unreferenced_vertices_are_zero():
    verts, faces = sphere(2)
    bumpy = _bump(verts)
    both = spectral_coordinates(
        np.concatenate((bumpy, [[9.0, 9, 9]], verts * [1, 2, 3.0] + 4)), np.concatenate((faces, faces + 163)), modes=5
    )
    alone = spectral_coordinates(bumpy, faces, modes=5)
    np.testing.assert_allclose(both.coords[:162], alone.coords, atol=1e-9)
    assert (both.coords[162] == 0).all() and both.component[162] == -1
    assert both.eigenvalues.shape == (2, 5)


def test_small_components_have_fewer_modes():
    verts = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]])
    result = spectral_coordinates(verts, np.array([[0, 1, 2]]), modes=5)
    assert np.isinf(result.eigenvalues[0, 2:]).all() and (result.coords[:, 2:] == 0).all()
    assert np.isfinite(result.eigenvalues[0, :2]).all()


def test_seam_of_coincident_border_vertices_is_closed():
    verts, faces = sphere(2)
    verts = _bump(verts)
    cut_faces = faces.copy()
    right = verts[faces].mean(1)[:, 0] > 0
    copies = np.arange(len(verts)) + len(verts)
    cut_faces[right] = copies[faces[right]]
    result = spectral_coordinates(np.concatenate((verts, verts)), cut_faces, modes=4)
    np.testing.assert_allclose(
        result.coords[cut_faces], spectral_coordinates(verts, faces, modes=4).coords[faces], atol=1e-8
    )


@pytest.mark.parametrize(
    "defect", ["sliver", "zero_area", "collapsed_edge", "duplicate_face", "fin", "repeated_vertex"]
)
def test_bad_triangles_change_little(defect):
    """A mesh with one defect has nearly the coordinates of the clean one, with a residual as small."""
    verts, faces = sphere(3)
    verts = _bump(verts)
    clean = spectral_coordinates(verts, faces, modes=6)
    a, b, c = faces[100]
    extra = np.zeros((0, 3))
    if defect in ("sliver", "zero_area"):
        # Split a face at a point on (or next to) one of its edges.
        height = 1e-9 if defect == "sliver" else 0.0
        extra = (0.4 * verts[a] + 0.6 * verts[b] + height * verts[c])[None]
        n = len(verts)
        faces = np.concatenate((np.delete(faces, 100, 0), [[a, b, n], [b, c, n], [c, a, n]]))
    elif defect == "collapsed_edge":
        verts = verts.copy()
        verts[a] = verts[b]
    elif defect == "duplicate_face":
        faces = np.concatenate((faces, faces[100:101]))
    elif defect == "fin":
        extra = 1.02 * verts[[a]] + 0.01
        faces = np.concatenate((faces, [[a, b, len(verts)]]))
    else:
        faces = np.concatenate((faces, [[a, a, b]]))
    result = spectral_coordinates(np.concatenate((verts, extra)), faces, modes=6)
    assert np.isfinite(result.coords).all() and result.residual.max() < 1e-8
    np.testing.assert_allclose(result.eigenvalues, clean.eigenvalues, rtol=0.02)
    # Up to sign, and without the vertex that moved.
    others = np.delete(np.arange(len(clean.coords)), a)
    ours, theirs = result.coords[others], clean.coords[others]
    assert np.minimum(np.abs(ours - theirs).max(0), np.abs(ours + theirs).max(0)).max() < 0.12


def test_robust_laplacian_is_a_laplacian_on_obtuse_and_open_meshes():
    verts, faces = grid(13, 4, 1.0, 0.02)
    for mesh in (
        (verts, faces),
        (verts * [1, 40, 1] + np.random.default_rng(0).normal(size=verts.shape) * 0.02, faces),
    ):
        stiffness, mass = robust_laplacian(*mesh)
        dense = stiffness.toarray()
        np.testing.assert_allclose(dense, dense.T, atol=0)
        np.testing.assert_allclose(dense.sum(1), 0, atol=1e-9 * np.abs(dense).max())
        off = dense - np.diag(np.diag(dense))
        assert off.max() <= 1e-9 * np.abs(dense).max() and (mass > 0).all()
        assert np.linalg.eigvalsh(dense)[0] > -1e-9 * np.abs(dense).max()


def test_texels_of_a_linear_function_are_that_function():
    """A function linear in space is its own barycentric continuation: f = a . x + b at every texel's place."""
    verts, faces = sphere(2, 0.1)
    verts = verts * [1, 1.3, 0.8]
    direction = np.array([[1.0, -2.0], [0.5, 3.0], [2.0, 1.0]])
    coords = verts @ direction + 0.3
    half = np.random.default_rng(0).uniform(0.4, 0.7, (len(faces), 2))
    values = texel_values(coords, verts, faces, half, texels=5, bound=10.0)
    assert values.shape == (len(faces), 5, 5, 2) and values.dtype == np.float32
    T, R, k = (x.numpy() for x in face_frames(torch.from_numpy(verts), torch.from_numpy(faces)))
    for f, i, j in [(0, 0, 0), (17, 4, 1), (200, 2, 2), (319, 3, 0)]:
        u, v = -1 + j / 2, -1 + i / 2
        place = T[f] + k[f] * R[f] @ [u * half[f, 0], v * half[f, 1], 0]
        # Out of the triangle's plane the function would differ; inside it the two agree.
        np.testing.assert_allclose(values[f, i, j], place @ direction + 0.3, atol=1e-6)


def test_texels_on_slivers_and_points_are_finite_and_bounded():
    verts = np.array([[0, 0, 0], [1, 0, 0], [0.5, 1e-7, 0], [0, 1, 0], [0, 1, 0.0]])
    faces = np.array([[0, 1, 2], [0, 3, 4], [3, 3, 3], [0, 1, 3]])
    coords = np.array([[0.0], [1.0], [-1.0], [0.5], [0.5]])
    values = texel_values(coords, verts, faces, np.full((4, 2), 0.6), texels=4)
    assert np.isfinite(values).all() and np.abs(values).max() <= 3.0
    # The proper face is not touched by the guards: value x + y / 2, first corner at x = y = 1/3 - 0.6 k with k = 1.
    k = 1.0
    np.testing.assert_allclose(values[3, 0, 0, 0], (1 / 3 - 0.6 * k) + 0.5 * (1 / 3 - 0.6 * k), atol=1e-6)
