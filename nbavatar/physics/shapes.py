"""A head and a hand of simple shapes, of any size: what benchmarks and tests press together without licence or data."""

import numpy as np

__all__ = ["capsule_hand", "press", "round_head"]


def round_head(vertices: int) -> tuple[np.ndarray, np.ndarray]:
    """An ellipsoid with a nose and an open neck, y up and z forward.

    Args:
        vertices: number wanted; the nearest that the grid of rings allows is made.

    Returns:
        Positions (V, 3) [m], 23 cm high, and faces (F, 3).
    """
    around = max(round(np.sqrt(vertices * 1.6)), 8)
    rings = max(round(vertices / around), 4)
    # From the top down to the neck's rim; the pole is one vertex.
    theta = np.linspace(0.0, 0.86 * np.pi, rings + 1)[1:]
    phi = 2 * np.pi * (np.arange(around)[None] + 0.5 * (np.arange(rings)[:, None] % 2)) / around
    sphere = np.stack(
        (
            np.sin(theta)[:, None] * np.sin(phi),
            np.broadcast_to(np.cos(theta)[:, None], phi.shape),
            np.sin(theta)[:, None] * np.cos(phi),
        ),
        axis=-1,
    ).reshape(-1, 3)
    sphere = np.concatenate((sphere, [[0.0, 1.0, 0.0]]))
    nose = np.exp(-((sphere[:, 0] / 0.16) ** 2) - ((sphere[:, 1] + 0.05) / 0.22) ** 2) * (sphere[:, 2] > 0)
    verts = sphere * [0.075, 0.115, 0.095] + nose[:, None] * [0.0, 0.0, 0.02]
    i, j = np.meshgrid(np.arange(rings - 1), np.arange(around), indexing="ij")
    odd = i % 2
    a, b = i * around + j, i * around + (j + 1) % around
    c, d = a + around, (i + 1) * around + (j + 1) % around
    even_faces = np.stack((a, c, b, b, c, d), -1)
    odd_faces = np.stack((a, d, b, a, c, d), -1)
    quads = np.where(odd[..., None] == 1, odd_faces, even_faces).reshape(-1, 3)
    pole = len(sphere) - 1
    first = np.arange(around)
    cap = np.stack((np.full(around, pole), first, (first + 1) % around), axis=1)
    return verts, np.concatenate((cap, quads)).astype(np.int64)


def capsule_hand(vertices: int, fingers: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Fingers side by side along x, each a capsule 16 mm thick and 8 cm long that is open at its far end (z = +8 cm).

    Fingertips are at z = 0, pointing towards -z.

    Args:
        vertices: number wanted in all, the nearest possible is made.
        fingers: number of fingers.

    Returns:
        Positions (V, 3) [m] and faces (F, 3).
    """
    around = max(round(np.sqrt(vertices / fingers / 1.6)), 6)
    rings = max(round(vertices / fingers / around), 4)
    radius, length = 0.008, 0.08
    caps = max(rings // 4, 2)
    theta = np.linspace(0, np.pi / 2, caps + 1)[1:]
    profile_r = np.concatenate((radius * np.sin(theta), np.full(rings - caps, radius)))
    profile_z = np.concatenate((radius * (1 - np.cos(theta)), np.linspace(radius, length, rings - caps + 1)[1:]))
    phi = 2 * np.pi * np.arange(around) / around
    ring = np.stack(
        (
            profile_r[:, None] * np.cos(phi),
            profile_r[:, None] * np.sin(phi),
            np.broadcast_to(profile_z[:, None], (rings, around)),
        ),
        axis=-1,
    ).reshape(-1, 3)
    verts = np.concatenate((ring, [[0.0, 0.0, 0.0]]))
    i, j = np.meshgrid(np.arange(rings - 1), np.arange(around), indexing="ij")
    a, b = i * around + j, i * around + (j + 1) % around
    sides = np.stack((a, b, a + around, b, b + around, a + around), -1).reshape(-1, 3)
    first = np.arange(around)
    tip = np.stack((np.full(around, len(ring)), (first + 1) % around, first), axis=1)
    faces = np.concatenate((tip, sides))
    count = len(verts)
    step = 0.018
    places = (np.arange(fingers) - (fingers - 1) / 2) * step
    return (
        np.concatenate([verts + [x, 0, 0] for x in places]),
        np.concatenate([faces + k * count for k in range(fingers)]).astype(np.int64),
    )


def press(hand: np.ndarray, depth: float, slide: float = 0.0) -> np.ndarray:
    """A hand of `capsule_hand` against the cheek of `round_head`.

    Args:
        hand: positions (V, 3) [m].
        depth: how deep the fingertips would be in the undeformed cheek [m]; negative: away from it.
        slide: shift along the skin, downwards [m].
    """
    # The cheek at 40 degrees from the nose, a little under the ellipsoid's equator.
    direction = np.array([np.sin(0.7), 0.0, np.cos(0.7)])
    normal = direction / [0.075, 1.0, 0.095]
    normal /= np.linalg.norm(normal)
    point = direction * [0.075, 0.0, 0.095]
    side = np.cross([0.0, 1.0, 0.0], normal)
    # Fingers side by side downwards, tips towards the head.
    frame = np.stack(([0.0, -1.0, 0.0], side, normal), axis=1)
    return hand @ frame.T + point - depth * normal + np.array([0.0, -slide, 0.0])
