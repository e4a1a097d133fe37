"""Half-edge collapse down to exact vertex counts, for the asset builder.

Collapsing a vertex onto a neighbour keeps the remaining vertices where they were, so the coarse mesh is a subset of
the fine one and every per-vertex attribute (displacement targets, skin weights) carries over by indexing. Costs are
quadric errors (Garland and Heckbert 1997) plus a small edge-length term that keeps triangles even, times an importance.
"""

import heapq

import numpy as np

__all__ = ["collapse"]


def _quadrics(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    normal = np.cross(verts[faces[:, 1]] - verts[faces[:, 0]], verts[faces[:, 2]] - verts[faces[:, 0]])
    area = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal / np.maximum(area, 1e-20)
    plane = np.concatenate([normal, -(normal * verts[faces[:, 0]]).sum(1, keepdims=True)], 1)
    per_face = plane[:, :, None] * plane[:, None, :] * area[:, :, None] / 2
    total = np.zeros((len(verts), 4, 4))
    for i in range(3):
        np.add.at(total, faces[:, i], per_face)
    return total


def collapse(
    verts: np.ndarray,
    faces: np.ndarray,
    kind: np.ndarray,
    targets: dict[int, int],
    importance: np.ndarray,
    *,
    regularity: float = 2e-4,
) -> tuple[np.ndarray, np.ndarray]:
    """Removes vertices until each kind has the wanted number.

    Args:
        verts: (V, 3) positions [m].
        faces: (F, 3) vertex ids of a manifold mesh.
        kind: (V,) 0 interior, 1.. curves whose vertices may only slide along their own curve, -1 fixed.
        targets: kind -> number of vertices to leave (kinds that are absent stay whole).
        importance: (V,) factor on the cost: larger keeps more detail.
        regularity: weight of the squared edge length in the cost, relative to the quadric error's scale.

    Returns:
        ``keep`` (V',) ids of the remaining vertices in increasing order and ``faces`` (F', 3) in terms of them.

    Raises:
        ValueError: if the count cannot be reached without folding the mesh.
    """
    faces_of: list[set[int]] = [set() for _ in range(len(verts))]
    tri = [tuple(int(i) for i in f) for f in faces]
    for index, face in enumerate(tri):
        for i in face:
            faces_of[i].add(index)
    quadric = _quadrics(verts, faces)
    count = {k: int((kind == k).sum()) for k in targets}
    stamp = np.zeros(len(verts), np.int64)
    alive = np.ones(len(verts), bool)
    heap: list[tuple[float, int, int, int, int]] = []

    def ring(u: int) -> set[int]:
        return {i for f in faces_of[u] for i in tri[f]} - {u}

    def push(u: int, v: int) -> None:
        if kind[u] < 0 or (kind[u] > 0 and kind[v] not in (kind[u], -1)) or kind[u] not in targets:
            return
        p = np.append(verts[v], 1.0)
        length2 = float(((verts[u] - verts[v]) ** 2).sum())
        cost = (
            float(p @ (quadric[u] + quadric[v]) @ p)
            + regularity * length2 * length2 * 1e2
            + 1e-6 * regularity * length2
        )
        heapq.heappush(heap, (cost * float(importance[u]), u, v, int(stamp[u]), int(stamp[v])))

    def allowed(u: int, v: int) -> bool:
        shared = faces_of[u] & faces_of[v]
        on_curve = kind[u] != 0
        if len(shared) != (1 if on_curve else 2) or len(ring(u) & ring(v)) != len(shared):
            return False
        for f in faces_of[u] - shared:
            old = [verts[i] for i in tri[f]]
            new = [verts[v] if i == u else verts[i] for i in tri[f]]
            n0 = np.cross(old[1] - old[0], old[2] - old[0])
            n1 = np.cross(new[1] - new[0], new[2] - new[0])
            size = np.linalg.norm(n1)
            if n0 @ n1 <= 0.2 * np.linalg.norm(n0) * size:
                return False
            longest = max(((new[i] - new[i - 1]) ** 2).sum() for i in range(3))
            if size < 0.06 * longest:
                return False
        return True

    for u in range(len(verts)):
        for v in ring(u):
            push(u, v)
    while any(count[k] > targets[k] for k in targets):
        if not heap:
            raise ValueError(f"collapse stopped at {count}, wanted {targets}")
        _, u, v, su, sv = heapq.heappop(heap)
        if not (alive[u] and alive[v]) or stamp[u] != su or stamp[v] != sv:
            continue
        k = int(kind[u])
        if count[k] <= targets[k] or not allowed(u, v):
            continue
        for f in list(faces_of[u]):
            if v in tri[f]:
                for i in tri[f]:
                    faces_of[i].discard(f)
            else:
                tri[f] = tuple(v if i == u else i for i in tri[f])
                faces_of[v].add(f)
        faces_of[u] = set()
        alive[u] = False
        quadric[v] += quadric[u]
        count[k] -= 1
        touched = ring(v) | {v}
        for i in touched:
            stamp[i] += 1
        for i in touched:
            for j in ring(i):
                push(i, j)
                if j not in touched:
                    push(j, i)
    keep = np.flatnonzero(alive)
    renumber = np.full(len(verts), -1)
    renumber[keep] = np.arange(len(keep))
    rest = sorted({f for i in keep for f in faces_of[i]})
    return keep, renumber[np.array([tri[f] for f in rest])]
