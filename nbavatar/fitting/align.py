"""Rigid alignment of tracked meshes to what the cameras saw: the jitter of a tracker, taken out.

Trackers place a part a millimetre off, another way in every frame. An avatar trained on such meshes learns the mean of
what it was shown, so its outlines and its details blur. Surface points keep their colour, though: seen by one camera in
frames in which the part lies alike, a vertex that is where it should be has the same colour in all of them.

For each part, a rigid motion a frame (rotation vector w about the part's mean, shift d) minimises

    sum over cameras c, frames t, vertices v of  rho( I_ct(pi_c(R_t x_tv + d_t)) - M_ctv )

with I the pictures' details (a difference of Gaussians, so that shading, which changes slowly, takes no part), rho
Geman and McClure's, and M the mean colour of the vertex in that camera over the frames in which the part lies alike.
M and the motions are found in turns, by Gauss-Newton steps, coarse to fine (direct alignment after Lucas and Kanade
1981). No texture, no body model and no avatar is needed. An error that all frames share cannot be seen by this, and is
left as it is: the motions of a run of frames have mean zero. Deformation is not touched.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from nbavatar.camera.distortion import distort_pixels
from nbavatar.camera.pinhole import Camera, project, scale_intrinsics
from nbavatar.config.geometry import AlignConfig
from nbavatar.mesh.drawing import vertex_normals
from nbavatar.mesh.zbuffer import rasterize_mesh

__all__ = ["Motion", "align_block", "blocks", "moved", "summary"]

_LEVELS = (3.0, 1.5)  # Gaussian of the pictures [px]
_BAND = 3.0  # the wider Gaussian that is subtracted, in the narrower one's widths
_FACING = 0.25  # least cosine between a vertex' normal and its line of sight
_RIM = 2  # pixels by which a vertex must lie within its part as the camera sees it
_BEHIND = 0.004  # a vertex may lie this far behind the surface that the camera sees, whose triangles are chords [m]
_ROBUST = 2.5  # residuals of this many deviations lose three quarters of their weight
_COMPANY = 0.2  # least weight of other frames in a vertex' mean colour
_STILL = 1e-5  # a mean step below this ends a level [m]


class Motion(NamedTuple):
    """Rigid motions of one part in a block of frames.

    Attributes:
        turn: rotation vectors about the part's mean, (n, 3) [rad].
        shift: (n, 3) [m].
        before, after: typical residual of the colours' details at the start and at the end [1].
    """

    turn: np.ndarray
    shift: np.ndarray
    before: float
    after: float


class _Shot(NamedTuple):
    """One camera's pictures of a block: details (n, h, w, 3), and from full to working pixels."""

    camera: Camera
    details: np.ndarray
    scale: float


def blocks(rows: Sequence[int], segments: Sequence[tuple[int, int]], most: int) -> list[list[int]]:
    """Runs of frames that are aligned together: none crosses a cut, none is longer than `most`.

    Args:
        rows: frames to align, increasing.
        segments: first and last frame of each uncut run.
        most: frames a block.
    """
    result = []
    for first, last in segments:
        inside = [row for row in rows if first <= row <= last]
        parts = -(-len(inside) // most)
        result += [list(map(int, piece)) for piece in np.array_split(inside, parts)] if parts else []
    return result


def moved(verts: np.ndarray, motion: Motion, centre: np.ndarray | None = None) -> np.ndarray:
    """Vertices (n, V, 3) [m] after a motion, float64; `centre` (n, 3) is their mean where none is given."""
    from scipy.spatial.transform import Rotation

    verts = np.asarray(verts, np.float64)
    middle = (verts.mean(1) if centre is None else centre)[:, None]
    turned = np.einsum("nij,nvj->nvi", Rotation.from_rotvec(motion.turn).as_matrix(), verts - middle)
    return turned + middle + motion.shift[:, None]


def align_block(
    verts: Mapping[str, np.ndarray],
    faces: Mapping[str, np.ndarray],
    cameras: Sequence[Camera],
    read: Callable[[str, int], np.ndarray | None],
    cfg: AlignConfig,
) -> dict[str, Motion]:
    """Finds the motions of all parts in a block of frames.

    Args:
        verts: part -> (n, V, 3) [m], world; NaN where the part is not in the frame.
        faces: part -> (F, 3).
        cameras: that saw it.
        read: picture of a camera (its name) in a frame of the block (its position), uint8 (H, W, 3) as recorded, or
            None where there is none.
        cfg: options.

    Returns:
        part -> motion: zero for frames without the part, and for a part whose colours agree no better for it.
    """
    count = len(next(iter(verts.values())))
    pictures = {camera.name: [_reduced(read(camera.name, i), camera, cfg) for i in range(count)] for camera in cameras}
    seen = _visible(verts, faces, cameras, pictures, cfg)
    levels = [[_shot(camera, pictures[camera.name], level, cfg) for camera in cameras] for level in _LEVELS]
    motions = {}
    for part, points in verts.items():
        there = np.array([bool(np.isfinite(one).all()) for one in points])
        start = np.where(there[:, None, None], points, 0.0).astype(np.float64)
        chosen = _spread(points.shape[1], cfg.points)
        weight = seen[part][..., chosen] & there[None, :, None]
        motions[part] = _align_part(start, chosen, weight, there, levels, cfg)
    return motions


def _spread(count: int, most: int) -> np.ndarray:
    """At most so many vertices, evenly from the list."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def _align_part(
    start: np.ndarray,
    chosen: np.ndarray,
    weight: np.ndarray,
    there: np.ndarray,
    levels: Sequence[Sequence[_Shot]],
    cfg: AlignConfig,
) -> Motion:
    """One part: `start` (n, V, 3), the `chosen` of V, their visibility (C, n, P), frames with the part (n,)."""
    rest = motion = Motion(np.zeros((len(start), 3)), np.zeros((len(start), 3)), np.nan, np.nan)
    if there.sum() < 2 or not weight.any():
        return rest
    centre, points = start.mean(1), start[:, chosen]
    alike = _likeness(points, 1e-3 * cfg.likeness_mm) * (there[:, None] & there)
    prior = np.repeat([np.radians(cfg.turn_deg) ** -2.0, (1e-3 * cfg.shift_mm) ** -2.0], 3)
    for shots in levels:
        for _ in range(cfg.iterations):
            system = _System.of(points, centre, motion, shots, weight, alike)
            so_far = np.concatenate([motion.turn, motion.shift], axis=1)
            step = -np.linalg.solve(system.matrix + np.diag(prior), (system.vector + prior * so_far)[..., None])[..., 0]
            step[~there] = 0.0
            step[there] -= step[there].mean(0)
            motion = Motion(_composed(step[:, :3], motion.turn), motion.shift + step[:, 3:], np.nan, np.nan)
            if np.abs(step[:, 3:]).mean() < _STILL:
                break
    before, after = (_System.of(points, centre, m, levels[-1], weight, alike).typical for m in (rest, motion))
    return motion._replace(before=before, after=after) if after < before else rest._replace(before=before, after=before)


def _composed(second: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Rotation vectors of `second` after `first`, (n, 3)."""
    from scipy.spatial.transform import Rotation

    return (Rotation.from_rotvec(second) * Rotation.from_rotvec(first)).as_rotvec()


def _likeness(points: np.ndarray, length: float) -> np.ndarray:
    """How alike a part lies in two frames (n, n): 1 for the same place, falling with the vertices' mean distance."""
    few = points[:, :: max(1, points.shape[1] // 200)]
    distance = ((few[:, None] - few[None]) ** 2).sum(-1).mean(-1)
    return np.exp(-0.5 * distance / length**2)


class _System(NamedTuple):
    """Normal equations of the six numbers of every frame, and the typical residual."""

    matrix: np.ndarray
    vector: np.ndarray
    typical: float

    @classmethod
    def of(
        cls,
        points: np.ndarray,
        centre: np.ndarray,
        motion: Motion,
        shots: Sequence[_Shot],
        weight: np.ndarray,
        alike: np.ndarray,
    ) -> "_System":
        placed = moved(points, motion, centre)
        arm = placed - (centre + motion.shift)[:, None]
        count, number = placed.shape[:2]
        # Per vertex first: 3x3 matrix and vector of the colours' change with its position.
        stiff, pull, sizes = np.zeros((count, number, 3, 3)), np.zeros((count, number, 3)), []
        for shot, visible in zip(shots, weight, strict=True):
            pixels, slope = _projected(placed, shot)
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
        swing = _cross_matrix(-arm)  # of a small rotation: d(w x arm)/dw
        stiff_swing = stiff @ swing
        matrix = np.zeros((count, 6, 6))
        matrix[:, :3, :3] = np.einsum("nvji,nvjk->nik", swing, stiff_swing)
        matrix[:, 3:, :3] = stiff_swing.sum(1)
        matrix[:, :3, 3:] = np.swapaxes(matrix[:, 3:, :3], 1, 2)
        matrix[:, 3:, 3:] = stiff.sum(1)
        vector = np.concatenate([np.einsum("nvji,nvj->ni", swing, pull), pull.sum(1)], axis=1)
        return cls(matrix, vector, float(np.mean(sizes)) if sizes else np.nan)


def _cross_matrix(a: np.ndarray) -> np.ndarray:
    """Matrices (..., 3, 3) of the cross product a x."""
    x, y, z = np.moveaxis(a, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], -2)


def _projected(points: np.ndarray, shot: _Shot) -> tuple[np.ndarray, np.ndarray]:
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


def _working_size(camera: Camera, cfg: AlignConfig) -> tuple[int, int]:
    """Width and height [px] of the pictures that are worked on."""
    scale = min(1.0, cfg.lines / camera.height)
    return max(1, round(camera.width * scale)), max(1, round(camera.height * scale))


def _reduced(picture: np.ndarray | None, camera: Camera, cfg: AlignConfig) -> np.ndarray | None:
    """A picture at the size that is worked on."""
    import cv2

    return None if picture is None else cv2.resize(picture, _working_size(camera, cfg), interpolation=cv2.INTER_AREA)


def _shot(camera: Camera, pictures: Sequence[np.ndarray | None], level: float, cfg: AlignConfig) -> _Shot:
    """Details of one camera's reduced pictures; nothing where a picture is missing."""
    import cv2

    width, height = _working_size(camera, cfg)
    details = np.zeros((len(pictures), height, width, 3), np.float16)  # details are small: 11 bits are plenty
    for row, picture in enumerate(pictures):
        if picture is not None:
            small = picture.astype(np.float32) / 255.0
            details[row] = cv2.GaussianBlur(small, (0, 0), level) - cv2.GaussianBlur(small, (0, 0), _BAND * level)
    return _Shot(camera, details, height / camera.height)


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
        width, height = _working_size(camera, cfg)
        K = scale_intrinsics(camera.K, width / camera.width, height / camera.height)
        for row in range(count):
            there = [part for part in verts if np.isfinite(verts[part][row]).all()]
            if pictures[camera.name][row] is None or not there:
                continue
            offsets = np.cumsum([0, *(len(verts[part][row]) for part in there)])
            merged = np.concatenate([verts[part][row] for part in there])
            joined = np.concatenate([faces[part] + first for part, first in zip(there, offsets, strict=False)])
            owner = np.repeat(np.arange(len(there)), [len(faces[part]) for part in there])
            face, _, depth = rasterize_mesh(merged, joined, K, width, height, cam_from_world=camera.cam_from_world)
            owners = np.where(face >= 0, owner[np.maximum(face, 0)], -1)
            pixels, z = project(merged.astype(np.float64), K, camera.cam_from_world)
            facing = _facing(merged, joined, camera.cam_from_world)
            cell = np.floor(np.nan_to_num(pixels, nan=-9.0, posinf=-9.0, neginf=-9.0)).clip(-9, 1 << 20).astype(int)
            inside = ((cell >= _RIM) & (cell < [width - _RIM, height - _RIM])).all(-1)
            x, y = cell.clip(_RIM, [max(_RIM, width - _RIM - 1), max(_RIM, height - _RIM - 1)]).T
            visible = inside & (facing > _FACING) & (z > 0) & (z < depth[y, x] + _BEHIND)
            own = np.repeat(np.arange(len(there)), np.diff(offsets))
            for dy in (-_RIM, 0, _RIM):
                for dx in (-_RIM, 0, _RIM):
                    visible &= owners[y + dy, x + dx] == own
            for i, part in enumerate(there):
                seen[part][index, row] = visible[offsets[i] : offsets[i + 1]]
    return seen


def _facing(verts: np.ndarray, faces: np.ndarray, cam_from_world: np.ndarray) -> np.ndarray:
    """Cosine between the vertices' normals and the directions to the camera, (V,)."""
    placed = verts.astype(np.float64) @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
    normals = vertex_normals(placed, faces)
    return -(normals * placed).sum(1) / np.maximum(np.linalg.norm(placed, axis=1), 1e-12)


def summary(motions: Sequence[Motion]) -> dict[str, Any]:
    """What a part's motions come to: shift and turn (median, largest), residual of the colours before and after."""
    shift = 1e3 * np.linalg.norm(np.concatenate([motion.shift for motion in motions]), axis=1)
    turn = np.degrees(np.linalg.norm(np.concatenate([motion.turn for motion in motions]), axis=1))
    pairs = np.array([(m.before, m.after) for m in motions if np.isfinite(m.before)]).reshape(-1, 2)
    ratio = float(pairs[:, 1].sum() / pairs[:, 0].sum()) if len(pairs) else None
    return {
        "shift_mm": [round(float(np.median(shift)), 4), round(float(shift.max()), 4)],
        "turn_deg": [round(float(np.median(turn)), 4), round(float(turn.max()), 4)],
        "colour_residual_ratio": None if ratio is None else round(ratio, 4),
    }
