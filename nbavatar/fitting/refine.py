"""Robust multi-view refit of one part: Levenberg-Marquardt on all frames and the shared shape at once.

Cost, in units of the keypoint noise sigma (so that priors, which are in units of their own deviations, weigh right):

    sum_mnl  c^2 rho(|pi_m(X_nl) - x_mnl|^2 / sigma^2)            keypoints l of frame n in camera m, confidence c
    + |W (local_n - centre_n)|^2 + |shape - centre|^2 / deviation^2    priors
    + |accelerations / deviation|^2                                   smoothness, within uncut runs

with the Geman-McClure loss `rho(q) = k^2 q / (k^2 + q)`. Its width shrinks in stages (graduated non-convexity, Blake
and Zisserman 1987): wide on the views that triangulation found to agree, then tight on all. Sigma is estimated from
the residuals, so exact keypoints outweigh any prior and poor ones yield to it.

The derivative by the 3D keypoints is formed once per keypoint (3x3 and 3 values summed over cameras); the number of
cameras costs almost nothing.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from nbavatar.fitting.parts import PartModel, State, retract
from nbavatar.fitting.silhouette import Silhouettes, choose_rim, pull_to_silhouettes
from nbavatar.fitting.system import NormalEquations, accelerations, solve
from nbavatar.math.rotations import matrix_to_axis_angle

__all__ = ["Observations", "Prior", "Step", "estimate_noise", "refine", "reproject"]

_CHUNK = 256
_WIDTH = 3.0
_FREEDOM = 30.0
_MEDIAN_2D = 1.3863  # median of a chi-square variable with two degrees of freedom


@dataclasses.dataclass(frozen=True)
class Observations:
    """Keypoints of one part in all cameras, float64.

    Attributes:
        pixels: undistorted `[M, N, L, 2]` [px]; anything where the confidence is 0.
        confidence: `[M, N, L]`, 0 for missing.
        agree: bool `[M, N, L]`, views that triangulation found to agree.
        K: `[M, 3, 3]` [px].
        cam_from_world: `[M, 4, 4]`.
        masks: silhouettes in the same cameras, or None.
    """

    pixels: Tensor
    confidence: Tensor
    agree: Tensor
    K: Tensor
    cam_from_world: Tensor
    masks: Silhouettes | None = None


@dataclasses.dataclass(frozen=True)
class Prior:
    """Gaussian beliefs about the unknowns.

    Attributes:
        local_centre: `[N, D]`.
        local_root: W, `[D', D]`: `W (local - centre)` has unit variance.
        shape_centre: `[S]`.
        shape_deviation: one number for all shape coefficients.
        smoothness: precision of accelerations of rotation, translation and local `[6 + D]`, 0 where free.
        segments: first and last frame of each uncut run, covering all frames.
    """

    local_centre: Tensor
    local_root: Tensor
    shape_centre: Tensor
    shape_deviation: float
    smoothness: Tensor
    segments: list[tuple[int, int]]


@dataclasses.dataclass(frozen=True)
class Step:
    """One row of the convergence curve: stage, cost in units of it, median error of agreeing views and sigma [px]."""

    stage: int
    cost: float
    median_px: float
    sigma_px: float


def refine(
    part: PartModel,
    state: State,
    prior: Prior,
    seen: Observations,
    *,
    threshold: float,
    iterations: int,
    noise_floor: float,
    tolerance: float = 1e-5,
    report: Callable[[Step], None] | None = None,
) -> tuple[State, list[Step]]:
    """Fits one part.

    Args:
        part: model of the part.
        state: where to start.
        prior: beliefs.
        seen: keypoints.
        threshold: residual up to which a view may be right before anything is known about the noise [px].
        iterations: largest number of steps in all stages together.
        noise_floor: smallest sigma [px].
        tolerance: the last stages end when a step lowers the cost by less than this share; the first ones,
            which only lead there, at a thousand times that.
        report: called after every step.

    Returns:
        the state of the lowest cost of the last stage, and the convergence curve.
    """
    curve: list[Step] = []
    # At first motion is all but free: what it is like is read off the first result, see `_observed_smoothness`.
    typical, prior = prior.smoothness, dataclasses.replace(prior, smoothness=prior.smoothness / _FREEDOM**2)
    agreed = dataclasses.replace(seen, confidence=seen.confidence * seen.agree, masks=None)
    schedule = [(agreed, threshold / 3, 10 * threshold), (agreed, threshold / 3, 3 * threshold)]
    left = iterations
    sigma = threshold / 3
    for stage in range(5):
        if left <= 0:
            break
        if stage < len(schedule):
            current, sigma, width = schedule[stage]
        else:
            current = seen
            if stage == len(schedule):
                prior = dataclasses.replace(prior, smoothness=_observed_smoothness(state, typical, prior.segments))
            previous = sigma
            sigma = max(estimate_noise(part, state, seen, max(_WIDTH * previous, noise_floor)), noise_floor)
            width = _WIDTH * sigma
            if stage == 4 and abs(sigma - previous) < 0.02 * previous:
                break
        reached = tolerance * (1000 if stage < 2 else 1)
        state, used = _descend(part, state, prior, current, sigma, width, left, reached, stage, curve, report)
        left -= used
    return state, curve


def estimate_noise(part: PartModel, state: State, seen: Observations, width: float) -> float:
    """Standard deviation of keypoints about the state's [px], from residuals up to `2 width`; `width` without any."""
    squared = torch.cat([r.flatten() for r in _residuals(part, state, seen)])
    used = squared[squared < (2 * width) ** 2]
    return float((used.median() / _MEDIAN_2D).sqrt()) if len(used) else width


def reproject(points: Tensor, K: Tensor, cam_from_world: Tensor) -> tuple[Tensor, Tensor]:
    """Projects `[n, L, 3]` into M cameras: pixels `[M, n, L, 2]` [px] and camera coordinates `[M, n, L, 3]` [m]."""
    camera = torch.einsum("mij,nlj->mnli", cam_from_world[:, :3, :3], points) + cam_from_world[:, None, None, :3, 3]
    depth = camera[..., 2:].clamp_min(1e-6)
    image = torch.einsum("mij,mnlj->mnli", K[:, :2], torch.cat([camera[..., :2] / depth, torch.ones_like(depth)], -1))
    return image, camera


def _residuals(part: PartModel, state: State, seen: Observations) -> list[Tensor]:
    """Squared pixel errors of agreeing observations, chunk by chunk."""
    result = []
    for rows in _chunks(len(state.transl)):
        image, _ = reproject(part.keypoints(state.rows(rows)).points, seen.K, seen.cam_from_world)
        squared = ((image - seen.pixels[:, rows]) ** 2).sum(-1)
        result.append(squared[(seen.confidence[:, rows] > 0) & seen.agree[:, rows]])
    return result


def _observed_smoothness(state: State, typical: Tensor, segments: list[tuple[int, int]]) -> Tensor:
    """Loosens the precision of accelerations where the motion is in fact less smooth `[6 + D]`.

    The keypoint loss saturates and smoothness does not: were smoothness stricter than the motion (few frames a second,
    quick hands), it would pull meshes off their keypoints and make outliers of them.
    """
    found = _motion_accelerations(state, segments)
    if not len(found):
        return typical
    squared = (found**2).mean(0)
    groups = [squared[:3].mean().expand(3), squared[3:6].mean().expand(3), squared[6:]]
    return torch.minimum(typical, 1 / torch.cat(groups).clamp_min(1e-300))


def _motion_accelerations(state: State, segments: list[tuple[int, int]]) -> Tensor:
    """Accelerations of rotation, translation and local `[n, 6 + D]`, of all runs one after the other."""
    rows = []
    for first, last in segments:
        if last - first >= 2:
            run = state.rows(slice(first, last + 1))
            velocity = matrix_to_axis_angle(run.rotation[:-1].mT @ run.rotation[1:])
            moving = accelerations(torch.cat([run.transl, run.local], 1), [(0, last - first)])[0]
            rows.append(torch.cat([velocity[1:] - velocity[:-1], moving], 1))
    return torch.cat(rows) if rows else state.local.new_zeros(0, 6 + state.local.shape[1])


def _chunks(count: int) -> list[slice]:
    return [slice(first, min(first + _CHUNK, count)) for first in range(0, count, _CHUNK)]


def _descend(
    part: PartModel,
    state: State,
    prior: Prior,
    seen: Observations,
    sigma: float,
    width: float,
    limit: int,
    tolerance: float,
    stage: int,
    curve: list[Step],
    report: Callable[[Step], None] | None,
) -> tuple[State, int]:
    seen = _with_rim(part, state, seen)
    system = _linearise(part, state, prior, seen, sigma, width)
    damping, done, used = 1e-4, False, 0
    while used < limit and not done and damping < 1e8:
        used += 1
        try:
            frame_step, shape_step = solve(system, prior.smoothness, prior.segments, damping)
            candidate = retract(state, frame_step, shape_step)
            trial = _linearise(part, candidate, prior, seen, sigma, width)
        except np.linalg.LinAlgError:
            damping *= 10
            continue
        if not np.isfinite(trial.cost) or trial.cost > system.cost * (1 + 1e-13):
            damping *= 10
            # Near the minimum a step may fail by rounding alone; ever more damping would only waste time.
            done = damping > 1e4
            continue
        done = system.cost - trial.cost <= tolerance * system.cost
        state, system, damping = candidate, trial, max(damping / 10, 1e-9)
        curve.append(Step(stage, system.cost, system.median_px, sigma))
        if report is not None:
            report(curve[-1])
    return state, used


def _linearise(
    part: PartModel, state: State, prior: Prior, seen: Observations, sigma: float, width: float
) -> NormalEquations:
    count, size, shapes = len(state.transl), 6 + part.local_count, part.shape_count
    new = state.transl.new_zeros
    system = NormalEquations(
        new(count, size, size), new(count, size), new(count, size, shapes), new(shapes, shapes), new(shapes), 0.0
    )
    squared = [_add_keypoints(system, part, state.rows(rows), seen, rows, sigma, width) for rows in _chunks(count)]
    system.median_px = _median(torch.cat(squared))
    # A trace of rigid precision keeps frames without any keypoint solvable; 1 / (10 m)^2 and 1 / (10 rad)^2.
    torch.diagonal(system.blocks, dim1=1, dim2=2)[:, :6] += 1e-2
    if seen.masks is not None:
        _add_silhouettes(system, part, state, seen, seen.masks)
    _add_prior(system, state, prior)
    _add_smoothness(system, state, prior)
    return system


def _add_keypoints(
    system: NormalEquations,
    part: PartModel,
    state: State,
    seen: Observations,
    rows: slice,
    sigma: float,
    width: float,
) -> Tensor:
    """Adds the keypoints of some frames; returns the squared errors of the views that agree [px^2]."""
    points, by_frame, by_shape = part.keypoints(state)
    image, camera = reproject(points, seen.K, seen.cam_from_world)
    residual = image - seen.pixels[:, rows]
    squared = (residual**2).sum(-1)
    weight = seen.confidence[:, rows] ** 2 / sigma**2
    visible = (weight > 0) & (camera[..., 2] > 1e-3)
    weight = torch.where(visible, weight, torch.zeros_like(weight))
    squared = torch.where(visible, squared, torch.zeros_like(squared))
    residual = torch.where(visible[..., None], residual, torch.zeros_like(residual))
    agreeing = squared[visible & seen.agree[:, rows]]
    loss = width**2 / (width**2 + squared)
    system.cost += 0.5 * float((weight * squared * loss).sum())
    weight = weight * loss**2
    jacobian = _pixel_jacobian(camera, seen)
    weighted = weight[..., None, None] * jacobian
    information = torch.einsum("mnlac,mnlad->nlcd", weighted, jacobian)
    force = torch.einsum("mnlac,mnla->nlc", weighted, residual).flatten(1)
    _add_points(system, rows, by_frame, by_shape, information, force)
    return agreeing


def _pixel_jacobian(camera: Tensor, seen: Observations) -> Tensor:
    """`d(pixel) / d(world point) = K_2x2 [I | -xy] / z  R`, `[M, n, L, 2, 3]`."""
    depth = camera[..., 2].clamp_min(1e-6)
    plane = camera[..., :2] / depth[..., None]
    inner = torch.cat([torch.eye(2, dtype=plane.dtype).expand(*plane.shape[:-1], 2, 2), -plane[..., None]], -1)
    jacobian = torch.einsum("mab,mnlbc->mnlac", seen.K[:, :2, :2], inner / depth[..., None, None])
    return torch.einsum("mnlac,mcd->mnlad", jacobian, seen.cam_from_world[:, :3, :3])


def _add_points(
    system: NormalEquations,
    rows: slice | Tensor,
    by_frame: Tensor,
    by_shape: Tensor,
    information: Tensor,
    force: Tensor,
) -> None:
    """Carries second and first derivatives by 3D points, `[n, L, 3, 3]` and `[n, 3 L]`, over to the unknowns."""
    frames, flat = by_frame.shape[:2]

    def pressed(derivative: Tensor) -> Tensor:
        return (information @ derivative.reshape(frames, flat // 3, 3, -1)).reshape(frames, flat, -1)

    shape_pressed = pressed(by_shape)
    system.blocks[rows] += by_frame.mT @ pressed(by_frame)
    system.gradient[rows] += (by_frame.mT @ force[..., None])[..., 0]
    system.cross[rows] += by_frame.mT @ shape_pressed
    system.shape_block += by_shape.flatten(0, 1).mT @ shape_pressed.flatten(0, 1)
    system.shape_gradient += by_shape.flatten(0, 1).mT @ force.flatten()


def _add_silhouettes(
    system: NormalEquations, part: PartModel, state: State, seen: Observations, masks: Silhouettes
) -> None:
    chosen = state.rows(masks.frames)
    points, by_frame, by_shape = part.surface(chosen)
    image, camera = reproject(points, seen.K, seen.cam_from_world)
    pull = pull_to_silhouettes(masks, image, camera)
    width = (3 * masks.deviation) ** 2
    squared = pull.residual**2
    loss = width / (width + squared)
    # The weight carries the loss' derivative, loss^2; the cost is weight / loss^2 * squared * loss.
    system.cost += 0.5 * float((pull.weight / loss * squared).sum())
    jacobian = torch.einsum("mnla,mnlac->mnlc", pull.gradient, _pixel_jacobian(camera, seen))
    weighted = pull.weight[..., None] * jacobian
    information = torch.einsum("mnlc,mnld->nlcd", weighted, jacobian)
    force = torch.einsum("mnlc,mnl->nlc", weighted, pull.residual).flatten(1)
    _add_points(system, masks.frames, by_frame, by_shape, information, force)


def _with_rim(part: PartModel, state: State, seen: Observations) -> Observations:
    """Chooses which surface points the silhouettes draw, see `silhouette.choose_rim`."""
    if seen.masks is None:
        return seen
    chosen = state.rows(seen.masks.frames)
    verts = part.vertices(chosen)
    image, camera = reproject(verts[:, part.samples], seen.K, seen.cam_from_world)
    normals = _normals(verts, part.faces)[:, part.samples]
    normals = torch.einsum("mij,nlj->mnli", seen.cam_from_world[:, :3, :3], normals)
    return dataclasses.replace(seen, masks=choose_rim(seen.masks, image, camera, normals))


def _normals(verts: Tensor, faces: np.ndarray) -> Tensor:
    """Unit vertex normals `[n, V, 3]`, area weighted."""
    ids = torch.from_numpy(faces)
    corners = verts[:, ids]
    cross = torch.linalg.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    normals = torch.zeros_like(verts)
    for corner in range(3):
        normals.index_add_(1, ids[:, corner], cross)
    return torch.nn.functional.normalize(normals, dim=-1)


def _median(squared: Tensor) -> float:
    return float(squared.median().sqrt()) if len(squared) else 0.0


def _add_prior(system: NormalEquations, state: State, prior: Prior) -> None:
    residual = (state.local - prior.local_centre) @ prior.local_root.mT
    system.cost += 0.5 * float((residual**2).sum())
    system.blocks[:, 6:, 6:] += prior.local_root.mT @ prior.local_root
    system.gradient[:, 6:] += residual @ prior.local_root
    precision = prior.shape_deviation**-2
    offset = state.shape - prior.shape_centre
    system.cost += 0.5 * precision * float((offset**2).sum())
    torch.diagonal(system.shape_block)[:] += precision
    system.shape_gradient += precision * offset


def _add_smoothness(system: NormalEquations, state: State, prior: Prior) -> None:
    if not bool((prior.smoothness > 0).any()):
        return
    for first, last in prior.segments:
        if last - first < 2:
            continue
        rows = slice(first, last + 1)
        residual = _motion_accelerations(state, [(first, last)])
        weighted = residual * prior.smoothness
        system.cost += 0.5 * float((weighted * residual).sum())
        gradient = system.gradient[rows]
        gradient[:-2] += weighted
        gradient[1:-1] -= 2 * weighted
        gradient[2:] += weighted
