"""Posed synthetic subjects: parameters of the dataset's kind, meshes, dents and contacts, without any picture."""

import dataclasses
from collections.abc import Callable, Iterable

import numpy as np
import torch

from nbavatar.bodymodels.files import landmark_arrays, model_arrays
from nbavatar.bodymodels.flame import Flame, rotate_about_centroid
from nbavatar.bodymodels.mano import Mano, shorten_tips
from nbavatar.data.sequences import MeshSequence, Part
from nbavatar.data.synthetic.contact import Surface, dent, signed_distance
from nbavatar.data.synthetic.legacy_pickle import Ch, Select
from nbavatar.data.synthetic.models import EYE_ORIGIN, Human, flame_content, landmark_content, load_human, mano_content
from nbavatar.data.synthetic.motion import TOUCHES, Motion, Subject, Touch, make_motion, make_subject, touch_frame
from nbavatar.math.rotations import axis_angle_to_matrix, matrix_to_axis_angle

__all__ = ["CONTACT_DISTANCE", "STAGE_TO_WORLD", "Bodies", "Scene", "build_bodies", "full_scene", "make_scene"]

CONTACT_DISTANCE = 0.004
"""Surfaces closer than this touch, at full size [m]; vertices of the tiny meshes are too far apart for it."""

STAGE_TO_WORLD = np.array([[1.0, 0.0, 0.0, 0.35], [0.0, 0.0, -1.0, 1.10], [0.0, 1.0, 0.0, 0.62], [0.0, 0.0, 0.0, 1.0]])
"""The dataset's world has z up and its origin elsewhere, so that a reader who confuses frames is found out."""

_NECK_FOOT = np.array([0.0, 0.69, 0.03])


@dataclasses.dataclass(frozen=True)
class Bodies:
    """Body models built from the same dictionaries that are written to disk (float64)."""

    human: Human
    flame: Flame
    mano: Mano

    @property
    def skin_faces(self) -> np.ndarray:
        """(F, 3) faces of the head without eyeballs."""
        faces = self.human.head_faces
        return faces[(faces < self.human.part_sizes[0]).all(1)]


@dataclasses.dataclass(frozen=True)
class Scene:
    """One subject over N frames; world axes, metres, float64.

    Attributes:
        head_rigid (N, V, 3): head without contact; offset (N, V, 3): what contact adds; hand (N, P, 3).
        canonical (N, V, 3): head model output before its rigid motion, with expression and jaw.
        landmarks (N, 68, 3): on the deformed head; joints (N, 21, 3): with shortened fingertips.
        contact_head (N, V), contact_hand (N, P): bool.
        parameters: name -> (N, k) arrays under the dataset's names, prefixed `head.` or `right_hand.`.
        residual (N,): deepest penetration that is left [m].
        rotation (N, 3, 3), shift (N, 3): rigid motion from the axes of the head's template to the world.
    """

    bodies: Bodies
    subject: Subject
    motion: Motion
    head_rigid: np.ndarray
    offset: np.ndarray
    hand: np.ndarray
    canonical: np.ndarray
    landmarks: np.ndarray
    joints: np.ndarray
    contact_head: np.ndarray
    contact_hand: np.ndarray
    parameters: dict[str, np.ndarray]
    residual: np.ndarray
    rotation: np.ndarray
    shift: np.ndarray

    @property
    def head(self) -> np.ndarray:
        """(N, V, 3) deformed head."""
        return self.head_rigid + self.offset


def _unwrapped(content: dict) -> dict:
    return {k: v.x if isinstance(v, Ch) else v.a.x if isinstance(v, Select) else v for k, v in content.items()}


def build_bodies(mesh: str) -> Bodies:
    """Builds the body models of one level of detail ("full" or "tiny")."""
    human = load_human(mesh)
    landmarks = landmark_arrays(landmark_content(human), len(human.head_faces), "synthetic landmarks")
    flame = Flame.build(
        model_arrays(_unwrapped(flame_content(human)), "synthetic head"), landmarks, dtype=torch.float64
    )
    mano = Mano.build(model_arrays(_unwrapped(mano_content(human)), "synthetic hand"), dtype=torch.float64)
    return Bodies(human, flame, mano)


def make_scene(
    bodies: Bodies,
    name: str,
    frames: int,
    seed: int,
    *,
    press: float = 6e-3,
    dents: bool = True,
    progress: Callable[[Iterable[int]], Iterable[int]] = lambda items: items,
) -> Scene:
    """Poses one subject.

    Args:
        bodies: body models.
        name: S1..S8.
        frames: N.
        seed: of shape and motion.
        press: how deep the hand reaches into the undeformed face when it presses fully [m].
        dents: solve the dents; without, `offset` is zero and contacts are those of the undeformed head.
        progress: wraps the loop over frames.
    """
    human, subject = bodies.human, make_subject(name, seed)
    motion = make_motion(human, subject, frames)
    as_tensor = torch.from_numpy
    shape, betas = as_tensor(subject.shape)[None], as_tensor(subject.betas)[None]
    canonical = bodies.flame.forward(shape, as_tensor(motion.expression), as_tensor(motion.jaw)).verts.numpy()
    local = bodies.mano.forward(betas, as_tensor(motion.hand_pose), torch.zeros(frames, 3, dtype=torch.float64))
    hand_local, joints_local = local.verts.numpy(), local.joints.numpy()
    turn = axis_angle_to_matrix(as_tensor(motion.head_turn)).numpy()
    stage_rotation, stage_shift = STAGE_TO_WORLD[:3, :3], STAGE_TO_WORLD[:3, 3]

    centre = canonical.mean(1)
    rotation = stage_rotation @ turn
    at_stage = np.einsum("nij,nj->ni", turn, centre - _NECK_FOOT) + _NECK_FOOT + motion.head_shift
    transl = at_stage @ stage_rotation.T + stage_shift - centre
    head_rigid = rotate_about_centroid(as_tensor(canonical), as_tensor(rotation), as_tensor(transl)).numpy()

    rest = (
        bodies.flame.forward(shape, torch.zeros(1, 50, dtype=torch.float64), torch.zeros(1, 3, dtype=torch.float64))
        .verts[0]
        .numpy()
    )
    skin = bodies.skin_faces
    movable = np.zeros(len(rest), bool)
    movable[: human.part_sizes[0]] = True
    movable[human.neck()] = False
    neck = np.zeros(len(rest), bool)
    neck[human.neck(0.008)] = True
    touching = CONTACT_DISTANCE if human.mesh == "full" else 2.5 * CONTACT_DISTANCE
    movable[_lids_and_mouth(human)] = False
    surface = Surface.build(rest, skin, movable)
    wrist = joints_local[:, 0]
    hand_rotation, hand_shift = np.zeros((frames, 3, 3)), np.zeros((frames, 3))
    offset = np.zeros_like(head_rigid)
    hand = np.zeros((frames, *human.hand.shape))
    contact_head, contact_hand = np.zeros(head_rigid.shape[:2], bool), np.zeros(hand.shape[:2], bool)
    residual = np.zeros(frames)
    laid = _Laying(
        human,
        canonical,
        hand_local - wrist[:, None],
        joints_local - wrist[:, None],
        skin,
        movable,
        motion,
        subject,
        press,
    )
    for n in progress(range(frames)):
        hand_to_head, shift, normal = laid.at(n)
        placed = (hand_local[n] - wrist[n]) @ hand_to_head.T
        depth = press * max(float(motion.approach[n]), 0.0)
        away = max(-float(motion.approach[n]), 0.0)
        shift = shift + away * (0.07 * normal + np.array([-0.03, -0.05, 0.03]))
        # from the canonical head to the world with the same rigid motion as the head
        to_world = rotation[n]
        base = transl[n] + centre[n] - to_world @ centre[n]
        hand_rotation[n] = to_world @ hand_to_head
        hand_shift[n] = to_world @ shift + base
        hand[n] = placed @ to_world.T + hand_shift[n]
        if dents and depth > 0:
            solved = dent(surface, head_rigid[n], hand[n], human.hand_faces)
            offset[n], residual[n] = solved.offset, solved.residual
        if away < 0.2:
            deformed = head_rigid[n] + offset[n]
            contact_head[n] = (signed_distance(deformed, hand[n], human.hand_faces)[0] < touching) & ~neck
            contact_hand[n] = signed_distance(hand[n], deformed, skin)[0] < touching
    joints = np.einsum("nij,nkj->nki", hand_rotation, joints_local - wrist[:, None]) + hand_shift[:, None]
    landmarks = bodies.flame.landmarks(as_tensor(head_rigid + offset)).numpy()  # type: ignore[misc]
    # MANO turns about its own wrist joint and then translates
    parameters = {
        "head.transl": transl,
        "head.global_orient": matrix_to_axis_angle(as_tensor(rotation)).numpy(),
        "head.shape_params": np.repeat(subject.shape[None], frames, 0),
        "head.expression_params": motion.expression,
        "head.pose_params": np.concatenate([np.zeros((frames, 3)), motion.jaw], 1),
        "right_hand.betas": np.repeat(subject.betas[None], frames, 0),
        "right_hand.global_orient": matrix_to_axis_angle(as_tensor(hand_rotation)).numpy(),
        "right_hand.hand_pose": motion.hand_pose,
        "right_hand.transl": hand_shift - wrist,
    }
    shortened = shorten_tips(as_tensor(joints)).numpy()
    return Scene(
        bodies,
        subject,
        motion,
        head_rigid,
        offset,
        hand,
        canonical,
        landmarks,
        shortened,
        contact_head,
        contact_hand,
        parameters,
        residual,
        rotation,
        transl + centre - np.einsum("nij,nj->ni", rotation, centre),
    )


def full_scene(
    n_frames: int, seed: int = 0, *, mesh: str = "full", name: str = "S2", dents: bool = True
) -> MeshSequence:
    """Posed meshes of one subject for benchmarks and tests.

    Args:
        n_frames: N, at least 4.
        seed: of shape and motion.
        mesh: "full" (5,023 + 778 vertices) or "tiny" (612 + 200).
        name: subject S1..S8.
        dents: solve the contact; without it the heads are rigid (much faster).

    Returns:
        Parts `head` (deformed) and `right_hand`; extras `head_rigid` (N, V, 3), `contact.head`, `contact.right_hand`
        (N, V) bool, `deformation.head` (N, V, 3), `segments` (R, 2).
    """
    scene = make_scene(build_bodies(mesh), name, n_frames, seed, dents=dents)
    human = scene.bodies.human
    rest_head = scene.bodies.flame.forward(
        torch.from_numpy(scene.subject.shape)[None],
        torch.zeros(1, 50, dtype=torch.float64),
        torch.zeros(1, 3, dtype=torch.float64),
    ).verts[0]
    rest_hand = scene.bodies.mano.forward(
        torch.from_numpy(scene.subject.betas)[None],
        torch.zeros(1, 45, dtype=torch.float64),
        torch.zeros(1, 3, dtype=torch.float64),
    ).verts[0]
    parts = {
        "head": Part(human.head_faces, rest_head.numpy().astype(np.float32), scene.head.astype(np.float32)),
        "right_hand": Part(human.hand_faces, rest_hand.numpy().astype(np.float32), scene.hand.astype(np.float32)),
    }
    extras = {
        "head_rigid": scene.head_rigid.astype(np.float32),
        "contact.head": scene.contact_head,
        "contact.right_hand": scene.contact_hand,
        "deformation.head": scene.offset.astype(np.float32),
        "segments": np.array(scene.motion.segments),
    }
    return MeshSequence([f"{n:05d}" for n in range(n_frames)], parts, extras)


def _lids_and_mouth(human: Human) -> np.ndarray:
    """Skin around the eyes and inside the mouth, which no dent moves: the solver's plate is not made for folds."""
    q = human.head - EYE_ORIGIN
    skin, left, _ = human.part_sizes
    eyes = [human.head[skin : skin + left].mean(0), human.head[skin + left :].mean(0)]
    lids = np.min([np.linalg.norm(human.head - eye, axis=1) for eye in eyes], axis=0) < 0.0175
    mouth = (np.abs(q[:, 0]) < 0.026) & (np.abs(q[:, 1] + 0.075) < 0.021) & (q[:, 2] < 0.006)
    return np.flatnonzero(lids | mouth)


@dataclasses.dataclass(frozen=True)
class _Laying:
    """Lays the hand on the canonical head of each frame; its turn against the face is the same over a whole take."""

    human: Human
    canonical: np.ndarray
    hand: np.ndarray
    joints: np.ndarray
    skin: np.ndarray
    movable: np.ndarray
    motion: Motion
    subject: Subject
    press: float
    turns: dict[int, tuple[float, float]] = dataclasses.field(default_factory=dict)

    def at(self, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Hand rotation (3, 3), shift (3,) [m] and the skin's normal (3,), in the head's own frame."""
        take = int(self.motion.touch[n])
        if take not in self.turns:
            first, last = self.motion.segments[take]
            pressed = [m for m in range(first, last + 1) if self.motion.approach[m] > 0] or [first]
            probes = sorted({pressed[int(i)] for i in np.linspace(0, len(pressed) - 1, 5)})
            touch = TOUCHES[self.subject.touches[take]]
            best = -np.inf
            for step in range(12):
                turn = (touch.lift + 0.07 * step, touch.tilt + 0.05 * step)
                clearance = min(self._place(m, *turn)[3] for m in probes)
                if clearance > best:
                    best, self.turns[take] = clearance, turn
                if clearance > 0.003:
                    break
        return self._place(n, *self.turns[take])[:3]

    def _place(self, n: int, lift: float, tilt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        """As `at`, and the distance to what cannot give way [m]."""
        touch = TOUCHES[self.subject.touches[self.motion.touch[n]]]
        head = self.canonical[n]
        point, normal, rotation = touch_frame(touch, float(self.motion.slide[n]), lift, tilt, head, self.skin)
        placed, joints = self.hand[n] @ rotation.T, self.joints[n] @ rotation.T
        shift = point - _pads(touch, joints, placed, normal) + normal * 0.004
        depth = self.press * max(float(self.motion.approach[n]), 0.0)
        clearance = np.inf
        for _ in range(8):
            distance, face, _ = signed_distance(placed + shift, head, self.skin)
            soft = self.movable[self.skin[face]].any(1)
            clearance = float(distance[~soft].min()) if not soft.all() else np.inf
            error = (distance[soft].min() if soft.any() else distance.min()) + depth
            shift = shift - normal * error
            if abs(error) < 2e-5:
                break
        return rotation, shift, normal, clearance


def _pads(touch: Touch, joints: np.ndarray, verts: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """The place on the palm's side of the touching fingers that is laid on the face (3,)."""
    total, weight = np.zeros(3), 0.0
    for finger, joint, w in touch.contact:
        at = joints[1 + 3 * finger + joint]
        near = np.linalg.norm(verts - at, axis=1) < 0.018
        total += w * (at + normal * ((verts[near] - at) @ normal).min()) if near.any() else w * at
        weight += w
    return total / weight
