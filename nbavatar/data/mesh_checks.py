"""Whether the meshes of a capture are one surface that moves, for `check` and `tracks` alike."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from nbavatar.errors import DataError
from nbavatar.mesh.consistency import (
    edge_lengths,
    edges_apart,
    reference_lengths,
    seam_welds,
    signed_volume,
    torn_edges,
)
from nbavatar.mesh.topology import edges, mesh_defects

__all__ = ["mesh_faults"]

_MOST_APART = 1.5  # factor between edges of one part at two times
_MOST_GROWN = 1.25  # factor of a part's size at two times
_SAMPLES = 64
_MIRRORED = 0.2  # share of the usual volume, with the other sign
_MOST_INCONSISTENT = 0.01  # share of edges between faces of opposite winding


def mesh_faults(
    folder: Path, part: str, faces: np.ndarray, rest: np.ndarray | None, frames: Mapping[str, np.ndarray]
) -> list[str]:
    """What is wrong with a part's meshes over time, one line for each fault and frame.

    Args:
        folder: of the meshes, for the lines.
        part: name of the part (or of its other state, `head_rigid`).
        faces: vertex ids (F, 3).
        rest: vertices (V, 3) [m] at rest, where the capture has them.
        frames: frame -> vertices (V, 3) [m], all of the same number.
    """
    names = list(frames)
    chosen = [
        frames[names[i]] for i in np.unique(np.linspace(0, len(names) - 1, min(_SAMPLES, len(names))).astype(int))
    ]
    pairs = edges(faces)
    reference = reference_lengths(chosen, pairs)
    topology = folder / "topology.npz"
    faults = []
    for frame, verts in frames.items():
        found = _wrong_edges(verts, pairs, reference)
        if found:
            expected, fix = "edges as long as in the other frames", "vertices must keep their order"
            faults.append(_line(folder / f"{frame}.npz", part, expected, found, fix))
    if faults:
        return faults
    if rest is not None:
        found = _wrong_edges(rest, pairs, reference)
        if found:
            expected, fix = "edges about as long as in the frames", "the same vertices in the same order, in metres"
            return [_line(topology, f"{part.removesuffix('_rigid')}_rest", expected, found, fix)]
    welded = seam_welds(chosen[:2], faces)[faces]
    volumes = {frame: signed_volume(verts, welded) for frame, verts in frames.items()}
    usual = float(np.median(list(volumes.values())))
    if usual < 0:
        expected, found = "corners counter-clockwise seen from outside", "clockwise"
        return [_line(topology, f"{part.removesuffix('_rigid')}_faces", expected, found, "swap two columns")]
    for frame, volume in volumes.items():
        if volume < -_MIRRORED * usual:
            expected, found = "a surface as in the other frames", "one that is turned inside out"
            faults.append(_line(folder / f"{frame}.npz", part, expected, found, "is it mirrored?"))
    mixed = len(mesh_defects(np.asarray(chosen[0], np.float64), welded).inconsistent)
    if mixed > _MOST_INCONSISTENT * len(pairs):
        expected, found = "faces that all turn the same way", f"{mixed} edges between faces of opposite winding"
        faults.append(_line(topology, f"{part.removesuffix('_rigid')}_faces", expected, found, ""))
    return faults


def _wrong_edges(verts: np.ndarray, pairs: np.ndarray, reference: np.ndarray) -> str:
    lengths = edge_lengths(verts, pairs)
    apart, grown = edges_apart(lengths, reference)
    if apart > _MOST_APART or grown > _MOST_GROWN:
        return f"lengths that differ by a factor of {apart:.3g}"
    diagonal = float(np.linalg.norm(np.ptp(np.asarray(verts, np.float64), axis=0)))
    torn = torn_edges(lengths, reference, diagonal)
    if not len(torn):
        return ""
    worst = int(torn[np.argmax(lengths[torn])])
    a, b = pairs[worst]
    others = f" and {len(torn) - 1} others" if len(torn) > 1 else ""
    return f"{lengths[worst]:.3g} m instead of {reference[worst]:.3g} m between vertices {a} and {b}{others}"


def _line(where: Path, field: str, expected: str, found: str, fix: str) -> str:
    return str(DataError.of(where, field, expected=expected, found=found, fix=fix))
