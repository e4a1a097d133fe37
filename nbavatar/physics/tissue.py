"""What the head is made of: stiffness of the soft tissue over the skull, and the surface operators of the solver.

Nobody has published the stiffness of the heads in question, so unless the user has data a stated heuristic is used:
tissue is a layer on a skull, softer the thicker it is. The skull is a proxy of two ellipsoids in the rest shape's own
axes (y up, z out of the face, as head models are): a cranium fitted to the skin above the eyes, and jaws inside the
lower face. It is an anatomical guess, made to be looked at (last row of the picture of `nbavatar deform --validate`)
and replaced.
"""

import dataclasses

import numpy as np

from nbavatar.mesh.laplacian import robust_laplacian
from nbavatar.mesh.topology import edges, unreferenced_vertices, vertex_components

__all__ = ["SoftSurface", "bed_stiffness", "soft_surface", "tissue_thickness"]

# Skin over the cranium, and over the jaw's front [m].
_SCALP = 0.005
_CHIN = 0.008
_THIN, _THICK = 0.003, 0.025


@dataclasses.dataclass(frozen=True)
class SoftSurface:
    """Operators of a head with V vertices that do not change over time.

    Attributes:
        faces: (F, 3) int64.
        edges: (E, 2) int64.
        area: lumped area of each vertex, (V,) [m^2]; a small positive number where it would be 0.
        ring: (V + 1,) int64, `ring_ids`, `ring_weights` [1/m^2]: rows of the Laplacian, positive off-diagonal weights.
        bed: stiffness of the tissue under the skin, (V,) [N/m^3].
    """

    faces: np.ndarray
    edges: np.ndarray
    area: np.ndarray
    ring: np.ndarray
    ring_ids: np.ndarray
    ring_weights: np.ndarray
    bed: np.ndarray


def soft_surface(rest: np.ndarray, faces: np.ndarray, bed: np.ndarray) -> SoftSurface:
    """Assembles the operators of a rest shape (V, 3) [m] with faces (F, 3) and bed stiffness (V,) [N/m^3]."""
    faces = np.asarray(faces, np.int64)
    used = np.setdiff1d(np.arange(len(rest)), unreferenced_vertices(faces, len(rest)))
    local = np.zeros(len(rest), np.int64)
    local[used] = np.arange(len(used))
    stiffness, mass = robust_laplacian(np.asarray(rest, np.float64)[used], local[faces])
    floor = 1e-3 * float(np.median(mass))
    mass = np.maximum(mass, floor)
    rows = stiffness.tocoo()
    off = (rows.row != rows.col) & (rows.data < 0)
    order = np.lexsort((rows.col[off], rows.row[off]))
    row, column, weight = (np.asarray(a)[off][order] for a in (rows.row, rows.col, np.negative(rows.data)))
    ring = np.zeros(len(rest) + 1, np.int64)
    np.add.at(ring, used[row] + 1, 1)
    area = np.full(len(rest), floor)
    area[used] = mass
    return SoftSurface(
        faces=faces,
        edges=edges(faces[_proper(faces)]),
        area=area,
        ring=np.cumsum(ring),
        ring_ids=used[column],
        ring_weights=weight / mass[row],
        bed=np.asarray(bed, np.float64),
    )


def bed_stiffness(thickness: np.ndarray, modulus: float, reference: float = 0.01) -> np.ndarray:
    """Stiffness per area of a layer of tissue on bone [N/m^3].

    modulus / thickness * (1 + (reference / thickness)^2): a thick layer yields like a column of its own depth, a thin
    one stiffens because incompressible tissue between skin and bone cannot get out of the way.

    Args:
        thickness: (V,) [m], positive.
        modulus: Young's modulus of the tissue [Pa].
        reference: thickness at which both effects are equal [m], about a fingertip's radius.
    """
    return modulus / thickness * (1.0 + (reference / thickness) ** 2)


def tissue_thickness(rest: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Estimated depth of soft tissue over bone at every vertex of a head in rest, (V,) [m], 3 to 25 mm.

    The distance from the skin to the nearer of the two ellipsoids of the skull proxy. Small components (eyeballs) count
    as thin, i.e. stiff.

    Args:
        rest: rest shape [m], (V, 3); y up, z out of the face.
        faces: (F, 3).
    """
    rest = np.asarray(rest, np.float64)
    component = vertex_components(faces, len(rest))
    main = component == np.bincount(component[component >= 0]).argmax()
    skin = rest[main]
    # Landmarks that every head mesh has: the top, and the tip of the nose as the most forward point. Eyes, mouth and
    # chin then lie near 0.77, 1.25 and 1.65 of the height from the top to the nose.
    top, nose = skin[:, 1].max(), skin[skin[:, 2].argmax()]
    unit = max(top - nose[1], 1e-6)
    centre, radii = _fit_ellipsoid(skin[skin[:, 1] > top - 0.72 * unit], _SCALP)
    # The skin only shows the upper half; the skull's base and cheek bones reach down to the level of the nose.
    low = top - 1.15 * unit
    centre[1], radii[1] = 0.5 * (top - _SCALP + low), 0.5 * (top - _SCALP - low)
    cranium = (centre, radii)
    mouth = top - 1.25 * unit
    lower = skin[(np.abs(skin[:, 1] - mouth) < 0.3 * unit) & (skin[:, 2] > nose[2] - 0.6 * unit)]
    half_width = np.abs(lower[:, 0] - nose[0]).max(initial=0.3 * unit)
    front = skin[np.abs(skin[:, 1] - mouth) < 0.1 * unit][:, 2].max(initial=nose[2] - 0.15 * unit)
    # Cheeks hang beside teeth and jaw, which take up little more than half the width; lips and chin lie closer to bone.
    depth = 0.6 * unit
    jaw_centre = np.array([nose[0], mouth, front - _CHIN - depth])
    jaw_radius = np.array([0.55 * half_width, 0.36 * unit, depth])
    distance = np.minimum(_outside(rest, *cranium), _outside(rest, jaw_centre, jaw_radius))
    thickness = np.clip(distance, _THIN, _THICK)
    thickness[~main] = _THIN
    return thickness


def _proper(faces: np.ndarray) -> np.ndarray:
    return (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])


def _fit_ellipsoid(points: np.ndarray, inwards: float) -> tuple[np.ndarray, np.ndarray]:
    """Axis-aligned ellipsoid through points, least squares in x^2, x ..., shrunk by `inwards` [m]; centre and radii."""
    middle, size = points.mean(axis=0), np.ptp(points, axis=0).max()
    half_box = 0.5 * np.ptp(points, axis=0)
    box = 0.5 * (points.min(axis=0) + points.max(axis=0)), np.maximum(half_box - inwards, 1e-3)
    if len(points) < 6:  # fewer than the numbers to be found
        return box
    scaled = (points - middle) / size
    squares, *_ = np.linalg.lstsq(np.concatenate((scaled**2, scaled), axis=1), np.ones(len(points)), rcond=None)
    if (squares[:3] <= 1e-3).any():  # not an ellipsoid
        return box
    centre = -0.5 * squares[3:] / squares[:3]
    radii = np.sqrt((1.0 + (squares[:3] * centre**2).sum()) / squares[:3])
    return middle + size * centre, np.maximum(size * radii - inwards, 1e-3)


def _outside(points: np.ndarray, centre: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Distance to an ellipsoid, to first order: (f - 1) f / |grad f| with f the scaled radius; negative inside."""
    scaled = (points - centre) / radii
    f = np.sqrt((scaled**2).sum(axis=1))
    slope = np.sqrt(((scaled / radii) ** 2).sum(axis=1))
    return f * (f - 1.0) / np.maximum(slope, 1e-12)
