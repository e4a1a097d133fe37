"""Smooth bending of tracked meshes to what the cameras saw: the error of a fit that no rigid motion takes out.

Shapes and expressions of a fit are off by smooth fields: in a test of noisy fits, 12 smooth functions on the surface
held three quarters of what a rigid motion had left. Each part of each frame is therefore moved by

    x' = R_t (x + Q_t sum over k of b_k(x) c_tk) + d_t

with b_k the lowest eigenfunctions of the surface's Laplacian (root mean square 1), Q_t the part's orientation in the
frame, and rotation, shift and the coefficients c found together, by Gauss-Newton steps, coarse to fine. Three terms
draw at the vertices: their colours (`nbavatar.fitting.details`), the outlines of the masks (`nbavatar.fitting.outline`)
and a prior that keeps the coefficients small. Outlines see what all frames share; colours do not, so without outlines
the coefficients of a run of frames have mean zero.

Where the person's outline lies more than 2 mm outside a vertex in most views, hair or cloth lies on the skin there. Its
thickness is found once a level, as the median over the views, and taken off; the vertex counts the less, the more the
distance varies. What all frames share is then seen by the outlines of bare skin alone.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from nbavatar.camera.pinhole import Camera
from nbavatar.config.geometry import AlignConfig
from nbavatar.fitting.align import STILL, Motion, composed, cross_matrix, moved, spread
from nbavatar.fitting.details import Details, Pulls, colour_pulls, likeness, look, projected
from nbavatar.fitting.outline import Rim, rims_of
from nbavatar.mesh.spectral import spectral_coordinates

__all__ = ["bend_block", "smooth_basis"]

_COLOUR = 0.1  # weight of a vertex' colour: about ten neighbours see the same detail
_TYPICAL = (0.1, 0.5)  # typical distances of outlines beyond these are not believed: hair is no error of a fit [px]
_COVER = 2e-3  # a vertex that is farther inside the outline in most views has hair or cloth on it [m]
_VIEWS = 4  # of fewer views nobody can tell how thick it is
_SLOPE = 0.5  # an outline's distance must change at least so much with a pixel; beside a ridge it tells no place
# Distances from an outline of this many typical ones lose three quarters of their weight, on the coarse and on the fine
# level of detail. More is believed at first: some frames are off by much more than the others.
_ROBUST = (6.0, 2.5)


class _Field(NamedTuple):
    """How a part is moved: rigid motion and coefficients (n, K, 3) in its own axes [m]."""

    motion: Motion
    bend: np.ndarray


class _Part(NamedTuple):
    """What stays: vertices (n, V, 3), their mean (n, 3), orientation (n, 3, 3), basis (V, K), those looked at (P,)."""

    verts: np.ndarray
    centre: np.ndarray
    turn: np.ndarray
    basis: np.ndarray
    chosen: np.ndarray

    def placed(self, field: _Field, which: np.ndarray | slice) -> np.ndarray:
        """Vertices after a field, (n, ..., 3) [m]."""
        bent = np.einsum("nij,nvj->nvi", self.turn, self.basis[which] @ field.bend)
        return moved(self.verts[:, which] + bent, field.motion, self.centre)


class _Outline(NamedTuple):
    """What the outlines of a part say on one level.

    Attributes:
        rims: of `rims_of`.
        cover: thickness of hair or cloth on each vertex, 0 on bare skin and where no rim is, (V,) [m].
        varies: 1.4826 times the median deviation from it, 0 on bare skin, (V,) [m].
        told: whether the outline of a vertex is believed: of covered ones, those of enough views, bool (V,).
        robust: see `_ROBUST`.
    """

    rims: Sequence[Rim]
    cover: np.ndarray
    varies: np.ndarray
    told: np.ndarray
    robust: float


def smooth_basis(rest: np.ndarray, faces: np.ndarray, modes: int) -> np.ndarray:
    """The lowest non-constant eigenfunctions of a surface, each of root mean square 1, float64 (V, K)."""
    basis = spectral_coordinates(np.asarray(rest, np.float64), faces, modes).coords.astype(np.float64)
    size = np.sqrt((basis**2).mean(0))
    return basis[:, size > 0] / size[size > 0]


def bend_block(
    verts: Mapping[str, np.ndarray],
    faces: Mapping[str, np.ndarray],
    rest: Mapping[str, np.ndarray],
    basis: Mapping[str, np.ndarray],
    labels: Mapping[str, int],
    cameras: Sequence[Camera],
    read: Callable[[str, int], np.ndarray | None],
    masks: Callable[[str, int], tuple[np.ndarray, np.ndarray] | None],
    cfg: AlignConfig,
) -> dict[str, np.ndarray]:
    """Bends all parts in a block of frames.

    Args:
        verts: part -> (n, V, 3) [m], world, aligned as a whole; NaN where the part is not in the frame.
        faces: part -> (F, 3).
        rest: part -> (V, 3) [m].
        basis: part -> (V, K), `smooth_basis`.
        labels: part -> its label in the masks.
        cameras: that saw it.
        read: picture of a camera (its name) in a frame of the block (its position), uint8 (H, W, 3), or None.
        masks: labels and coverage likewise, uint8 (H, W) each, or None.
        cfg: options.

    Returns:
        part -> vertices, float64 (n, V, 3) [m]; as they came where nothing is seen of the part.
    """
    seen, levels = look(verts, faces, cameras, read, cfg)
    current = {part: points.astype(np.float64) for part, points in verts.items()}
    fields: dict[str, _Field] = {}
    parts: dict[str, _Part] = {}
    for shots, robust in zip(levels, _ROBUST, strict=True):
        rims = rims_of(current, faces, labels, cameras, masks, cfg)
        for part, points in verts.items():
            there = np.array([bool(np.isfinite(one).all()) for one in points])
            if not there.any() or not (seen[part].any() or rims[part]):
                continue
            if part not in parts:
                parts[part] = _prepared(points, there, rest[part], basis[part], cfg)
                fields[part] = _still(len(points), parts[part].basis.shape[1])
            weight = seen[part][..., parts[part].chosen] & there[None, :, None]
            outline = _outline_of(parts[part].placed(fields[part], slice(None)), rims[part], robust, shots)
            fields[part] = _bent(parts[part], fields[part], there, weight, outline, shots, cfg)
            moved_part = parts[part].placed(fields[part], slice(None))
            current[part] = np.where(there[:, None, None], moved_part, np.nan)
    return current


def _still(count: int, modes: int) -> _Field:
    nothing = np.zeros((count, 3))
    return _Field(Motion(nothing, nothing, np.nan, np.nan), np.zeros((count, modes, 3)))


def _prepared(points: np.ndarray, there: np.ndarray, rest: np.ndarray, basis: np.ndarray, cfg: AlignConfig) -> _Part:
    from scipy.spatial.transform import Rotation

    start = np.where(there[:, None, None], points, 0.0).astype(np.float64)
    flat = np.asarray(rest, np.float64) - rest.mean(0)
    turn = np.tile(np.eye(3), (len(start), 1, 1))
    for row in np.flatnonzero(there):
        turn[row] = Rotation.align_vectors(start[row] - start[row].mean(0), flat)[0].as_matrix()
    return _Part(start, start.mean(1), turn, basis, spread(points.shape[1], cfg.points))


def _bent(
    part: _Part, field: _Field, there: np.ndarray, weight: np.ndarray, outline: _Outline, shots: Sequence[Details],
    cfg: AlignConfig,
) -> _Field:  # fmt: skip
    """Steps on one scale of detail."""
    count, modes = field.bend.shape[:2]
    alike = likeness(part.verts[:, part.chosen], 1e-3 * cfg.likeness_mm) * (there[:, None] & there)
    rigid = np.repeat([np.radians(cfg.turn_deg) ** -2.0, (1e-3 * cfg.shift_mm) ** -2.0], 3)
    prior = np.concatenate([rigid, np.full(3 * modes, (1e-3 * cfg.bend_mm) ** -2.0)])
    for _ in range(cfg.iterations):
        matrix, vector = _equations(part, field, weight, outline, shots, alike)
        so_far = np.concatenate([field.motion.turn, field.motion.shift, field.bend.reshape(count, -1)], axis=1)
        step = -np.linalg.solve(matrix + np.diag(prior), (vector + prior * so_far)[..., None])[..., 0]
        step[~there] = 0.0
        if not outline.rims:
            step[there] -= step[there].mean(0)
        motion = Motion(composed(step[:, :3], field.motion.turn), field.motion.shift + step[:, 3:6], np.nan, np.nan)
        field = _Field(motion, field.bend + step[:, 6:].reshape(count, modes, 3))
        if np.abs(step[there, 3:]).max() < STILL:
            break
    return field


def _equations(
    part: _Part, field: _Field, weight: np.ndarray, outline: _Outline, shots: Sequence[Details], alike: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of rotation, shift and coefficients of every frame: (n, 6 + 3K, 6 + 3K) and (n, 6 + 3K)."""
    from scipy.spatial.transform import Rotation

    count, modes = field.bend.shape[:2]
    placed = part.placed(field, slice(None))
    middle = part.centre + field.motion.shift
    local = Rotation.from_rotvec(field.motion.turn).as_matrix() @ part.turn  # from the part's own axes to the world
    colour = colour_pulls(placed[:, part.chosen], shots, weight, alike)
    border = _outline_pulls(placed, outline, shots)
    size = 6 + 3 * modes
    matrix, vector = np.zeros((count, size, size)), np.zeros((count, size))
    for pulls, which, share in ((colour, part.chosen, _COLOUR), (border, slice(None), 1.0)):
        if pulls is None:
            continue
        arm = placed[:, which] - middle[:, None]
        basis = part.basis[which]
        for row in range(count):
            told = np.flatnonzero(pulls.stiff[row].any((1, 2)))
            if not len(told):
                continue
            stiff, pull, few = pulls.stiff[row, told], pulls.pull[row, told], basis[told]
            swing = cross_matrix(-arm[row, told])
            rigid = np.concatenate([swing, np.broadcast_to(np.eye(3), swing.shape)], axis=-1)  # (P, 3, 6)
            axes = local[row]
            stiff_rigid = stiff @ rigid
            own = axes.T @ stiff @ axes
            matrix[row, :6, :6] += share * np.einsum("vja,vjb->ab", rigid, stiff_rigid)
            weighted = (few[:, :, None, None] * own[:, None]).reshape(len(few), -1)  # (P, K * 9)
            both = (few.T @ weighted).reshape(modes, modes, 3, 3).transpose(0, 2, 1, 3)
            matrix[row, 6:, 6:] += share * both.reshape(3 * modes, 3 * modes)
            cross = (few.T @ (axes.T @ stiff_rigid).reshape(len(few), -1)).reshape(3 * modes, 6)
            matrix[row, 6:, :6] += share * cross
            matrix[row, :6, 6:] += share * cross.T
            vector[row, :6] += share * np.einsum("vja,vj->a", rigid, pull)
            vector[row, 6:] += share * (few.T @ (pull @ axes)).ravel()
    return matrix, vector


def _outline_of(placed: np.ndarray, rims: Sequence[Rim], robust: float, shots: Sequence[Details]) -> _Outline:
    """The outlines of a part, and how thick hair or cloth lies on its vertices, at the start of a level.

    Args:
        placed: vertices (n, V, 3) [m]; robust: see `_ROBUST`.
    """
    import scipy.ndimage

    cover, varies = np.zeros(placed.shape[1]), np.zeros(placed.shape[1])
    told = np.zeros(placed.shape[1], bool)
    views = [(rim.vertices, -residual, _length(change)) for rim, residual, change in _distances(placed, rims, shots)]
    if views:
        vertex, inside, slope = (np.concatenate(values) for values in zip(*views, strict=True))
        which, place, number = np.unique(vertex, return_inverse=True, return_counts=True)
        depth = inside / slope
        groups = np.arange(len(which))
        middle = scipy.ndimage.median(depth, place, groups)
        covered = middle > _COVER
        cover[which] = np.where(covered, middle, 0.0)
        deviation = scipy.ndimage.median(np.abs(depth - middle[place]), place, groups)
        varies[which] = np.where(covered, 1.4826 * deviation, 0.0)
        told[which] = ~covered | (number >= _VIEWS)
    return _Outline(rims, cover, varies, told, robust)


def _distances(
    placed: np.ndarray, rims: Sequence[Rim], shots: Sequence[Details]
) -> list[tuple[Rim, np.ndarray, np.ndarray]]:
    """Rims, how far each vertex is outside the outline [px], and its change with the vertex (R, 3) [px/m].

    Vertices beside a ridge of the distance map, between two locks of hair for example, are left out.
    """
    slopes = [projected(placed, shot) for shot in shots] if rims else []
    result = []
    for rim in rims:
        pixels, slope = (values[rim.frame, rim.vertices] for values in slopes[rim.camera])
        residual, change = rim.residual(pixels)
        clear = _length(change) > _SLOPE
        if clear.any():
            few = rim._replace(vertices=rim.vertices[clear], own=rim.own[clear])
            result.append((few, residual[clear], np.einsum("rp,rpx->rx", change[clear], slope[clear])))
    return result


def _outline_pulls(placed: np.ndarray, outline: _Outline, shots: Sequence[Details]) -> Pulls | None:
    """Where the outlines want the rim vertices to be."""
    told = []
    for rim, residual, change in _distances(placed, outline.rims, shots):
        told.append((rim, residual + outline.cover[rim.vertices] * _length(change), change))
    if not told:
        return None
    bare = np.concatenate([residual[outline.cover[rim.vertices] == 0] for rim, residual, _ in told])
    typical = 1.4826 * float(np.median(np.abs(bare))) if bare.size else _TYPICAL[1]
    typical = min(max(typical, _TYPICAL[0]), _TYPICAL[1])
    stiff, pull = np.zeros((*placed.shape, 3)), np.zeros(placed.shape)
    for rim, residual, change in told:
        scale = np.hypot(typical, outline.varies[rim.vertices] * _length(change))
        share = outline.told[rim.vertices] / (1.0 + (residual / (outline.robust * scale)) ** 2) ** 2 / scale**2
        stiff[rim.frame, rim.vertices] += share[:, None, None] * change[:, :, None] * change[:, None, :]
        pull[rim.frame, rim.vertices] += (share * residual)[:, None] * change
    return Pulls(stiff, pull, typical)


def _length(change: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.norm(change, axis=-1))
