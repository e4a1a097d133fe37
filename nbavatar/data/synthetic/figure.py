"""What the cameras see of a subject besides the two models: hair, clothed torso, arm; and the looks of all of it.

Hair is a layer on the scalp; some styles have more, on the chin or hanging off the head (`synthetic.hair`).
"""

import dataclasses

import numpy as np

from nbavatar.data.synthetic.contact import vertex_normals
from nbavatar.data.synthetic.hair import beard, loose_hair
from nbavatar.data.synthetic.models import EYE_ORIGIN, Human, hand_axes
from nbavatar.data.synthetic.motion import Subject
from nbavatar.data.synthetic.scene import STAGE_TO_WORLD, Scene
from nbavatar.data.synthetic.shading import ARM, CLOTH, EYE, HAIR, HAND, SKIN, hairline

__all__ = ["Figure", "Looks", "build_figure", "looks_of", "pose_figure"]


@dataclasses.dataclass(frozen=True)
class Looks:
    """Colours (linear light) and landmarks of the procedural textures; see `shading.shade`."""

    colours: np.ndarray
    lips: np.ndarray
    brow: np.ndarray
    eyes: np.ndarray
    nails: np.ndarray
    knuckles: np.ndarray
    seed: float


@dataclasses.dataclass(frozen=True)
class Figure:
    """Everything about the drawn mesh that does not change over time.

    Attributes:
        faces (F, 3), material (F,): head, hand, hair, torso, arm, hair off the head in this order.
        rest (V, 3): texture coordinates [mm]; dorsal (V,).
        counts: vertices of the six pieces.
        hair_ids: head vertices under each hair vertex; hair_lift (H,) [m].
        tail: hair off the head, in the axes of the head's template, (T, 3) [m]; there may be none.
    """

    faces: np.ndarray
    material: np.ndarray
    rest: np.ndarray
    dorsal: np.ndarray
    counts: tuple[int, ...]
    hair_ids: np.ndarray
    hair_lift: np.ndarray
    torso: np.ndarray
    shoulder: np.ndarray
    looks: Looks
    tail: np.ndarray

    def piece(self, number: int) -> tuple[slice, np.ndarray]:
        """Vertices of a piece, and its faces, (F, 3) from its first vertex on."""
        start = int(sum(self.counts[:number]))
        part = slice(start, start + self.counts[number])
        rows = ((self.faces >= part.start) & (self.faces < part.stop)).all(1)
        return part, self.faces[rows] - start


def _linear(colour: tuple[float, float, float]) -> np.ndarray:
    return np.array(colour) ** 2.2


_ARM_RINGS, _ARM_SIDES = 25, 20


def looks_of(human: Human, subject: Subject) -> Looks:
    """Textures of one subject."""
    points = (human.head[human.head_faces[human.landmark_faces]] * human.landmark_bary[..., None]).sum(1)
    q = (points - EYE_ORIGIN) * 1e3
    upper, lower = q[[51, 50, 49, 48]], q[[57, 58, 59, 48]]
    lips = np.stack(
        [np.abs(upper[:, 0]), upper[:, 1], np.interp(np.abs(upper[:, 0]), np.abs(lower[:, 0]), lower[:, 1])], 1
    )
    brow = np.stack([np.abs(q[21:16:-1, 0]) + 1.0, q[21:16:-1, 1] - [1.0, 3.0, 4.0, 3.5, 2.5]], 1)
    skin, left, _ = human.part_sizes
    centres = np.stack([human.head[skin : skin + left].mean(0), human.head[skin + left :].mean(0)])
    joints = human.hand_regressor @ human.hand
    tips = human.hand[human.tips][[1, 2, 4, 3, 0]]  # in the order of the joints: index, middle, little, ring, thumb
    bend, _ = hand_axes(joints)
    nails = []
    for finger in range(5):
        last = joints[3 + 3 * finger]
        along = (tips[finger] - last) / np.linalg.norm(tips[finger] - last)
        back = -np.cross(along, bend[3 * finger + 2])
        back = back if back[1] > 0 else -back
        nails.append(np.concatenate([(tips[finger] - 0.0065 * along + 0.0025 * back) * 1e3, along, back]))
    knuckles = joints[[i for i in range(1, 16)]] * 1e3 + np.array([0, 7.0, 0])
    colours = np.stack(
        [
            _linear(subject.skin),
            _linear(subject.hair),
            _linear(subject.iris),
            _linear(subject.shirt),
            [0.36, 0.40, 0.46],
            [0.16, 0.14, 0.13],
        ]
    )
    return Looks(colours, lips, brow, (centres - EYE_ORIGIN) * 1e3, np.array(nails), knuckles, float(subject.seed % 97))


def build_figure(scene: Scene, hair: str = "cap") -> Figure:
    """Collects the drawn mesh of one subject, with hair of a style (`nbavatar.config.synthetic.HAIR`)."""
    human, subject = scene.bodies.human, scene.subject
    q = (human.head - EYE_ORIGIN) * 1e3
    skin = human.part_sizes[0]
    height = np.array([hairline(*row) for row in q])
    height[skin:] = -100
    chin = beard(q) if hair == "beard" else np.full(len(q), -1.0)
    chin[skin:] = -1.0
    covered = (height > -14) | (chin > -0.004)
    scalp = scene.bodies.skin_faces[covered[scene.bodies.skin_faces].all(1)]
    ids = np.unique(scalp)
    renumber = np.full(len(q), -1)
    renumber[ids] = np.arange(len(ids))
    lump = 1 + 0.25 * np.sin(q[ids, 0] / 9 + subject.seed % 7) * np.sin(q[ids, 1] / 11) * np.sin(q[ids, 2] / 10)
    lift = np.maximum(subject.hair_length * np.clip(height[ids] / 16, -0.45, 1.0), chin[ids]) * lump - 0.001
    torso = human.torso
    # cloth lies off the skin, and the collar most of all, so that a turning head does not bare the seam
    rim = torso[:, 1] - EYE_ORIGIN[1] + 0.150 + 0.3 * (torso[:, 2] - EYE_ORIGIN[2] + 0.08)
    off = 0.006 + 0.007 * np.clip(1 + rim / 0.03, 0, 1)
    torso = torso + vertex_normals(torso, human.torso_faces) * off[:, None]
    arm_faces = []
    for ring in range(_ARM_RINGS - 1):
        for s in range(_ARM_SIDES):
            a, b = ring * _ARM_SIDES + s, ring * _ARM_SIDES + (s + 1) % _ARM_SIDES
            arm_faces += [[a, b, a + _ARM_SIDES], [b, b + _ARM_SIDES, a + _ARM_SIDES]]
    arm_faces = np.array(arm_faces)
    sleeve = (arm_faces.min(1) // _ARM_SIDES) < _ARM_RINGS * 6 // 10
    tail, tail_faces = loose_hair(hair)
    pieces = [human.head_faces, human.hand_faces, renumber[scalp], human.torso_faces, arm_faces, tail_faces]
    counts = (len(q), len(human.hand), len(ids), len(torso), _ARM_RINGS * _ARM_SIDES, len(tail))
    start = np.concatenate([[0], np.cumsum(counts)[:-1]])
    faces = np.concatenate([f + s for f, s in zip(pieces, start, strict=True)])
    material = np.concatenate(
        [
            np.where((human.head_faces < skin).all(1), SKIN, EYE),
            np.full(len(human.hand_faces), HAND),
            np.full(len(scalp), HAIR),
            np.full(len(torso[human.torso_faces]), CLOTH),
            np.where(sleeve, CLOTH, ARM),
            np.full(len(tail_faces), HAIR),
        ]
    )
    ring, side = np.divmod(np.arange(counts[4]), _ARM_SIDES)
    angle = 2 * np.pi * side / _ARM_SIDES
    arm_rest = np.stack([40 * np.cos(angle), ring * 22.0, 40 * np.sin(angle)], 1)
    rest = np.concatenate([q, human.hand * 1e3, q[ids], torso * 1e3, arm_rest, tail * 1e3])
    dorsal = np.zeros(len(rest))
    dorsal[counts[0] : counts[0] + counts[1]] = vertex_normals(human.hand, human.hand_faces)[:, 1]
    looks = looks_of(human, subject)
    tail = tail + EYE_ORIGIN
    return Figure(faces, material, rest, dorsal, counts, ids, lift, torso, human.shoulder, looks, tail)


def pose_figure(figure: Figure, scene: Scene, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The drawn mesh of frame `n`.

    Returns:
        vertices (V, 3) [m], normals (V, 3), both world, and the share of ambient light (V,).
    """
    human = scene.bodies.human
    head, hand = scene.head[n], scene.hand[n]
    head_normals = vertex_normals(head, human.head_faces)
    hand_normals = vertex_normals(hand, human.hand_faces)
    hair = head[figure.hair_ids] + head_normals[figure.hair_ids] * figure.hair_lift[:, None]
    torso = figure.torso @ STAGE_TO_WORLD[:3, :3].T + STAGE_TO_WORLD[:3, 3]
    inside = figure.shoulder + np.array([0.035, -0.012, 0.0])  # the sleeve starts within the torso
    shoulder = inside @ STAGE_TO_WORLD[:3, :3].T + STAGE_TO_WORLD[:3, 3]
    tail = figure.tail @ scene.rotation[n].T + scene.shift[n]
    verts = np.concatenate([head, hand, hair, torso, _arm(scene, n, shoulder), tail])
    start = np.concatenate([[0], np.cumsum(figure.counts)])
    normals = np.zeros_like(verts)
    normals[: start[1]], normals[start[1] : start[2]] = head_normals, hand_normals
    for piece in range(2, len(figure.counts)):
        part, faces = figure.piece(piece)
        normals[part] = vertex_normals(verts[part], faces)
    return verts, normals, _ambient(verts, normals, start)


def _ambient(verts: np.ndarray, normals: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Hands and faces that are close to each other take each other's ambient light."""
    from scipy.spatial import cKDTree

    out = np.ones(len(verts))
    head, hand = slice(0, start[1]), slice(start[1], start[2])
    for receiver, caster in ((head, hand), (hand, head)):
        tree = cKDTree(verts[caster])
        distance, nearest = tree.query(verts[receiver], k=6, distance_upper_bound=0.06)
        found = np.isfinite(distance)
        towards = verts[caster][np.minimum(nearest, len(verts[caster]) - 1)] - verts[receiver][:, None]
        cosine = (towards * normals[receiver][:, None]).sum(-1) / np.maximum(distance, 1e-6)
        near = np.where(found, np.exp(-distance / 0.018) * np.clip(0.45 + cosine, 0, 1), 0.0).max(1)
        out[receiver] = 1 - 0.75 * near
    return out


def _arm(scene: Scene, n: int, shoulder: np.ndarray) -> np.ndarray:
    """A tube from shoulder over elbow to the wrist of the hand mesh, (rings x sides, 3)."""
    human = scene.bodies.human
    hand, joints = scene.hand[n], scene.joints[n]
    edges = np.concatenate([human.hand_faces[:, [0, 1]], human.hand_faces[:, [1, 2]], human.hand_faces[:, [2, 0]]])
    code = edges[:, 0] * len(hand) + edges[:, 1]
    rim = np.unique(edges[~np.isin(code, edges[:, 1] * len(hand) + edges[:, 0])])
    wrist = hand[rim].mean(0)
    forward = joints[[1, 4, 7, 10]].mean(0) - wrist
    forward /= np.linalg.norm(forward)
    down = -STAGE_TO_WORLD[:3, 1]
    # the elbow lies behind the wrist along the hand and below, at arm's length from the shoulder
    elbow = wrist - 0.24 * (0.75 * forward - 0.5 * down) / np.linalg.norm(0.75 * forward - 0.5 * down)
    s = np.linspace(0, 1, _ARM_RINGS)[:, None]
    upper, fore = np.clip(s / 0.5, 0, 1), np.clip((s - 0.5) / 0.5, 0, 1)
    path = np.where(s < 0.5, shoulder + upper * (elbow - shoulder), elbow + fore * (wrist + 0.006 * forward - elbow))
    for _ in range(3):
        path[1:-1] = (path[:-2] + 2 * path[1:-1] + path[2:]) / 4
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    spread = hand[rim] - wrist
    spread = spread - (spread @ forward)[:, None] * forward
    axes = np.linalg.svd(spread, full_matrices=False)
    wide, thin = (axes[1][:2] / np.sqrt(len(rim) / 2)) * 0.985
    side = axes[2][0]
    angle = 2 * np.pi * np.arange(_ARM_SIDES) / _ARM_SIDES
    out = np.zeros((_ARM_RINGS, _ARM_SIDES, 3))
    for ring in range(_ARM_RINGS):
        u = side - (side @ tangent[ring]) * tangent[ring]
        u /= np.linalg.norm(u)
        v = np.cross(tangent[ring], u)
        t = ring / (_ARM_RINGS - 1)
        a = np.interp(t, [0, 0.3, 0.5, 0.7, 0.88, 1], [0.078, 0.058, 0.048, 0.046, 0.034, wide])
        b = np.interp(t, [0, 0.3, 0.5, 0.7, 0.88, 1], [0.085, 0.058, 0.046, 0.043, 0.027, thin])
        out[ring] = path[ring] + a * np.cos(angle)[:, None] * u + b * np.sin(angle)[:, None] * v
    return out.reshape(-1, 3)
