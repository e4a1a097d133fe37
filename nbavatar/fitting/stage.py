"""The refit stage: keypoints and starting parameters of a sequence in, fitted meshes out."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from nbavatar.bodymodels.flame import Flame
from nbavatar.bodymodels.mano import Mano
from nbavatar.config.geometry import FitConfig
from nbavatar.data.sequences import MeshSequence, Part
from nbavatar.errors import DataError
from nbavatar.fitting.handedness import judge_handedness
from nbavatar.fitting.observe import error_table, explained, frame_errors, keypoint_cameras, observe
from nbavatar.fitting.parts import HandPart, HeadPart, PartModel, State
from nbavatar.fitting.refine import Observations, Prior, Step, refine
from nbavatar.fitting.silhouette import FAR, Silhouettes, distance_map, ideal_mask, signed_distance_map
from nbavatar.fitting.start import start_from_keypoints, start_from_parameters, with_anchor, zero_state
from nbavatar.fitting.triangulate import Triangulation

__all__ = ["Bodies", "Masks", "fit_sequence"]

_VERTEX_CHUNK = 64
_LINES = 1080


@dataclasses.dataclass(frozen=True)
class Bodies:
    """Body models, float64; None where the files are not there.

    Attributes:
        head: FLAME with landmarks.
        hands: side (`right`, `left`) -> MANO.
    """

    head: Flame | None
    hands: Mapping[str, Mano]


@dataclasses.dataclass(frozen=True)
class Masks:
    """Masks of some frames.

    Attributes:
        frames: positions in the sequence, increasing.
        images: camera -> bool `[n, H, W]`, as recorded (distorted); cameras may be missing.
        labels: whether they show head and hands only, or (False) the whole person.
        unseen: camera -> where they say nothing, likewise, and `images` is true; cameras may be missing.
    """

    frames: Sequence[int]
    images: Mapping[str, np.ndarray]
    labels: bool
    unseen: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)


def fit_sequence(
    frames: Sequence[str],
    parts: Mapping[str, Part],
    extras: Mapping[str, np.ndarray],
    bodies: Bodies,
    cfg: FitConfig,
    *,
    cameras: Sequence[str] | None = None,
    masks: Masks | None = None,
    progress: Callable[[str, Step], None] | None = None,
) -> tuple[MeshSequence, dict[str, Any]]:
    """Fits every part that has keypoints, all frames at once.

    Args:
        frames: frame ids.
        parts: meshes of the tracks; a part without keypoints is handed on as it is.
        extras: extras of the tracks (see `nbavatar.data.sequences`): keypoints, cameras, parameters if any, `segments`.
        bodies: body models.
        cfg: options.
        cameras: cameras to use; all that have keypoints when None.
        masks: silhouettes of some frames, or None.
        progress: called with the part's name after every step.

    Returns:
        The sequence with fitted parts; extras as before, with new parameters and
            `reprojection.cameras` [M], `reprojection.<part>.{before, after}` [M, 4] (`observe.error_table`),
            `convergence.<part>` [I, 4] (stage, cost, median error [px], sigma [px]),
            `fit_error.<part>` [N] (root mean truncated squared error of the frame [px]),
            `explained.<part>` uint8 [M, N, L] (0 missing, 1 farther from the fit than the threshold, 2 near it);
        and a report for the record.

    Raises:
        DataError: nothing to fit, a body model is missing, or inputs that disagree.
    """
    names = [part for part in ("head", "right_hand", "left_hand") if keypoint_cameras(extras, part)]
    if not names:
        raise DataError.of(
            "tracks", "keypoints", expected="keypoints.<part>.<camera> of at least one part", found="none"
        )
    segments = _segments(extras, len(frames))
    maps = _distance_maps(masks, cameras, extras, cfg)
    fitted, out, report = dict(parts), dict(extras), {}
    for name in names:
        part, arrays, summary = _fit_part(
            name, len(frames), segments, extras, bodies, cfg, cameras, masks, maps, progress
        )
        fitted[name] = part
        out |= arrays
        report[name] = summary
    _turn_reference(extras, out)
    ordered = {name: fitted[name] for name in ("head", "right_hand", "left_hand") if name in fitted}
    return MeshSequence(list(frames), ordered, out), report


def _fit_part(
    name: str,
    count: int,
    segments: list[tuple[int, int]],
    extras: Mapping[str, np.ndarray],
    bodies: Bodies,
    cfg: FitConfig,
    cameras: Sequence[str] | None,
    masks: Masks | None,
    maps: Mapping[str, "_Maps"],
    progress: Callable[[str, Step], None] | None,
) -> tuple[Part, dict[str, np.ndarray], dict[str, Any]]:
    used = [c for c in keypoint_cameras(extras, name) if cameras is None or c in cameras]
    if len(used) < 2:
        raise DataError.of("tracks", f"keypoints.{name}", expected="keypoints in two cameras or more", found=len(used))
    scale = _lines(extras, used) / _LINES
    threshold = cfg.inlier_px * scale
    model, mean = _model(name, bodies)
    seen, points = observe(extras, name, used, count, threshold=threshold, contour_weight=cfg.contour_weight)
    prior = _prior(name, model, mean, bodies, segments, cfg, count)
    start, given, prior, summary = _start(name, model, extras, prior, seen, points, segments, cfg, threshold)
    before = error_table(model, given, seen, threshold)
    if name != "head" and cfg.check_handedness:
        summary["handedness"] = judge_handedness(
            name, {side: HandPart(mano) for side, mano in bodies.hands.items()}, points.points, seen, prior,
            threshold=threshold, noise_floor=cfg.noise_floor_px * scale, width=_widths(extras, used),
        )  # fmt: skip
    shown = seen if masks is None else dataclasses.replace(seen, masks=_silhouettes(masks, maps, used, cfg, scale))
    state, curve = refine(
        model, start, prior, shown, threshold=threshold, iterations=cfg.iterations,
        noise_floor=cfg.noise_floor_px * scale,
        report=None if progress is None else lambda step: progress(name, step),
    )  # fmt: skip
    after = error_table(model, state, seen, threshold)
    summary |= {
        "cameras": used,
        "steps": len(curve),
        "sigma_px": curve[-1].sigma_px if curve else None,
        "median_px_before": _median(before),
        "median_px_after": _median(after),
        "unexplained_before": _share(before),
        "unexplained_after": _share(after),
        "views_that_agree": float(seen.agree.double().mean()),
    }
    arrays = {
        "reprojection.cameras": np.array(used),
        f"reprojection.{name}.before": before,
        f"reprojection.{name}.after": after,
        f"convergence.{name}": np.array([[s.stage, s.cost, s.median_px, s.sigma_px] for s in curve]).reshape(-1, 4),
        f"fit_error.{name}": frame_errors(model, state, seen, threshold).sqrt().numpy(),
    }
    arrays[f"explained.{name}"] = explained(
        model, state, seen, max(threshold, 3 * (curve[-1].sigma_px if curve else 0))
    )
    for key, value in model.parameters(state).items():
        arrays[f"param.{name}.{key}"] = value.numpy().astype(np.float32)
    faces = bodies.head.faces if name == "head" and bodies.head is not None else bodies.hands[_side(name)].faces
    rows = range(0, count, _VERTEX_CHUNK)
    verts = [model.vertices(state.rows(slice(n, n + _VERTEX_CHUNK))).numpy().astype(np.float32) for n in rows]
    return Part(faces, model.rest(state).numpy().astype(np.float32), np.concatenate(verts)), arrays, summary


def _start(
    name: str,
    model: PartModel,
    extras: Mapping[str, np.ndarray],
    prior: Prior,
    seen: Observations,
    points: Triangulation,
    segments: list[tuple[int, int]],
    cfg: FitConfig,
    threshold: float,
) -> tuple[State, State, Prior, dict[str, Any]]:
    """Start, what was given, prior, summary; frames that a rigid alignment explains better start from that."""
    count = len(points.points)
    given = start_from_parameters(model, name, extras, count) if cfg.start != "keypoints" else None
    if given is None and cfg.start == "params":
        raise DataError.of("tracks", f"param.{name}", expected="parameters to start from", found="none")
    if given is None:
        zero = zero_state(model, prior.local_centre[0], count)
        start, valid = start_from_keypoints(model, name, zero, points.points, segments)
        return start, start, prior, {"start": "keypoints", "frames_without_points": int((~valid).sum())}
    aligned, valid = start_from_keypoints(model, name, given, points.points, segments)
    wide = 10 * threshold
    worse = frame_errors(model, given, seen, wide) > 2 * frame_errors(model, aligned, seen, wide) + threshold**2
    worse &= valid
    start = State(
        torch.where(worse[:, None, None], aligned.rotation, given.rotation),
        torch.where(worse[:, None], aligned.transl, given.transl),
        given.local,
        given.shape,
    )
    summary = {"start": "params", "frames_realigned": int(worse.sum()), "frames_without_points": int((~valid).sum())}
    # The head's deviations say nothing about the dataset's error, the hand's pose statistics say what hands do.
    prior = with_anchor(prior, given, None if name == "head" else math.radians(cfg.anchor_deg))
    return start, given, prior, summary


def _model(name: str, bodies: Bodies) -> tuple[PartModel, torch.Tensor]:
    """Model of a part and its mean local pose."""
    if name == "head":
        if bodies.head is None or bodies.head.landmarks is None:
            raise DataError.of("assets", "FLAME", expected="a head model with landmarks", found="none")
        head = HeadPart(bodies.head, bodies.head.landmarks)
        return head, torch.zeros(head.local_count, dtype=torch.float64)
    mano = bodies.hands.get(_side(name))
    if mano is None:
        raise DataError.of("assets", "MANO", expected=f"a model of the {_side(name)} hand", found="none")
    return HandPart(mano), mano.mean_pose


def _prior(
    name: str,
    model: PartModel,
    mean: torch.Tensor,
    bodies: Bodies,
    segments: list[tuple[int, int]],
    cfg: FitConfig,
    count: int,
) -> Prior:
    size = model.local_count
    angle = _precision(math.radians(cfg.smooth_pose_deg))
    if name == "head":
        jaw = torch.full((3,), 1 / math.radians(cfg.jaw_deviation_deg), dtype=torch.float64)
        expression = torch.full((size - 3,), 1 / cfg.expression_deviation, dtype=torch.float64)
        root = torch.diag(torch.cat([jaw, expression]))
        local = [angle] * 3 + [_precision(cfg.smooth_expression)] * (size - 3)
    else:
        mano = bodies.hands[_side(name)]
        floor = math.radians(cfg.pose_floor_deg)
        if mano.pose_basis is None or mano.pose_deviation is None:
            root = torch.eye(size, dtype=torch.float64) / math.radians(30)
        else:
            root = mano.pose_basis / mano.pose_deviation.clamp_min(floor)[:, None]
        local = [angle] * size
    rigid = [_precision(math.radians(cfg.smooth_rotation_deg))] * 3 + [_precision(cfg.smooth_transl_mm / 1000)] * 3
    smoothness = torch.tensor(rigid + local, dtype=torch.float64)
    centre = mean.expand(count, -1).clone()
    shape = torch.zeros(model.shape_count, dtype=torch.float64)
    return Prior(centre, root, shape, cfg.shape_deviation, smoothness, segments)


def _distance_maps(
    masks: Masks | None, cameras: Sequence[str] | None, extras: Mapping[str, np.ndarray], cfg: FitConfig
) -> dict[str, "_Maps"]:
    """Camera -> its maps; the same serve all parts."""
    maps: dict[str, _Maps] = {}
    if masks is None or cfg.silhouette_weight == 0:
        return maps
    for camera, images in masks.images.items():
        if f"camera.{camera}.K" in extras and (cameras is None or camera in cameras):
            distortion = extras.get(f"camera.{camera}.distortion")
            if distortion is not None and not np.any(distortion):
                distortion = None
            K = np.asarray(extras[f"camera.{camera}.K"], dtype=np.float64)
            reduced, scale = ideal_mask(images, K, distortion, cfg.silhouette_lines)
            distance, cover = np.stack([signed_distance_map(mask, 1 / scale) for mask in reduced]), None
            if camera in masks.unseen:
                hidden, _ = ideal_mask(masks.unseen[camera], K, distortion, cfg.silhouette_lines)
                cover = np.stack([distance_map(mask, 1 / scale) for mask in hidden])
            maps[camera] = _Maps(distance, cover, scale)
    return maps


class _Maps(NamedTuple):
    """Of one camera: signed distances to the border, distances to what says nothing, `[n, h, w]`; their scale."""

    distance: np.ndarray
    cover: np.ndarray | None
    scale: float


def _silhouettes(
    masks: Masks, maps: Mapping[str, _Maps], cameras: Sequence[str], cfg: FitConfig, scale: float
) -> Silhouettes | None:
    """Distance maps of the cameras in use; None when there are none."""
    maps = {camera: maps[camera] for camera in cameras if camera in maps}
    if not maps:
        return None
    height, width = (max(found.distance.shape[axis] for found in maps.values()) for axis in (1, 2))
    distance = np.zeros((len(cameras), len(masks.frames), height, width), dtype=np.float32)
    cover = np.full_like(distance, FAR)
    scales = np.ones(len(cameras))
    for row, camera in enumerate(cameras):
        if camera in maps:
            found = maps[camera]
            scales[row], window = found.scale, np.s_[row, :, : found.distance.shape[1], : found.distance.shape[2]]
            distance[window] = found.distance
            cover[window] = FAR if found.cover is None else found.cover
    return Silhouettes(
        torch.tensor(list(masks.frames)), torch.from_numpy(distance), torch.from_numpy(scales), masks.labels,
        cfg.silhouette_band_px * scale, cfg.silhouette_deviation_px * scale, cfg.silhouette_weight,
        torch.from_numpy(cover) if any(found.cover is not None for found in maps.values()) else None,
    )  # fmt: skip


def _precision(deviation: float) -> float:
    return 0.0 if deviation == 0 else deviation**-2


def _side(name: str) -> str:
    return name.removesuffix("_hand")


def _segments(extras: Mapping[str, np.ndarray], count: int) -> list[tuple[int, int]]:
    if "segments" not in extras:
        return [(0, count - 1)]
    segments = [(int(a), int(b)) for a, b in np.asarray(extras["segments"]).reshape(-1, 2)]
    covered = [frame for a, b in segments for frame in range(a, b + 1)]
    if covered != list(range(count)):
        raise DataError.of(
            "tracks", "segments", expected=f"runs that cover frames 0 to {count - 1} once", found=segments
        )
    return segments


def _lines(extras: Mapping[str, np.ndarray], cameras: Sequence[str]) -> float:
    """Image height that pixel options refer to, the mean over cameras; 1080 when unknown."""
    sizes = [extras[f"camera.{c}.size"] for c in cameras if f"camera.{c}.size" in extras]
    return float(np.mean([size[1] for size in sizes])) if sizes else float(_LINES)


def _widths(extras: Mapping[str, np.ndarray], cameras: Sequence[str]) -> np.ndarray | None:
    names = [f"camera.{c}.size" for c in cameras]
    return np.array([float(extras[n][0]) for n in names]) if all(n in extras for n in names) else None


def _turn_reference(before: Mapping[str, np.ndarray], after: dict[str, np.ndarray]) -> None:
    """Reference dents are in world axes: they turn with the head when the refit turns it."""
    from nbavatar.math.rotations import axis_angle_to_matrix

    key, orient = "deformation.head", "param.head.global_orient"
    if key in before and orient in before and after[orient] is not before[orient]:
        old, new = (axis_angle_to_matrix(torch.from_numpy(np.asarray(s[orient], np.float64))) for s in (before, after))
        after[key] = np.einsum("nij,nvj->nvi", (new @ old.mT).numpy(), before[key]).astype(np.float32)


def _median(table: np.ndarray) -> float | None:
    values = table[:, 0][np.isfinite(table[:, 0])]
    return float(np.median(values)) if len(values) else None


def _share(table: np.ndarray) -> float | None:
    known = table[:, 3] > 0
    return float((table[known, 2] * table[known, 3]).sum() / table[known, 3].sum()) if known.any() else None
