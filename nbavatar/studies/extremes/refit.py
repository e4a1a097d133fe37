"""Cells of the refit, float64: its normal equations, and its optimiser on a body of a few points seen by cameras.

The body is a cloud of points with one local unknown and one shape unknown, so that the truth is known and nothing has
to be built; triangulation, start, robust loss, damping and coupling over time are the refit's own.
"""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nbavatar.config.geometry import FitConfig
from nbavatar.fitting.observe import explained
from nbavatar.fitting.parts import Keypoints, State
from nbavatar.fitting.points import skew
from nbavatar.fitting.refine import Observations, Prior, refine
from nbavatar.fitting.stage import Bodies, fit_sequence
from nbavatar.fitting.start import start_from_keypoints, zero_state
from nbavatar.fitting.system import NormalEquations, acceleration_bands, solve
from nbavatar.fitting.triangulate import triangulate
from nbavatar.math.rotations import axis_angle_to_matrix
from nbavatar.studies.extremes.cells import DOUBLE, Level, Limit, Sample, Tolerance, cell
from nbavatar.studies.extremes.compare import relative
from nbavatar.studies.extremes.triangulation import rig

__all__: list[str] = []

_FRAMES, _POINTS, _THRESHOLD = 8, 16, 8.0


def _system(condition: float = 1.0, scale: float = 1.0, frames: int = 5) -> NormalEquations:
    """A positive definite system of three unknowns a frame and two of shape; blocks of a given condition."""
    random = np.random.default_rng(11)
    blocks = []
    for _ in range(frames):
        turn, _ = np.linalg.qr(random.normal(size=(3, 3)))
        blocks.append(turn @ np.diag([1.0, condition**-0.5, 1.0 / condition]) @ turn.T)
    arrays = (
        np.stack(blocks), random.normal(size=(frames, 3)), 0.1 / condition * random.normal(size=(frames, 3, 2)),
        (1.0 + frames) * np.eye(2), random.normal(size=2),
    )  # fmt: skip
    return NormalEquations(*(scale * torch.tensor(a) for a in arrays), cost=0.0)


def _solved(system: NormalEquations, precision: float = 0.0, damping: float = 0.0) -> Sample:
    """The step, all unknowns together, against elimination with 60 digits."""
    import mpmath

    count = len(system.gradient)
    smoothness = torch.full((3,), float(precision), dtype=torch.float64)
    steps, shape = solve(system, smoothness, [(0, count - 1)], damping)
    size = 3 * count + 2
    with mpmath.workdps(60):
        matrix = mpmath.zeros(size)
        for n in range(count):
            for i in range(3):
                for j in range(3):
                    matrix[3 * n + i, 3 * n + j] = mpmath.mpf(float(system.blocks[n, i, j]))
                for s in range(2):
                    matrix[3 * n + i, size - 2 + s] = matrix[size - 2 + s, 3 * n + i] = mpmath.mpf(
                        float(system.cross[n, i, s])
                    )
        for band, values in enumerate(acceleration_bands(count)):
            for n in range(len(values)):
                for i in range(3):
                    a, b = 3 * n + i, 3 * (n + band) + i
                    matrix[a, b] += mpmath.mpf(float(values[n])) * mpmath.mpf(float(precision))
                    if band:
                        matrix[b, a] = matrix[a, b]
        for s in range(2):
            for t in range(2):
                matrix[size - 2 + s, size - 2 + t] = mpmath.mpf(float(system.shape_block[s, t]))
        for i in range(size):
            matrix[i, i] *= 1 + mpmath.mpf(float(damping))
        right = torch.cat([system.gradient.flatten(), system.shape_gradient])
        answer = mpmath.lu_solve(matrix, mpmath.matrix([-mpmath.mpf(float(v)) for v in right]))
        true = np.array([float(v) for v in answer])
    return Sample(relative(torch.cat([steps.flatten(), shape]), true))


def _of_system(condition: str, axis: str, levels: tuple[Level, ...], **more: Any):
    return cell(
        "refit", "normal equations float64", condition, axis, levels, oracle="elimination, 60 digits", exact=DOUBLE,
        **more,
    )  # fmt: skip


@_of_system(
    "condition of a frame's block", "condition [1]", (1.0, 1e2, 1e4, 1e6, 1e10, 1e14, 1e18), quick=(1.0,),
    limits=(Limit(lambda c: float(c) > 1e6, 1.0, 1.0, "16 digits, less those of the condition"),),
    refuses=lambda c: float(c) >= 1e14,
)  # fmt: skip
def _condition(condition: float) -> Sample:
    return _solved(_system(condition))


@_of_system("damping", "share of the diagonal [1]", (0.0, 1e-9, 1e-3, 1.0, 1e8, 1e30), quick=(1e-3,))
def _damping(damping: float) -> Sample:
    return _solved(_system(100.0), 1.0, damping)


@_of_system(
    "stiff coupling over time", "precision of accelerations [1]", (0.0, 1e-12, 1.0, 1e4, 1e6, 1e9, 1e12), quick=(1.0,),
    limits=(Limit(lambda p: float(p) > 1e4, 1.0, 1.0, "16 digits, less those of the ratio of the terms"),),
)  # fmt: skip
def _coupling(precision: float) -> Sample:
    return _solved(_system(), precision)


@_of_system("frames of a run", "frames [1]", (1.0, 2.0, 3.0, 4.0, 7.0), quick=(3.0,))
def _runs(frames: float) -> Sample:
    return _solved(_system(frames=int(frames)), 1.0)


@_of_system("scale of the cost", "scale [1]", (1.0, 1e-100, 1e100), quick=())
def _scale(scale: float) -> Sample:
    return _solved(_system(scale=scale))


@_of_system(
    "a frame that nothing holds", "case", ("neighbours hold it", "nothing holds it"), quick=(),
    refuses=lambda case: case == "nothing holds it",
)  # fmt: skip
def _unheld(case: str) -> Sample:
    system = _system()
    system.blocks[2], system.gradient[2], system.cross[2] = 0.0, 0.0, 0.0
    return _solved(system, 1.0 if case == "neighbours hold it" else 0.0)


class _Cloud:
    """The solver's view of a body: `R (base + local a + shape b) + t`."""

    local_count = shape_count = 1
    faces = np.zeros((0, 3), np.int64)
    samples = torch.zeros(0, dtype=torch.int64)

    def __init__(self) -> None:
        random = np.random.default_rng(5)
        self._base, self._local, self._shape = (
            torch.tensor(size * random.normal(size=(_POINTS, 3))) for size in (0.05, 0.02, 0.02)
        )

    def keypoints(self, state: State) -> Keypoints:
        count, turn = len(state.transl), state.rotation[:, None]
        points = self._base + state.local[:, :, None] * self._local + state.shape * self._shape
        shift = torch.eye(3, dtype=torch.float64).expand(count, _POINTS, 3, 3)
        by_local, by_shape = ((turn @ way[..., None]).expand(count, -1, -1, -1) for way in (self._local, self._shape))
        by_frame = torch.cat([-turn @ skew(points), shift, by_local], -1)
        placed = (turn @ points[..., None])[..., 0] + state.transl[:, None]
        return Keypoints(placed, by_frame.reshape(count, 3 * _POINTS, -1), by_shape.reshape(count, 3 * _POINTS, -1))

    surface = keypoints

    def vertices(self, state: State) -> Tensor:
        return self.keypoints(state).points

    def rest(self, state: State) -> Tensor:
        return self._base + state.shape * self._shape

    def parameters(self, state: State) -> dict[str, Tensor]:
        return {"local": state.local}


_BODY = _Cloud()


def _truth(offset: float = 0.0) -> State:
    time = torch.linspace(0, 1, _FRAMES, dtype=torch.float64)[:, None]
    turn = axis_angle_to_matrix(time * torch.tensor([0.3, -0.4, 0.2], dtype=torch.float64))
    shift = 0.03 * time * torch.tensor([1.0, 0.5, -0.5], dtype=torch.float64) + offset
    return State(turn, shift, 0.2 * torch.sin(3 * time), torch.full((1,), 0.3, dtype=torch.float64))


def _seen(cameras: int = 8, offset: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Exact pixels (M, N, L, 2), confidence 1, and the cameras."""
    K, views = rig(cameras, spread=2 * math.pi if cameras > 2 else 2.0)
    views[:, :3, 3] -= (views[:, :3, :3] @ np.full(3, offset)[:, None])[..., 0]
    points = _BODY.keypoints(_truth(offset)).points.numpy()
    camera = np.einsum("mij,nlj->mnli", views[:, :3, :3], points) + views[:, None, None, :3, 3]
    image = np.einsum("mij,mnlj->mnli", K, camera)
    return image[..., :2] / image[..., 2:], np.ones((cameras, _FRAMES, _POINTS)), K, views


def _fit(
    pixels: np.ndarray, confidence: np.ndarray, K: np.ndarray, views: np.ndarray, given: State | None = None
) -> tuple[State, Observations]:
    """The refit, from triangulated keypoints or from a state that is given."""
    whole = [(0, _FRAMES - 1)]
    found = triangulate(pixels, confidence, K, views, threshold=_THRESHOLD)
    zero = torch.zeros(1, dtype=torch.float64)
    if given is None:
        given, _ = start_from_keypoints(_BODY, "head", zero_state(_BODY, zero, _FRAMES), found.points, whole)
    smooth = torch.tensor([(math.radians(2.0)) ** -2] * 3 + [0.003**-2] * 3 + [0.5**-2], dtype=torch.float64)
    prior = Prior(zero.expand(_FRAMES, 1), torch.eye(1, dtype=torch.float64), zero, 1.0, smooth, whole)
    arrays = (np.where(confidence[..., None] > 0, pixels, 0.0), confidence, found.inliers, K, views)
    observed, weight, inliers, intrinsics, poses = (torch.tensor(a) for a in arrays)
    seen = Observations(observed, weight, inliers, intrinsics, poses)
    floor = FitConfig().noise_floor_px
    return refine(_BODY, given, prior, seen, threshold=_THRESHOLD, iterations=60, noise_floor=floor)[0], seen


def _fitted(
    pixels: np.ndarray, confidence: np.ndarray, K: np.ndarray, views: np.ndarray, *, given: State | None = None,
    judged: slice = slice(None), offset: float = 0.0,
) -> Sample:  # fmt: skip
    """Largest error of a point [m] over its 5 cm."""
    state, _ = _fit(pixels, confidence, K, views, given)
    gap = _BODY.vertices(state)[judged] - _BODY.vertices(_truth(offset))[judged]
    return Sample(float(torch.linalg.norm(gap, dim=-1).max()) / 0.05)


def _of_fit(condition: str, axis: str, levels: tuple[Level, ...], **more: Any):
    return cell(
        "refit", "optimiser float64", condition, axis, levels, oracle="the points themselves", unit="error / size",
        exact=Tolerance(1e-4, 1.0), **more,
    )  # fmt: skip


@_of_fit("cameras", "cameras [1]", (8.0, 3.0, 2.0, 1.0, 0.0), quick=(2.0, 1.0), refuses=lambda c: float(c) < 2)
def _cameras(cameras: float) -> Sample:
    if cameras >= 2:
        return _fitted(*_seen(int(cameras)))
    extras = {f"keypoints.head.{m}": np.ones((_FRAMES, 68, 3)) for m in range(int(cameras))}
    fit_sequence([str(n) for n in range(_FRAMES)], {}, extras, Bodies(None, {}), FitConfig())
    return Sample(0.0)


@_of_fit("outliers in 8 views", "share of outliers [1]", (0.0, 0.2, 0.5, 0.6), quick=(0.5,))
def _outliers(share: float) -> Sample:
    pixels, confidence, K, views = _seen()
    random = np.random.default_rng(8)
    wrong = random.random(confidence.shape) < share
    pixels[wrong] += random.uniform(50, 400, (int(wrong.sum()), 2)) * random.choice([-1, 1], (int(wrong.sum()), 2))
    return _fitted(pixels, confidence, K, views)


@cell(
    "refit", "optimiser float64", "all keypoints wrong", "size of the errors [px]", (50.0, 1e3, 1e30), quick=(1e30,),
    oracle="no view", unit="share explained", exact=Tolerance(0.0, 1.0),
    limits=(Limit(lambda size: True, 0.2, 1.0, "the mesh is wrong, and most views count as unexplained"),),
)  # fmt: skip
def _all_wrong(size: float) -> Sample:
    """The share of views that the fit claims to explain: a wrong mesh must not pass for a right one."""
    pixels, confidence, K, views = _seen()
    pixels += np.random.default_rng(8).uniform(-size, size, pixels.shape)
    state, seen = _fit(pixels, confidence, K, views, _truth())
    return Sample(float((explained(_BODY, state, seen, _THRESHOLD) == 2).mean()))


@_of_fit(
    "frames without a keypoint", "frames of 8 [1]", (1.0, 4.0, 7.0, 8.0), quick=(4.0, 8.0),
    refuses=lambda frames: float(frames) == 8,
)  # fmt: skip
def _blind(frames: float) -> Sample:
    pixels, confidence, K, views = _seen()
    confidence[:, _FRAMES - int(frames) :] = 0.0
    return _fitted(pixels, confidence, K, views, judged=slice(0, max(_FRAMES - int(frames), 1)))


@_of_fit(
    "no keypoint at all, start given", "case", ("NaN pixels",), quick=(),
    limits=(Limit(lambda case: True, 0.5, 1.0, "nothing is seen: motion stays, local and shape go to the prior"),),
)  # fmt: skip
def _nothing(case: str) -> Sample:
    pixels, confidence, K, views = _seen()
    return _fitted(np.full_like(pixels, np.nan), 0.0 * confidence, K, views, given=_truth())


@_of_fit(
    "start off the truth", "distance [m]", (0.005, 0.1, 1.0, 10.0), quick=(0.1,),
    limits=(Limit(lambda off: float(off) > 1, 1e3, 1.0, "out of the reach of the robust loss: another minimum"),),
)  # fmt: skip
def _off(off: float) -> Sample:
    truth = _truth()
    turn = axis_angle_to_matrix(torch.tensor([0.03, -0.04, 0.02], dtype=torch.float64) * min(off / 0.005, 10.0))
    shift = off * torch.tensor([0.6, -0.6, 0.5], dtype=torch.float64)
    given = State(truth.rotation @ turn, truth.transl + shift, 0 * truth.local, 0 * truth.shape)
    return _fitted(*_seen(), given=given)


@_of_fit(
    "odd observations in one view of 8", "case",
    ("pixels of 1e6", "pixels of 1e30", "confidence 1e-30", "seen from behind", "on the camera"), quick=(),
)  # fmt: skip
def _odd(case: str) -> Sample:
    pixels, confidence, K, views = _seen()
    if case.startswith("pixels"):
        pixels[2] = float(case.split()[-1])
    elif case.startswith("confidence"):
        confidence[2] = 1e-30
    elif case == "seen from behind":
        views[2, :3, 3] -= [0, 0, 10.0]
    else:
        views[2, :3, 3] = -views[2, :3, :3] @ _BODY.vertices(_truth())[0, 0].numpy()
    return _fitted(pixels, confidence, K, views)


@_of_fit(
    "world far from its origin", "offset [m]", (0.0, 10.0, 1e5), quick=(),
    limits=(Limit(lambda offset: float(offset) >= 1e5, 1e-2, 1.0, "16 digits of the offset"),),
)  # fmt: skip
def _far(offset: float) -> Sample:
    return _fitted(*_seen(offset=offset), offset=offset)
