"""Outlines of the parts in masks, against the outlines of their meshes: signed distances, in pixels.

A vertex on the rim of its mesh, as a camera sees it, should lie on the border between the person and the background.
How far it is from there is read off a map of signed distances to that border, less its distance from the border of the
drawn mesh, since vertices lie beside the outline that their triangles draw. Nothing is said where another part is
near, at the border of the picture, and where the vertex lies inside the mesh's own outline.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from nbavatar.camera.pinhole import Camera, project, scale_intrinsics
from nbavatar.config.geometry import AlignConfig
from nbavatar.fitting.details import facing, working_size
from nbavatar.fitting.silhouette import signed_distance_map
from nbavatar.mesh.zbuffer import joined_meshes, rasterize_mesh

__all__ = ["Rim", "rims_of"]

_HALF = 2  # maps are measured on pixels half as large
_SIDEWAYS = 0.3  # largest cosine between a rim vertex' normal and its line of sight
_NEAR = 1.5  # a rim vertex lies within this of the drawn outline [px]
_APART = 4  # from other parts and the border of the picture [px]


class Rim(NamedTuple):
    """Vertices of one part on the outline that one camera sees in one frame.

    Attributes:
        camera, frame: positions of both.
        vertices: which they are, (R,).
        own: signed distance from the outline of the drawn meshes, (R,) [px].
        distance: signed distances to the person's outline in the picture, float16 (h, w) [px], negative inside.
    """

    camera: int
    frame: int
    vertices: np.ndarray
    own: np.ndarray
    distance: np.ndarray

    def residual(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far the rim vertices, at working pixels (R, 2), are outside, (R,) [px], and its change (R, 2)."""
        value = _sampled(self.distance, pixels)
        steps = [0.5 * np.eye(2)[axis] for axis in (0, 1)]
        change = [_sampled(self.distance, pixels + step) - _sampled(self.distance, pixels - step) for step in steps]
        return value - self.own, np.stack(change, axis=-1)


def _sampled(values: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Bilinear values of a map (h, w) at pixels (P, 2), centres at +0.5; of the border beyond it. float64 (P,)."""
    height, width = values.shape
    place = np.clip(np.nan_to_num(pixels, nan=0.0) - 0.5, 0, [width - 1.001, height - 1.001])
    cell = np.floor(place).astype(int)
    (x, y), (u, v) = cell.T, (place - cell).T
    a, b, c, d = (values[y + j, x + i].astype(np.float64) for j in (0, 1) for i in (0, 1))
    return (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * d)


def rims_of(
    verts: Mapping[str, np.ndarray],
    faces: Mapping[str, np.ndarray],
    labels: Mapping[str, int],
    cameras: Sequence[Camera],
    masks: Callable[[str, int], tuple[np.ndarray, np.ndarray] | None],
    cfg: AlignConfig,
) -> dict[str, list[Rim]]:
    """The rims of all parts in a block of frames.

    Args:
        verts: part -> (n, V, 3) [m], world; NaN where the part is not in the frame.
        faces: part -> (F, 3).
        labels: part -> its label; parts without one have no outline.
        cameras: that saw it.
        masks: labels and coverage of a camera (its name) in a frame of the block, uint8 (H, W) each, or None.
        cfg: options; `lines` says how large the pictures are that are worked on.

    Returns:
        part -> rims, of the frames and cameras in which any of its vertices lies on an outline.
    """
    import cv2

    found: dict[str, list[Rim]] = {part: [] for part in verts}
    count = len(next(iter(verts.values())))
    for index, camera in enumerate(cameras):
        width, height = working_size(camera, cfg)
        K = scale_intrinsics(camera.K, width / camera.width, height / camera.height)
        for row in range(count):
            given = masks(camera.name, row)
            there = [part for part in verts if np.isfinite(verts[part][row]).all()]
            if given is None or not there:
                continue
            label = cv2.resize(given[0], (width, height), interpolation=cv2.INTER_NEAREST)
            meshes = [(verts[part][row], faces[part]) for part in there]
            drawn = _drawn(meshes, scale_intrinsics(K, _HALF, _HALF), camera, _HALF * width, _HALF * height)
            if not drawn.any() or drawn.all():
                continue
            mesh, shown = signed_distance_map(drawn, 1 / _HALF), _shown(given[1], width, height)
            if not shown.any() or shown.all():
                continue
            fine = signed_distance_map(shown, 1 / _HALF)
            person = cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA).astype(np.float16)
            for part in there:
                if part not in labels:
                    continue
                other = ((label != labels[part]) & (label != 0)).astype(np.uint8)
                near = cv2.dilate(other, np.ones((2 * _APART + 1, 2 * _APART + 1), np.uint8)) > 0
                pixels, _ = project(verts[part][row].astype(np.float64), K, camera.cam_from_world)
                inside = ((pixels > _APART) & (pixels < [width - _APART, height - _APART])).all(1)
                cell = np.clip(np.nan_to_num(pixels), 0, [width - 1, height - 1]).astype(int)
                own = _sampled(mesh, _HALF * pixels)
                rim = inside & ~near[cell[:, 1], cell[:, 0]] & (np.abs(own) < _NEAR)
                rim &= np.abs(facing(verts[part][row], faces[part], camera.cam_from_world)) < _SIDEWAYS
                if rim.any():
                    where = np.flatnonzero(rim)
                    found[part].append(Rim(index, row, where, own[where], person))
    return found


def _drawn(
    meshes: Sequence[tuple[np.ndarray, np.ndarray]], K: np.ndarray, camera: Camera, width: int, height: int
) -> np.ndarray:
    """Where meshes are in a picture with intrinsics K, bool (height, width)."""
    merged, joined, _ = joined_meshes(meshes)
    face, _, _ = rasterize_mesh(merged, joined, K, width, height, cam_from_world=camera.cam_from_world)
    return np.asarray(face >= 0)


def _shown(alpha: np.ndarray, width: int, height: int) -> np.ndarray:
    """Where the person covers more than half, bool, in a picture of half pixels."""
    import cv2

    few = cv2.resize(alpha, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.resize(few, (_HALF * width, _HALF * height), interpolation=cv2.INTER_LINEAR) >= 128)
