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

from nbavatar.camera.pinhole import Camera
from nbavatar.config.geometry import AlignConfig
from nbavatar.fitting.details import Details, colour_pulls, likeness, look

__all__ = ["STILL", "Motion", "align_block", "blocks", "composed", "cross_matrix", "moved", "spread", "summary"]

STILL = 1e-5  # a level ends when no frame moves farther than this in a step [m]


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
    seen, levels = look(verts, faces, cameras, read, cfg)
    motions = {}
    for part, points in verts.items():
        there = np.array([bool(np.isfinite(one).all()) for one in points])
        start = np.where(there[:, None, None], points, 0.0).astype(np.float64)
        chosen = spread(points.shape[1], cfg.points)
        weight = seen[part][..., chosen] & there[None, :, None]
        motions[part] = _align_part(start, chosen, weight, there, levels, cfg)
    return motions


def spread(count: int, most: int) -> np.ndarray:
    """At most so many vertices, evenly from the list."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def _align_part(
    start: np.ndarray,
    chosen: np.ndarray,
    weight: np.ndarray,
    there: np.ndarray,
    levels: Sequence[Sequence[Details]],
    cfg: AlignConfig,
) -> Motion:
    """One part: `start` (n, V, 3), the `chosen` of V, their visibility (C, n, P), frames with the part (n,)."""
    rest = motion = Motion(np.zeros((len(start), 3)), np.zeros((len(start), 3)), np.nan, np.nan)
    if there.sum() < 2 or not weight.any():
        return rest
    centre, points = start.mean(1), start[:, chosen]
    alike = likeness(points, 1e-3 * cfg.likeness_mm) * (there[:, None] & there)
    prior = np.repeat([np.radians(cfg.turn_deg) ** -2.0, (1e-3 * cfg.shift_mm) ** -2.0], 3)
    for shots in levels:
        for _ in range(cfg.iterations):
            system = _System.of(points, centre, motion, shots, weight, alike)
            so_far = np.concatenate([motion.turn, motion.shift], axis=1)
            step = -np.linalg.solve(system.matrix + np.diag(prior), (system.vector + prior * so_far)[..., None])[..., 0]
            step[~there] = 0.0
            step[there] -= step[there].mean(0)
            motion = Motion(composed(step[:, :3], motion.turn), motion.shift + step[:, 3:], np.nan, np.nan)
            if np.abs(step[:, 3:]).max() < STILL:
                break
    before, after = (_System.of(points, centre, m, levels[-1], weight, alike).typical for m in (rest, motion))
    return motion._replace(before=before, after=after) if after < before else rest._replace(before=before, after=before)


def composed(second: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Rotation vectors of `second` after `first`, (n, 3)."""
    from scipy.spatial.transform import Rotation

    return (Rotation.from_rotvec(second) * Rotation.from_rotvec(first)).as_rotvec()


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
        shots: Sequence[Details],
        weight: np.ndarray,
        alike: np.ndarray,
    ) -> "_System":
        placed = moved(points, motion, centre)
        arm = placed - (centre + motion.shift)[:, None]
        count = len(placed)
        pulls = colour_pulls(placed, shots, weight, alike)
        stiff, pull = pulls.stiff, pulls.pull
        swing = cross_matrix(-arm)  # of a small rotation: d(w x arm)/dw
        stiff_swing = stiff @ swing
        matrix = np.zeros((count, 6, 6))
        matrix[:, :3, :3] = np.einsum("nvji,nvjk->nik", swing, stiff_swing)
        matrix[:, 3:, :3] = stiff_swing.sum(1)
        matrix[:, :3, 3:] = np.swapaxes(matrix[:, 3:, :3], 1, 2)
        matrix[:, 3:, 3:] = stiff.sum(1)
        vector = np.concatenate([np.einsum("nvji,nvj->ni", swing, pull), pull.sum(1)], axis=1)
        return cls(matrix, vector, pulls.typical)


def cross_matrix(a: np.ndarray) -> np.ndarray:
    """Matrices (..., 3, 3) of the cross product a x."""
    x, y, z = np.moveaxis(a, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], -2)


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
