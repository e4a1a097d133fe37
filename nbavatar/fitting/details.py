"""What pictures say about where the surface is: their details, and how far the surface's colours disagree with them.

Surface points keep their colour: seen by one camera in frames in which the part lies alike, a vertex that is where it
should be has the same colour in all of them. Compared are details (a difference of Gaussians), so that shading, which
changes slowly, takes no part.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from nbavatar.camera.distortion import distort_pixels
from nbavatar.camera.pinhole import Camera, project, scale_intrinsics
from nbavatar.config.geometry import AlignConfig
from nbavatar.mesh.drawing import vertex_normals
from nbavatar.mesh.zbuffer import joined_meshes, rasterize_mesh

__all__ = ["Details", "Pulls", "colour_pulls", "facing", "likeness", "look", "projected", "working_size"]

_LEVELS = (3.0, 1.5)  # Gaussian of the pictures [px]
_BAND = 3.0  # the wider Gaussian that is subtracted, in the narrower one's widths
_FACING = 0.25  # least cosine between a vertex' normal and its line of sight
_RIM = 2  # pixels by which a vertex must lie within its part as the camera sees it
_BEHIND = 0.004  # a vertex may lie this far behind the surface that the camera sees, whose triangles are chords [m]
_ROBUST = 2.5  # residuals of this many deviations lose three quarters of their weight
_COMPANY = 0.2  # least weight of other frames in a vertex' mean colour


class Details(NamedTuple):
    """One camera's pictures of a block: details (n, h, w, 3), and from full to working pixels."""

    camera: Camera
    details: np.ndarray
    scale: float


class Pulls(NamedTuple):
    """What the vertices of a part are drawn to: normal equations of each one's position alone.

    Attributes:
        stiff: (n, P, 3, 3); pull: (n, P, 3). The best small step of a vertex solves stiff step = -pull.
        typical: typical residual [1].
    """

    stiff: np.ndarray
    pull: np.ndarray
    typical: float


def look(
    verts: Mapping[str, np.ndarray],
    faces: Mapping[str, np.ndarray],
    cameras: Sequence[Camera],
    read: Callable[[str, int], np.ndarray | None],
    cfg: AlignConfig,
) -> tuple[dict[str, np.ndarray], list[list[Details]]]:
    """Reads the pictures of a block of frames.

    Args:
        verts, faces, cameras, read, cfg: as in `nbavatar.fitting.align.align_block`.

    Returns:
        which vertices each camera sees, part -> bool (C, n, V), and the cameras' details, coarse to fine.
    """
    count = len(next(iter(verts.values())))
    pictures = {camera.name: [_reduced(read(camera.name, i), camera, cfg) for i in range(count)] for camera in cameras}
    seen = _visible(verts, faces, cameras, pictures, cfg)
    return seen, [[_shot(camera, pictures[camera.name], level, cfg) for camera in cameras] for level in _LEVELS]


def colour_pulls(placed: np.ndarray, shots: Sequence[Details], weight: np.ndarray, alike: np.ndarray) -> Pulls:
    """Where the colours of vertices (n, P, 3) want them to be.

    Args:
        placed: vertices in the world [m].
        shots: details of the cameras.
        weight: visibility (C, n, P).
        alike: how alike the part lies in two frames (n, n).
    """
    count, number = placed.shape[:2]
    stiff, pull, sizes = np.zeros((count, number, 3, 3)), np.zeros((count, number, 3)), []
    for shot, visible in zip(shots, weight, strict=True):
        pixels, slope = projected(placed, shot)
        colour, gradient, inside = _sample(shot.details, pixels)
        shown = visible * inside
        total = alike @ shown
        mean = (alike @ (shown[..., None] * colour).reshape(count, -1)).reshape(colour.shape)
        residual = colour - mean / np.maximum(total, 1e-9)[..., None]
        shown = shown * (total > 1.0 + _COMPANY)
        if not shown.any():
            continue
        typical = 1.4826 * float(np.median(np.abs(residual)[shown > 0])) + 1e-4
        sizes.append(typical)
        share = shown[..., None] / (1.0 + (residual / (_ROBUST * typical)) ** 2) ** 2 / typical**2
        change = gradient @ slope
        stiff += np.swapaxes(change * share[..., None], -1, -2) @ change
        pull += ((share * residual)[..., None, :] @ change)[..., 0, :]
    return Pulls(stiff, pull, float(np.mean(sizes)) if sizes else np.nan)


def likeness(points: np.ndarray, length: float) -> np.ndarray:
    """How alike a part lies in two frames (n, n): 1 for the same place, falling with the vertices' mean distance."""
    few = points[:, :: max(1, points.shape[1] // 200)]
    distance = ((few[:, None] - few[None]) ** 2).sum(-1).mean(-1)
    return np.exp(-0.5 * distance / length**2)


def projected(points: np.ndarray, shot: Details) -> tuple[np.ndarray, np.ndarray]:
    """Working pixels (n, P, 2) of points, and their change with the position (n, P, 2, 3) [px/m].

    Lens distortion moves the pixels; that it also bends their change by some percent only makes steps less exact.
    """
    camera = shot.camera
    ideal, depth = project(points, camera.K, camera.cam_from_world)
    pixels = distort_pixels(ideal, camera.K, camera.distortion) * shot.scale
    depth = np.maximum(depth, 1e-6)
    slope = np.zeros((*points.shape[:-1], 2, 3))
    for axis in (0, 1):
        slope[..., axis, axis] = camera.K[axis, axis] / depth
        slope[..., axis, 2] = -(ideal[..., axis] - camera.K[axis, 2]) / depth
    return pixels, shot.scale * slope @ camera.cam_from_world[:3, :3]


def working_size(camera: Camera, cfg: AlignConfig) -> tuple[int, int]:
    """Width and height [px] of the pictures that are worked on."""
    scale = min(1.0, cfg.lines / camera.height)
    return max(1, round(camera.width * scale)), max(1, round(camera.height * scale))


def _reduced(picture: np.ndarray | None, camera: Camera, cfg: AlignConfig) -> np.ndarray | None:
    """A picture at the size that is worked on."""
    import cv2

    return None if picture is None else cv2.resize(picture, working_size(camera, cfg), interpolation=cv2.INTER_AREA)


def _shot(camera: Camera, pictures: Sequence[np.ndarray | None], level: float, cfg: AlignConfig) -> Details:
    """Details of one camera's reduced pictures; nothing where a picture is missing."""
    import cv2

    width, height = working_size(camera, cfg)
    details = np.zeros((len(pictures), height, width, 3), np.float16)  # details are small: 11 bits are plenty
    for row, picture in enumerate(pictures):
        if picture is not None:
            small = picture.astype(np.float32) / 255.0
            details[row] = cv2.GaussianBlur(small, (0, 0), level) - cv2.GaussianBlur(small, (0, 0), _BAND * level)
    return Details(camera, details, height / camera.height)


def _sample(details: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bilinear colours (n, P, 3), their change with the pixel (n, P, 3, 2), and whether it lies in the picture."""
    height, width = details.shape[1:3]
    place = np.nan_to_num(pixels, nan=-9.0) - 0.5
    inside = np.asarray(((place >= 0) & (place < [width - 1, height - 1])).all(-1))
    place = np.clip(place, 0, [width - 1.001, height - 1.001])
    cell = np.floor(place).astype(int)
    u, v = np.moveaxis((place - cell)[..., None], -2, 0)
    row = np.arange(len(details))[:, None]
    x, y = cell[..., 0], cell[..., 1]
    a, b, c, d = (details[row, y + j, x + i].astype(np.float64) for j in (0, 1) for i in (0, 1))
    colour = (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * d)
    gradient = np.stack([(1 - v) * (b - a) + v * (d - c), (1 - u) * (c - a) + u * (d - b)], axis=-1)
    return colour, gradient, inside


def _visible(
    verts: Mapping[str, np.ndarray],
    faces: Mapping[str, np.ndarray],
    cameras: Sequence[Camera],
    pictures: Mapping[str, list[np.ndarray | None]],
    cfg: AlignConfig,
) -> dict[str, np.ndarray]:
    """Which vertices each camera sees, well within the outline of their part: part -> bool (C, n, V)."""
    count = len(next(iter(verts.values())))
    seen = {part: np.zeros((len(cameras), count, points.shape[1]), bool) for part, points in verts.items()}
    for index, camera in enumerate(cameras):
        width, height = working_size(camera, cfg)
        K = scale_intrinsics(camera.K, width / camera.width, height / camera.height)
        for row in range(count):
            there = [part for part in verts if np.isfinite(verts[part][row]).all()]
            if pictures[camera.name][row] is None or not there:
                continue
            merged, joined, offsets = joined_meshes([(verts[part][row], faces[part]) for part in there])
            owner = np.repeat(np.arange(len(there)), [len(faces[part]) for part in there])
            face, _, depth = rasterize_mesh(merged, joined, K, width, height, cam_from_world=camera.cam_from_world)
            owners = np.where(face >= 0, owner[np.maximum(face, 0)], -1)
            pixels, z = project(merged.astype(np.float64), K, camera.cam_from_world)
            towards = facing(merged, joined, camera.cam_from_world)
            cell = np.floor(np.nan_to_num(pixels, nan=-9.0, posinf=-9.0, neginf=-9.0)).clip(-9, 1 << 20).astype(int)
            inside = ((cell >= _RIM) & (cell < [width - _RIM, height - _RIM])).all(-1)
            x, y = cell.clip(_RIM, [max(_RIM, width - _RIM - 1), max(_RIM, height - _RIM - 1)]).T
            visible = inside & (towards > _FACING) & (z > 0) & (z < depth[y, x] + _BEHIND)
            own = np.repeat(np.arange(len(there)), np.diff(offsets))
            for dy in (-_RIM, 0, _RIM):
                for dx in (-_RIM, 0, _RIM):
                    visible &= owners[y + dy, x + dx] == own
            for i, part in enumerate(there):
                seen[part][index, row] = visible[offsets[i] : offsets[i + 1]]
    return seen


def facing(verts: np.ndarray, faces: np.ndarray, cam_from_world: np.ndarray) -> np.ndarray:
    """Cosine between the vertices' normals and the directions to the camera, (V,)."""
    placed = verts.astype(np.float64) @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
    normals = vertex_normals(placed, faces)
    return -(normals * placed).sum(1) / np.maximum(np.linalg.norm(placed, axis=1), 1e-12)
