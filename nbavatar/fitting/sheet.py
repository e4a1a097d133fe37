"""Contact sheet of a refit: fitted meshes drawn over images, keypoints, convergence, errors per camera.

Wireframes show front-facing edges, head cyan, right hand orange, left hand magenta; dots are detected keypoints (white
when the fit explains them, red when not). Below, the median keypoint error over the steps of the refit, and a bar
pair per camera: error before and after.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from PIL import Image, ImageDraw

from nbavatar.camera.distortion import distort_pixels
from nbavatar.camera.pinhole import project

__all__ = ["View", "draw_sheet"]

_COLOURS = {"head": (0, 200, 220), "right_hand": (255, 150, 0), "left_hand": (230, 60, 200)}
_INK, _PAPER, _GREY = (30, 30, 30), (250, 250, 250), (150, 150, 150)
_PLOT_HEIGHT = 220


@dataclasses.dataclass(frozen=True)
class View:
    """One picture of the sheet.

    Attributes:
        title: camera and frame.
        image: uint8 `[H, W, 3]`, as recorded (distorted); None draws on grey.
        size: width and height [px].
        K: `[3, 3]`.
        cam_from_world: `[4, 4]`.
        distortion: coefficients or None.
        meshes: part -> (vertices `[V, 3]` [m], faces `[F, 3]`).
        keypoints: part -> `[L, 3]` x, y [px, distorted], and 0 for missing, 1 for unexplained, 2 for explained.
    """

    title: str
    image: np.ndarray | None
    size: tuple[int, int]
    K: np.ndarray
    cam_from_world: np.ndarray
    distortion: np.ndarray | None
    meshes: Mapping[str, tuple[np.ndarray, np.ndarray]]
    keypoints: Mapping[str, np.ndarray]


def draw_sheet(
    rows: Sequence[Sequence[View]],
    curves: Mapping[str, np.ndarray],
    errors: Mapping[str, tuple[np.ndarray, np.ndarray]],
    cameras: Sequence[str],
    *,
    tile: int,
) -> np.ndarray:
    """Draws the sheet.

    Args:
        rows: pictures, one row a frame.
        curves: part -> `[I, 4]` convergence (stage, cost, median error, sigma).
        errors: part -> (before, after) `[M, 4]` tables of `observe.error_table`.
        cameras: names of their M rows.
        tile: height of a picture [px].

    Returns:
        uint8 `[H, W, 3]`.
    """
    strips = [np.concatenate([_draw_view(view, tile) for view in row], axis=1) for row in rows]
    width = max([strip.shape[1] for strip in strips] + [640])
    parts = [np.pad(s, ((0, 0), (0, width - s.shape[1]), (0, 0)), constant_values=_PAPER[0]) for s in strips]
    parts.append(_draw_plots(curves, errors, cameras, width))
    return np.concatenate(parts)


def _draw_view(view: View, tile: int) -> np.ndarray:
    """One square picture: the region of the meshes, scaled to `tile`."""
    projected = {name: _project(view, verts) for name, (verts, _) in view.meshes.items()}
    x0, y0, side = _window(projected, view)
    width, height = view.size
    image = view.image if view.image is not None else np.full((height, width, 3), 96, dtype=np.uint8)
    scale = tile / side
    box = (x0, y0, x0 + side, y0 + side)
    picture = Image.fromarray(image).transform((tile, tile), Image.Transform.EXTENT, box, Image.Resampling.BILINEAR)
    draw = ImageDraw.Draw(picture)
    for name, (verts, faces) in view.meshes.items():
        xy = (projected[name] - [x0, y0]) * scale
        _draw_mesh(draw, xy, verts, faces, view, _COLOURS[name])
    radius = max(1.5, tile / 200)
    for points in view.keypoints.values():
        for x, y, kind in points[points[:, 2] > 0]:
            cx, cy = (x - x0) * scale, (y - y0) * scale
            fill = (255, 255, 255) if kind > 1 else (230, 30, 30)
            draw.ellipse((cx - radius, cy - radius, cx + radius, cy + radius), fill=fill, outline=(0, 0, 0))
    draw.text((4, 3), view.title, fill=(255, 255, 255), stroke_width=1, stroke_fill=(0, 0, 0))
    return np.asarray(picture)


def _project(view: View, verts: np.ndarray) -> np.ndarray:
    ideal, depth = project(np.asarray(verts, np.float64), view.K, view.cam_from_world)
    pixels = distort_pixels(ideal, view.K, view.distortion)
    return np.where(depth[..., None] > 0, pixels, np.nan)


def _window(projected: Mapping[str, np.ndarray], view: View) -> tuple[float, float, float]:
    """Square around all meshes, with a margin; the whole image when nothing is in it."""
    points = np.concatenate([*projected.values(), np.zeros((0, 2))])
    points = points[np.isfinite(points).all(1)]
    width, height = view.size
    inside = (points > 0).all(1) & (points < [width, height]).all(1)
    points = points[inside]
    if len(points) < 3:
        return 0.0, 0.0, float(max(width, height))
    low, high = points.min(0), points.max(0)
    side = 1.1 * max((high - low).max(), 8.0)
    middle = (low + high) / 2 - side / 2
    return float(middle[0]), float(middle[1]), float(side)


def _draw_mesh(
    draw: ImageDraw.ImageDraw,
    xy: np.ndarray,
    verts: np.ndarray,
    faces: np.ndarray,
    view: View,
    colour: tuple[int, int, int],
) -> None:
    """Edges of faces that look at the camera."""
    camera = verts @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]
    corners = camera[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    front = (normal * corners[:, 0]).sum(1) < 0
    edges = np.sort(faces[front][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges = np.unique(edges, axis=0)
    lines = xy[edges]
    for a, b in lines[np.isfinite(lines).all((1, 2))]:
        draw.line((a[0], a[1], b[0], b[1]), fill=colour)


def _draw_plots(
    curves: Mapping[str, np.ndarray],
    errors: Mapping[str, tuple[np.ndarray, np.ndarray]],
    cameras: Sequence[str],
    width: int,
) -> np.ndarray:
    picture = Image.new("RGB", (width, _PLOT_HEIGHT), _PAPER)
    draw = ImageDraw.Draw(picture)
    half = width // 2
    _draw_curves(draw, curves, (50, 30, half - 20, _PLOT_HEIGHT - 30))
    _draw_bars(draw, errors, cameras, (half + 50, 30, width - 20, _PLOT_HEIGHT - 30))
    return np.asarray(picture)


def _draw_curves(draw: ImageDraw.ImageDraw, curves: Mapping[str, np.ndarray], box: tuple[int, int, int, int]) -> None:
    left, top, right, bottom = box
    draw.text((left, 8), "median keypoint error by step [px, log]", fill=_INK)
    values = [curve[:, 2] for curve in curves.values() if len(curve)]
    if not values:
        return
    logs = np.log10(np.concatenate(values).clip(1e-4))
    low, high = np.floor(logs.min() * 4) / 4, np.ceil(logs.max() * 4) / 4 + 1e-9
    steps = max(len(v) for v in values)
    for tick in np.linspace(low, high, 3):
        y = bottom - (tick - low) / (high - low) * (bottom - top)
        draw.line((left, y, right, y), fill=(225, 225, 225))
        draw.text((4, y - 6), f"{10**tick:.3g}", fill=_INK)
    for name, curve in curves.items():
        x = left + np.arange(len(curve)) / max(steps - 1, 1) * (right - left)
        y = bottom - (np.log10(curve[:, 2].clip(1e-4)) - low) / (high - low) * (bottom - top)
        draw.line([(float(a), float(b)) for a, b in zip(x, y, strict=True)], fill=_COLOURS[name], width=2)
        for a, b, stage in zip(x, y, curve[:, 0], strict=True):
            size = 2 + stage / 2
            draw.ellipse((a - size, b - size, a + size, b + size), fill=_COLOURS[name])


def _draw_bars(
    draw: ImageDraw.ImageDraw,
    errors: Mapping[str, tuple[np.ndarray, np.ndarray]],
    cameras: Sequence[str],
    box: tuple[int, int, int, int],
) -> None:
    left, top, right, bottom = box
    draw.text((left, 8), "median error per camera, before (grey) and after [px]", fill=_INK)
    tables = [table[:, 0] for pair in errors.values() for table in pair]
    largest = max([float(np.nanmax(t, initial=0.0)) for t in tables] + [1e-6])
    group = (right - left) / max(len(cameras), 1)
    bar = group / (2 * max(len(errors), 1) + 1)
    draw.text((left - 46, top - 6), f"{largest:.3g}", fill=_INK)
    draw.line((left, bottom, right, bottom), fill=_INK)
    for row, camera in enumerate(cameras):
        draw.text((left + row * group + 2, bottom + 4), camera[:12], fill=_INK)
        for k, (name, (before, after)) in enumerate(errors.items()):
            for j, (table, colour) in enumerate(((before, _GREY), (after, _COLOURS[name]))):
                if row < len(table) and np.isfinite(table[row, 0]):
                    x = left + row * group + (2 * k + j) * bar
                    y = bottom - table[row, 0] / largest * (bottom - top)
                    draw.rectangle((x, y, x + bar - 1, bottom), fill=colour)
