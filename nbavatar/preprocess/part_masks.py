"""Head and hand cut out of a person's matte by the posed meshes.

The matte knows where the person ends, the meshes know what is head (with neck) and what is hand (above the wrist).
Neither alone suffices: hair, brows and lips stand off the head's mesh, and the matte holds the torso and both arms.

Every foreground pixel is given to the nearest projected surface: pixels under a mesh to the mesh in front, others to
the nearest silhouette, if it is within that surface's margin [m]. Margins are wide over the scalp (hair) and narrow
along neck, jaw and hand. Two kinds of helper surfaces take what is not wanted: a sleeve beyond each wrist, which also
hides what is behind it, and a collar beyond the neck, which opens like shoulders do and never hides anything. Both are
extruded from the open border of the part; a part without one (a closed mesh) gets none.

Limits: long hair below the margin is cut; a forearm that bends sharply at the wrist and passes in front of the face
beyond the sleeve's length counts as head.
"""

import dataclasses
from collections.abc import Callable

import cv2
import numpy as np

from nbavatar.camera.distortion import distort_vertices
from nbavatar.camera.pinhole import Camera
from nbavatar.data.sequences import PARTS, MeshSequence
from nbavatar.mesh.topology import boundary_loops
from nbavatar.mesh.zbuffer import rasterize_mesh
from nbavatar.preprocess.clean import threshold_matte

__all__ = ["Margins", "PartCutter", "Silhouettes"]

LABELS = {name: i + 1 for i, name in enumerate(PARTS)}
_RINGS = 5
_COLLAR_LENGTH = 0.25  # [m]
_COLLAR_FLARE = 1.2  # radius gained per length
_SLEEVE_FLARE = 0.12
_SCALP = (0.2, 0.6)  # heights, border 0 and centroid 1, between which the margin widens from the neck's to the hair's
_CLOTHES = 0.5  # height below which clothes may cover the head's mesh


@dataclasses.dataclass(frozen=True)
class Margins:
    """How far the person may stand off each surface, and the sleeve's length, all [m]; see `MasksConfig`."""

    hair: float
    neck: float
    hand: float
    sleeve: float


@dataclasses.dataclass(frozen=True)
class Silhouettes:
    """Projected surfaces of one frame.

    Attributes:
        support: uint8 `[H, W]`, part that is in front, 0 where there is none or a sleeve hides it.
        nearest: uint8 `[H, W]`, part whose surface is nearest and within its margin, 0 where there is none.
        rim: float32 `[H, W]`, how far from the matte's edge such a pixel may be [px]: infinite on the surfaces
        themselves
            and around the scalp; elsewhere the margin, because what stands off a neck or a hand ends soon after it,
            while a torso behind them does not.
        face: bool `[H, W]`, upper head, where no clothes are.
        neck: bool `[H, W]`, lower head and all around the surfaces, where clothes may be.
        torso: bool `[H, W]`, nearest to the collar: torso, if the matte has anything there.
        meshes: draws bool `[H, W]`, where a part's mesh is, whatever is in front of it.
    """

    support: np.ndarray
    nearest: np.ndarray
    rim: np.ndarray
    face: np.ndarray
    neck: np.ndarray
    torso: np.ndarray
    meshes: Callable[[], np.ndarray]


class PartCutter:
    """Cuts the mattes of one camera.

    Args:
        sequence: posed meshes; parts that are absent are not looked for.
        camera: its size, matrix and distortion are those of the mattes.
        margins: see `Margins`.
        whole: whether what the meshes do not claim is kept too, as head (or the first part there is).
    """

    def __init__(self, sequence: MeshSequence, camera: Camera, margins: Margins, *, whole: bool = False) -> None:
        self._sequence, self._camera = sequence, camera
        self._others = np.uint8(LABELS[next(iter(sequence.parts))] if whole else 0)
        corners = np.array([[x, y] for x in (0, camera.width) for y in (0, camera.height)], dtype=np.float64)
        self._reach = float(np.linalg.norm((corners - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]], axis=1).max() * 1.1)
        self._borders: dict[str, np.ndarray] = {}
        faces, owners, reaches, solid, heights = [], [], [], [], []
        offset = 0
        for name, part in sequence.parts.items():
            hair = margins.hair if name == "head" else 0.0
            height = _heights(part.rest, part.faces, border := _border(part.rest, part.faces))
            heights.append(height if name == "head" else np.full(len(part.faces), np.nan))
            narrow = margins.neck if name == "head" else margins.hand
            faces.append(part.faces + offset)
            owners.append(np.full(len(part.faces), LABELS[name], dtype=np.uint8))
            scalp = hair * np.clip((height - _SCALP[0]) / (_SCALP[1] - _SCALP[0]), 0.0, 1.0)
            reaches.append(np.maximum(scalp, narrow))
            solid.append(np.ones(len(part.faces), dtype=bool))
            offset += len(part.rest)
            if border is not None and (name == "head" or margins.sleeve > 0):
                self._borders[name] = border
                strips = _strips(len(border)) + offset
                faces.append(strips)
                owners.append(np.zeros(len(strips), dtype=np.uint8))
                reaches.append(np.zeros(len(strips)))
                heights.append(np.full(len(strips), -1.0 if name == "head" else np.nan))
                solid.append(np.full(len(strips), name != "head"))
                offset += len(border) * _RINGS
        self._faces, self._solid = np.concatenate(faces), np.concatenate(solid)
        self._owner, self._margin = np.concatenate(owners), np.concatenate(reaches).astype(np.float32)
        self._height, self._narrow = np.concatenate(heights), max(margins.neck, margins.hand)
        self._lengths = {name: _COLLAR_LENGTH if name == "head" else margins.sleeve for name in self._borders}

    def silhouettes(self, frame: str) -> Silhouettes:
        """Projects the meshes of one frame into the (distorted) image."""
        row = self._sequence.index([frame])[0]
        world, absent, count = [], [], 0
        for name, part in self._sequence.parts.items():
            verts = part.verts[row].astype(np.float64)
            there = bool(np.isfinite(verts).all())
            if not there:
                verts = part.rest.astype(np.float64)
            world.append(verts)
            if name in self._borders:
                flare = _COLLAR_FLARE if name == "head" else _SLEEVE_FLARE
                world.append(_extrude(verts, self._borders[name], self._lengths[name], flare))
            before, count = count, sum(map(len, world))
            if not there:
                absent.append(slice(before, count))
        pose = self._camera.cam_from_world
        points = np.concatenate(world) @ pose[:3, :3].T + pose[:3, 3]
        for rows in absent:  # a part that is not in this frame goes where no camera looks
            points[rows] = (0.0, 0.0, -1.0)
        points = distort_vertices(points, self._camera.distortion, self._reach)
        width, height = self._camera.width, self._camera.height

        def meshes() -> np.ndarray:
            camera, faces = self._camera, self._faces[self._owner > 0]
            own, _, _ = rasterize_mesh(points, faces, camera.K, camera.width, camera.height)
            return np.asarray(own >= 0)

        face, _, depth = rasterize_mesh(points, self._faces[self._solid], self._camera.K, width, height)
        face = np.where(face >= 0, np.flatnonzero(self._solid)[face], -1)
        if not self._solid.all():
            soft = np.flatnonzero(~self._solid)
            behind, _, far = rasterize_mesh(points, self._faces[soft], self._camera.K, width, height)
            fill = (face < 0) & (behind >= 0)
            face, depth = np.where(fill, soft[behind], face), np.where(fill, far, depth)
        support = np.where(face >= 0, self._owner[face], np.uint8(0))
        if not (face >= 0).any():
            nowhere = np.zeros(face.shape, dtype=bool)
            return Silhouettes(support, support, np.zeros(face.shape, np.float32), nowhere, nowhere, nowhere, meshes)
        distance, index = _nearest(face >= 0)
        near_face = face.reshape(-1)[index]
        pixels = (float(self._camera.K[0, 0]) / depth.reshape(-1)[index] * self._margin[near_face]).astype(np.float32)
        within = (face >= 0) | (distance <= pixels)
        wide = (face >= 0) | (self._margin[near_face] > self._narrow)
        height = self._height[near_face]
        on_head = support == LABELS["head"]
        return Silhouettes(
            support,
            np.where(within, self._owner[near_face], np.uint8(0)),
            np.where(wide, np.float32(np.inf), pixels),
            on_head & (height > _CLOTHES),
            (on_head & (height <= _CLOTHES)) | (face < 0),
            height < 0,
            meshes,
        )

    def cut(self, matte: np.ndarray, silhouettes: Silhouettes, threshold: int) -> np.ndarray:
        """Labels uint8 `[H, W]` of the foreground of one grey matte, not yet cleaned."""
        person = threshold_matte(matte, threshold)
        inside = cv2.distanceTransform(person.astype(np.uint8), cv2.DIST_L2, 5)
        label = np.where(person & (inside <= silhouettes.rim), silhouettes.nearest, np.uint8(0))
        return np.where(person & (label == 0), self._others, label)


def _border(rest: np.ndarray, faces: np.ndarray) -> np.ndarray | None:
    """The longest open border, the neck's or the wrist's, as a loop of vertex ids."""
    loops = [loop for loop in boundary_loops(faces) if len(loop) >= 6]
    if not loops:
        return None
    lengths = [np.linalg.norm(rest[loop] - rest[np.roll(loop, 1)], axis=1).sum() for loop in loops]
    return np.asarray(loops[int(np.argmax(lengths))])


def _heights(rest: np.ndarray, faces: np.ndarray, border: np.ndarray | None) -> np.ndarray:
    """Height of each face along the axis from the open border (0) to the part's centroid (1); 1 without a border.

    No knowledge of the topology is used.
    """
    if border is None:
        return np.ones(len(faces))
    axis = rest.mean(axis=0) - rest[border].mean(axis=0)
    heights = (rest[faces].mean(axis=1) - rest[border].mean(axis=0)) @ axis / max(float(axis @ axis), 1e-12)
    return np.maximum(heights, 0.0)


def _extrude(verts: np.ndarray, border: np.ndarray, length: float, flare: float) -> np.ndarray:
    """Rings `[_RINGS * L, 3]` that continue a border outwards, growing by `flare` per length."""
    ring = verts[border]
    centre = ring.mean(axis=0)
    normal = np.linalg.svd(ring - centre, full_matrices=False)[2][2]
    if normal @ (verts.mean(axis=0) - centre) > 0:
        normal = -normal
    radius = max(float(np.linalg.norm(ring - centre, axis=1).mean()), 1e-6)
    steps = np.linspace(0.0, 1.0, _RINGS) * length
    rings = [centre + normal * step + (ring - centre) * (1 + flare * step / radius) for step in steps]
    return np.concatenate(rings)


def _strips(count: int) -> np.ndarray:
    """Triangles between consecutive rings of `count` vertices."""
    a = np.arange(count)
    b = (a + 1) % count
    quads = [np.stack([a, b, b + count, a + count], axis=1) + ring * count for ring in range(_RINGS - 1)]
    quad = np.concatenate(quads)
    return np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])


def _nearest(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance [px] to, and flat index of, the nearest true pixel of a bool image."""
    away = np.where(mask, np.uint8(0), np.uint8(1))
    distance, tag = cv2.distanceTransformWithLabels(away, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    tag = np.asarray(tag, dtype=np.int64)
    index = np.zeros(int(tag.max()) + 1, dtype=np.int64)
    index[tag[mask]] = np.flatnonzero(mask)
    return np.asarray(distance), index[tag]
