"""Contact over a sequence: warm starts, cuts, frames that cannot be used, pieces that can be resumed."""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from nbavatar.mesh.bvh import DeformingMesh
from nbavatar.physics.contact import ContactSolver, FrameResult

__all__ = ["FrameRecord", "SequenceSolver", "enclosed_volume", "pack", "uncut_runs", "unpack"]


@dataclasses.dataclass(frozen=True)
class FrameRecord:
    """Outcome of one frame in the precision that is stored.

    Attributes:
        head: float32 (V, 3) [m]; `hands` float32, (Vh, 3) each: the input's own bits where nothing was done.
        head_contact, hand_contact: bool, nearer than the touch distance.
        pose: float64 (H, 6), correction of each hand, translation [m] and rotation vector [rad] about its centroid.
        depth: deepest vertex or edge before and after [m].
        steps, active: steps taken and vertices simulated; 0 in free frames.
        exceeded: the depth left is over twice the tolerance, or a bound was reached.
        finite: False where the input holds NaN or infinity; it is passed on untouched.
    """

    head: np.ndarray
    hands: list[np.ndarray]
    head_contact: np.ndarray
    hand_contact: list[np.ndarray]
    pose: np.ndarray
    depth: tuple[float, float]
    steps: int
    active: int
    exceeded: bool
    finite: bool


class SequenceSolver:
    """Runs a `ContactSolver` over frames in order; keeps what the next frame starts from."""

    def __init__(self, solver: ContactSolver, runs: Sequence[tuple[int, int]]) -> None:
        """Takes a solver and the uncut runs, (first, last) frame each, inclusive; nothing crosses their ends."""
        self._solver = solver
        self._starts = {first for first, _ in runs}
        self._before: tuple[FrameResult, np.ndarray, list[np.ndarray]] | None = None

    def frames(self, head: np.ndarray, hands: list[np.ndarray], first: int, last: int) -> Iterator[FrameRecord]:
        """Yields frames first..last (inclusive) of head (N, V, 3) float32 and hands (N, Vh, 3) float32 each.

        Call it for consecutive pieces in order; a piece may start anywhere after `resume`.
        """
        for frame in range(first, last + 1):
            if frame in self._starts:
                self._before = None
            yield self._frame(head[frame], [hand[frame] for hand in hands])

    def resume(self, record: FrameRecord, head: np.ndarray, hands: list[np.ndarray]) -> None:
        """Makes the next frame start from a stored one, as if it had just been computed.

        Args:
            record: the frame before; `head` (V, 3) and `hands`: its inputs.
        """
        self._remember(record, head, hands)

    def _frame(self, head: np.ndarray, hands: list[np.ndarray]) -> FrameRecord:
        if not (np.isfinite(head).all() and all(np.isfinite(hand).all() for hand in hands)):
            self._before = None
            none = [np.zeros(len(hand), bool) for hand in hands]
            return FrameRecord(
                head, hands, np.zeros(len(head), bool), none, np.zeros((len(hands), 6)), (0.0, 0.0), 0, 0, False, False
            )
        result = self._solver.solve(head, hands, *(self._before or (None, None, None)))
        moved = result.active > 0
        record = FrameRecord(
            head=result.head.astype(np.float32) if moved else head,
            hands=[
                new.astype(np.float32) if pose.any() else old
                for new, old, pose in zip(result.hands, hands, result.pose, strict=True)
            ],
            head_contact=result.head_contact,
            hand_contact=result.hand_contact,
            pose=result.pose,
            depth=result.depth,
            steps=result.steps,
            active=result.active,
            exceeded=result.exceeded,
            finite=True,
        )
        self._remember(record, head, hands)
        return record

    def _remember(self, record: FrameRecord, head: np.ndarray, hands: list[np.ndarray]) -> None:
        """The next frame starts from what is stored, in its precision, so that a resumed run has the same bits."""
        if not record.finite:
            self._before = None
            return
        result = FrameResult(
            record.head.astype(np.float64),
            [hand.astype(np.float64) for hand in record.hands],
            record.pose,
            record.head_contact,
            record.hand_contact,
            record.depth,
            record.steps,
            record.exceeded,
            record.active,
        )
        self._before = (result, head.astype(np.float64), [hand.astype(np.float64) for hand in hands])


def pack(records: Sequence[FrameRecord]) -> dict[str, np.ndarray]:
    """Frames stacked into named arrays, the form in which pieces are stored; the inverse of `unpack`."""
    arrays = {
        "head": np.stack([r.head for r in records]),
        "contact.head": np.stack([r.head_contact for r in records]),
        "pose": np.stack([r.pose for r in records]),
        "depth": np.array([r.depth for r in records]),
        "steps": np.array([r.steps for r in records]),
        "active": np.array([r.active for r in records]),
        "exceeded": np.array([r.exceeded for r in records]),
        "finite": np.array([r.finite for r in records]),
    }
    for k in range(len(records[0].hands)):
        arrays[f"hand.{k}"] = np.stack([r.hands[k] for r in records])
        arrays[f"contact.hand.{k}"] = np.stack([r.hand_contact[k] for r in records])
    return arrays


def unpack(arrays: dict[str, np.ndarray], i: int) -> FrameRecord:
    """Frame i of what `pack` stacked."""
    hands = sum(name.startswith("hand.") for name in arrays)
    return FrameRecord(
        head=arrays["head"][i],
        hands=[arrays[f"hand.{k}"][i] for k in range(hands)],
        head_contact=arrays["contact.head"][i],
        hand_contact=[arrays[f"contact.hand.{k}"][i] for k in range(hands)],
        pose=arrays["pose"][i],
        depth=(float(arrays["depth"][i, 0]), float(arrays["depth"][i, 1])),
        steps=int(arrays["steps"][i]),
        active=int(arrays["active"][i]),
        exceeded=bool(arrays["exceeded"][i]),
        finite=bool(arrays["finite"][i]),
    )


def uncut_runs(segments: np.ndarray | None, count: int) -> list[tuple[int, int]]:
    """Uncut runs (first, last) that cover frames 0..count-1; `segments` (R, 2) inclusive, None for one run.

    Frames that no segment names form runs of their own, so that nothing is carried into or out of them.
    """
    if segments is None or not len(segments):
        return [(0, count - 1)] if count else []
    runs, covered = [], 0
    for first, last in sorted((int(a), int(b)) for a, b in segments):
        first, last = max(first, covered), min(last, count - 1)
        if first > covered:
            runs.append((covered, first - 1))
        if last >= first:
            runs.append((first, last))
            covered = last + 1
    if covered < count:
        runs.append((covered, count - 1))
    return runs


def enclosed_volume(mesh: DeformingMesh, verts: np.ndarray) -> float:
    """Volume inside a surface with vertices (V, 3) [m], holes closed by fans [m^3]."""
    mesh.move(verts)
    corners = mesh.verts[mesh.closed_faces] - mesh.verts.mean(axis=0)
    return float(np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0)
