"""Cells of the contact physics, float64: stiffness, time step, depth, speed, friction.

Single constraints have closed solutions, which are the oracle of the solver's arithmetic (XPBD converges to the minimum
of inertia and energy); whole frames of contact are judged by what they promise: nothing left inside beyond
the tolerance, or the flag `exceeded`.
"""

import dataclasses
import functools
import math
from typing import Any

import numpy as np

from nbavatar.physics.contact import ContactNumbers, ContactSolver, rigid_motion
from nbavatar.physics.shapes import capsule_hand, press, round_head
from nbavatar.physics.tissue import bed_stiffness, soft_surface, tissue_thickness
from nbavatar.physics.xpbd import relax
from nbavatar.studies.extremes.cells import Level, Limit, Refusal, Sample, Tolerance, cell
from nbavatar.studies.extremes.compare import relative

__all__: list[str] = []

_EXACT = Tolerance(1e-9, 1.0)
_STIFF = (1e2, 1.0, 0.0, 1e-12, 1e6, 1e12, 1e300)
_STEPS = (2e-3, 1e-6, 1e-4, 0.1, 1.0, 1e3)
_CLOSED = "closed solution"
_NO_IDS = np.zeros((0, 3), np.int64)


def _relax(x: np.ndarray, rest: np.ndarray, **given: object) -> tuple[np.ndarray, np.ndarray]:
    """`relax` with everything off that is not named; positions and impulses after it."""
    count = len(x)
    values: dict[str, object] = {
        "inverse_mass": np.ones(count),
        "active": np.arange(count),
        "support": np.zeros(count),
        "edges": np.zeros((0, 2), np.int64),
        "lengths": np.zeros(0),
        "stretch": 0.0,
        "shear": 0.0,
        "ring": np.zeros(count + 1, np.int64),
        "ring_ids": np.zeros(0, np.int64),
        "ring_weights": np.zeros(0),
        "bend": np.zeros(count),
        "faces": _NO_IDS,
        "bulge": np.ones(count),
        "volume_stiffness": 0.0,
        "contacts": np.zeros((0, 9)),
        "ids": _NO_IDS,
        "weights": np.zeros((0, 3)),
        "hand": np.zeros(0, np.int64),
        "pose": np.zeros((1, 6)),
        "pose_inverse_mass": np.zeros((1, 2)),
        "pose_stiffness": np.zeros(2),
        "pose_bound": np.full(2, np.inf),
        "centre": np.zeros((1, 3)),
        "dt": 2e-3,
        "iterations": 8,
        "friction": 0.0,
        "max_dent": np.inf,
    } | given
    x = x.copy()
    pressed = relax(x, rest, *values.values())
    return x, pressed


def _cell(condition: str, axis: str, levels: tuple[Level, ...], **more: Any):
    more.setdefault("oracle", _CLOSED)
    more.setdefault("exact", _EXACT)
    return cell("physics", "relax", condition, axis, levels, **more)


def _bed(stiffness: float, dt: float, iterations: int = 8) -> Sample:
    rest, x = np.zeros((1, 3)), np.array([[1e-3, -2e-3, 5e-4]])
    found, _ = _relax(
        x, rest, support=np.array([stiffness]), dt=dt, iterations=iterations, inverse_mass=np.array([50.0])
    )
    # Minimum of m |y - x|^2 / (2 h^2) + k |y|^2 / 2, written so that no product overflows.
    inertia = 1 / 50.0 / dt / dt
    return Sample(relative(found, x * (1 / (1 + stiffness / inertia))))


@_cell(
    "stiffness of the bed",
    "stiffness [N/m]",
    _STIFF,
    limits=(Limit(lambda k: float(k) >= 1e300, 1.0, 1.0, "a rest of 1e-300 is rounding of the rest place"),),
)
def _bed_stiffness(stiffness: float) -> Sample:
    return _bed(stiffness, 2e-3)


@_cell("time step of the bed", "time step [s]", _STEPS)
def _bed_step(dt: float) -> Sample:
    return _bed(300.0, dt)


@_cell("iterations of one constraint", "iterations [1]", (8.0, 1.0, 100.0, 1e4))
def _bed_iterations(iterations: float) -> Sample:
    return _bed(300.0, 2e-3, int(iterations))


def _edge(stiffness: float, dt: float, length: float = 0.01, now: float = 0.013) -> Sample:
    rest = np.array([[0.0, 0, 0], [length, 0, 0]])
    x = np.array([[0.0, 0, 0], [now, 0, 0]])
    found, _ = _relax(
        x,
        rest,
        edges=np.array([[0, 1]]),
        lengths=np.array([length]),
        stretch=stiffness,
        dt=dt,
        inverse_mass=np.array([50.0, 20.0]),
    )
    # Two masses and a spring along a line: the common centre stays, the length goes to the weighted mean.
    inertia = 1 / 70.0 / dt / dt
    gap = length + (now - length) / (1 + stiffness / inertia)
    centre = (x[0, 0] / 50 + x[1, 0] / 20) / (1 / 50 + 1 / 20)
    left = centre - gap * 50 / 70
    return Sample(relative(found, [[left, 0, 0], [left + gap, 0, 0]]))


@_cell("stiffness of an edge", "stiffness [N/m]", _STIFF)
def _edge_stiffness(stiffness: float) -> Sample:
    return _edge(stiffness, 2e-3)


@_cell("time step of an edge", "time step [s]", _STEPS)
def _edge_step(dt: float) -> Sample:
    return _edge(30.0, dt)


@_cell(
    "length of an edge",
    "length now [m]",
    (0.013, 1e-6, 1e-11, 1e-13, 0.0),
    limits=(Limit(lambda now: 0 <= float(now) < 1e-12, 5.0, 1.0, "an edge of no length has no direction: left alone"),),
)
def _edge_length(now: float) -> Sample:
    return _edge(30.0, 2e-3, now=now)


@_cell("stiffness of the plate", "rigidity [N m^3]", (1e-5, 0.0, 1e-12, 1.0, 1e12, 1e300))
def _plate(stiffness: float) -> Sample:
    """One vertex between two fixed neighbours: the Laplacian of its displacement is -2 r u."""
    x = np.array([[0.0, 0, 0], [0.01, 2e-3, -1e-3], [0.02, 0, 0]])
    rest = np.array([[0.0, 0, 0], [0.01, 0, 0], [0.02, 0, 0]])
    r, dt = 5e3, 2e-3
    found, _ = _relax(
        x,
        rest,
        inverse_mass=np.array([0.0, 50.0, 0.0]),
        active=np.array([1]),
        ring=np.array([0, 0, 2, 2]),
        ring_ids=np.array([0, 2]),
        ring_weights=np.array([r, r]),
        bend=np.array([0.0, stiffness, 0.0]),
        dt=dt,
    )
    inertia = 1 / 50.0 / dt / dt
    # |C| = 2 r u: a spring of 4 r^2 k against inertia.
    shrink = 1 / (1 + 4 * r * r * (stiffness / inertia))
    true = rest + (x - rest) * shrink
    # At 1e300 what is left of the displacement is rounding of the rest place.
    return Sample(relative(found, true))


def _contact(depth: float, **given: object) -> tuple[np.ndarray, np.ndarray]:
    """A point of the hand, `depth` under a vertex at the origin; normal z from head to hand."""
    contact = np.zeros((1, 9))
    contact[0, :3] = contact[0, 3:6] = [0.0, 0.0, -depth]
    contact[0, 8] = 1.0
    return _relax(
        np.zeros((1, 3)),
        np.zeros((1, 3)),
        contacts=contact,
        ids=np.zeros((1, 3), np.int64),
        weights=np.array([[1.0, 0, 0]]),
        hand=np.zeros(1, np.int64),
        inverse_mass=np.array([50.0]),
        **given,
    )


@_cell("penetration", "depth [m]", (1e-3, 1e-9, 0.0, -1e-3, 0.1, 10.0))
def _depth(depth: float) -> Sample:
    found, pressed = _contact(depth)
    return Sample(max(relative(found, [[0, 0, -max(depth, 0.0)]], least=1e-6), relative(pressed, [max(depth, 0) / 50])))


@_cell("contact against a bed", "stiffness [N/m]", _STIFF)
def _contact_bed(stiffness: float) -> Sample:
    """The contact has the last word: the vertex lies on the hand, however stiff the bed."""
    found, _ = _contact(1e-3, support=np.array([stiffness]))
    return Sample(relative(found, [[0, 0, -1e-3]]))


@_cell("friction", "coefficient [1]", (0.3, 0.0, 1.0, 1e6, 1e300))
def _friction(coefficient: float) -> Sample:
    """The hand slides 4 mm along x while pressing 1 mm deep: Coulomb's cone, or sticking."""
    contact = np.array([[4e-3, 0.0, -1e-3, 0.0, 0.0, -1e-3, 0, 0, 1.0]])
    found, _ = _relax(
        np.zeros((1, 3)),
        np.zeros((1, 3)),
        contacts=contact,
        ids=np.zeros((1, 3), np.int64),
        friction=coefficient,
        weights=np.array([[1.0, 0, 0]]),
        hand=np.zeros(1, np.int64),
        inverse_mass=np.array([50.0]),
    )
    return Sample(relative(found, [[min(4e-3, coefficient * 1e-3), 0, -1e-3]]))


@_cell("mass", "inverse mass [1/kg]", (50.0, 1e-12, 1e12, 1e-300, 0.0))
def _mass(inverse: float) -> Sample:
    found, _ = _weighted(inverse)
    return Sample(relative(found, [[0, 0, -1e-3 if inverse > 0 else 0.0]]))


def _weighted(inverse: float) -> tuple[np.ndarray, np.ndarray]:
    contact = np.zeros((1, 9))
    contact[0, 2], contact[0, 5], contact[0, 8] = -1e-3, -1e-3, 1.0
    return _relax(
        np.zeros((1, 3)),
        np.zeros((1, 3)),
        contacts=contact,
        ids=np.zeros((1, 3), np.int64),
        weights=np.array([[1.0, 0, 0]]),
        hand=np.zeros(1, np.int64),
        inverse_mass=np.array([inverse]),
    )


@_cell(
    "resistance to loss of volume",
    "stiffness [N/m^5]",
    (3e8, 0.0, 1e-3, 1e13, 1e15, 1e30),
    unit="share of the loss",
    exact=Tolerance(1e-3, 1.0),
)
def _volume(stiffness: float) -> Sample:
    """A tetrahedron pressed by a micrometre at one corner: one constraint, linear to 1e-4."""
    rest = np.array([[0.0, 0, 0], [0.01, 0, 0], [0, 0.01, 0], [0, 0, 0.01]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    x = rest.copy()
    x[3, 2] -= 1e-6
    found, _ = _relax(x, rest, faces=faces, volume_stiffness=stiffness, inverse_mass=np.full(4, 50.0), iterations=20)

    def volume(p: np.ndarray) -> float:
        return float(np.linalg.det(p[1:] - p[0]) / 6)

    slopes = np.zeros((4, 3))
    for face in faces:
        a, b, c = rest[face]
        slopes[face] += np.cross(b - a, c - a) / 6
    share = (volume(found) - volume(rest)) / (volume(x) - volume(rest))
    return Sample(abs(share - 1 / (1 + stiffness * 2e-3**2 * 50.0 * float((slopes**2).sum()))))


@functools.cache
def _scene(vertices: int = 900) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    head, faces = round_head(vertices)
    hand, hand_faces = capsule_hand(240)
    return head, faces, hand, hand_faces


def _frame(condition: str, axis: str, levels: tuple[Level, ...], **more: Any):
    more.setdefault("oracle", "depth left, or the flag `exceeded`")
    return cell(
        "physics",
        "ContactSolver",
        condition,
        axis,
        levels,
        unit="depth left / tolerance",
        exact=Tolerance(2.0, 1.0),
        **more,
    )


def _press(depth: float, *, before: float | None = None, hands: int = 1, **numbers: object) -> Sample | Refusal:
    """One frame (or a second one, after a frame at another depth); depth left in units of the tolerance."""
    head, faces, hand, hand_faces = _scene()
    model = dataclasses.replace(ContactNumbers(), **numbers)
    surface = soft_surface(head, faces, bed_stiffness(tissue_thickness(head, faces), 2e4))
    solver = ContactSolver(surface, head, [(hand, hand_faces)] * hands, model)
    now = [press(hand, depth)] * hands
    result = solver.solve(head, now)
    if before is not None:
        past = [press(hand, before)] * hands
        result = solver.solve(head, now, solver.solve(head, past), head, past)
    values = [result.head, result.pose, *result.hands]
    if not all(np.isfinite(value).all() for value in values) or not math.isfinite(result.depth[1]):
        return Sample(math.nan)
    left = result.depth[1] / model.tolerance
    if left > 2.0 and not result.exceeded:
        return Sample(math.inf)
    return (
        Refusal("exceeded: the depth left, or a bound on dent or hand, is reported")
        if result.exceeded
        else Sample(left)
    )


@_frame(
    "penetration",
    "depth [m]",
    (2e-3, -1e-2, 5e-4, 8e-3, 0.02, 0.05, 0.1),
    quick=(2e-3,),
    refuses=lambda depth: float(depth) >= 8e-3,
)
def _press_depth(depth: float) -> Sample | Refusal:
    return _press(depth)


@_frame("sudden penetration", "depth before [m]", (0.0, -5e-3, -0.05, -0.5), quick=(), refuses=lambda depth: False)
def _press_sudden(before: float) -> Sample | Refusal:
    return _press(3e-3, before=before)


@_frame("time step", "time step [s]", (2e-3, 1e-6, 1e-4, 0.1, 1.0), quick=(), refuses=lambda dt: False)
def _press_step(dt: float) -> Sample | Refusal:
    return _press(3e-3, time_step=dt)


@_frame(
    "stiffness of the skin",
    "all stiffnesses times [1]",
    (1.0, 0.0, 1e-6, 1e6, 1e12),
    quick=(),
    refuses=lambda factor: float(factor) >= 1e6,
)
def _press_stiffness(factor: float) -> Sample | Refusal:
    n = ContactNumbers()
    return _press(
        3e-3, stretch=n.stretch * factor, shear=n.shear * factor, bending=n.bending * factor, volume=n.volume * factor
    )


@_frame("two hands in one place", "hands [1]", (1.0, 2.0), quick=(), refuses=lambda hands: False)
def _press_two(hands: float) -> Sample | Refusal:
    return _press(2e-3, hands=int(hands))


@cell(
    "physics",
    "rigid_motion",
    "points",
    "case",
    ("solid", "flat", "a line", "one point", "mirrored", "1e4 m away"),
    oracle="the motion itself, where the points determine it; a rotation elsewhere",
    exact=Tolerance(1e-9, 1.0),
)
def _rigid(case: Level) -> Sample:
    random = np.random.default_rng(1)
    points = random.normal(size=(9, 3))
    points *= {"flat": [1, 1, 0], "a line": [1, 0, 0], "one point": [0, 0, 0]}.get(str(case), [1, 1, 1])
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    place = np.array([1.0, -0.7, 0.4]) * (1e4 if case == "1e4 m away" else 1.0)
    target = points @ turn.T + place
    if case == "mirrored":
        target = points * [1, 1, -1]
    rotation, shift = rigid_motion(points, target)
    proper = max(relative(rotation @ rotation.T, np.eye(3)), abs(np.linalg.det(rotation) - 1))
    if case == "mirrored":
        return Sample(proper)
    return Sample(max(proper, relative(points @ rotation.T + shift - place, target - place, least=1.0)))


@cell(
    "physics",
    "bed_stiffness",
    "thickness of the tissue",
    "thickness [m]",
    (0.01, 1e-3, 1e-9, 1.0),
    oracle=_CLOSED,
    exact=Tolerance(1e-12, 1.0),
)
def _thickness(thickness: float) -> Sample:
    return Sample(
        relative(bed_stiffness(np.array([thickness]), 2e4), [2e4 / thickness * (1 + (0.01 / thickness) ** 2)])
    )
