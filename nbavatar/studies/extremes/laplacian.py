"""Cells of the Laplacians and the spectral coordinates, float64.

A function that is linear on a flat patch has the patch's area as its Dirichlet energy, however bad the triangles are:
an oracle without any discretisation error.
"""

from typing import Any

import numpy as np
import torch

from nbavatar.mesh.frames import face_frames
from nbavatar.mesh.laplacian import robust_laplacian
from nbavatar.mesh.spectral import spectral_coordinates
from nbavatar.mesh.texels import texel_values
from nbavatar.studies.extremes.cells import Level, Limit, Sample, Tolerance, cell
from nbavatar.studies.extremes.compare import relative
from nbavatar.studies.extremes.frames import patch

__all__: list[str] = []

_EXACT = Tolerance(1e-9, 1.0)


def _flat(shear: float = 0.0) -> tuple[np.ndarray, np.ndarray, float]:
    """A flat grid 1 m wide, sheared; vertices, faces, area."""
    _, faces = patch()
    x, y = np.meshgrid(np.linspace(0, 1, 4), np.linspace(0, 1, 4), indexing="ij")
    verts = np.stack((x + shear * y, y, np.zeros_like(x)), -1).reshape(-1, 3)
    return verts, faces, 1.0


def _energy(verts: np.ndarray, faces: np.ndarray, area: float) -> Sample:
    """Error of the energies of x and y over a flat patch, of the mass, and of the properties of the operator."""
    stiffness, mass = robust_laplacian(verts, faces)
    size = np.ptp(verts, axis=0).max()
    x, y = verts[:, 0] / size, verts[:, 1] / size
    energies = [x @ (stiffness @ x), y @ (stiffness @ y), x @ (stiffness @ y)]
    share = area / size**2
    matrix = stiffness.toarray()
    largest = np.abs(matrix).max()
    off = matrix - np.diag(np.diag(matrix))
    wrong = max(
        float(np.abs(matrix.sum(1)).max()) / largest,
        float(np.abs(matrix - matrix.T).max()) / largest,
        max(0.0, float(off.max())) / largest,
        max(0.0, -float(np.linalg.eigvalsh(matrix)[0])) / largest,
        0.0 if (mass > 0).all() else float("nan"),
    )
    return Sample(max(relative(energies, [share, share, 0.0]), relative(mass.sum(), area), wrong))


def _robust(condition: str, axis: str, levels: tuple[Level, ...], **more: Any):
    more.setdefault("oracle", "energy of linear functions = area; symmetric, semi-definite, no negative weight")
    more.setdefault("exact", _EXACT)
    return cell("laplacian", "robust_laplacian", condition, axis, levels, **more)


# The mollification moves every edge by 1e-5 of the mean edge where a triangle is that thin.
_THIN = "thin triangles are thickened by 1e-5 of the mean edge"


@_robust(
    "obtuse slivers within a sound rim",
    "height / width [1]",
    (1.0, 0.1, 1e-2, 1e-3, 1e-4, 1e-6, 1e-12, 0.0),
    limits=(Limit(lambda height: float(height) <= 1e-3, 1e-3, 1.0, _THIN),),
)
def _slivers(height: float) -> Sample:
    """The inner vertices of a square, pressed towards a line."""
    verts, faces, area = _flat()
    inner = (np.abs(verts[:, :2] - 0.5) < 0.4).all(1)
    verts[inner, 1] = 0.5 + (verts[inner, 1] - 0.5) * height
    return _energy(verts, faces, area)


@_robust(
    "obtuse corners opposite the rim",
    "largest angle [deg]",
    (90.0, 100.0, 120.0, 150.0, 170.0),
    limits=(Limit(lambda angle: float(angle) > 120, 1.0, 1.0, "beyond an obtuse rim lies the surface's own back"),),
)
def _obtuse(angle: float) -> Sample:
    verts, faces, area = _flat(shear=-float(np.tan(np.radians(angle - 90.0))))
    return _energy(verts, faces, area)


@_robust(
    "one needle in a sound mesh",
    "height / edge [1]",
    (0.5, 1e-2, 1e-4, 1e-6, 1e-12, 0.0),
    limits=(Limit(lambda height: float(height) <= 1e-4, 1e-3, 1.0, _THIN),),
)
def _needle(height: float) -> Sample:
    """An edge of the rim gets a vertex at a small distance outside."""
    verts, faces, area = _flat()
    edge = 1 / 3
    verts = np.concatenate((verts, [[edge / 2, -height * edge, 0.0]]))
    faces = np.concatenate((faces, [[4, 0, len(verts) - 1]]))
    return _energy(verts, faces, area + 0.5 * height * edge**2)


@_robust("size of the mesh", "width [m]", (1.0, 1e-3, 1e-6, 1e-100, 1e3, 1e6, 1e100), quick=(1.0, 1e-100))
def _size(size: float) -> Sample:
    verts, faces, area = _flat()
    return _energy(verts * size, faces, area * size**2)


@_robust(
    "mesh far from the origin",
    "offset / width [1]",
    (0.0, 1e2, 1e4, 1e6),
    limits=(Limit(lambda offset: float(offset) >= 1e6, 1e-8, 1.0, "the positions themselves are rounded"),),
)
def _offset(offset: float) -> Sample:
    verts, faces, area = _flat()
    moved = verts + offset * np.array([1.0, -0.7, 0.4])
    return Sample(
        max(
            _energy(verts, faces, area).forward,
            relative(robust_laplacian(moved, faces)[0].toarray(), robust_laplacian(verts, faces)[0].toarray()),
        )
    )


@_robust(
    "connectivity",
    "case",
    (
        "pages of a book",
        "doubled faces",
        "faces in all directions",
        "a vertex of two fans",
        "a face that names a vertex twice",
    ),
    quick=("pages of a book",),
)
def _connectivity(case: str) -> Sample:
    verts, faces, area = _flat()
    if case == "pages of a book":
        # Three flat grids that share the edge x = 0: a function of y has their whole area as its energy.
        pages, maps = [verts], [np.arange(16)]
        for turn in (2.0, 4.0):
            page = verts * [np.cos(turn), 1, 1] + verts[:, :1] * [0, 0, np.sin(turn)]
            maps.append(np.where(np.arange(16) < 4, np.arange(16), np.arange(16) + 12 * len(pages)))
            pages.append(page[4:])
        verts, faces = np.concatenate(pages), np.concatenate([ids[faces] for ids in maps])
        stiffness, mass = robust_laplacian(verts, faces)
        y = verts[:, 1]
        return Sample(max(relative(y @ (stiffness @ y), 3 * area), relative(mass.sum(), 3 * area)))
    if case == "doubled faces":
        return _doubled(verts, faces, area)
    if case == "faces in all directions":
        faces = np.where((np.arange(len(faces)) % 2 == 0)[:, None], faces, faces[:, ::-1])
    elif case == "a vertex of two fans":
        other = np.where(np.arange(16) == 0, 0, np.arange(16) + 15)
        verts, faces, area = np.concatenate((verts, -verts[1:])), np.concatenate((faces, other[faces])), 2 * area
        stiffness, mass = robust_laplacian(verts, faces)
        x = verts[:, 0]
        return Sample(max(relative(x @ (stiffness @ x), area), relative(mass.sum(), area)))
    else:
        faces = np.concatenate((faces, [[3, 3, 7], [0, 0, 0]]))
    return _energy(verts, faces, area)


def _doubled(verts: np.ndarray, faces: np.ndarray, area: float) -> Sample:
    """Every face twice: stiffness and mass double."""
    once, mass = robust_laplacian(verts, faces)
    twice, double = robust_laplacian(verts, np.concatenate((faces, faces)))
    return Sample(max(relative(twice.toarray(), 2 * once.toarray()), relative(double, 2 * mass)))


@_robust(
    "what has no Laplacian",
    "case",
    ("NaN vertex", "no face", "unused vertex", "all in one place"),
    quick=("NaN vertex", "all in one place"),
    oracle="a one-line refusal",
    refuses=lambda case: True,
)
def _refused(case: str) -> Sample:
    verts, faces, _ = _flat()
    if case == "NaN vertex":
        verts[3] = np.nan
    elif case == "no face":
        faces = faces[:0]
    elif case == "unused vertex":
        verts = np.concatenate((verts, [[9.0, 9, 9]]))
    else:
        verts = verts * 0 + 1.0
    robust_laplacian(verts, faces)
    return Sample(float("nan"))


def _spectral(condition: str, axis: str, levels: tuple[Level, ...], **more: Any):
    more.setdefault("exact", Tolerance(1e-7, 1.0))
    return cell("laplacian", "spectral_coordinates", condition, axis, levels, **more)


_INVARIANCE = "the mesh of unit size at the origin; residual of the eigenproblem"


def _same(verts: np.ndarray, faces: np.ndarray, size: float) -> Sample:
    """Eigenvalues times size^2 and coordinates against those of the plain patch; the residual."""
    plain = spectral_coordinates(patch()[0], faces, 5)
    found = spectral_coordinates(verts, faces, 5)
    return Sample(
        max(
            relative(found.eigenvalues * size**2, plain.eigenvalues),
            relative(found.coords, plain.coords),
            float(found.residual.max()),
        )
    )


@_spectral("size of the mesh", "width [m]", (1.0, 1e-3, 1e-6, 1e-50, 1e6, 1e50), oracle=_INVARIANCE, quick=(1.0, 1e-50))
def _spectral_size(size: float) -> Sample:
    verts, faces = patch()
    return _same(verts * size, faces, size)


@_spectral("mesh far from the origin", "offset / width [1]", (0.0, 1e2, 1e4, 1e6), oracle=_INVARIANCE)
def _spectral_offset(offset: float) -> Sample:
    verts, faces = patch()
    return _same(verts + offset * np.array([1.0, -0.7, 0.4]), faces, 1.0)


@_spectral(
    "needle",
    "height / edge of one face [1]",
    (0.5, 1e-2, 1e-4, 1e-6, 1e-12, 0.0),
    oracle="the eigenproblem",
    limits=(Limit(lambda height: float(height) <= 1e-4, 1e-3, 1.0, "weights from 1 to 1e5 in one matrix"),),
)
def _spectral_needle(height: float) -> Sample:
    verts, faces = patch()
    a, b = verts[0], verts[4]
    verts = np.concatenate((verts, [(a + b) / 2 - [0, height * np.linalg.norm(b - a), 0]]))
    found = spectral_coordinates(verts, np.concatenate((faces, [[4, 0, 16]])), 5)
    bounded = np.isfinite(found.coords).all() and np.abs(found.coords).max() <= 1 + 1e-12
    return Sample(float(found.residual.max()) if bounded else float("nan"))


@_spectral("more modes than vertices", "modes [1]", (5.0, 15.0, 16.0, 40.0), oracle="no such mode: value inf, column 0")
def _modes(modes: float) -> Sample:
    verts, faces = patch()
    found = spectral_coordinates(verts, faces, int(modes))
    missing = slice(15, None)
    right = np.isinf(found.eigenvalues[0, missing]).all() and not found.coords[:, missing].any()
    return Sample(float(found.residual.max()) if right and np.isfinite(found.coords).all() else float("nan"))


@cell(
    "laplacian",
    "texel_values",
    "sliver under the texels",
    "height / edge of one face [1]",
    (1.0, 1e-2, 1e-4, 1e-8, 0.0),
    oracle="the plane through the corners, clipped to twice their range",
    exact=Tolerance(1e-5, 1.0),
    limits=(Limit(lambda ratio: float(ratio) <= 1e-4, 2.0, 1.0, "the continuation over a sliver is clipped"),),
)
def _texels(ratio: float) -> Sample:
    """A function linear in space on one triangle; a billboard that covers it."""
    verts = np.array([[0.0, 0, 0], [1, 0, 0], [0.4, ratio, 0]])
    values = verts @ [[1.0, 0.3], [-0.5, 0.9], [0, 0]]
    found = texel_values(values, verts, np.array([[0, 1, 2]]), np.full((1, 2), 0.3), 5)
    low, high = values.min(0), values.max(0)
    if not (
        np.isfinite(found).all() and (found >= 2 * low - high - 1e-6).all() and (found <= 2 * high - low + 1e-6).all()
    ):
        return Sample(float("nan"))
    frames = face_frames(torch.from_numpy(verts), torch.tensor([[0, 1, 2]]))
    grid = np.linspace(-0.3, 0.3, 5)
    u, v = np.meshgrid(grid, grid)
    local = np.stack((u, v, 0 * u), -1) * frames.k.numpy()[0]
    points = local @ frames.R.numpy()[0].T + frames.T.numpy()[0]
    true = np.clip(points @ [[1.0, 0.3], [-0.5, 0.9], [0, 0]], 2 * low - high, 2 * high - low)
    return Sample(relative(found[0], true))
