"""Licence-free body models with the arrays of the official files: a FLAME-like head and MANO-like hands.

Shape, expression targets and skin weights are MakeHuman's (CC0), see `assets/LICENSE.md`; `full` has exactly the
counts of the official models (5,023 vertices and 9,976 faces; 778 and 1,538), `tiny` is a subset of its vertices
(612; 200). The first 60 shape and 40 expression directions are principal directions of MakeHuman's targets (one
standard deviation each), the others up to 300 + 100 small smooth fields, so that every column of the official layout
exists and does something.
Frame as in FLAME and MANO: metres, y up, the face looks along +z, the subject's left is +x; the right hand points along
-x with its palm down.
"""

import dataclasses
import functools
from importlib import resources
from typing import Any

import numpy as np

from nbavatar.data.synthetic.legacy_pickle import Ch, Select

__all__ = [
    "EYE_ORIGIN",
    "Human",
    "flame_content",
    "hand_axes",
    "landmark_content",
    "load_human",
    "mano_content",
    "mirrored_mano_content",
]

EYE_ORIGIN = np.array([0.0, 0.8035, 0.126])
"""Point between the eyes of the head template [m]; texture coordinates count from here."""

_SHAPES, _EXPRESSIONS = 300, 100


@dataclasses.dataclass(frozen=True)
class Human:
    """Arrays of one level of detail; float64, metres.

    Attributes:
        head, hand: templates (V, 3); `head_faces`, `hand_faces` (F, 3) int64.
        head_shape (V, 3, 60), head_expression (V, 3, 40), hand_shape (V, 3, 10): one standard deviation each.
        head_weights (V, 5), hand_weights (V, 16): skin weights, rows sum to 1.
        head_regressor (5, V), hand_regressor (16, V): joints from vertices.
        landmark_faces (68,), landmark_bary (68, 3): landmarks on the head's faces.
        flip (V,): vertex on the other side of the head; an involution.
        part_sizes: vertices of skin, left and right eyeball, in this order.
        tips (5,): fingertip vertices, thumb first.
        units: expression coefficients (40,) of MakeHuman's face units by name.
    """

    mesh: str
    head: np.ndarray
    head_faces: np.ndarray
    head_shape: np.ndarray
    head_expression: np.ndarray
    head_weights: np.ndarray
    head_regressor: np.ndarray
    landmark_faces: np.ndarray
    landmark_bary: np.ndarray
    flip: np.ndarray
    part_sizes: tuple[int, int, int]
    hand: np.ndarray
    hand_faces: np.ndarray
    hand_shape: np.ndarray
    hand_weights: np.ndarray
    hand_regressor: np.ndarray
    tips: np.ndarray
    units: dict[str, np.ndarray]
    torso: np.ndarray
    torso_faces: np.ndarray
    shoulder: np.ndarray

    def neck(self, margin: float = 0.0) -> np.ndarray:
        """Ids of the vertices below a plane under the chin, raised by `margin` [m]."""
        q = self.head - EYE_ORIGIN
        return np.flatnonzero(q[:, 1] < -0.128 - 0.6 * (q[:, 2] + 0.035) + margin)


@functools.cache
def load_human(mesh: str = "full") -> Human:
    """Reads the packaged shape data.

    Args:
        mesh: "full" or "tiny".
    """
    source = resources.files("nbavatar.data.synthetic") / "assets" / "human.npz"
    with resources.as_file(source) as path, np.load(path) as file:
        raw = {key: file[key] for key in file.files}
    head_ids: Any = slice(None) if mesh == "full" else raw["head_tiny.ids"].astype(np.int64)
    hand_ids: Any = slice(None) if mesh == "full" else raw["hand_tiny.ids"].astype(np.int64)
    head, hand = ("head", "hand") if mesh == "full" else ("head_tiny", "hand_tiny")

    def directions(name: str, ids: Any) -> np.ndarray:
        top = np.iinfo(raw[name].dtype).max
        return raw[name][ids].astype(np.float64) / top * raw[f"{name}_scale"].astype(np.float64)

    def weights(name: str, ids: Any) -> np.ndarray:
        w = raw[name][ids].astype(np.float64)
        return w / w.sum(1, keepdims=True)

    def whole(name: str) -> np.ndarray:
        return raw[name].astype(np.int64)

    def regressor(name: str) -> np.ndarray:
        r = raw[name].astype(np.float64)
        return r / r.sum(1, keepdims=True)

    bary = raw[f"{head}.landmark_bary"].astype(np.float64)
    return Human(
        mesh=mesh,
        head=raw["head.template"][head_ids].astype(np.float64),
        head_faces=whole(f"{head}.faces"),
        head_shape=directions("head.shape", head_ids),
        head_expression=directions("head.expression", head_ids),
        head_weights=weights("head.weights", head_ids),
        head_regressor=regressor(f"{head}.regressor"),
        landmark_faces=whole(f"{head}.landmark_faces"),
        landmark_bary=bary / bary.sum(1, keepdims=True),
        flip=whole(f"{head}.flip"),
        part_sizes=tuple(int(n) for n in raw[f"{head}.part_sizes"]),  # type: ignore[arg-type]
        hand=raw["hand.template"][hand_ids].astype(np.float64),
        hand_faces=whole(f"{hand}.faces"),
        hand_shape=directions("hand.shape", hand_ids),
        hand_weights=weights("hand.weights", hand_ids),
        hand_regressor=regressor(f"{hand}.regressor"),
        tips=whole(f"{hand}.tips"),
        units={str(n): row.astype(np.float64) for n, row in zip(raw["head.unit_names"], raw["head.unit_coefficients"])},
        torso=raw["torso.verts"].astype(np.float64),
        torso_faces=whole("torso.faces"),
        shoulder=raw["torso.shoulder"].astype(np.float64),
    )


def flame_content(human: Human) -> dict[str, Any]:
    """The dictionary of `generic_model.pkl`, with the wrappers of the original (`Ch`, sparse regressor)."""
    import scipy.sparse

    rng = np.random.default_rng(2020)
    extra_shape = _smooth_fields(human, _SHAPES - human.head_shape.shape[2], 1.0e-3, rng)
    extra_expression = _smooth_fields(human, _EXPRESSIONS - human.head_expression.shape[2], 0.4e-3, rng)
    directions = np.concatenate([human.head_shape, extra_shape, human.head_expression, extra_expression], axis=2)
    parents = np.array([2**32 - 1, 0, 1, 1, 1])
    return {
        "v_template": Ch(human.head),
        "f": human.head_faces.astype(np.uint32),
        "shapedirs": Ch(directions),
        "posedirs": Ch(_pose_fields(human.head, human.head_regressor @ human.head, human.head_weights, rng)),
        "J_regressor": scipy.sparse.csc_matrix(human.head_regressor),
        "J": human.head_regressor @ human.head,
        "weights": Ch(human.head_weights),
        "kintree_table": np.stack([parents, np.arange(5)]).astype(np.int64),
        "bs_style": "lbs",
        "bs_type": "lrotmin",
    }


def mano_content(human: Human) -> dict[str, Any]:
    """The dictionary of `MANO_RIGHT.pkl`; models without 778 vertices carry their fingertips under `tip_vertices`."""
    import scipy.sparse

    rng = np.random.default_rng(2017)
    joints = human.hand_regressor @ human.hand
    poses = _sample_poses(joints, rng)
    mean = poses.mean(0)
    components = np.linalg.svd(poses - mean, full_matrices=True)[2]
    parents = np.array([2**32 - 1, *(0 if i % 3 == 0 else i for i in range(15))])
    shape = human.hand_shape
    content = {
        "v_template": human.hand,
        "f": human.hand_faces.astype(np.uint32),
        # MANO's own file keeps its shape directions as a selection from a larger array
        "shapedirs": Select(Ch(shape), np.arange(shape.size), shape.shape),
        "posedirs": _pose_fields(human.hand, joints, human.hand_weights, rng),
        "J_regressor": scipy.sparse.csc_matrix(human.hand_regressor),
        "J": joints,
        "weights": human.hand_weights,
        "kintree_table": np.stack([parents, np.arange(16)]).astype(np.int64),
        "hands_mean": mean,
        "hands_components": components,
        "hands_coeffs": (poses - mean) @ components.T,
        "bs_style": "lbs",
        "bs_type": "lrotmin",
    }
    if len(human.hand) != 778:
        content["tip_vertices"] = human.tips
    return content


def mirrored_mano_content(content: dict[str, Any]) -> dict[str, Any]:
    """The left hand: everything mirrored in x, faces turned, pose features and angles with their signs."""
    flip = np.array([-1.0, 1.0, 1.0])
    angles = np.tile(-flip, 15)
    feature = np.tile(np.outer(flip, flip).ravel(), 15)
    shape = content["shapedirs"].a.x * flip[:, None]
    return {
        **content,
        "v_template": content["v_template"] * flip,
        "f": np.ascontiguousarray(content["f"][:, ::-1]),
        "shapedirs": Select(Ch(shape), np.arange(shape.size), shape.shape),
        "posedirs": content["posedirs"] * flip[:, None] * feature,
        "J": content["J"] * flip,
        "hands_mean": content["hands_mean"] * angles,
        "hands_components": content["hands_components"] * angles,
    }


def landmark_content(human: Human) -> dict[str, np.ndarray]:
    """The dictionary of `landmark_embedding.npy`: 68 fixed landmarks, the inner 51, the contour for 79 yaw steps."""
    faces, bary = human.landmark_faces, human.landmark_bary
    contour_faces, contour_bary = _contours(human)
    return {
        "static_lmk_faces_idx": faces[17:],
        "static_lmk_bary_coords": bary[17:],
        "dynamic_lmk_faces_idx": contour_faces,
        "dynamic_lmk_bary_coords": contour_bary,
        "full_lmk_faces_idx": faces[None],
        "full_lmk_bary_coords": bary[None],
    }


def hand_axes(joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Flexion and spreading axes (15, 3) of the finger joints in the rest pose, from their joints (16, 3).

    A positive turn about the first bends a finger towards the palm, about the second towards the thumb's side.
    """
    bend, spread = np.zeros((15, 3)), np.zeros((15, 3))
    for finger in range(5):
        chain = joints[1 + 3 * finger : 4 + 3 * finger]
        up = np.array([0.0, 1.0, 0.0]) if finger < 4 else np.array([0.25, 0.55, 0.8])
        for k in range(3):
            bone = chain[min(k + 1, 2)] - chain[min(k, 1)]
            bone = bone / np.linalg.norm(bone)
            axis = np.cross(up, bone)
            bend[3 * finger + k] = axis / np.linalg.norm(axis)
            spread[3 * finger + k] = np.cross(bend[3 * finger + k], bone)
    return bend, -spread


def _sample_poses(joints: np.ndarray, rng: np.random.Generator, count: int = 400) -> np.ndarray:
    """Natural hand poses (count, 45): fingers bend together, each a little on its own; small spreading."""
    bend, spread = hand_axes(joints)
    grip = rng.beta(1.2, 2.0, (count, 1, 1)) * 1.2
    own = rng.normal(0, 0.15, (count, 5, 1))
    reach = np.array([0.9, 1.0, 0.6])[None, None]
    amount = np.clip(grip + own, -0.15, 1.6) * reach * np.array([1, 1.05, 1.15, 1.1, 0.5])[None, :, None]
    sideways = np.zeros((count, 5, 3))
    sideways[..., 0] = rng.normal(0, 0.08, (count, 5))
    noise = rng.normal(0, 0.02, (count, 15, 3))
    poses = amount.reshape(count, 15, 1) * bend + sideways.reshape(count, 15, 1) * spread + noise
    return poses.reshape(count, 45)


def _smooth_fields(human: Human, count: int, size: float, rng: np.random.Generator) -> np.ndarray:
    """Displacement fields (V, 3, count) of a few waves across the head, fading with their index, eyeballs whole."""
    points = human.head.copy()
    skin, left, _ = human.part_sizes
    points[skin : skin + left] = points[skin : skin + left].mean(0)
    points[skin + left :] = points[skin + left :].mean(0)
    order = np.arange(count) / max(count, 1)
    waves = rng.normal(size=(count, 3, 3)) * (2 * np.pi / 0.25 * (0.6 + 1.4 * order))[:, None, None]
    phase = rng.uniform(0, 2 * np.pi, (count, 3))
    field = np.sin(np.einsum("vc,kdc->vdk", points - EYE_ORIGIN, waves) + phase.T[None])
    return field * (size * (1 + 4 * order) ** -1.0)


def _pose_fields(template: np.ndarray, joints: np.ndarray, weights: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Pose correctives (V, 3, 9 (J - 1)): up to 0.6 mm near the joint that turns, nothing elsewhere."""
    count = len(joints) - 1
    out = np.zeros((len(template), 3, 9 * count))
    for j in range(1, count + 1):
        away = template - joints[j]
        near = np.exp(-(away**2).sum(1) / (2 * 0.012**2)) * (weights[:, j] > 0.01)
        out[:, :, 9 * (j - 1) : 9 * j] = near[:, None, None] * rng.normal(0, 0.3e-3, (3, 9))[None]
    return out


def _contours(human: Human) -> tuple[np.ndarray, np.ndarray]:
    """Contour landmarks for 79 yaw steps: of the two halves, the one turned away slides from the jaw onto the cheek.

    Rows 0..39 are 0..39 degrees to one side, rows 40..78 are 1..39 degrees to the other.
    """
    skin = human.head_faces[(human.head_faces < human.part_sizes[0]).all(1)]
    ids = np.flatnonzero((human.head_faces < human.part_sizes[0]).all(1))
    normal = np.cross(human.head[skin[:, 1]] - human.head[skin[:, 0]], human.head[skin[:, 2]] - human.head[skin[:, 0]])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    centre = human.head[skin].mean(1)
    q = centre - EYE_ORIGIN
    face = (q[:, 2] > -0.07) & (q[:, 1] < 0.01) & (q[:, 1] > -0.125)
    rest = (human.head[human.head_faces[human.landmark_faces[:17]]] * human.landmark_bary[:17, :, None]).sum(1)
    faces = np.tile(human.landmark_faces[:17], (79, 1))
    bary = np.tile(human.landmark_bary[:17], (79, 1, 1))
    for row in range(1, 79):
        yaw = np.deg2rad(row if row < 40 else -(row - 39))
        view = np.array([-np.sin(yaw), 0.0, np.cos(yaw)])  # towards the viewer, in the head's frame
        for k in range(17):
            side = np.sign(rest[k, 0])
            if side * view[0] >= 0 or abs(rest[k, 0]) < 0.01:
                continue  # this half faces the viewer: its contour stays on the jaw
            away = np.linalg.norm(centre - rest[k], axis=1)
            cost = 0.03 * np.abs(normal @ view) + np.abs(centre[:, 1] - rest[k, 1]) + 0.15 * away
            cost = np.where(face & (centre[:, 0] * side > 0), cost, np.inf)
            faces[row, k], bary[row, k] = ids[cost.argmin()], 1 / 3
    return faces, bary
