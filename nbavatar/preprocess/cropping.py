"""Crop windows of a camera's sequence, and frames cut, undistorted and resized with their camera matrices."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from nbavatar.camera.distortion import undistort_pixels
from nbavatar.camera.pinhole import Camera, crop_intrinsics, project, scale_intrinsics
from nbavatar.data.sequences import MeshSequence
from nbavatar.errors import DataError
from nbavatar.preprocess.boxes import center_square, fill_missing, padded_square, square_window, union_box

__all__ = ["CropPlan", "crop_extent", "frame_boxes", "plan_crop"]

_EDGE_SAMPLES = 9


@dataclasses.dataclass(frozen=True)
class CropPlan:
    """Where each frame is cut.

    Attributes:
        windows: frame -> x0, y0, side [px] in the (undistorted) native image.
        size: side of the result [px].
        K: frame -> camera matrix of the result [px]; all equal unless the boxes move.
        moving: whether they do.
    """

    windows: dict[str, tuple[int, int, int]]
    size: int
    K: dict[str, np.ndarray]
    moving: bool


def plan_crop(
    camera: Camera,
    frames: Sequence[str],
    *,
    kind: str,
    size: int,
    pad: float,
    per_frame: bool,
    multiple: int,
    boxes: np.ndarray | None = None,
) -> CropPlan:
    """Decides the windows of all frames.

    Args:
        camera: native camera; the windows lie in its undistorted image.
        frames: ids.
        kind: `center`, `box` or `full`; see `config.preprocess.CropConfig`.
        size: side of the result [px], 0 for the window's own.
        pad: margin of boxes as a share.
        per_frame: one window a frame, all of the largest one's side, instead of one for all.
        multiple: the side of `full` windows, and of results at native scale, is a multiple of this [px].
        boxes: float `[N, 4]` [px, undistorted], NaN where there is no detection; needed for `box`.

    Raises:
        DataError: `box` and no valid box in the whole sequence.
    """
    if kind == "center":
        windows = [center_square(camera.width, camera.height)] * len(frames)
    elif kind == "full":
        windows = [padded_square(camera.width, camera.height, multiple)] * len(frames)
    else:
        assert boxes is not None
        valid = np.asarray(np.isfinite(boxes).all(axis=1))
        if not valid.any():
            raise DataError.of(f"camera {camera.name}", "boxes", expected="at least one valid box", found="none")
        if per_frame:
            filled = fill_missing(boxes)
            side = max(square_window(box, camera.width, camera.height, pad=pad)[2] for box in filled)
            windows = [square_window(box, camera.width, camera.height, pad=pad, side=side) for box in filled]
        else:
            windows = [square_window(union_box(boxes), camera.width, camera.height, pad=pad)] * len(frames)
    side = windows[0][2]
    result = size or -(-side // multiple) * multiple
    if not size and result != side:  # native scale: the window grows instead of the pixels
        grow = (result - side) // 2
        windows = [(x0 - grow, y0 - grow, result) for x0, y0, _ in windows]
    scale = result / windows[0][2]
    K = {
        frame: scale_intrinsics(crop_intrinsics(camera.K, x0, y0), scale, scale)
        for frame, (x0, y0, _) in zip(frames, windows)
    }
    return CropPlan(dict(zip(frames, windows)), result, K, len(set(windows)) > 1)


def frame_boxes(
    sequence: MeshSequence, camera: Camera, frames: Sequence[str], *, fill: bool = False
) -> tuple[np.ndarray, str, list[str]]:
    """Box over head and hands of each frame, in the undistorted image.

    Tracked boxes are used where the sequence has them for this camera, projected meshes otherwise.

    Args:
        sequence: meshes, and tracked boxes among its extras.
        camera: native camera.
        frames: ids.
        fill: interpolate each part's missing boxes over time first, so that a lost hand does not shrink the box.

    Returns:
        float64 `[N, 4]` [px], NaN where nothing was detected; where they come from; frames in which a part is missing.
    """
    rows = sequence.index(frames)
    tracked = [
        sequence.extras[name][rows].astype(np.float64)
        for name in (f"boxes.{part}.{camera.name}" for part in sequence.parts)
        if name in sequence.extras
    ]
    if not tracked:
        boxes = np.stack([_mesh_box(sequence, camera, row) for row in rows])
        lost = np.isnan(boxes).any(axis=1)
        return (fill_missing(boxes) if fill else boxes), "projected meshes", _named(frames, lost)
    lost = np.isnan(np.stack(tracked)).any(axis=(0, 2))
    stack = np.stack([fill_missing(boxes) if fill else boxes for boxes in tracked])  # [parts, N, 4]
    boxes = np.stack([_undistorted(union_box(stack[:, i]), camera) for i in range(len(rows))])
    return boxes, "tracked boxes", _named(frames, lost)


def _named(frames: Sequence[str], chosen: Sequence[bool] | np.ndarray | np.bool) -> list[str]:
    return [frames[int(i)] for i in np.flatnonzero(chosen)]


def crop_extent(plan: CropPlan, camera: Camera) -> Mapping[str, float]:
    """How much of the windows lies outside the image, as a share of their area: mean and largest."""
    shares = []
    for x0, y0, side in plan.windows.values():
        wide = max(0, min(x0 + side, camera.width) - max(x0, 0))
        high = max(0, min(y0 + side, camera.height) - max(y0, 0))
        shares.append(1.0 - wide * high / side**2)
    return {"mean": float(np.mean(shares)), "max": float(np.max(shares))}


def _undistorted(box: np.ndarray, camera: Camera) -> np.ndarray:
    """Bounding box of a box's undistorted outline."""
    if camera.distortion is None or not np.isfinite(box).all():
        return box
    x, y = np.linspace(box[0], box[2], _EDGE_SAMPLES), np.linspace(box[1], box[3], _EDGE_SAMPLES)
    outline = [np.stack([x, np.full_like(x, v)], 1) for v in (box[1], box[3])]
    outline += [np.stack([np.full_like(y, v), y], 1) for v in (box[0], box[2])]
    ideal = undistort_pixels(np.concatenate(outline), camera.K, camera.distortion)
    ideal = ideal[np.isfinite(ideal).all(axis=1)]
    return union_box(np.concatenate([ideal, ideal], axis=1)) if len(ideal) else box


def _mesh_box(sequence: MeshSequence, camera: Camera, row: int) -> np.ndarray:
    points = np.concatenate([part.verts[row] for part in sequence.parts.values()]).astype(np.float64)
    points = points[np.isfinite(points).all(axis=1)]  # parts that are not in this frame are NaN
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels, depth = project(points, camera.K, camera.cam_from_world)
    pixels = pixels[depth > 1e-3]
    if len(pixels):
        pixels = np.clip(pixels, 0, [camera.width, camera.height])
    box = union_box(np.concatenate([pixels, pixels], axis=1)) if len(pixels) else np.full(4, np.nan)
    return box if box[2] > box[0] and box[3] > box[1] else np.full(4, np.nan)
