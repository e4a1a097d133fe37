"""Small random models in the official files' format: every array dense or sparse as in the originals."""

from typing import Any

import numpy as np
import scipy.sparse

ROOT = np.uint32(2**32 - 1)
FLAME_PARENTS = [ROOT, 0, 1, 1, 1]
MANO_PARENTS = [ROOT, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14]


def random_model(
    rng: np.random.Generator, parents: list[int], verts: int, faces: int, directions: int, scale: float
) -> dict[str, Any]:
    """A dictionary as the official pickles hold it; lengths of order `scale` [m]."""
    joints = len(parents)
    regressor = rng.random((joints, verts)) * (rng.random((joints, verts)) < 0.2) + 1e-9
    regressor[:, 0] += 1e-3
    weights = rng.random((verts, joints)) ** 8
    return {
        "v_template": scale * rng.normal(size=(verts, 3)),
        "f": rng.integers(0, verts, (faces, 3)).astype(np.uint32),
        "shapedirs": 0.01 * scale * rng.normal(size=(verts, 3, directions)),
        "posedirs": 0.01 * scale * rng.normal(size=(verts, 3, 9 * (joints - 1))),
        "J_regressor": scipy.sparse.csc_matrix(regressor / regressor.sum(1, keepdims=True)),
        "kintree_table": np.stack([np.array(parents, dtype=np.uint32), np.arange(joints, dtype=np.uint32)]),
        "weights": weights / weights.sum(1, keepdims=True),
        "J": np.zeros((joints, 3)),
        "bs_style": "lbs",
        "bs_type": "lrotmin",
    }


def random_flame(seed: int = 0, verts: int = 60, faces: int = 90) -> dict[str, Any]:
    """A FLAME-like model with all 400 directions."""
    return random_model(np.random.default_rng(seed), FLAME_PARENTS, verts, faces, 400, 0.1)


def random_mano(seed: int = 1, verts: int = 778, faces: int = 90) -> dict[str, Any]:
    """A MANO-like model with pose statistics."""
    rng = np.random.default_rng(seed)
    basis, _ = np.linalg.qr(rng.normal(size=(45, 45)))
    return random_model(rng, MANO_PARENTS, verts, faces, 10, 0.05) | {
        "hands_mean": 0.1 * rng.normal(size=45),
        "hands_components": basis,
        "hands_coeffs": rng.normal(size=(200, 45)) * np.linspace(1, 0.1, 45),
    }


def random_landmarks(seed: int, faces: int) -> dict[str, Any]:
    """A landmark embedding with static, dynamic and full sets."""
    rng = np.random.default_rng(seed)

    def pair(*lead: int) -> tuple[np.ndarray, np.ndarray]:
        weights = rng.dirichlet(np.ones(3), size=lead)
        return rng.integers(0, faces, lead), weights

    result: dict[str, Any] = {}
    for name, lead in (("static", (51,)), ("dynamic", (79, 17)), ("full", (1, 68))):
        result[f"{name}_lmk_faces_idx"], result[f"{name}_lmk_bary_coords"] = pair(*lead)
    return result
