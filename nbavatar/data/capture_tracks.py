"""A capture's tracked meshes as a mesh sequence.

A part that a frame's file leaves out is not in that frame: its vertices are NaN there.

Extras, besides those of `sequences`: `camera.<camera>.*`, `split`, `segments` as for Decaf, and where the capture
stores heads without contact, `head_rigid` and `head_final` float32 [N, V, 3] [m], whichever of the two the heads are.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from nbavatar.data.capture import Capture, read_mesh, read_topology
from nbavatar.data.mesh_checks import mesh_faults
from nbavatar.data.sequences import MeshSequence, Part
from nbavatar.errors import DataError
from nbavatar.mesh.consistency import seam_welds

__all__ = ["build_capture_tracks"]


def build_capture_tracks(
    capture: Capture, frames: Sequence[str], *, contact: str
) -> tuple[MeshSequence, dict[str, Any]]:
    """Reads the meshes of the chosen frames.

    Args:
        capture: whose.
        frames: frame ids.
        contact: `solve` takes `head_rigid` for the head where the capture has it; `given` takes `head`.

    Returns:
        the sequence (extras without `split` and `segments`), and a report for the record.

    Raises:
        DataError: a mesh is missing or damaged, vertex counts change, only some frames have `head_rigid`, or the meshes
            of a part are not one surface that moves (see `mesh_checks`).
    """
    topology = read_topology(capture.root)
    rows: dict[str, dict[int, np.ndarray]] = {}
    for row, frame in enumerate(frames):
        mesh = read_mesh(capture, frame, topology)
        for name, verts in mesh.items():
            known = rows.setdefault(name, {})
            before = next(iter(known.values()), verts)
            if verts.shape != before.shape:
                path = capture.root / "meshes" / f"{frame}.npz"
                raise DataError.of(path, name, expected=f"{len(before)} vertices as before", found=len(verts))
            known[row] = verts
    for name in topology:
        if name not in rows:
            expected, fix = f"{name} in a frame at least", f"leave {name}_faces out of topology.npz if it is nowhere"
            raise DataError.of(capture.root / "meshes", expected=expected, found="it in none", fix=fix)
    rigid = rows.pop("head_rigid", None)
    if rigid is not None and len(rigid) != len(rows["head"]):
        expected, found = "head_rigid beside every head or none", f"it in {len(rigid)} of {len(rows['head'])} frames"
        raise DataError.of(capture.root / "meshes", expected=expected, found=found)
    states = {**rows, **({} if rigid is None else {"head_rigid": rigid})}
    report: dict[str, Any] = {"rest": {}, "origin": capture.origin.tolist(), "vertices_left_out": {}}
    for name, (faces, rest) in topology.items():
        of_part = [state for state in states if state.removesuffix("_rigid") == name]
        for state in of_part:
            frames_of = {frames[row]: verts for row, verts in states[state].items()}
            faults = mesh_faults(capture.root / "meshes", state, faces, rest, frames_of)
            if faults:
                raise DataError(faults[0])
        topology[name], report["vertices_left_out"][name] = _surface(faces, rest, [states[state] for state in of_part])
    parts: dict[str, Part] = {}
    for name, (faces, rest) in topology.items():
        shown = rigid if name == "head" and rigid is not None and contact == "solve" else rows[name]
        first = next(iter(shown.values()))
        report["rest"][name] = "topology.npz" if rest is not None else "first frame"
        parts[name] = Part(faces, first.copy() if rest is None else rest, _stacked(shown, len(frames)))
    extras: dict[str, np.ndarray] = {}
    if rigid is not None:
        extras["head_rigid"], extras["head_final"] = (
            _stacked(vertices, len(frames)) for vertices in (rigid, rows["head"])
        )
    report["head"] = "head_rigid" if rigid is not None and contact == "solve" else "head"
    for name, camera in capture.cameras.items():
        extras[f"camera.{name}.K"] = camera.K
        extras[f"camera.{name}.cam_from_world"] = camera.cam_from_world
        extras[f"camera.{name}.distortion"] = np.zeros(12) if camera.distortion is None else camera.distortion
        extras[f"camera.{name}.size"] = np.array([camera.width, camera.height])
    return MeshSequence(list(frames), parts, extras), report


def _surface(
    faces: np.ndarray, rest: np.ndarray | None, states: Sequence[dict[int, np.ndarray]]
) -> tuple[tuple[np.ndarray, np.ndarray | None], int]:
    """A part without seams and loose vertices, and how many vertices fell away; the states' are cut in place.

    Vertices that lie together in all frames are one, so that a seam of texture coordinates is no border to any stage.
    Vertices that no face uses are no part of the surface, and would pull at its boxes and means.
    """
    frames = [verts for state in states for verts in state.values()]
    welded = seam_welds(frames if rest is None else [*frames, rest], faces)
    kept = np.zeros(len(welded), bool)
    kept[welded[faces]] = True
    if kept.all():
        return (faces, rest), 0
    place = np.cumsum(kept) - 1
    for state in states:
        for row in state:
            state[row] = state[row][kept]
    return (place[welded[faces]], None if rest is None else rest[kept]), int((~kept).sum())


def _stacked(vertices: Mapping[int, np.ndarray], count: int) -> np.ndarray:
    """Vertices float32 `[N, V, 3]` of all frames, NaN in frames that have none."""
    result = np.full((count, *next(iter(vertices.values())).shape), np.nan, dtype=np.float32)
    for row, verts in vertices.items():
        result[row] = verts
    return result
