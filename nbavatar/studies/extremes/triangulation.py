"""Cells of the triangulation, float64: exact pixels of known points, then what robust estimation is for."""

from typing import Any

import numpy as np

from nbavatar.fitting.triangulate import triangulate
from nbavatar.studies.extremes.cells import Level, Limit, Refusal, Sample, Tolerance, cell

__all__: list[str] = []

_EXACT = Tolerance(1e-6, 1e-6)
_THRESHOLD = 4.0


def rig(cameras: int, *, spread: float = 2 * np.pi, distance: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    """Cameras on a circle that look at the origin: K (M, 3, 3) [px] and cam_from_world (M, 4, 4)."""
    views = []
    for i in range(cameras):
        angle = spread * i / cameras
        back = np.array([np.sin(angle), 0.1, -np.cos(angle)])
        back /= np.linalg.norm(back)
        right = np.cross([0.0, 1.0, 0.0], -back)
        right /= np.linalg.norm(right)
        rotation = np.stack((right, np.cross(-back, right), -back))
        view = np.eye(4)
        view[:3, :3], view[:3, 3] = rotation, -rotation @ (distance * back)
        views.append(view)
    K = np.array([[1000.0, 0, 512], [0, 1000.0, 512], [0, 0, 1]])
    return np.tile(K, (cameras, 1, 1)), np.stack(views)


def _points(count: int = 20, size: float = 0.1) -> np.ndarray:
    return np.random.default_rng(1).uniform(-size, size, (count, 3))


def _pixels(points: np.ndarray, K: np.ndarray, views: np.ndarray) -> np.ndarray:
    seen = points @ views[:, :3, :3].transpose(0, 2, 1) + views[:, None, :3, 3]
    image = seen @ K.transpose(0, 2, 1)
    return image[..., :2] / image[..., 2:]


def _error(
    points: np.ndarray,
    pixels: np.ndarray,
    confidence: np.ndarray,
    K: np.ndarray,
    views: np.ndarray,
    distance: float = 2.0,
) -> Sample | Refusal:
    """Largest error of a point, in units of the cameras' distance; a refusal where no point is given at all."""
    found = triangulate(pixels, confidence, K, views, threshold=_THRESHOLD)
    missing = np.isnan(found.points).any(-1)
    if missing.all():
        return Refusal("NaN: fewer than two views agree")
    if missing.any():
        return Sample(float("nan"))
    return Sample(float(np.linalg.norm(found.points - points, axis=1).max()) / distance)


def _cell(condition: str, axis: str, levels: tuple[Level, ...], **more: Any):
    return cell(
        "triangulation",
        "triangulate float64",
        condition,
        axis,
        levels,
        oracle="the points themselves",
        exact=_EXACT,
        unit="error / distance",
        **more,
    )


@_cell(
    "missing views of 8",
    "views left [1]",
    (8.0, 4.0, 3.0, 2.0, 1.0, 0.0),
    quick=(8.0, 2.0, 1.0),
    refuses=lambda left: float(left) < 2,
)
def _missing(left: float) -> Sample | Refusal:
    K, views = rig(8)
    points = _points()
    confidence = np.zeros((8, len(points)))
    random = np.random.default_rng(2)
    pixels = _pixels(points, K, views)
    for i in range(len(points)):
        seen = random.permutation(8)[: int(left)]
        if int(left) == 2 and (seen[0] - seen[1]) % 8 == 4:  # opposite cameras: their rays are one line
            seen[1] = (seen[1] + 1) % 8
        confidence[seen, i] = 1.0
    return _error(points, np.where(confidence[..., None] > 0, pixels, np.nan), confidence, K, views)


@_cell(
    "outliers among 8 views",
    "share of outliers [1]",
    (0.0, 0.25, 0.5, 0.625, 0.75),
    quick=(0.0, 0.5),
)
def _outliers(share: float) -> Sample | Refusal:
    K, views = rig(8)
    points = _points()
    pixels = _pixels(points, K, views)
    random = np.random.default_rng(3)
    for i in range(len(points)):
        wrong = random.permutation(8)[: round(8 * share)]
        pixels[wrong, i] += random.uniform(100, 600, (len(wrong), 2)) * random.choice([-1, 1], (len(wrong), 2))
    return _error(points, pixels, np.ones((8, len(points))), K, views)


@cell(
    "triangulation",
    "triangulate float64",
    "no two right views of 8",
    "right views [1]",
    (1.0, 0.0),
    quick=(0.0,),
    oracle="no point",
    unit="share of wrong points",
    exact=Tolerance(0.0, 0.0),
    limits=(
        Limit(lambda right: True, 0.5, 0.0, "two wrong views that agree by chance cannot be told from right ones"),
    ),
)
def _hopeless(right: float) -> Sample:
    K, views = rig(8)
    points = _points(200)
    pixels = _pixels(points, K, views)
    random = np.random.default_rng(3)
    pixels[int(right) :] = random.uniform(0, 1024, pixels[int(right) :].shape)
    found = triangulate(pixels, np.ones((8, len(points))), K, views, threshold=_THRESHOLD)
    return Sample(float(np.isfinite(found.points).all(-1).mean()))


@_cell(
    "two cameras only",
    "angle between the rays [deg]",
    (90.0, 10.0, 1.0, 0.2, 0.01, 1e-4, 1e-6, 0.0),
    refuses=lambda angle: float(angle) <= 0.01,
)
def _two(angle: float) -> Sample | Refusal:
    K, views = rig(2, spread=2 * np.radians(angle))
    points = _points()
    return _error(points, _pixels(points, K, views), np.ones((2, len(points))), K, views)


@_cell(
    "two cameras face to face",
    "points off their line [m]",
    (0.1, 1e-2, 1e-4, 1e-6, 0.0),
    refuses=lambda off: float(off) <= 1e-4,
)
def _facing(off: float) -> Sample | Refusal:
    """Points between two cameras that look at each other, beside the line that joins them."""
    K, views = rig(2)
    across = np.diag([-1.0, 1, -1])
    views[1] = views[0]
    views[1, :3, :3] = across @ views[0, :3, :3]
    place = -views[0, :3, :3].T @ views[0, :3, 3]
    views[1, :3, 3] = views[1, :3, :3] @ place
    angle = np.arange(20) + 0.3
    points = off * (np.cos(angle)[:, None] * views[0, 0, :3] + np.sin(angle)[:, None] * views[0, 1, :3]) + 0.1 * place
    return _error(points, _pixels(points, K, views), np.ones((2, len(points))), K, views)


@_cell("distance of the cameras", "distance [m]", (2.0, 0.3, 10.0, 1e3, 1e6), quick=(2.0, 1e6))
def _distance(distance: float) -> Sample | Refusal:
    K, views = rig(8, distance=distance)
    points = _points(size=0.05 * distance)
    return _error(points, _pixels(points, K, views), np.ones((8, len(points))), K, views, distance)


@_cell(
    "world far from its origin",
    "offset [m]",
    (0.0, 1.0, 1e2, 1e4, 1e6),
    quick=(0.0, 1e4),
    limits=(Limit(lambda offset: float(offset) >= 1e6, 1e-4, 1.0, "K (R x + t) is right to 1e-16 of the offset"),),
)
def _offset(offset: float) -> Sample | Refusal:
    K, views = rig(8)
    place = offset * np.array([1.0, -0.7, 0.4])
    points = _points()
    pixels = _pixels(points, K, views)
    views[:, :3, 3] -= views[:, :3, :3] @ place
    return _error(points + place, pixels, np.ones((8, len(points))), K, views)


@_cell(
    "noise of the pixels",
    "standard deviation [px]",
    (0.0, 1e-3, 0.1, 1.0),
    quick=(0.0, 1.0),
    limits=(Limit(lambda noise: float(noise) > 0, 3e-3, 1.0, "in proportion to the noise"),),
)
def _noise(noise: float) -> Sample | Refusal:
    K, views = rig(8)
    points = _points()
    pixels = _pixels(points, K, views) + np.random.default_rng(4).normal(size=(8, len(points), 2)) * noise
    return _error(points, pixels, np.ones((8, len(points))), K, views)


@_cell(
    "odd detections in one view of 8",
    "case",
    (
        "NaN pixels",
        "infinite pixels",
        "pixels of 1e30",
        "confidence 0",
        "confidence NaN",
        "confidence negative",
        "confidence 1e30",
        "confidence 1e-30",
        "seen from behind",
        "point on the camera",
    ),
)
def _odd(case: str) -> Sample | Refusal:
    K, views = rig(8)
    points = _points()
    pixels = _pixels(points, K, views)
    confidence = np.ones((8, len(points)))
    if case == "NaN pixels":
        pixels[2] = np.nan
    elif case == "infinite pixels":
        pixels[2] = np.inf
    elif case == "pixels of 1e30":
        pixels[2] = 1e30
    elif case == "seen from behind":
        views[2, :3, 3] -= [0, 0, 10.0]
    elif case == "point on the camera":
        views[2, :3, 3] = -views[2, :3, :3] @ points[0]
    else:
        confidence[2] = {"0": 0.0, "NaN": np.nan, "negative": -1.0, "1e30": 1e30, "1e-30": 1e-30}[case.split()[1]]
    return _error(points, pixels, confidence, K, views)
