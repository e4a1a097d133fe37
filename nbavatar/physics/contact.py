"""One frame of contact: how a soft head gives way to hands, and how far tracked hands are moved back.

The head's shape without contact and the tracked hands come in; out come the deformed head and hands with a small
rigid correction, so that no vertex of one is inside the other. The hand follows a path: from its place in the frame
before (or, where there is none, from where it does not touch) to its place now, in steps of a few millimetres, and
the skin is pushed ahead of it. So a fast finger does not pass through a cheek, and a hand that starts deep inside is
resolved on the side it came from.
"""

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from nbavatar.mesh.bvh import DeformingMesh
from nbavatar.mesh.topology import edges
from nbavatar.physics.collision import Contacts, deepest_edge, estimate_overlap, find_contacts, measure_overlap
from nbavatar.physics.region import Region, Skin
from nbavatar.physics.rigid import rigid_motion, rotation_matrix
from nbavatar.physics.tissue import SoftSurface
from nbavatar.physics.xpbd import relax

__all__ = ["ContactNumbers", "ContactSolver", "FrameResult"]


@dataclasses.dataclass(frozen=True)
class ContactNumbers:
    """Numbers of the contact model; units in [brackets]."""

    stretch: float = 30.0  # of an edge [N/m]
    shear: float = 300.0  # of the layer of fat, by which neighbours move along [N/m]
    bending: float = 1e-5  # flexural rigidity of the skin [N m]
    volume: float = 3e8  # resistance to loss of volume [N/m^5]
    friction: float = 0.3
    density: float = 10.0  # of moving tissue, per area [kg/m^2]
    reach: float = 0.05  # how far from a contact the skin moves, along the surface [m]
    max_dent: float = 0.035  # [m]
    hand_stiffness: float = 1e4  # of the track's hold on the hand's position [N/m]
    hand_turn_stiffness: float = 50.0  # [N m]
    hand_shift: float = 0.004  # bound of the correction [m]
    hand_turn: float = 0.05  # bound of the correction [rad]
    touch: float = 0.002  # nearer than this is contact [m]
    tolerance: float = 1e-4  # depth left at most [m]
    step: float = 0.003  # longest step of the hand's path [m]
    max_steps: int = 16
    settle: int = 4  # steps at the end of the path
    iterations: int = 8  # per step
    time_step: float = 0.002  # [s]
    repair: int = 40  # rounds of the final projection
    contact_only: bool = True  # False simulates all frames and all of the head


class FrameResult(NamedTuple):
    """Outcome of one frame.

    Attributes:
        head: deformed head [m], (V, 3) float64; `hands`: corrected hands.
        pose: correction of each hand, translation [m] and rotation vector [rad] about the hand's centroid, (H, 6).
        head_contact: head vertices nearer to a hand than the touch distance, or corners of a face that is, (V,) bool;
            `hand_contact` likewise.
        depth: greatest depth of vertices, and edges between outer ones, before and after [m]. steps: steps taken.
        exceeded: the depth left is over the tolerance, or a bound (dent, hand correction) was reached.
        active: number of simulated head vertices; 0 where nothing was to be done and the input is returned as it was.
    """

    head: np.ndarray
    hands: list[np.ndarray]
    pose: np.ndarray
    head_contact: np.ndarray
    hand_contact: list[np.ndarray]
    depth: tuple[float, float]
    steps: int
    exceeded: bool
    active: int


class ContactSolver:
    """Contact of one head with its hands; holds what does not change from frame to frame."""

    def __init__(
        self,
        surface: SoftSurface,
        head_rest: np.ndarray,
        hands: list[tuple[np.ndarray, np.ndarray]],
        numbers: ContactNumbers,
        pinned: np.ndarray | None = None,
    ) -> None:
        """Builds hierarchies and masses.

        Args:
            surface: operators of the head.
            head_rest: rest shape [m], (V, 3).
            hands: rest shape (Vh, 3) [m] and faces (Fh, 3) of each hand.
            numbers: the model's numbers.
            pinned: ids of head vertices that never move, such as the neck's rim.
        """
        self.surface, self.numbers = surface, numbers
        self._head = _outwards(DeformingMesh(head_rest, surface.faces), head_rest)
        self._hands = [_outwards(DeformingMesh(rest, faces), rest) for rest, faces in hands]
        self._count, self._hand_counts = len(head_rest), [len(rest) for rest, _ in hands]
        self._hand_edges = [edges(np.asarray(faces, np.int64)) for _, faces in hands]
        # A vertex without mass would answer any force at once: it gets a little, far below that of a real one.
        self._inverse_mass = 1.0 / np.maximum(numbers.density * surface.area, 1e-9)
        if pinned is not None:
            self._inverse_mass[pinned] = 0.0
        self._support = surface.bed * surface.area
        self._bend = numbers.bending * surface.area
        self._skin = Skin(surface, head_rest, numbers.reach)
        # A hand's inertia matches its hold, so that it finds its balance within a few steps at any stiffness.
        hold = np.maximum([numbers.hand_stiffness, numbers.hand_turn_stiffness], 1e-3) * numbers.time_step**2
        self._pose_inverse_mass = np.tile(1.0 / hold, (len(hands), 1))

    def solve(
        self,
        head: np.ndarray,
        hands: list[np.ndarray],
        before: FrameResult | None = None,
        head_before: np.ndarray | None = None,
        hands_before: list[np.ndarray] | None = None,
    ) -> FrameResult:
        """Resolves the contact of one frame.

        Args:
            head: head without contact [m], (V, 3). hands: tracked hands, (Vh, 3) each. All finite.
            before: result of the preceding frame, if it belongs to the same uncut run; `head_before`, `hands_before`
                are its inputs.
        """
        n = self.numbers
        head = np.ascontiguousarray(head, np.float64)
        hands = [np.ascontiguousarray(hand, np.float64) for hand in hands]
        depth, free = self._probe(head, hands)
        if free is not None and n.contact_only:
            return free
        outward = self._skin.outward(head, self._head.faces)
        dent, pose, start = self._begin(head, hands, outward, before, head_before, hands_before)
        centre = np.array([hand.mean(axis=0) for hand in hands])
        travel = max(float(np.linalg.norm(a - b, axis=1).max()) for a, b in zip(hands, start, strict=True))
        path = int(np.clip(math.ceil(travel / n.step), 1, n.max_steps))
        x = head + dent
        # What was dented in the frame before springs back, touched or not.
        old = np.abs(dent).max(axis=1) > 1e-6 if n.contact_only else np.ones(self._count, bool)
        distance = np.full(self._count, np.inf)
        region = self._skin.region(np.flatnonzero(old), head)
        last = [self._posed(s, pose[k], centre[k]) for k, s in enumerate(start)]
        total = path + n.settle
        done = 0
        for step in range(1, total + 1):
            share = min(step / path, 1.0)
            there = [s + share * (hand - s) for s, hand in zip(start, hands, strict=True)]
            now = [self._posed(p, pose[k], centre[k]) for k, p in enumerate(there)]
            contacts = self._contacts(x, now, outward, region.active)
            if (distance[contacts.ids] > 0.0).any():
                self._skin.spread(distance, contacts.ids.ravel())
                region = self._skin.region(np.flatnonzero(np.isfinite(distance) | old), head)
            if not len(region.active):
                last = now
                continue
            previous = np.einsum("pc,pci->pi", contacts.anchor_weights, _gather(last, contacts))
            self._relax(x, head, region, contacts, previous, pose, centre, n.iterations, held=step < path)
            last = now
            done += 1
        final = [self._posed(hand, pose[k], centre[k]) for k, hand in enumerate(hands)]
        self._repair(x, head, final, outward, region)
        return self._result(x, head, outward, final, pose, depth, done, len(region.active))

    def _probe(self, head: np.ndarray, hands: list[np.ndarray]) -> tuple[float, FrameResult | None]:
        """Depth before, and the result if there is nothing to do."""
        n = self.numbers
        self._head.move(head)
        deepest, head_contact, hand_contact = 0.0, np.zeros(self._count, bool), []
        for k, (mesh, hand, count) in enumerate(zip(self._hands, hands, self._hand_counts, strict=True)):
            mesh.move(hand)
            if n.contact_only and self._head.clear_of(mesh, n.touch):
                hand_contact.append(np.zeros(count, bool))
                continue
            overlap = estimate_overlap(self._head, mesh, self._edges_with(k), (self._count, count), n.touch)
            deepest = max(deepest, overlap.deepest)
            head_contact |= overlap.head_distance < n.touch
            hand_contact.append(overlap.hand_distance < n.touch)
            if deepest <= n.tolerance:
                deepest = max(deepest, deepest_edge(self._head, mesh, self._edges_with(k)))
        if deepest > n.tolerance:
            return deepest, None
        if head_contact.any() or any(touching.any() for touching in hand_contact):
            self._label(head, hands, self._skin.outward(head, self._head.faces), head_contact, hand_contact)
        pose = np.zeros((len(hands), 6))
        return deepest, FrameResult(head, hands, pose, head_contact, hand_contact, (deepest, deepest), 0, False, 0)

    def _begin(
        self, head: np.ndarray, hands: list[np.ndarray], outward: np.ndarray, before: FrameResult | None,
        head_before: np.ndarray | None, hands_before: list[np.ndarray] | None,
    ) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:  # fmt: skip
        """Dent, hand corrections and start of the hands' path, from the frame before or from outside."""
        n = self.numbers
        if before is not None and head_before is not None and hands_before is not None:
            rotation, shift = rigid_motion(head_before, head)
            start = [hand @ rotation.T + shift for hand in hands_before]
            travel = max(float(np.linalg.norm(a - b, axis=1).max()) for a, b in zip(hands, start, strict=True))
            if travel <= n.step * n.max_steps:
                dent = (before.head - head_before) @ rotation.T
                pose = np.concatenate([p.reshape(-1, 3) @ rotation.T for p in before.pose]).reshape(-1, 6)
                centre = [hand.mean(axis=0) for hand in hands]
                posed = [self._posed(s, pose[k], centre[k]) for k, s in enumerate(start)]
                if self._contacts(head + dent, posed, outward, np.zeros(0, np.int64)).depth.max(initial=0.0) < n.step:
                    return dent, pose, start
        pose = np.zeros((len(hands), 6))
        return np.zeros_like(head), pose, [self._retreat(head, k, hand, outward) for k, hand in enumerate(hands)]

    def _retreat(self, head: np.ndarray, k: int, hand: np.ndarray, outward: np.ndarray) -> np.ndarray:
        """The hand moved out along the skin's mean normal until it is out of the head."""
        self._head.move(head)
        mesh, count = self._hands[k], self._hand_counts[k]
        mesh.move(hand)
        inside = np.flatnonzero(self._head.inside(np.ascontiguousarray(mesh.verts[:count])))
        if not len(inside):
            return hand
        _, face, weight = self._head.closest(np.ascontiguousarray(hand[inside]), np.inf)
        away = np.einsum("pc,pci->i", weight, outward[self._head.faces[face]])
        away /= max(float(np.linalg.norm(away)), 1e-12)
        out = hand
        for _ in range(24):
            points = np.ascontiguousarray(out[inside])
            still = self._head.inside(points)
            if not still.any():
                inside = np.flatnonzero(self._head.inside(np.ascontiguousarray(out)))
                if not len(inside):
                    break
                continue
            depth = self._head.closest(np.ascontiguousarray(points[still]), np.inf)[0].max()
            out = out + away * max(1.05 * float(depth), 0.001)
        return out

    def _contacts(
        self, x: np.ndarray, hands: list[np.ndarray], outward: np.ndarray, active: np.ndarray,
        near: float | None = None, pairs: np.ndarray | None = None,
    ) -> Contacts:  # fmt: skip
        n = self.numbers
        self._head.move(x)
        for mesh, hand in zip(self._hands, hands, strict=True):
            mesh.move(hand)
        movable = active if len(active) else np.arange(self._count)
        near = 0.5 * n.step if near is None else near
        edges = None if pairs is None else (pairs, self._hand_edges)
        return find_contacts(self._head, self._hands, self._hand_counts, outward, movable, 2.0 * n.step, near, edges)

    def _edges_with(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        return self.surface.edges, self._hand_edges[k]

    def _label(
        self, x: np.ndarray, hands: list[np.ndarray], outward: np.ndarray, head: np.ndarray, hand: list[np.ndarray]
    ) -> None:
        """Adds, in place, the corners of the faces that something touches: a coarse mesh has no vertex near enough."""
        contacts = self._contacts(x, hands, outward, np.zeros(0, np.int64), near=self.numbers.touch)
        head[contacts.ids[contacts.weights > 0.2]] = True
        for k, touching in enumerate(hand):
            mine = contacts.hand == k
            touching[contacts.anchor[mine][contacts.anchor_weights[mine] > 0.2]] = True

    def _relax(
        self, x: np.ndarray, head: np.ndarray, region: Region, contacts: Contacts, previous: np.ndarray,
        pose: np.ndarray, centre: np.ndarray, iterations: int, held: bool,
    ) -> None:  # fmt: skip
        n, s = self.numbers, self.surface
        inverse_mass = np.where(region.moving > 0.0, self._inverse_mass, 0.0)
        table = np.concatenate((contacts.points, previous, contacts.normals), axis=1)
        relax(
            x, head, inverse_mass, region.active, self._support, region.edges, region.lengths, n.stretch, n.shear,
            s.ring, s.ring_ids, s.ring_weights, self._bend, region.faces, region.moving, n.volume, table,
            contacts.ids, contacts.weights, contacts.hand, pose,
            np.zeros_like(pose[:, :2]) if held else self._pose_inverse_mass,
            np.array([n.hand_stiffness, n.hand_turn_stiffness]),
            np.array([n.hand_shift, n.hand_turn]), centre, n.time_step, iterations, n.friction, n.max_dent,
        )  # fmt: skip

    def _repair(
        self, x: np.ndarray, head: np.ndarray, hands: list[np.ndarray], outward: np.ndarray, region: Region
    ) -> None:
        """Pushes out what is still inside, with the hands held: the guarantee that the step sizes cannot give."""
        n, s = self.numbers, self.surface
        if not len(region.active):
            return
        moving = np.where(self._inverse_mass > 0, region.moving, 0.0)
        none, no_faces = np.zeros((0, 2), np.int64), np.zeros((0, 3), np.int64)
        held, still = np.zeros((len(hands), 6)), np.zeros((len(hands), 2))
        for turn in range(n.repair):
            contacts = self._contacts(x, hands, outward, region.active, near=2e-4, pairs=region.edges)
            if contacts.depth.max(initial=0.0) <= 0.5 * n.tolerance:
                break
            table = np.concatenate((contacts.points, contacts.points, contacts.normals), axis=1)
            # Aim a little outside, so that rounding and neighbours do not undo it, and farther when they keep doing so.
            table[:, :3] -= 0.2 * n.tolerance * (1.0 + turn) * contacts.normals
            relax(
                x, head, moving, region.active, np.zeros(self._count), none, np.zeros(0), 0.0, 0.0, s.ring, s.ring_ids,
                s.ring_weights, np.zeros(self._count), no_faces, moving, 0.0, table, contacts.ids, contacts.weights,
                contacts.hand, held, still, np.zeros(2), np.full(2, np.inf), np.zeros((len(hands), 3)), 1.0, 8, 0.0,
                n.max_dent,
            )  # fmt: skip

    def _result(
        self, x: np.ndarray, head: np.ndarray, outward: np.ndarray, hands: list[np.ndarray], pose: np.ndarray,
        depth: float, steps: int, active: int,
    ) -> FrameResult:  # fmt: skip
        n = self.numbers
        self._head.move(x)
        deepest, head_contact, hand_contact = 0.0, np.zeros(self._count, bool), []
        for k, (mesh, hand, count) in enumerate(zip(self._hands, hands, self._hand_counts, strict=True)):
            mesh.move(hand)
            overlap = measure_overlap(self._head, mesh, (self._count, count), n.touch)
            deepest = max(deepest, overlap.deepest, deepest_edge(self._head, mesh, self._edges_with(k)))
            head_contact |= overlap.head_distance < n.touch
            hand_contact.append(overlap.hand_distance < n.touch)
        self._label(x, hands, outward, head_contact, hand_contact)
        dent = float(np.linalg.norm(x - head, axis=1).max())
        shift = np.linalg.norm(pose[:, :3], axis=1).max()
        turn = np.linalg.norm(pose[:, 3:], axis=1).max()
        exceeded = (
            deepest > 2.0 * n.tolerance
            or dent >= 0.999 * n.max_dent
            or shift >= 0.999 * n.hand_shift > 0
            or turn >= 0.999 * n.hand_turn > 0
        )
        return FrameResult(x, hands, pose, head_contact, hand_contact, (depth, deepest), steps, bool(exceeded), active)

    @staticmethod
    def _posed(hand: np.ndarray, pose: np.ndarray, centre: np.ndarray) -> np.ndarray:
        if not pose.any():
            return hand
        return (hand - centre) @ rotation_matrix(pose[3:]).T + centre + pose[:3]


def _outwards(mesh: DeformingMesh, rest: np.ndarray) -> DeformingMesh:
    """The mesh with its faces turned if they look inwards (a mirrored model), so that inside is inside."""
    corners = mesh.verts[mesh.closed_faces] - mesh.verts.mean(axis=0)
    volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    return mesh if volume >= 0 else DeformingMesh(rest, mesh.faces[:, ::-1])


def _gather(hands: list[np.ndarray], contacts: Contacts) -> np.ndarray:
    """Positions (C, 3, 3) of the hand vertices that contacts are made of."""
    out = np.zeros((len(contacts.hand), 3, 3))
    for h, hand in enumerate(hands):
        mine = contacts.hand == h
        out[mine] = hand[contacts.anchor[mine]]
    return out
