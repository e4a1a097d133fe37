"""Every cell keeps its verdict: at its quick levels, and, by random levels between, along its axis."""

import functools
import math

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from nbavatar.studies.extremes.cells import FAMILIES, cells
from nbavatar.studies.extremes.verdict import measure


@functools.cache  # quick levels are levels, too
def judged(cell, level):
    return measure(cell, level)


@pytest.mark.parametrize("family", FAMILIES)
def test_no_defect_at_the_quick_levels(family):
    for cell in cells((family,)):
        for level in cell.quick:
            row = judged(cell, level)
            assert row.verdict != "defect", f"{cell.name} at {level}: {row.message} ({row.forward}, {row.gradient})"


# name of the cell, least and greatest level, on a logarithmic scale; levels in between must keep the verdict
AXES = [
    ("raster/cpu float32: grazing view", 1e-4, 90.0),
    ("raster/cpu float32: grazing view, no low-pass", 1e-4, 90.0),
    ("raster/cpu float32: plane through the near plane", 1e-3, 2.0),
    ("raster/cpu float32: ratio of depths", 1.0, 1e6),
    ("raster/cpu float32: distance of the whole scene", 0.1, 1e7),
    ("raster/cpu float32: scene far from the origin, float64 means", 1.0, 1e5),
    ("raster/cpu float32: parallel layers almost in one plane", 1e-9, 1e-2),
    ("raster/cpu float32: principal point off the image", 1.0, 1e6),
    ("raster/cpu float32: norm of quaternions", 1e-18, 1e18),
    ("projection/float64: grazing view", 1e-3, 90.0),
    ("projection/float64: small and far", 1.0, 1e6),
    ("splat/cpu float32: needles", 1e-12, 1.0),
    ("splat/cpu float32: screen-filling size", 1e-3, 1e6),
    ("rotations/axis_angle_to_matrix: identity to half turn", 1e-30, math.pi),
    ("rotations/axis_angle_to_quaternion: identity to half turn", 1e-30, math.pi),
    ("rotations/matrix_to_quaternion: identity to half turn", 1e-30, math.pi),
    ("rotations/matrix_to_axis_angle: identity to half turn", 1e-30, math.pi),
    ("rotations/normalize_quaternion: norm", 1e-37, 1e38),
    ("frames/face_frames float32: size of the mesh", 1e-16, 1e12),
    ("frames/face_frames float32: sliver under the threshold", 1e-12, 9e-4),
    ("laplacian/robust_laplacian: obtuse slivers within a sound rim", 1e-12, 1.0),
    ("laplacian/robust_laplacian: size of the mesh", 1e-100, 1e100),
    ("laplacian/spectral_coordinates: needle", 1e-12, 1.0),
    ("walking/walk: fold", 1e-3, 179.9),
    ("walking/walk: slivers in the way", 1e-9, 1.0),
    ("walking/walk: through vertices", 1e-9, 1.0),
    ("distance/inside: distance to the surface", 1e-13, 0.2),
    ("physics/relax: stiffness of the bed", 1e-12, 1e20),
    ("physics/relax: time step of the bed", 1e-6, 1e3),
    ("physics/relax: stiffness of an edge", 1e-12, 1e20),
    ("physics/relax: contact against a bed", 1e-12, 1e20),
    ("physics/relax: friction", 1e-6, 1e100),
    ("skinning/pose float32: identity to many turns of all joints", 1e-30, 2 * math.pi),
    ("skinning/pose float32: huge shape coefficients", 1e-30, 1e30),
    ("skinning/right_jacobian float64: identity to many turns", 1e-30, 1e3),
    ("refit/normal equations float64: damping", 1e-12, 1e30),
    ("refit/optimiser float64: outliers in 8 views", 0.01, 0.6),
    ("triangulation/triangulate float64: two cameras only", 0.2, 90.0),
    ("triangulation/triangulate float64: two cameras only", 1e-9, 0.01),
    ("triangulation/triangulate float64: world far from its origin", 1.0, 1e6),
    ("distortion/undistort_pixels: towards the fold of a barrel lens", 1e-3, 0.999),
    ("distortion/distort_vertices: vertices outside the lens's reach", 1e-3, 1e6),
    ("losses/loss_knn: spread of the neighbours", 1e-6, 0.5),
    ("losses/loss_dice: weak prediction, empty target", 1e-12, 1.0),
    ("halfprecision/decode fp16: magnitude of the features", 1e-8, 1e30),
]


@pytest.mark.parametrize(("name", "low", "high"), AXES)
def test_no_defect_along_the_axis(name, low, high):
    cell = next(one for one in cells((name.split("/")[0],)) if one.name == name)

    @settings(max_examples=6, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
    @given(st.floats(math.log(low), math.log(high)))
    def check(logarithm):
        level = min(max(math.exp(logarithm), low), high)
        row = measure(cell, level)
        assert row.verdict != "defect", f"{name} at {level}: {row.message} ({row.forward}, {row.gradient})"

    check()


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_no_defect_at_any_level(family):
    defects = [
        f"{cell.name} at {level}: {row.message} ({row.forward}, {row.gradient})"
        for cell in cells((family,))
        for level in cell.levels
        for row in [judged(cell, level)]
        if row.verdict == "defect"
    ]
    assert not defects, "\n".join(defects)
