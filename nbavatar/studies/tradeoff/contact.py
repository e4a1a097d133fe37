"""The contact solver on chosen frames of a sequence, and what it saves by simulating only what contact reaches."""

import dataclasses
import time
import tracemalloc
from collections.abc import Sequence
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from nbavatar.config.geometry import DeformConfig
from nbavatar.data.sequences import PARTS, MeshSequence
from nbavatar.mesh.bvh import DeformingMesh
from nbavatar.physics.collision import measure_overlap
from nbavatar.physics.contact import ContactNumbers, ContactSolver, FrameResult
from nbavatar.physics.tissue import bed_stiffness, soft_surface, tissue_thickness

__all__ = ["ContactScene", "contact_only_rows", "contact_scene"]

_TOUCH = 0.002  # as close counts as contact [m]
_MOVED = 2e-4  # vertices that contact moves by less do not count in a mean [m]


class ContactScene(NamedTuple):
    """Head and hands of a sequence, ready to be solved.

    Attributes:
        sequence: head not deformed by contact, and hands.
        hands: names of the hands.
        bed: stiffness of the tissue under each vertex of the head, (V,).
        deepest: frames with the deepest contact, in time order, int64.
        free: frames without contact, evenly spaced, as many at most.
    """

    sequence: MeshSequence
    hands: list[str]
    bed: np.ndarray
    deepest: np.ndarray
    free: np.ndarray

    def solver(self, config: DeformConfig) -> ContactSolver:
        """The solver with other numbers."""
        numbers = ContactNumbers(**config.contact_numbers())
        head = self.sequence.parts["head"]
        rest = np.asarray(head.rest, np.float64)
        own = (self.sequence.parts[name] for name in self.hands)
        hands = [(np.asarray(part.rest, np.float64), part.faces) for part in own]
        return ContactSolver(soft_surface(rest, head.faces, self.bed), rest, hands, numbers)

    def solve(self, solver: ContactSolver, frame: int) -> FrameResult:
        """One frame, from rest."""
        parts = self.sequence.parts
        return solver.solve(parts["head"].verts[frame], [parts[name].verts[frame] for name in self.hands])


def contact_scene(sequence: MeshSequence, count: int) -> ContactScene | None:
    """The scene of a sequence, with at most `count` frames of each kind; None where no hand ever touches a head."""
    hands = [name for name in sequence.parts if name in PARTS[1:]]
    if "head" not in sequence.parts or not hands:
        return None
    depth = _depths(sequence, hands)
    if not (depth > 0).any():
        return None
    head = sequence.parts["head"]
    bed = bed_stiffness(tissue_thickness(head.rest, head.faces), DeformConfig().modulus)
    chosen = np.argsort(-depth, kind="stable")[:count]
    apart = np.flatnonzero(depth == 0)  # NaN, where a part is not there, is neither
    free = apart[np.unique(np.linspace(0, len(apart) - 1, min(count, len(apart))).astype(int))]
    return ContactScene(sequence, hands, bed, np.sort(chosen[depth[chosen] > 0]), free)


def contact_only_rows(scene: ContactScene, repeats: int) -> list[dict[str, Any]]:
    """Contact frames and free frames, with all of the head simulated and with only what contact reaches.

    Args:
        scene: of `contact_scene`.
        repeats: passes over the frames; the first compiles, and is not timed.

    Returns:
        A row for each kind of frame there is: `saving`, `scene`, milliseconds a frame on and off, how much faster
        (median ratio of frames taken in turn), memory that a frame takes besides [MB], `error_mm` (mean distance of the
        two heads where either moved) and `worst_mm`, simulated vertices on and off (`on_posed`, `off_posed`).
    """
    on, off = (scene.solver(dataclasses.replace(DeformConfig(), contact_only=only)) for only in (True, False))
    rows = []
    for name, frames in (("frames with contact", scene.deepest), ("frames without contact", scene.free)):
        if not len(frames):
            continue
        spent: dict[bool, list[float]] = {True: [], False: []}
        results: dict[bool, list[FrameResult]] = {True: [], False: []}
        for lap in range(1 + repeats):
            for frame in frames:
                for side, solver in ((True, on), (False, off)):
                    began = time.perf_counter()
                    result = scene.solve(solver, int(frame))
                    if lap > 0:
                        spent[side].append(1e3 * (time.perf_counter() - began))
                    else:
                        results[side].append(result)
        error, worst = _apart(scene, frames, results)
        rows.append(
            {
                "saving": "contact regions only",
                "scene": name,
                "on_ms": median(spent[True]),
                "off_ms": median(spent[False]),
                "faster": median(b / a for a, b in zip(spent[True], spent[False], strict=True)),
                "on_memory_mb": _memory_mb(scene, on, int(frames[-1])),
                "off_memory_mb": _memory_mb(scene, off, int(frames[-1])),
                "error_mm": error,
                "worst_mm": worst,
                "on_posed": max(result.active for result in results[True]),
                "off_posed": max(result.active for result in results[False]),
            }
        )
    return rows


def _apart(
    scene: ContactScene, frames: Sequence[int] | np.ndarray, results: dict[bool, list[FrameResult]]
) -> tuple[float, float]:
    """Mean distance of two heads where either was moved by contact, and the largest [mm]."""
    head = scene.sequence.parts["head"].verts
    distances, largest = [], 0.0
    for frame, a, b in zip(frames, results[True], results[False], strict=True):
        apart = 1e3 * np.linalg.norm(a.head - b.head, axis=1)
        moved = np.maximum(*(np.linalg.norm(side.head - head[frame], axis=1) for side in (a, b))) > _MOVED
        distances.append(apart[moved])
        largest = max(largest, float(apart.max()))
    merged = np.concatenate(distances)
    return float(merged.mean()) if len(merged) else 0.0, largest


def _memory_mb(scene: ContactScene, solver: ContactSolver, frame: int) -> float:
    """Most memory that arrays of one frame take [MB]."""
    tracemalloc.start()
    try:
        scene.solve(solver, frame)
        return tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()


def _depths(sequence: MeshSequence, hands: Sequence[str]) -> np.ndarray:
    """Deepest overlap of the head with a hand in every frame [m], (N,); NaN where a part is not there."""
    head = sequence.parts["head"]
    meshes = {name: DeformingMesh(sequence.parts[name].rest, sequence.parts[name].faces) for name in ("head", *hands)}
    depth = np.full(len(sequence.frames), np.nan)
    for frame in range(len(depth)):
        points = {name: np.asarray(sequence.parts[name].verts[frame], np.float64) for name in meshes}
        if not all(np.isfinite(values).all() for values in points.values()):
            continue
        for name, values in points.items():
            meshes[name].move(values)
        counts = [(len(head.rest), len(points[name])) for name in hands]
        depth[frame] = max(
            measure_overlap(meshes["head"], meshes[name], count, _TOUCH).deepest
            for name, count in zip(hands, counts, strict=True)
        )
    return depth
