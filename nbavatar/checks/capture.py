"""Everything that can be wrong with a capture, found in one go and said in one line each."""

import dataclasses
import hashlib
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from nbavatar.camera.pinhole import Camera
from nbavatar.checks.collector import Collector
from nbavatar.checks.poses import PoseJudge, sampled_frames
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
from nbavatar.data.mesh_checks import mesh_faults
from nbavatar.data.sequences import PARTS
from nbavatar.errors import DataError
from nbavatar.io.framepack import UNSEEN, parts_in
from nbavatar.mesh.topology import mesh_defects
from nbavatar.preprocess.capture_masks import CameraMasks, open_masks
from nbavatar.preprocess.mask_values import Meaning
from nbavatar.preprocess.supplied_masks import supplied_masks

__all__ = ["CaptureReport", "Supplied", "check_capture"]

_SIZES = {"head": (0.1, 0.8), "right_hand": (0.05, 0.7), "left_hand": (0.05, 0.7)}  # plausible diagonals [m]
_UNITS = {"millimetres": 1000.0, "centimetres": 100.0}
_MUCH_ASTRAY = 0.15  # share of a mesh's pixels off its part, of which a note is made


class Supplied(NamedTuple):
    """Folder of masks that are used in place of the capture's, or nothing, and whose are taken from there."""

    folder: str
    subject: str


@dataclasses.dataclass
class CaptureReport:
    """What a check found.

    Attributes:
        defects: lines that name what has to be mended before the capture can be used.
        notes: lines about what is unusual but usable.
        supplied: masks that are used in place of the capture's.
        overlap: camera -> intersection over union of its masks and the projected meshes, in a few frames.
        astray: camera -> share of the projected meshes' pixels that are off their part of the masks, in these frames.
        capture: the capture, if its cameras can be read.
        frames: frame ids.
        topology: faces and rest vertices of the parts.
        masks: camera -> its masks, if they can be read.
        meanings: camera -> what the masks that are used mean, if they can be read.
        labels: all labels that these masks hold.
    """

    defects: list[str] = dataclasses.field(default_factory=list)
    notes: list[str] = dataclasses.field(default_factory=list)
    supplied: Supplied = Supplied("", "")
    overlap: dict[str, float] = dataclasses.field(default_factory=dict)
    astray: dict[str, float] = dataclasses.field(default_factory=dict)
    capture: Capture | None = None
    frames: list[str] = dataclasses.field(default_factory=list)
    topology: dict[str, tuple[np.ndarray, np.ndarray | None]] = dataclasses.field(default_factory=dict)
    masks: dict[str, CameraMasks] = dataclasses.field(default_factory=dict)
    meanings: dict[str, Meaning] = dataclasses.field(default_factory=dict)
    labels: set[int] = dataclasses.field(default_factory=set)


def check_capture(
    root: str | Path,
    progress: Callable[[Iterable[str], str], Iterable[str]] = lambda items, _: items,
    *,
    pixel_center: float = 0.5,
    supplied: str = "",
    subject: str = "",
) -> CaptureReport:
    """Reads every file of a capture and compares them with each other.

    Args:
        root: folder of the capture.
        progress: wraps the loop over the frames of a camera, for a progress bar.
        pixel_center: where the stored matrices put the centre of pixel (0, 0) [px].
        supplied: folder of masks that are used in place of the capture's, see `supplied_masks`; empty for none.
        subject: whose masks are taken from there.

    Returns:
        the report; the capture is usable if `defects` is empty.
    """
    root = Path(root)
    report = CaptureReport(supplied=Supplied(supplied, subject))
    found = Collector(report.defects)
    if not root.is_dir():
        report.defects.append(f"{root}: expected the folder of a capture, found no such folder")
        return report
    cameras = found.attempt("cameras", lambda: _cameras(root, found, pixel_center)) or {}
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
        _check_camera(capture, camera, report, found, judge, progress)
    if meshes:
        _check_poses(root, judge, report, found)
    if UNSEEN in report.labels and set(report.meanings) == set(cameras):
        _check_hidden(Path(supplied) if supplied else root / "masks", report, found)
    if len(cameras) == 1:
        report.notes.append(f"{root / 'cameras.json'}: one camera only; held-out poses are judged, new views are not")
    _notes_on_topology(root, report)
    found.close()
    return report


def _cameras(root: Path, found: Collector, pixel_center: float) -> dict[str, Camera]:
    path = root / "cameras.json"
    cameras = {}
    for name, entry in read_rig(path).items():
        camera = found.attempt(f"camera {name}", lambda: camera_of(name, entry, path, pixel_center))  # noqa: B023
        if camera is not None:
            twin = next(
                (n for n, c in cameras.items() if np.array_equal(c.cam_from_world, camera.cam_from_world)), None
            )
            if twin is not None:
                line = DataError.of(
                    f"{path}: camera {name}", "R, t", expected="a pose of its own", found=f"that of {twin}"
                )
                found.note("twins", str(line))
            cameras[name] = camera
    return cameras


def _check_meshes(capture: Capture, report: CaptureReport, found: Collector) -> dict[str, dict[str, np.ndarray]]:
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
        meshes[frame] = mesh
        first = mesh | first
    if meshes:
        if _check_sizes(root, meshes, found):
            return {}
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


def _check_sizes(root: Path, meshes: dict[str, dict[str, np.ndarray]], found: Collector) -> bool:
    """Notes parts that are no people's; whether all lengths are in another unit, which explains what else is wrong."""
    sizes = {
        (frame, part): float(np.linalg.norm(np.ptp(mesh[part], axis=0)))
        for frame, mesh in meshes.items()
        for part in _SIZES
        if part in mesh
    }

    def fits(part: str, size: float) -> bool:
        return _SIZES[part][0] <= size <= _SIZES[part][1]

    wrong = {key: size for key, size in sizes.items() if not fits(key[1], size)}
    units = {
        unit: times
        for unit, times in _UNITS.items()
        if len(wrong) == len(sizes) and all(fits(part, size / times) for (_, part), size in sizes.items())
    }
    for (frame, part), size in wrong.items():
        low, high = _SIZES[part]
        fix = "lengths must be metres"
        for unit, times in list(units.items())[:1]:
            fix = f"lengths look like {unit}: divide vertices by {times:g}, and each t that is in {unit} too"
        where, expected = root / "meshes" / f"{frame}.npz", f"a size of {low} to {high} m"
        error = DataError.of(where, part, expected=expected, found=f"{size:.3g}", fix=fix)
        found.note("sizes", str(error))
    return bool(units)


def _check_camera(
    capture: Capture,
    camera: Camera,
    report: CaptureReport,
    found: Collector,
    judge: PoseJudge,
    progress: Callable[[Iterable[str], str], Iterable[str]],
) -> None:
    name = camera.name
    masks = found.attempt(f"masks {name}", lambda: open_masks(capture, camera, report.frames))
    if masks is not None:
        report.masks[name] = masks
        for kind, meaning in (("masks", masks.mask), ("alpha", masks.coverage)):
            if meaning is not None and meaning.white not in (0, 255, 65535):
                where = capture.root / kind / name
                report.notes.append(f"{where}: a matte in which {meaning.white} is full coverage")
    _check_images(capture, camera, report.frames, found, judge.moving, progress)
    if report.supplied.folder:
        folder, parts = Path(report.supplied.folder), tuple(report.topology)
        own = found.attempt(
            f"supplied {name}", lambda: supplied_masks(folder, report.supplied.subject, camera, report.frames, parts)
        )
        if own is not None:
            report.meanings[name] = own[1]
            shown = zip(report.frames, own[0])
            _check_masks(folder / name, camera, shown, own[1].kind == "label", report, found, judge)
    elif masks is not None and (masks.mask is not None or masks.coverage is not None):
        others = [other for other in capture.cameras if any((capture.root / "masks" / other).glob("*"))]
        if masks.mask is None and others:
            where, expected = capture.root / "masks" / name, f"masks as of camera {others[0]}"
            found.note(f"no mask {name}", str(DataError.of(where, expected=expected, found="none")))
        labelled, there = masks.mask is not None and masks.mask.kind == "label", masks.mask is not None
        meaning = masks.mask or masks.coverage
        assert meaning is not None
        report.meanings[name] = meaning
        shown = ((frame, masks.read_mask(frame) if there else masks.read_coverage(frame)) for frame in report.frames)
        _check_masks(capture.root / "masks" / name, camera, shown, labelled, report, found, judge)
    elif masks is not None and report.frames:
        where = capture.root / "masks" / name
        line = DataError.of(where, expected="a mask (or an alpha image) for each frame", found="none")
        found.note(f"no mask {name}", str(line))


def _check_images(
    capture: Capture,
    camera: Camera,
    frames: list[str],
    found: Collector,
    moving: bool,
    progress: Callable[[Iterable[str], str], Iterable[str]],
) -> None:
    """Reads all images of a camera, and compares them with each other."""
    where, blank, digests = capture.root / "images" / camera.name, 0, set()
    for frame in progress(frames, f"check {camera.name}"):
        image = found.attempt(f"images {camera.name}", lambda: read_rgb(capture, camera, frame))  # noqa: B023
        if image is not None:
            blank += int(image.min() == image.max())
            digests.add(hashlib.sha256(image.tobytes()).digest())
    if frames and blank == len(frames):
        found.note(
            f"blank {camera.name}",
            str(DataError.of(where, expected="pictures of someone", found="one colour in all of them")),
        )
    elif len(frames) > 2 and len(digests) == 1 and moving:
        line = DataError.of(where, expected="a film, as the meshes move", found=f"{len(frames)} times the same picture")
        found.note(f"still {camera.name}", str(line))


def _check_masks(
    folder: Path,
    camera: Camera,
    masks: Iterable[tuple[str, np.ndarray | None]],
    labelled: bool,
    report: CaptureReport,
    found: Collector,
    judge: PoseJudge,
) -> None:
    """Looks at (frame, mask) of one camera: labels 0..3 and 255, or mattes of the person."""
    sampled, empty, labels, count = set(sampled_frames(report.frames)), [], set(), 0
    for frame, mask in masks:
        assert mask is not None
        person = mask if labelled else (mask > MATTE_THRESHOLD).astype(np.uint8)
        count += 1
        if not parts_in(person).any():
            empty.append(frame)
        if labelled:
            labels |= set(np.unique(mask).tolist())
        if frame in sampled:
            judge.add(camera.name, frame, person, labelled=labelled)
    if count and len(empty) == count:
        line = DataError.of(
            folder, expected="labelled pixels in a frame at least", found=f"none in {count}",
            fix="mend the masks, or leave this camera out of cameras.json",
        )  # fmt: skip
        found.note(f"nothing {camera.name}", str(line))
    elif empty:
        more = f" (and {len(empty) - 1} more frames)" if len(empty) > 1 else ""
        report.notes.append(f"{folder / empty[0]}: the mask shows nobody{more}")
    report.labels |= labels
    for value in sorted(labels - {0, UNSEEN}):
        part = PARTS[value - 1]
        if report.topology and part not in report.topology:
            where = report.capture.root / "meshes" / "topology.npz" if report.capture else folder
            line = DataError.of(where, f"{part}_faces", expected=f"a mesh for label {value} of the masks", found="none")
            found.note(f"label {value}", str(line))


def _check_hidden(masks: Path, report: CaptureReport, found: Collector) -> None:
    """Refuses masks whose 255 seems to be meant for a part: one with a mesh and without its label in any mask."""
    for part in report.topology:
        label = PARTS.index(part) + 1
        if label not in report.labels:
            expected, fix = f"label {label} in a mask, as it has a mesh", f"store {label} where the part is seen"
            line = DataError.of(masks, part, expected=expected, found="none, and 255 (something in front)", fix=fix)
            found.note(f"hidden {part}", str(line))


def _check_poses(root: Path, judge: PoseJudge, report: CaptureReport, found: Collector) -> None:
    path = root / "cameras.json"
    lines = judge.defects(path)
    report.overlap, report.astray = judge.overlaps(), judge.misfits()
    for line in lines:
        found.note("poses", line)
    for name, astray in report.astray.items() if not lines else ():
        if astray > _MUCH_ASTRAY:
            report.notes.append(
                f"{path}: camera {name}: {astray:.0%} of the meshes' pixels are off their part of the masks"
            )


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
