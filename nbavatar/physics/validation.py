"""How good a contact deformation is: against a reference, and by itself."""

import numpy as np

from nbavatar.mesh.bvh import DeformingMesh
from nbavatar.physics.collision import measure_overlap

__all__ = ["compare_deformation", "plausibility", "vertex_areas"]


def compare_deformation(
    ours: np.ndarray, reference: np.ndarray, touching: np.ndarray, reference_touching: np.ndarray, moved: float = 5e-4
) -> dict[str, float]:
    """Agreement of two deformation fields.

    Args:
        ours: displacement of every vertex [m], (N, V, 3); `reference` likewise.
        touching: our contact labels, (N, V) bool; `reference_touching` likewise.
        moved: direction is compared where both displacements are longer than this [m].

    Returns:
        On the reference's contact vertices: `mean_mm`, `p95_mm`, `max_mm` of the difference, and `reference_mm`, the
        mean length of the reference there (the error of doing nothing). On all vertices that either moves by `moved`:
        `moved_mean_mm`, `moved_reference_mm`, and `cosine` of the directions. `contact_precision`, `contact_recall`,
        `contact_f1` of the labels. NaN where there is nothing to compare.
    """
    error = np.linalg.norm(ours - reference, axis=-1) * 1e3
    length, reference_length = (np.linalg.norm(field, axis=-1) for field in (ours, reference))
    contact = reference_touching & np.isfinite(error)
    both = (length > moved) & (reference_length > moved)
    either = (length > moved) | (reference_length > moved)
    cosine = (ours[both] * reference[both]).sum(-1) / (length[both] * reference_length[both])
    hits = float((touching & reference_touching).sum())
    precision = hits / touching.sum() if touching.any() else np.nan
    recall = hits / reference_touching.sum() if reference_touching.any() else np.nan
    return {
        "mean_mm": _mean(error[contact]),
        "p95_mm": float(np.percentile(error[contact], 95)) if contact.any() else np.nan,
        "max_mm": float(error[contact].max()) if contact.any() else np.nan,
        "reference_mm": _mean(reference_length[contact]) * 1e3,
        "moved_mean_mm": _mean(error[either]),
        "moved_reference_mm": _mean(reference_length[either]) * 1e3,
        "cosine": _mean(cosine),
        "contact_precision": float(precision),
        "contact_recall": float(recall),
        "contact_f1": float(2 * hits / max(touching.sum() + reference_touching.sum(), 1)),
    }


def plausibility(
    head: DeformingMesh,
    hand: DeformingMesh,
    areas: tuple[np.ndarray, np.ndarray],
    heads: np.ndarray,
    hands: np.ndarray,
    tolerance: float = 2e-4,
    touch: float = 5e-3,
) -> dict[str, float]:
    """Penetration and touch of two parts over N frames.

    Unlike the public script of DICE, nothing deep is dropped as a leak, and a vertex counts as colliding only when it
    is inside (there, values set to 0 count too).

    Args:
        head: hierarchy of the head, `hand` of one hand; moved by this function.
        areas: lumped vertex areas of head and hand [m^2], (V,) and (Vh,).
        heads: (N, V, 3) [m]; `hands` (N, Vh, 3) [m].
        tolerance: a frame collides when a vertex is deeper than this [m].
        touch: a frame touches when a vertex is nearer than this [m] (5 mm as in the literature).

    Returns:
        `max_depth_mm` of any vertex of either part inside the other, `mean_depth_mm` of the frames' deepest vertices,
        `volume_mm3` mean over frames of depth times vertex area (both parts, halved), `non_collision_ratio` and
        `touch_ratio` of the frames.
    """
    depths, volumes, touches = [], [], []
    count = (heads.shape[1], hands.shape[1])
    for head_verts, hand_verts in zip(heads, hands, strict=True):
        if not (np.isfinite(head_verts).all() and np.isfinite(hand_verts).all()):
            continue
        head.move(head_verts)
        hand.move(hand_verts)
        overlap = measure_overlap(head, hand, count, touch)
        depths.append(overlap.deepest)
        volumes.append(0.5 * (areas[0] @ overlap.head_depth + areas[1] @ overlap.hand_depth))
        touches.append(np.isfinite(overlap.hand_distance).any() or np.isfinite(overlap.head_distance).any())
    deepest = np.array(depths)
    return {
        "max_depth_mm": float(deepest.max(initial=0.0) * 1e3),
        "mean_depth_mm": _mean(deepest) * 1e3,
        "volume_mm3": _mean(np.array(volumes)) * 1e9,
        "non_collision_ratio": _mean(deepest <= tolerance),
        "touch_ratio": _mean(np.array(touches, float)),
    }


def vertex_areas(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """A third of the area of the faces around each vertex, (V,) [m^2]."""
    verts = np.asarray(verts, np.float64)
    cross = np.cross(verts[faces[:, 1]] - verts[faces[:, 0]], verts[faces[:, 2]] - verts[faces[:, 0]])
    area = np.linalg.norm(cross, axis=1) / 6.0
    return np.bincount(np.asarray(faces).ravel(), np.repeat(area, 3), minlength=len(verts))


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values)) if np.size(values) else float("nan")
