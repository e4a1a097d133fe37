"""Cells of the distance queries of deforming meshes, float64, against every triangle in 40 digits."""

from typing import Any

import numpy as np

from nbavatar.mesh.bvh import DeformingMesh
from nbavatar.studies.extremes.cells import DOUBLE, Level, Limit, Sample, Tolerance, cell
from nbavatar.studies.extremes.compare import precise, relative
from nbavatar.studies.extremes.frames import patch

__all__: list[str] = []

_ORACLE = "all triangles, 40 digits (mpmath)"


def _tetrahedron() -> tuple[np.ndarray, np.ndarray]:
    verts = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    return verts, np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])


def _nearest(p: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> object:
    """Squared distance of a point to a triangle: the inner point if it is inside, else the nearest edge; mpmath."""
    best = min(_to_segment(p, a, b), _to_segment(p, b, c), _to_segment(p, c, a))  # type: ignore[type-var]
    e, f, g = b - a, c - a, p - a
    d11, d12, d22, g1, g2 = e @ e, e @ f, f @ f, g @ e, g @ f
    det = d11 * d22 - d12 * d12
    if det == 0:
        return best
    v, w = (d22 * g1 - d12 * g2) / det, (d11 * g2 - d12 * g1) / det
    if v < 0 or w < 0 or v + w > 1:
        return best
    rest = g - v * e - w * f
    return min(best, rest @ rest)  # type: ignore[type-var]


def _to_segment(p: np.ndarray, a: np.ndarray, b: np.ndarray) -> object:
    edge, g = b - a, p - a
    square = edge @ edge
    t = min(max((g @ edge) / square, 0), 1) if square != 0 else 0
    rest = g - t * edge
    return rest @ rest


def _closest(verts: np.ndarray, faces: np.ndarray, points: np.ndarray, size: float = 1.0) -> Sample:
    """Error of distances, and of the surface points that the weights stand for, in units of the mesh."""
    import mpmath

    found, face, weight = DeformingMesh(verts, faces).closest(points, np.inf)
    at = np.einsum("pc,pci->pi", weight, verts[faces[face]])
    with mpmath.workdps(40):
        corners, queries = precise(verts), precise(points)
        true = np.array(
            [float(mpmath.sqrt(min(_nearest(p, *corners[list(f)]) for f in faces))) for p in queries]  # type: ignore[type-var]
        )
    gap = np.linalg.norm(at - points, axis=1)
    sound = (weight >= -1e-12).all() and np.allclose(weight.sum(1), 1.0)
    return Sample(max(relative(found, true, least=size), relative(gap, true, least=size)) if sound else float("nan"))


def _queries(count: int = 12, size: float = 1.0) -> np.ndarray:
    return np.random.default_rng(2).normal(size=(count, 3)) * 0.6 * size


def _cell(kernel: str, condition: str, axis: str, levels: tuple[Level, ...], **more: Any):
    more.setdefault("oracle", _ORACLE)
    more.setdefault("exact", DOUBLE)
    return cell("distance", kernel, condition, axis, levels, unit="of the mesh", **more)


@_cell("closest", "size of the mesh", "width [m]", (1.0, 1e-6, 1e-30, 1e6, 1e30))
def _size(size: float) -> Sample:
    verts, faces = patch()
    return _closest(verts * size, faces, _queries(size=size), size)


@_cell("closest", "mesh far from the origin", "offset / width [1]", (0.0, 1e2, 1e4, 1e6))
def _offset(offset: float) -> Sample:
    verts, faces = patch()
    place = offset * np.array([1.0, -0.7, 0.4])
    return _closest(verts + place, faces, _queries() + place)


@_cell("closest", "distance of the points", "distance / width [1]", (1.0, 1e-3, 1e-8, 1e-12, 1e3, 1e6))
def _far(distance: float) -> Sample:
    verts, faces = patch()
    points = _queries()
    if distance < 1:
        points = verts[faces].mean(1)[:12] + distance * _queries()
    else:
        points = points / np.linalg.norm(points, axis=1, keepdims=True) * distance
    return _closest(verts, faces, points, max(1.0, distance))


@_cell(
    "closest",
    "slivers",
    "height / edge [1]",
    (1.0, 1e-2, 1e-4, 1e-8, 1e-12, 0.0),
    limits=(
        Limit(lambda height: 0 < float(height) <= 1e-8, 1e-6, 1.0, "inner point of a needle from cancelling areas"),
    ),
)
def _slivers(height: float) -> Sample:
    verts = np.array([[0.0, 0, 0], [1, 0, 0], [0.4, height, 0], [0.45, -height, 1e-3]])
    points = np.concatenate(
        (_queries(), [[0.4, 0.1, 0], [0.5, 0, 0.01], [0.2, height * 0.2, 0.02], [0.39, height * 0.5, 0]])
    )
    return _closest(verts, np.array([[0, 1, 2], [1, 0, 3]]), points)


@_cell("closest", "points", "case", ("on a vertex", "on an edge", "on a face", "a triangle that is a point"))
def _on(case: str) -> Sample:
    verts, faces = patch()
    if case == "on a vertex":
        points = verts[:5]
    elif case == "on an edge":
        points = 0.5 * (verts[faces[:, 0]] + verts[faces[:, 1]])
    elif case == "on a face":
        points = verts[faces].mean(1)
    else:
        verts = np.concatenate((verts, [[0.1, 0.2, 3.0]] * 3))
        faces, points = np.concatenate((faces, [[16, 17, 18]])), np.array([[0.1, 0.2, 2.9], [0, 0, 5.0]])
    return _closest(verts, faces, points)


_INSIDE = "sides of the planes of a tetrahedron"


@_cell(
    "inside",
    "distance to the surface",
    "distance / width [1]",
    (0.1, 1e-3, 1e-6, 1e-9, 1e-12, 1e-15),
    oracle=_INSIDE,
    exact=Tolerance(0.0, 0.0),
    limits=(Limit(lambda gap: float(gap) <= 1e-15, 1.0, 1.0, "within rounding of the surface"),),
)
def _inside(gap: float) -> Sample:
    return _sides(gap, 0.0, 1.0)


@_cell(
    "inside",
    "mesh far from the origin",
    "offset / width [1]",
    (0.0, 1e2, 1e4, 1e6),
    oracle=_INSIDE,
    exact=Tolerance(0.0, 0.0),
)
def _inside_offset(offset: float) -> Sample:
    return _sides(1e-6, offset, 1.0)


@_cell(
    "inside", "size of the mesh", "width [m]", (1.0, 1e-6, 1e-20, 1e6, 1e20), oracle=_INSIDE, exact=Tolerance(0.0, 0.0)
)
def _inside_size(size: float) -> Sample:
    return _sides(1e-6, 0.0, size)


def _sides(gap: float, offset: float, size: float) -> Sample:
    """Share of points on the wrong side, just inside and just outside every face: by `inside` and by `signed`."""
    verts, faces = _tetrahedron()
    weights = np.random.default_rng(3).dirichlet([2.0, 2, 2], 10)
    on = np.einsum("pc,fci->fpi", weights, verts[faces]).reshape(-1, 3)
    normal = np.cross(verts[faces[:, 1]] - verts[faces[:, 0]], verts[faces[:, 2]] - verts[faces[:, 0]])
    normal = np.repeat(normal / np.linalg.norm(normal, axis=1, keepdims=True), 10, axis=0)
    points = np.concatenate((on - gap * normal, on + gap * normal))
    place = offset * np.array([1.0, -0.7, 0.4])
    mesh = DeformingMesh(verts * size + place, faces)
    points = np.ascontiguousarray(points * size + place)
    truth = np.arange(len(points)) < len(on)
    by_sign = mesh.signed(points, np.inf)[0] < 0
    return Sample(float(max((mesh.inside(points) != truth).mean(), (by_sign != truth).mean())))


@_cell(
    "inside",
    "winding number of an open mesh",
    "height over the hole / width [1]",
    (0.5, 1e-3, 1e-9, 0.0),
    oracle="solid angles of the closed fan, 40 digits",
    exact=Tolerance(1e-9, 1.0),
    limits=(
        Limit(lambda gap: gap == 0.0, 1.5, 1.0, "on the lid that closes the hole there is no side"),
        Limit(lambda gap: float(gap) <= 1e-9, 1e-7, 1.0, "solid angles close to a half turn"),
    ),
)
def _winding(gap: float) -> Sample:
    """A tetrahedron without its last face; points just under the missing face have winding number 1."""
    verts, faces = _tetrahedron()
    lid = verts[faces[3]]
    normal = np.cross(lid[1] - lid[0], lid[2] - lid[0])
    point = lid.mean(0) * 0.9 + lid[0] * 0.1 - gap * normal / np.linalg.norm(normal)
    found = DeformingMesh(verts, faces[:3]).winding(np.repeat(point[None], 6, 0))
    return Sample(relative(found, np.ones(6)))


@_cell(
    "closest",
    "no surface",
    "case",
    ("radius 0", "no query", "nothing within the radius"),
    oracle="distance inf, face -1",
)
def _none(case: str) -> Sample:
    verts, faces = patch()
    points = np.array([[0.0, 0.0, 5.0]]) if case != "no query" else np.zeros((0, 3))
    distance, face, _ = DeformingMesh(verts, faces).closest(points, 0.0 if case == "radius 0" else 0.1)
    return Sample(0.0 if np.isinf(distance).all() and (face == -1).all() else float("nan"))
