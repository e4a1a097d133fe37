"""A contact frame from three sides: before, after, the dent, and what the tissue was taken to be."""

import numpy as np

from nbavatar.mesh.drawing import draw_mesh, look_from, vertex_normals
from nbavatar.physics.rigid import rigid_motion

__all__ = ["contact_picture"]

_SKIN, _HAND = np.array([0.87, 0.72, 0.64]), np.array([0.45, 0.6, 0.85])
# What is shown around the deepest point [m].
_FIELD = 0.09


def contact_picture(
    rest: np.ndarray,
    faces: np.ndarray,
    rigid: np.ndarray,
    deformed: np.ndarray,
    hands: list[tuple[np.ndarray, np.ndarray]],
    stiffness: np.ndarray,
    size: int,
) -> np.ndarray:
    """Four rows of three views: head and hands before, after, the dent alone (white 0, red its maximum), the stiffness.

    Args:
        rest: head at rest [m], (V, 3), y up and z forward; faces (F, 3).
        rigid: head of the frame without contact [m], (V, 3); `deformed` with it.
        hands: positions [m] and faces of each hand in the frame.
        stiffness: of the tissue under each vertex [N/m^3], (V,); shown as its logarithm, dark = soft.
        size: side of a view [px].

    Returns:
        uint8 (4 size, 3 size, 3).
    """
    rigid, deformed = rigid.astype(np.float64), deformed.astype(np.float64)
    dent = np.linalg.norm(deformed - rigid, axis=1)
    rotation, _ = rigid_motion(rest.astype(np.float64), rigid)
    up = rotation @ np.array([0.0, 1.0, 0.0])
    centre = rigid[dent.argmax()] if dent.max() > 0 else rigid.mean(axis=0)
    near = np.linalg.norm(rigid - centre, axis=1) < 0.03
    outward = vertex_normals(rigid, faces)[near].sum(axis=0)
    outward -= (outward @ up) * up
    outward = outward / np.linalg.norm(outward) if np.linalg.norm(outward) > 1e-6 else rotation @ [0.0, 0.0, 1.0]
    side = np.cross(up, outward)
    box = centre + _FIELD * np.array([[-1, -1, -1], [1, 1, 1], [0, 0, 0]]) / np.sqrt(3)
    low, high = np.log(np.maximum(stiffness, 1e-9)).min(), np.log(np.maximum(stiffness, 1e-9)).max()
    stiff = ((np.log(np.maximum(stiffness, 1e-9)) - low) / max(high - low, 1e-9))[:, None]
    heat = (dent / max(dent.max(), 1e-9))[:, None]
    red, white = np.array([0.75, 0.1, 0.1]), np.array([0.95, 0.95, 0.95])
    rows: list[list[np.ndarray]] = [[], [], [], []]
    for angle in (-70.0, 0.0, 70.0):
        turn = np.deg2rad(angle)
        K, pose = look_from(box, np.cos(turn) * outward + np.sin(turn) * side + 0.15 * up, up, size)
        rows[0].append(_scene(rigid, faces, np.tile(_SKIN, (len(rigid), 1)), hands, K, pose, size))
        rows[1].append(_scene(deformed, faces, np.tile(_SKIN, (len(rigid), 1)), hands, K, pose, size))
        rows[2].append(_scene(deformed, faces, white + heat * (red - white), [], K, pose, size))
        around, view = look_from(rigid, np.cos(turn) * outward + np.sin(turn) * side, up, size)
        dark, light = np.array([0.2, 0.1, 0.35]), np.array([0.98, 0.9, 0.5])
        rows[3].append(_scene(rigid, faces, dark + stiff * (light - dark), [], around, view, size))
    return np.concatenate([np.concatenate(row, axis=1) for row in rows])


def _scene(
    head: np.ndarray, faces: np.ndarray, colors: np.ndarray, hands: list[tuple[np.ndarray, np.ndarray]],
    K: np.ndarray, pose: np.ndarray, size: int,
) -> np.ndarray:  # fmt: skip
    verts, ids, colors_of = [head], [np.asarray(faces)], [colors]
    offset = len(head)
    for hand, hand_faces in hands:
        verts.append(hand.astype(np.float64))
        ids.append(np.asarray(hand_faces) + offset)
        colors_of.append(np.tile(_HAND, (len(hand), 1)))
        offset += len(hand)
    return draw_mesh(np.concatenate(verts), np.concatenate(ids), np.concatenate(colors_of), K, pose, size)
