"""Cells of the lens model, float64: strong distortion, the fold, poles of the rational model, huge images."""

import numpy as np

from nbavatar.camera.distortion import (
    checked_coefficients,
    distort_plane,
    distort_vertices,
    undistort_pixels,
    undistortion_map,
)
from nbavatar.studies.extremes.cells import DOUBLE, Level, Limit, Refusal, Sample, Tolerance, cell
from nbavatar.studies.extremes.compare import precise, relative

__all__: list[str] = []

_ORACLE = "50 digits (mpmath)"
_K = np.array([[1000.0, 0.0, 512.0], [0.0, 1000.0, 512.0], [0.0, 0.0, 1.0]])
_BARREL = np.array([-0.3, 0.1, 1e-3, -5e-4, -0.01])


def _plane(xy: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """The lens model in mpmath, as its definition reads."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = precise(np.pad(coefficients, (0, 12 - len(coefficients))))
    x, y = precise(xy).T
    r = x * x + y * y
    radial = (1 + k1 * r + k2 * r**2 + k3 * r**3) / (1 + k4 * r + k5 * r**2 + k6 * r**3)
    moved = [
        x * radial + 2 * p1 * x * y + p2 * (r + 2 * x * x) + s1 * r + s2 * r**2,
        y * radial + p1 * (r + 2 * y * y) + 2 * p2 * x * y + s3 * r + s4 * r**2,
    ]
    return np.stack(moved, 1).astype(np.float64)


def _ring(radius: float) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False) + 0.1
    return radius * np.stack((np.cos(angle), np.sin(angle)), 1)


@cell(
    "distortion",
    "distort_plane",
    "distance from the axis",
    "radius, plane z = 1 [1]",
    (0.1, 0.0, 0.5, 1.0, 10.0, 1e4, 1e8),
    oracle=_ORACLE,
    exact=DOUBLE,
)
def _forward(radius: float) -> Sample:
    import mpmath

    with mpmath.workdps(50):
        return Sample(relative(distort_plane(_ring(radius), _BARREL), _plane(_ring(radius), _BARREL)))


@cell(
    "distortion",
    "distort_plane",
    "towards a pole of the rational model",
    "1 + k4 r2 [1]",
    (0.5, 1e-2, 1e-6, 1e-12, 0.0),
    oracle=_ORACLE,
    exact=DOUBLE,
    refuses=lambda gap: gap == 0.0,
    limits=(Limit(lambda gap: 0 < float(gap) <= 1e-6, 1e-2, 1.0, "the denominator loses its digits"),),
)
def _pole(gap: float) -> Sample | Refusal:
    import mpmath

    coefficients = np.array([0.0, 0, 0, 0, 0, -(1.0 - gap)])
    xy = np.array([[1.0, 0.0]])
    found = distort_plane(xy, coefficients)
    if gap == 0.0:
        return Refusal("infinite: the lens model has a pole there") if np.isinf(found[0, 0]) else Sample(float("nan"))
    with mpmath.workdps(50):
        return Sample(relative(found, _plane(xy, coefficients)))


@cell(
    "distortion",
    "undistort_pixels",
    "towards the fold of a barrel lens",
    "radius / radius of the fold [1]",
    (0.1, 0.5, 0.9, 0.99, 0.999, 0.99999, 1.001, 2.0, 100.0),
    quick=(0.1, 0.99, 1.001),
    oracle="the ideal points themselves",
    exact=Tolerance(1e-8, 1.0),
    refuses=lambda radius: float(radius) >= 0.999,
    limits=(Limit(lambda radius: float(radius) >= 0.99, 1e-4, 1.0, "the slope of the lens goes to zero"),),
)
def _fold(share: float) -> Sample | Refusal:
    coefficients = np.array([-0.3, 0, 0, 0])
    fold = np.sqrt(1 / 0.9)  # of r - 0.3 r^3
    ideal = _ring(min(share, 1.0) * fold)
    seen = distort_plane(ideal, coefficients)
    if share > 1:  # beyond what the lens can show
        seen = seen * share
    found = undistort_pixels(seen * 1000 + 512, _K, coefficients)
    if np.isnan(found).all():
        return Refusal("NaN: no ideal point is seen there")
    return Sample(relative((found - 512) / 1000, ideal) if share <= 1 else float("nan"))


@cell(
    "distortion",
    "undistort_pixels",
    "strength of the lens",
    "k1 [1]",
    (0.0, -0.1, -0.5, -1.0, 0.5, 5.0, 100.0),
    oracle="the ideal points themselves",
    exact=Tolerance(1e-8, 1.0),
    refuses=lambda k: k == -1.0,
)
def _strong(k1: float) -> Sample | Refusal:
    coefficients = np.array([k1, 0, 0, 0])
    ideal = np.concatenate([_ring(radius) for radius in (0.0, 0.05, 0.2, 0.5)])
    found = undistort_pixels(distort_plane(ideal, coefficients) * 1000 + 512, _K, coefficients)
    missing = np.isnan(found).any(-1)
    if missing.all():
        return Refusal("NaN: no ideal point is seen there")
    return Sample(relative((found - 512) / 1000, ideal) if not missing.any() else float("nan"))


@cell(
    "distortion",
    "undistort_pixels",
    "missing detections",
    "case",
    ("none", "one NaN", "all NaN", "infinite", "empty"),
    oracle="the ideal points themselves",
    exact=Tolerance(1e-8, 1.0),
)
def _missing(case: str) -> Sample:
    ideal = _ring(0.3)
    seen = distort_plane(ideal, _BARREL) * 1000 + 512
    bad = np.zeros(len(seen), bool)
    bad[: {"none": 0, "one NaN": 1, "all NaN": len(seen), "infinite": 1, "empty": 0}[case]] = True
    seen[bad] = np.inf if case == "infinite" else np.nan
    if case == "empty":
        ideal, seen, bad = ideal[:0], seen[:0], bad[:0]
    found = undistort_pixels(seen, _K, _BARREL)
    if not np.isnan(found[bad]).all():
        return Sample(float("nan"))
    return Sample(relative((found[~bad] - 512) / 1000, ideal[~bad]))


@cell(
    "distortion",
    "undistortion_map",
    "offset of the crop",
    "offset [px]",
    (0.0, 1e3, 1e4, 1e5, 1e7),
    oracle=_ORACLE,
    unit="px",
    exact=Tolerance(1e-2, 1.0),
    limits=(Limit(lambda offset: float(offset) >= 1e5, 1.0, 1.0, "maps are float32, 1e-7 of the coordinate"),),
)
def _map(offset: float) -> Sample:
    import mpmath

    K = np.array([[1e3 + offset, 0, offset], [0, 1e3 + offset, offset], [0, 0, 1]])
    x, y = undistortion_map(K, _BARREL, K, 6, 5)
    grid = np.stack(np.meshgrid(np.arange(6) + 0.5, np.arange(5) + 0.5), -1).reshape(-1, 2)
    with mpmath.workdps(50):
        exact = precise(K)
        plane = (precise(grid) - exact[:2, 2]) / exact[[0, 1], [0, 1]]
        moved = precise(_plane_exact(plane))
        true = (moved * exact[[0, 1], [0, 1]] + exact[:2, 2] - mpmath.mpf(0.5)).astype(np.float64)
    return Sample(float(np.abs(np.stack((x, y), -1).reshape(-1, 2) - true).max()))


def _plane_exact(xy: np.ndarray) -> np.ndarray:
    return _plane(xy.astype(np.float64), _BARREL)


@cell(
    "distortion",
    "distort_vertices",
    "vertices outside the lens's reach",
    "radius, plane z = 1 [1]",
    (0.1, 0.5, 1.0, 10.0, 1e6),
    oracle="the lens within reach, its displacement in proportion beyond",
    exact=DOUBLE,
)
def _vertices(radius: float) -> Sample:
    reach = 0.6
    points = np.concatenate((_ring(radius), np.ones((12, 1))), 1) * 2.0
    behind = np.array([[0.1, 0.2, -1.0], [0.0, 0.0, 0.0]])
    found = distort_vertices(np.concatenate((points, behind)), _BARREL, reach)
    inner = min(1.0, reach / radius)
    import mpmath

    with mpmath.workdps(50):
        true = _plane(_ring(radius * inner), _BARREL) / inner * 2.0
    return Sample(
        max(
            relative(found[:12, :2], true),
            relative(found[:, 2], [2.0] * 12 + [-1.0, 0.0]),
            relative(found[12:], behind),
        )
    )


@cell(
    "distortion",
    "checked_coefficients",
    "not a lens",
    "case",
    ("3 numbers", "NaN", "text", "tilted sensor"),
    quick=("3 numbers",),
    oracle="a one-line refusal",
    refuses=lambda case: True,
)
def _refused(case: Level) -> Sample:
    values: dict[Level, object] = {
        "3 numbers": [1.0, 2, 3],
        "NaN": [np.nan] * 5,
        "text": "wide",
        "tilted sensor": [0.1] * 14,
    }
    checked_coefficients(values[case], "camera 1: distortion")
    return Sample(float("nan"))
