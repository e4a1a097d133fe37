"""The contact stage in one camera: photo, head and hands before and after, and how far the skin has moved."""

from collections.abc import Sequence

import numpy as np

from nbavatar.data.sequences import PARTS, MeshSequence
from nbavatar.mesh.drawing import draw_mesh, vertex_normals
from nbavatar.reporting.pictures import RAMP

__all__ = ["best_camera", "deepest_frames", "dent_pictures", "dent_scale"]

_SKIN, _HAND = (0.87, 0.72, 0.64), (0.45, 0.6, 0.85)


def deepest_frames(sequence: MeshSequence, frames: Sequence[str], count: int) -> list[str]:
    """The frames among ``frames`` in which the skin moved most, in time order; empty without a contact stage."""
    if "head_rigid" not in sequence.extras or "head" not in sequence.parts:
        return []
    known = [frame for frame in sequence.frames if frame in set(frames)]
    rows = sequence.index(known)
    moved = np.linalg.norm(sequence.parts["head"].verts[rows] - sequence.extras["head_rigid"][rows], axis=2)
    depth = np.nan_to_num(moved.max(axis=1))
    best = sorted(np.argsort(-depth, kind="stable")[:count].tolist())
    return [known[i] for i in best if depth[i] > 0]


def dent_scale(sequence: MeshSequence, frames: Sequence[str]) -> float:
    """The largest displacement in these frames [mm], rounded up to 1, 2 or 5 times a power of ten."""
    rows = sequence.index(frames)
    moved = sequence.parts["head"].verts[rows] - sequence.extras["head_rigid"][rows]
    largest = max(1e-3, 1000 * float(np.nanmax(np.linalg.norm(moved, axis=2))))
    unit = 10.0 ** np.floor(np.log10(largest))
    return float(next(unit * m for m in (1, 2, 5, 10) if unit * m >= largest * (1 - 1e-9)))


def best_camera(sequence: MeshSequence, frame: str, cameras: Sequence[np.ndarray]) -> tuple[int, np.ndarray]:
    """Which camera faces the deepest dent most squarely, and where that dent is.

    Args:
        sequence: result of the contact stage, with ``head_rigid``.
        frame: id.
        cameras: ``cam_from_world`` (4, 4) of each.

    Returns:
        index of the camera, position of the deepest vertex (3,) [m].
    """
    (row,) = sequence.index([frame])
    head, rigid = sequence.parts["head"].verts[row], sequence.extras["head_rigid"][row]
    deepest = int(np.nan_to_num(np.linalg.norm(head - rigid, axis=1)).argmax())
    place = head[deepest].astype(np.float64)
    normal = vertex_normals(rigid, sequence.parts["head"].faces)[deepest]
    scores = []
    for camera in cameras:
        towards = -camera[:3, :3].T @ camera[:3, 3] - place
        scores.append(float(normal @ towards / np.linalg.norm(towards)))
    return int(np.argmax(scores)), place


def dent_pictures(
    sequence: MeshSequence,
    frame: str,
    K: np.ndarray,
    cam_from_world: np.ndarray,
    width: int,
    height: int,
    largest_mm: float,
) -> dict[str, np.ndarray]:
    """Pictures of one frame from one camera.

    Args:
        sequence: result of the contact stage, with ``head_rigid``.
        frame: id.
        K: intrinsics (3, 3) [px]; cam_from_world: (4, 4); width, height: size [px].
        largest_mm: displacement of the ramp's last colour [mm].

    Returns:
        title -> uint8 [H, W, 3]: head and hands before, after, and the head coloured by displacement, from black (0)
        to pale yellow.
    """
    (row,) = sequence.index([frame])
    after = sequence.parts["head"].verts[row].astype(np.float64)
    before = sequence.extras["head_rigid"][row].astype(np.float64)
    faces = sequence.parts["head"].faces
    hands = [
        (part.verts[row].astype(np.float64), part.faces)
        for name, part in sequence.parts.items()
        if name in PARTS[1:] and np.isfinite(part.verts[row]).all()
    ]
    share = np.clip(1000 * np.linalg.norm(after - before, axis=1) / largest_mm, 0, 1)
    anchors, table = np.linspace(0, 1, len(RAMP)), np.asarray(RAMP) / 255
    heat = np.stack([np.interp(share, anchors, table[:, c]) for c in range(3)], axis=1)
    skin = np.tile(_SKIN, (len(after), 1))

    def scene(head: np.ndarray, colours: np.ndarray, others: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        verts, ids, values, first = [head], [np.asarray(faces)], [colours], len(head)
        for hand, hand_faces in others:
            verts.append(hand)
            ids.append(np.asarray(hand_faces) + first)
            values.append(np.tile(_HAND, (len(hand), 1)))
            first += len(hand)
        side = max(width, height)
        merged = np.concatenate(verts), np.concatenate(ids), np.concatenate(values)
        return draw_mesh(*merged, K, cam_from_world, side)[:height, :width]

    return {
        "before": scene(before, skin, hands),
        "after": scene(after, skin, hands),
        "displacement": scene(after, heat, []),
    }
