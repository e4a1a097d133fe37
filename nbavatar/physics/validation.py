"""How good a contact deformation is: against a reference, and by itself."""

from collections.abc import Sequence

import numpy as np

from nbavatar.mesh.bvh import DeformingMesh
from nbavatar.physics.collision import measure_overlap

__all__ = ["compare_deformation", "compare_labels", "head_distances", "plausibility", "vertex_areas"]

_TOUCH = (0.001, 0.002, 0.003, 0.004, 0.005, 0.006, 0.008, 0.01)


def compare_deformation(
    ours: np.ndarray, reference: np.ndarray, touching: np.ndarray, reference_touching: np.ndarray, moved: float = 5e-4
) -> dict[str, float]:
    """Agreement of two deformation fields.

    Args:
        ours: displacement of every vertex [m], (N, V, 3); `reference` likewise.
        touching: our contact labels, (N, V) bool; `reference_touching` likewise.
        moved: direction is compared where both displacements are longer than this [m].

    Returns:
        On the reference's contact vertices: `mean_mm`, `p95_mm`, `max_mm` of the difference, `reference_mm`, the mean
        length of the reference there (the error of doing nothing), and `cosine` of the directions. On all vertices
        that either moves by `moved`, the rim of the dent included: `moved_mean_mm`, `moved_reference_mm`,
        `moved_cosine`. `contact_precision`, `contact_recall`, `contact_f1` of the labels. NaN where there is nothing
        to compare.
    """
    error = np.linalg.norm(ours - reference, axis=-1) * 1e3
    length, reference_length = (np.linalg.norm(field, axis=-1) for field in (ours, reference))
    contact = reference_touching & np.isfinite(error)
    both = (length > moved) & (reference_length > moved)
    either = (length > moved) | (reference_length > moved)
    cosine = (ours * reference).sum(-1) / np.maximum(length * reference_length, 1e-12)
    hits = float((touching & reference_touching).sum())
    precision = hits / touching.sum() if touching.any() else np.nan
    recall = hits / reference_touching.sum() if reference_touching.any() else np.nan
    return {
        "mean_mm": _mean(error[contact]),
        "p95_mm": float(np.percentile(error[contact], 95)) if contact.any() else np.nan,
        "max_mm": float(error[contact].max()) if contact.any() else np.nan,
        "reference_mm": _mean(reference_length[contact]) * 1e3,
        "cosine": _mean(cosine[both & contact]),
        "moved_mean_mm": _mean(error[either]),
        "moved_reference_mm": _mean(reference_length[either]) * 1e3,
        "moved_cosine": _mean(cosine[both]),
        "contact_precision": float(precision),
        "contact_recall": float(recall),
        "contact_f1": float(2 * hits / max(touching.sum() + reference_touching.sum(), 1)),
    }


def head_distances(
    head: DeformingMesh, hands: list[DeformingMesh], heads: np.ndarray, posed: list[np.ndarray], radius: float = 0.01
) -> np.ndarray:
    """Distance of every head vertex to the nearest hand, inside or outside.

    Args:
        head: hierarchy of the head, `hands` of each hand; moved by this function.
        heads: (N, V, 3) [m]; `posed` (N, Vh, 3) [m] of each hand. Finite.
        radius: how far to look [m].

    Returns:
        (N, V) [m], inf beyond the radius.
    """
    result = np.full(heads.shape[:2], np.inf)
    for n, verts in enumerate(heads):
        head.move(verts)
        for hand, at in zip(hands, posed, strict=True):
            hand.move(at[n])
            overlap = measure_overlap(head, hand, (len(verts), at.shape[1]), radius)
            result[n] = np.minimum(result[n], np.where(overlap.head_depth > 0, 0.0, overlap.head_distance))
    return result


def compare_labels(
    distance: np.ndarray, reference_touching: np.ndarray, touch: Sequence[float] = _TOUCH
) -> dict[str, object]:
    """Contact labels by distance against a reference whose touch distance is not known.

    Args:
        distance: of vertices to the nearest hand [m], (N, V).
        reference_touching: (N, V) bool.
        touch: distances below which a vertex would count as touching [m].

    Returns:
        `f1_by_touch_mm`, F-score at each distance; `best_touch_mm`, the one at which it is highest, with `precision`,
        `recall` and `f1` there.
    """
    scores = {}
    for limit in touch:
        ours = distance < limit
        hits = float((ours & reference_touching).sum())
        scores[limit] = (
            hits / max(float(ours.sum()), 1.0),
            hits / max(float(reference_touching.sum()), 1.0),
            2.0 * hits / max(float(ours.sum() + reference_touching.sum()), 1.0),
        )
    best = max(scores, key=lambda limit: scores[limit][2])
    return {
        "f1_by_touch_mm": {f"{1e3 * limit:g}": score[2] for limit, score in scores.items()},
        "best_touch_mm": 1e3 * best,
        **dict(zip(("precision", "recall", "f1"), scores[best], strict=True)),
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
