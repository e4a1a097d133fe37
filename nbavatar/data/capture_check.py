"""Everything that can be wrong with a capture, found in one go and said in one line each."""

import dataclasses
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nbavatar.camera.pinhole import Camera
from nbavatar.config.cameras import read_rig, stored_test_camera
from nbavatar.config.preprocess import MATTE_THRESHOLD
from nbavatar.data.capture import (
    Capture,
    camera_of,
    read_mesh,
    read_rgb,
    read_splits,
    read_topology,
    recentred,
)
from nbavatar.data.capture_masks import CameraMasks, open_masks
from nbavatar.data.capture_poses import PoseJudge, sampled_frames
from nbavatar.data.mesh_checks import mesh_faults
from nbavatar.data.sequences import PARTS
from nbavatar.errors import DataError
from nbavatar.mesh.topology import mesh_defects
from nbavatar.mesh.zbuffer import rasterize_mesh

__all__ = ["CaptureReport", "check_capture"]

_SIZES = {"head": (0.1, 0.8), "right_hand": (0.05, 0.7), "left_hand": (0.05, 0.7)}  # plausible diagonals [m]
_MUCH_ASTRAY = 0.15  # share of a mesh's pixels off its part, of which a note is made


@dataclasses.dataclass
class CaptureReport:
    """What a check found.

    Attributes:
        defects: lines that name what has to be mended before the capture can be used.
        notes: lines about what is unusual but usable.
        overlap: camera -> mean share of the masks that the projected meshes cover.
        capture: the capture, if its cameras can be read.
        frames: frame ids.
        topology: faces and rest vertices of the parts.
        masks: camera -> its masks, if they can be read.
    """

    defects: list[str] = dataclasses.field(default_factory=list)
    notes: list[str] = dataclasses.field(default_factory=list)
    overlap: dict[str, float] = dataclasses.field(default_factory=dict)
    capture: Capture | None = None
    frames: list[str] = dataclasses.field(default_factory=list)
    topology: dict[str, tuple[np.ndarray, np.ndarray | None]] = dataclasses.field(default_factory=dict)
    masks: dict[str, CameraMasks] = dataclasses.field(default_factory=dict)


class _Collector:
    """Collects defects; many of one kind become one line with a count."""

    def __init__(self, lines: list[str]) -> None:
        self._lines, self._groups = lines, {}

    def attempt(self, group: str, call: Callable[[], Any]) -> Any:
        """The call's result, or None after noting its error."""
        try:
            return call()
        except DataError as error:
            self.note(group, str(error))
            return None

    def note(self, group: str, line: str) -> None:
        self._groups.setdefault(group, []).append(line)

    def close(self) -> None:
        for lines in self._groups.values():
            more = f" (and {len(lines) - 1} more like it)" if len(lines) > 1 else ""
            self._lines.append(lines[0] + more)


def check_capture(
    root: str | Path, progress: Callable[[Iterable[str], str], Iterable[str]] = lambda items, _: items
) -> CaptureReport:
    """Reads every file of a capture and compares them with each other.

    Args:
        root: folder of the capture.
        progress: wraps the loop over the frames of a camera, for a progress bar.

    Returns:
        the report; the capture is usable if `defects` is empty.
    """
    root = Path(root)
    report = CaptureReport()
    found = _Collector(report.defects)
    if not root.is_dir():
        report.defects.append(f"{root}: expected the folder of a capture, found no such folder")
        return report
    cameras = found.attempt("cameras", lambda: _cameras(root, found)) or {}
    splits = found.attempt("splits", lambda: read_splits(root))
    report.topology = found.attempt("topology", lambda: read_topology(root)) or {}
    capture = recentred(root, cameras)
    cameras = capture.cameras
    if cameras:
        report.capture = capture
        if capture.origin.any():
            moved = ", ".join(f"{x:.0f}" for x in capture.origin)
            report.notes.append(f"{root / 'cameras.json'}: the world's origin is far away; it is moved to ({moved}) m")
    if splits is not None:
        report.frames = splits.frames
        if cameras:
            found.attempt("test camera", lambda: stored_test_camera(root, read_rig(root / "cameras.json")))
        _note_on_order(root, splits.frames, report)
    meshes = _check_meshes(capture, report, found) if report.topology and report.frames else {}
    judge = PoseJudge(cameras, report.topology, meshes)
    for camera in cameras.values():
        _check_camera(capture, camera, report, meshes, found, judge, progress)
    if meshes:
        _check_poses(root, judge, report, found)
    if len(cameras) == 1:
        report.notes.append(f"{root / 'cameras.json'}: one camera only; held-out poses are judged, new views are not")
    _notes_on_topology(root, report)
    found.close()
    return report


def _cameras(root: Path, found: _Collector) -> dict[str, Camera]:
    path = root / "cameras.json"
    cameras = {}
    for name, entry in read_rig(path).items():
        camera = found.attempt(f"camera {name}", lambda: camera_of(name, entry, path))  # noqa: B023
        if camera is not None:
            cameras[name] = camera
    return cameras


def _check_meshes(capture: Capture, report: CaptureReport, found: _Collector) -> dict[str, dict[str, np.ndarray]]:
    root = capture.root
    meshes: dict[str, dict[str, np.ndarray]] = {}
    first: dict[str, np.ndarray] = {}
    for frame in report.frames:
        mesh = found.attempt("meshes", lambda: read_mesh(capture, frame, report.topology))  # noqa: B023
        if mesh is None:
            continue
        path = root / "meshes" / f"{frame}.npz"
        if {n: v.shape for n, v in mesh.items() if n in first} != {n: v.shape for n, v in first.items() if n in mesh}:
            found.note("counts", f"{path}: expected as many vertices as in the frames before, found another number")
            continue
        if "head" in mesh and "head" in first and ("head_rigid" in mesh) != ("head_rigid" in first):
            found.note("rigid", f"{path}: head_rigid: expected it in all frames or in none, found it only in some")
        for part, (low, high) in _SIZES.items():
            if part in mesh:
                size = float(np.linalg.norm(np.ptp(mesh[part], axis=0)))
                if not low <= size <= high:
                    expected = f"a size of {low} to {high} m"
                    error = DataError.of(
                        path, part, expected=expected, found=f"{size:.3g}", fix="lengths must be metres"
                    )
                    found.note(f"size {part}", str(error))
        meshes[frame] = mesh
        first = mesh | first
    if meshes:
        for part, (faces, rest) in report.topology.items():
            mesh = next((mesh for mesh in meshes.values() if part in mesh), None)
            if mesh is None:
                where, fix = root / "meshes", f"leave {part}_faces out of topology.npz if it is nowhere"
                found.note(f"absent {part}", str(DataError.of(where, part, expected="vertices", found="none", fix=fix)))
                continue
            for state in (part, f"{part}_rigid"):
                of_part = {frame: mesh[state] for frame, mesh in meshes.items() if state in mesh}
                for line in mesh_faults(root / "meshes", state, faces, rest, of_part) if of_part else ():
                    found.note(f"surface {part}", line)
    return meshes


def _check_camera(
    capture: Capture,
    camera: Camera,
    report: CaptureReport,
    meshes: Mapping[str, Mapping[str, np.ndarray]],
    found: _Collector,
    judge: PoseJudge,
    progress: Callable[[Iterable[str], str], Iterable[str]],
) -> None:
    name, overlaps = camera.name, []
    masks_folder = capture.root / "masks" / name
    labels: set[int] = set()
    sampled = set(sampled_frames(report.frames)) if report.frames else set()
    marked = False
    masks = found.attempt(f"masks {name}", lambda: open_masks(capture, camera, report.frames))
    if masks is not None:
        report.masks[name] = masks
        if report.frames and masks.mask is None and masks.coverage is None:
            line = DataError.of(masks_folder, expected="a mask (or an alpha image) for each frame", found="none")
            found.note(f"no mask {name}", str(line))
        for kind, meaning in (("masks", masks.mask), ("alpha", masks.coverage)):
            if meaning is not None and meaning.white not in (0, 255, 65535):
                where = capture.root / kind / name
                report.notes.append(f"{where}: a matte in which {meaning.white} is full coverage")
    for frame in progress(report.frames, f"check {name}"):
        found.attempt(f"images {name}", lambda: read_rgb(capture, camera, frame))  # noqa: B023
        if masks is None:
            continue
        mask, alpha = masks.read_mask(frame), masks.read_coverage(frame)
        labelled = masks.mask is not None and masks.mask.kind == "label"
        shown = mask if mask is not None else alpha
        if shown is not None:
            person = shown if labelled else (shown > MATTE_THRESHOLD).astype(np.uint8)
            marked = marked or bool(person.any())
            if frame in sampled:
                judge.add(name, frame, person, labelled=labelled)
        if mask is None:
            continue
        if masks.mask is not None and masks.mask.kind == "label":
            labels |= set(np.unique(mask).tolist())
            there = mask > 0
        else:
            there = mask > MATTE_THRESHOLD
        if not there.any():
            report.notes.append(f"{masks_folder / frame}: the mask is empty")
        elif frame in meshes:
            overlaps.append(_overlap(camera, report.topology, meshes[frame], there))
    if report.frames and not marked and masks is not None and (masks.mask or masks.coverage):
        line = DataError.of(
            masks_folder, expected="labelled pixels in a frame at least", found="none in any",
            fix="mend the masks, or leave this camera out of cameras.json",
        )  # fmt: skip
        found.note(f"nothing {name}", str(line))
    for value in sorted(labels - {0}):
        part = PARTS[value - 1]
        if report.topology and part not in report.topology:
            where = capture.root / "meshes" / "topology.npz"
            line = DataError.of(where, f"{part}_faces", expected=f"a mesh for label {value} of the masks", found="none")
            found.note(f"label {value}", str(line))
    if overlaps:
        report.overlap[name] = float(np.mean(overlaps))


def _check_poses(root: Path, judge: PoseJudge, report: CaptureReport, found: _Collector) -> None:
    path = root / "cameras.json"
    lines = judge.defects(path)
    for number, line in enumerate(lines):
        found.note(f"poses {number}", line)
    for name, astray in judge.misfits().items() if not lines else ():
        if astray > _MUCH_ASTRAY:
            report.notes.append(
                f"{path}: camera {name}: {astray:.0%} of the meshes' pixels are off their part of the masks"
            )


def _overlap(
    camera: Camera,
    topology: Mapping[str, tuple[np.ndarray, np.ndarray | None]],
    mesh: Mapping[str, np.ndarray],
    mask: np.ndarray,
) -> float:
    """Intersection over union of mask (bool `[H, W]`) and mesh silhouette, at a quarter of the resolution."""
    step = max(1, max(camera.width, camera.height) // 256)
    K = camera.K.copy()
    K[:2] /= step
    small = mask[step // 2 :: step, step // 2 :: step]
    height, width = small.shape
    covered = np.zeros_like(small)
    for part, (faces, _) in topology.items():
        if part not in mesh:
            continue
        covered |= rasterize_mesh(mesh[part], faces, K, width, height, cam_from_world=camera.cam_from_world)[0] >= 0
    return float((covered & small).sum() / max((covered | small).sum(), 1))


def _note_on_order(root: Path, frames: list[str], report: CaptureReport) -> None:
    """Frames are a film in the order of splits.json; another order than that of their names is seldom meant."""

    def natural(frame: str) -> list[tuple[int, str]]:
        return [(int(piece), "") if piece.isdecimal() else (-1, piece) for piece in re.split(r"(\d+)", frame)]

    for before, after in zip(frames, frames[1:]):
        if natural(before) > natural(after):
            path = root / "splits.json"
            report.notes.append(
                f"{path}: frames: {before} comes before {after}; is that the order in time? (a sorting as text puts 10 "
                "before 9)"
            )
            return


def _notes_on_topology(root: Path, report: CaptureReport) -> None:
    for part, (faces, rest) in report.topology.items():
        verts = rest if rest is not None else None
        if verts is None:
            continue
        defects = mesh_defects(verts.astype(np.float64), faces)
        unusual = {
            "faces with a vertex twice": len(defects.repeated_vertex),
            "duplicate faces": len(defects.duplicate),
            "faces without area": len(defects.zero_area),
            "edges of three faces or more": len(defects.non_manifold),
            "edges between faces of opposite winding": len(defects.inconsistent),
            "vertices without a face": len(defects.unreferenced),
        }
        said = ", ".join(f"{count} {what}" for what, count in unusual.items() if count)
        if said:
            report.notes.append(f"{root / 'meshes' / 'topology.npz'}: {part}: {said}")
