"""What the subjects do: expressions, jaw, head turns, and a hand that approaches, presses, slides and leaves.

The stage has y up and the room's front along +z, in metres, with the resting head where its template is. Every
sequence has one cut: two takes with a touch at another place each (cheek, chin, temple, brow), so that nothing may
run on across it.
"""

import dataclasses

import numpy as np

from nbavatar.data.synthetic.models import EYE_ORIGIN, Human, hand_axes

__all__ = ["Motion", "Subject", "Touch", "make_motion", "make_subject", "touch_frame"]


@dataclasses.dataclass(frozen=True)
class Touch:
    """One way to touch the face.

    Attributes:
        place: direction from the head's middle that meets the surface there (3,).
        fingers: direction on the face that the fingers point to (3,).
        slide: path along the face [m] (3,).
        bend: how far each finger is bent [rad] (5,), index first, thumb last.
        contact: which finger joints carry the touch: (finger, joint, weight).
        tilt: least turn of the hand about the finger direction, the little finger's side away from the face [rad].
        lift: least turn of the palm away from the face [rad]. Both grow where the hand would meet jaw, neck or eyes.
    """

    place: tuple[float, float, float]
    fingers: tuple[float, float, float]
    slide: tuple[float, float, float]
    bend: tuple[float, float, float, float, float]
    contact: tuple[tuple[int, int, float], ...]
    tilt: float = 0.0
    lift: float = 0.0


# Places are seen from a point 80 mm behind and 45 mm below the eyes.
TOUCHES = {
    "cheek": Touch(
        (-0.72, 0.06, 0.74),
        (0.15, 0.93, -0.1),
        (0.0, -0.016, 0.010),
        (0.16, 0.10, 0.2, 0.28, -0.1),
        ((0, 2, 1.0), (1, 2, 1.0), (3, 2, 0.6)),
        0.1,
        0.3,
    ),
    "chin": Touch(
        (-0.40, -0.52, 0.80),
        (0.75, 0.5, 0.2),
        (-0.02, 0.004, -0.006),
        (0.38, 0.30, 0.05, 0.14, 0.1),
        ((0, 2, 1.0), (1, 2, 1.0)),
        0.05,
        0.25,
    ),
    "temple": Touch(
        (-0.74, 0.74, 0.42),
        (0.25, 0.9, -0.1),
        (0.0, 0.010, 0.014),
        (0.25, 0.2, 0.3, 0.45, 0.0),
        ((0, 2, 1.0), (1, 2, 1.0)),
        0.0,
        0.3,
    ),
    "mouth": Touch(
        (-0.70, -0.16, 0.70),
        (0.8, 0.5, 0.0),
        (-0.02, 0.006, -0.004),
        (0.25, 0.2, 0.0, 0.1, 0.0),
        ((0, 2, 1.0), (1, 2, 1.0)),
        0.05,
        0.25,
    ),
}


@dataclasses.dataclass(frozen=True)
class Subject:
    """One person: shape and looks.

    Attributes:
        shape (100,), betas (10,): model coefficients.
        skin, hair, iris, shirt: sRGB colours in [0, 1].
        hair_length: thickness of the hair [m]; 0 for none.
        touches: names in `TOUCHES` for the takes, in order.
        seed: seed of its textures and motion.
    """

    name: str
    shape: np.ndarray
    betas: np.ndarray
    skin: tuple[float, float, float]
    hair: tuple[float, float, float]
    iris: tuple[float, float, float]
    shirt: tuple[float, float, float]
    hair_length: float
    touches: tuple[str, ...]
    seed: int


@dataclasses.dataclass(frozen=True)
class Motion:
    """Parameters over time, N frames.

    Attributes:
        expression (N, 50), jaw (N, 3): head model.
        head_turn (N, 3): axis-angle about the foot of the neck [rad]; head_shift (N, 3) [m].
        hand_pose (N, 45) [rad].
        touch (N,): index into the subject's touches.
        approach (N,): -1 away, 0 about to touch, 1 pressed fully; slide (N,): 0..1 along the touch's path.
        segments: first and last frame of each take.
    """

    expression: np.ndarray
    jaw: np.ndarray
    head_turn: np.ndarray
    head_shift: np.ndarray
    hand_pose: np.ndarray
    touch: np.ndarray
    approach: np.ndarray
    slide: np.ndarray
    segments: list[tuple[int, int]]


_SKINS = (
    (0.80, 0.58, 0.46),
    (0.86, 0.66, 0.55),
    (0.55, 0.37, 0.27),
    (0.74, 0.53, 0.39),
    (0.90, 0.71, 0.61),
    (0.42, 0.28, 0.20),
    (0.83, 0.62, 0.48),
    (0.66, 0.46, 0.34),
)
_HAIRS = (
    (0.10, 0.07, 0.05),
    (0.22, 0.13, 0.07),
    (0.05, 0.04, 0.04),
    (0.09, 0.06, 0.05),
    (0.48, 0.33, 0.17),
    (0.04, 0.03, 0.03),
    (0.30, 0.17, 0.09),
    (0.14, 0.10, 0.08),
)
_IRISES = (
    (0.30, 0.18, 0.09),
    (0.25, 0.38, 0.48),
    (0.20, 0.12, 0.07),
    (0.35, 0.30, 0.14),
    (0.33, 0.45, 0.50),
    (0.18, 0.11, 0.07),
    (0.30, 0.36, 0.22),
    (0.24, 0.14, 0.08),
)
_SHIRTS = (
    (0.20, 0.32, 0.46),
    (0.42, 0.18, 0.20),
    (0.72, 0.70, 0.66),
    (0.18, 0.36, 0.28),
    (0.50, 0.42, 0.25),
    (0.30, 0.30, 0.34),
    (0.55, 0.30, 0.42),
    (0.16, 0.20, 0.30),
)
_LENGTHS = (0.010, 0.013, 0.005, 0.009, 0.015, 0.004, 0.012, 0.008)
_TAKES = (
    ("cheek", "chin"),
    ("cheek", "mouth"),
    ("chin", "cheek"),
    ("temple", "cheek"),
    ("mouth", "temple"),
    ("cheek", "temple"),
    ("chin", "mouth"),
    ("cheek", "chin"),
)


def make_subject(name: str, seed: int) -> Subject:
    """The person called S1..S8; the same name and seed give the same person."""
    number = int(name[1:]) - 1
    rng = np.random.default_rng([seed, number, 17])
    shape = np.zeros(100)
    shape[:60] = rng.normal(0, 0.75, 60).clip(-1.6, 1.6)
    shape[60:] = rng.normal(0, 0.3, 40)
    return Subject(
        name,
        shape,
        rng.normal(0, 0.6, 10).clip(-1.2, 1.2),
        _SKINS[number],
        _HAIRS[number],
        _IRISES[number],
        _SHIRTS[number],
        _LENGTHS[number],
        _TAKES[number],
        int(rng.integers(1 << 31)),
    )


def make_motion(human: Human, subject: Subject, frames: int) -> Motion:
    """Writes the takes of one subject.

    Args:
        human: body model arrays (for the expression units and finger axes).
        subject: who.
        frames: N, at least 4.
    """
    cut = int(np.clip(round(0.56 * frames), 2, frames - 2))
    segments = [(0, cut - 1), (cut, frames - 1)]
    motion = Motion(
        np.zeros((frames, 50)),
        np.zeros((frames, 3)),
        np.zeros((frames, 3)),
        np.zeros((frames, 3)),
        np.zeros((frames, 45)),
        np.zeros(frames, int),
        np.zeros(frames),
        np.zeros(frames),
        segments,
    )
    bend_axes, spread_axes = hand_axes(human.hand_regressor @ human.hand)
    for take, (first, last) in enumerate(segments):
        rng = np.random.default_rng([subject.seed, take, 29])
        u = (np.arange(last - first + 1) + 0.5) / (last - first + 1)
        rows = slice(first, last + 1)
        # away, touch at 0.2, pressed from 0.36 to 0.8, gone at 0.92
        motion.approach[rows] = np.interp(u, [0, 0.2, 0.36, 0.8, 0.9, 1], [-1, 0, 1, 0.9, 0, -1])
        motion.slide[rows] = _ease((u - 0.4) / 0.4)
        touch = TOUCHES[subject.touches[take]]
        motion.touch[rows] = take
        motion.expression[rows] = _expressions(human, u, rng)
        motion.jaw[rows, 0] = (
            0.01 + 0.2 * np.clip(np.sin(2 * np.pi * (u * rng.uniform(1.0, 1.6) + rng.uniform())), 0, None) ** 2
        )
        motion.jaw[rows, 1] = 0.02 * _drift(u, rng)
        motion.head_turn[rows] = np.stack([0.10 * _drift(u, rng), 0.28 * _drift(u, rng), 0.08 * _drift(u, rng)], 1)
        motion.head_shift[rows] = np.stack([0.012 * _drift(u, rng) for _ in range(3)], 1)
        bend = (
            np.array(touch.bend)[None, :, None]
            + np.array([0.0, 0.12, 0.12, 0.12, 0.02])[None, :, None] * (1 - motion.approach[rows])[:, None, None] / 2
        )
        bend = bend * np.array([0.7, 1.0, 0.7]) + 0.06 * np.stack([_drift(u, rng) for _ in range(5)], 1)[:, :, None]
        spread = np.zeros((len(u), 5, 3))
        spread[..., 0] = np.array([0.05, 0.0, -0.12, -0.05, 0.1]) + 0.04 * np.stack(
            [_drift(u, rng) for _ in range(5)], 1
        )
        pose = bend.reshape(-1, 15, 1) * bend_axes + spread.reshape(-1, 15, 1) * spread_axes
        motion.hand_pose[rows] = pose.reshape(-1, 45)
    return motion


def _ease(x: np.ndarray) -> np.ndarray:
    x = np.clip(x, 0, 1)
    return x * x * (3 - 2 * x)


def _drift(u: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A smooth curve in about [-1, 1] with a few swings over the take."""
    return sum(rng.normal(0, 0.5) / (k**0.5) * np.sin(2 * np.pi * (k * u * 0.75 + rng.uniform())) for k in (1, 2, 3))  # type: ignore[return-value]


def _expressions(human: Human, u: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    smile = 0.75 * _ease(1 - np.abs(u - rng.uniform(0.3, 0.7)) / 0.35)
    brow = np.clip(_drift(u, rng), 0, 1) * 0.8
    pucker = 0.6 * _ease(1 - np.abs(u - rng.uniform(0.0, 1.0)) / 0.25)
    squint = 0.5 * smile
    blink = np.exp(-(((u - rng.uniform(0.1, 0.9)) / 0.05) ** 2)) * 0.9
    curves = {
        "mouthSmileLeft": smile,
        "mouthSmileRight": smile * 0.9,
        "browInnerUp": brow,
        "browOuterUpLeft": 0.7 * brow,
        "browOuterUpRight": 0.8 * brow,
        "mouthPucker": pucker,
        "cheekSquintLeft": squint,
        "cheekSquintRight": squint,
        "eyeBlinkLeft": blink,
        "eyeBlinkRight": blink,
        "mouthUpperUpLeft": 0.3 * np.clip(_drift(u, rng), 0, 1),
        "mouthLowerDownRight": 0.3 * np.clip(_drift(u, rng), 0, 1),
    }
    out = np.zeros((len(u), 50))
    for name, curve in curves.items():
        out[:, :40] += curve[:, None] * human.units[name]
    return out


def touch_frame(
    touch: Touch, slide: float, lift: float, tilt: float, head: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where and how the hand is laid on a head that stands at its rest place.

    Args:
        touch: what kind of touch.
        slide: 0..1 along its path.
        lift: turn of the palm away from the face [rad].
        tilt: turn about the fingers, the little finger's side away from the face [rad].
        head: (V, 3) skin and eyes [m].
        faces: (F, 3) skin faces.

    Returns:
        point (3,) on the skin [m], outward normal (3,), hand rotation (3, 3): hand model axes to stage.
    """
    middle = EYE_ORIGIN + np.array([0.0, -0.045, -0.08])
    direction = np.array(touch.place) / np.linalg.norm(touch.place)
    direction = direction + slide * np.array(touch.slide) / 0.09
    direction /= np.linalg.norm(direction)
    # the outermost crossing of the ray, and a normal smoothed over a palm's breadth
    corners = head[faces]
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = np.cross(direction, edge2)
    det = (edge1 * p).sum(1)
    det = np.where(np.abs(det) < 1e-14, 1e-14, det)
    s = middle - corners[:, 0]
    u = (s * p).sum(1) / det
    q = np.cross(s, edge1)
    v = (q * direction).sum(1) / det
    t = (edge2 * q).sum(1) / det
    t = np.where((u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9), t, -np.inf)
    point = middle + direction * t.max()
    area_normal = np.cross(edge1, edge2)
    near = np.exp(-((corners.mean(1) - point) ** 2).sum(1) / (2 * 0.018**2)) * ((area_normal * direction).sum(1) > 0)
    normal = (area_normal * near[:, None]).sum(0)
    normal /= np.linalg.norm(normal)
    along = np.array(touch.fingers) - np.array(touch.fingers) @ normal * normal
    along /= np.linalg.norm(along)
    side = np.cross(normal, along)
    along, normal_ = np.cos(lift) * along - np.sin(lift) * normal, np.cos(lift) * normal + np.sin(lift) * along
    # hand axes: x away from the fingertips, y out of the back of the hand, z to the thumb
    c, s_ = np.cos(tilt), np.sin(tilt)
    back, thumb = c * normal_ + s_ * side, np.cross(-along, c * normal_ + s_ * side)
    return point, normal, np.stack([-along, back, thumb], axis=1)
