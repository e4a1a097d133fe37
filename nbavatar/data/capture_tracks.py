"""A capture's tracked meshes as a mesh sequence.

A part that a frame's file leaves out is not in that frame: its vertices are NaN there.

Extras, besides those of `sequences`: `camera.<camera>.*`, `split`, `segments` as for Decaf, and where the capture
stores heads without contact, `head_rigid` and `head_final` float32 [N, V, 3] [m], whichever of the two the heads are.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from nbavatar.data.capture import Capture, read_mesh, read_topology
from nbavatar.data.sequences import MeshSequence, Part
from nbavatar.errors import DataError

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
        DataError: a mesh is missing or damaged, vertex counts change, or only some frames have `head_rigid`.
    """
    topology = read_topology(capture.root)
    rows: dict[str, dict[int, np.ndarray]] = {}
    for row, frame in enumerate(frames):
        mesh = read_mesh(capture.root, frame, topology)
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
    parts: dict[str, Part] = {}
    report: dict[str, Any] = {"rest": {}}
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


def _stacked(vertices: Mapping[int, np.ndarray], count: int) -> np.ndarray:
    """Vertices float32 `[N, V, 3]` of all frames, NaN in frames that have none."""
    result = np.full((count, *next(iter(vertices.values())).shape), np.nan, dtype=np.float32)
    for row, verts in vertices.items():
        result[row] = verts
    return result
