"""Linear blend skinning as its paper writes it, in float64 and plain loops: the oracle of our body models.

Loper et al., "SMPL: A Skinned Multi-Person Linear Model", 2015: template plus shape and pose directions (their eq. 8
and 9), joints from the shaped template (eq. 10), rigid transforms along the chain (eq. 3 and 4), blended (eq. 2).
"""

from typing import Any

import numpy as np
import scipy.sparse
from scipy.spatial.transform import Rotation


def pose_model(model: dict[str, Any], shape: np.ndarray, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and joints (J, 3) [m] of an official model's dictionary.

    Args:
        model: `v_template`, `shapedirs`, `posedirs`, `J_regressor`, `weights`, `kintree_table`.
        shape: one coefficient for each of its shape directions.
        pose: axis-angle (3 J,) [rad], the root first.
    """
    shaped = np.array(model["v_template"], np.float64)
    for number, coefficient in enumerate(shape):
        shaped += coefficient * np.asarray(model["shapedirs"][:, :, number])
    regressor = model["J_regressor"]
    regressor = regressor.toarray() if scipy.sparse.issparse(regressor) else np.asarray(regressor)
    joints = np.array([sum(w * v for w, v in zip(row, shaped, strict=True)) for row in regressor])
    turns = [Rotation.from_rotvec(vector).as_matrix() for vector in pose.reshape(-1, 3)]
    posed = shaped.copy()
    feature = np.concatenate([(turn - np.eye(3)).reshape(-1) for turn in turns[1:]])
    for number, value in enumerate(feature):
        posed += value * np.asarray(model["posedirs"][:, :, number])
    rotation, place = [turns[0]], [joints[0]]
    for joint in range(1, len(joints)):
        parent = int(model["kintree_table"][0][joint])
        place.append(place[parent] + rotation[parent] @ (joints[joint] - joints[parent]))
        rotation.append(rotation[parent] @ turns[joint])
    verts = np.zeros_like(posed)
    for v, point in enumerate(posed):
        for joint, weight in enumerate(model["weights"][v]):
            verts[v] += weight * (rotation[joint] @ (point - joints[joint]) + place[joint])
    return verts, np.array(place)
