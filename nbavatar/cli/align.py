"""Alignment of a capture's meshes to its pictures: takes a tracker's jitter out, frame by frame.

Reads
  --meshes   mesh sequence (.npz, `nbavatar tracks`) with camera.<camera>.{K, cam_from_world, distortion, size}
  --frames   frame packs (.zip, `nbavatar ingest`) of the cameras to use, layer rgb, as recorded; a camera held out for
             evaluation is left out here and so never looked at
  --masks    frame packs (.zip, `nbavatar masks`) of the same cameras, layers label and alpha, as recorded: with the
             option `modes`, outlines draw the meshes too
and writes
  --out      the mesh sequence with every part moved as a whole in every frame, and its extras head_rigid and head_final
             with the head; new extras align.<part> float32 [N, 6] (rotation vector about the part's mean [rad],
             shift [m]), zero where nothing was done; what bends a part is in its vertices only

With {"modes": 12} parts are bent too, by smooth functions on their surface, to where colours and the outlines of the
masks agree: the error of a fit that no motion as a whole takes out. Errors that all frames share are seen by outlines
of bare skin only; without masks, and without `modes`, they stay. Where an outline lies more than 2 mm outside a vertex
in most views, hair or cloth lies there, whose thickness is taken off. With {"frames": "train"} frames held out for
self-reenactment keep the meshes they came with.

A part has to keep its colours while it moves a little, and to be seen in two frames or more.
"""

import argparse
import contextlib
from collections.abc import Callable
from typing import Any

import numpy as np

from nbavatar.camera.distortion import checked_coefficients
from nbavatar.camera.pinhole import Camera, project
from nbavatar.cli.common import add_cfg_argument, progress, stage_config
from nbavatar.config.core import to_mapping
from nbavatar.config.geometry import AlignConfig
from nbavatar.data.sequences import PARTS, MeshSequence, Part, read_sequence, write_sequence
from nbavatar.errors import ConfigError, DataError
from nbavatar.fitting.align import Motion, align_block, blocks, moved, summary
from nbavatar.fitting.bend import bend_block, smooth_basis
from nbavatar.io.framepack import FramePack
from nbavatar.provenance import run_record

__all__ = ["add_arguments", "main"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options."""
    parser.add_argument("--meshes", required=True, metavar="NPZ", help="mesh sequence of `nbavatar tracks`")
    parser.add_argument("--frames", nargs="+", required=True, metavar="ZIP", help="frame packs of the cameras to use")
    parser.add_argument("--masks", nargs="*", default=[], metavar="ZIP", help="masks of the same cameras, for `modes`")
    parser.add_argument("--out", required=True, metavar="NPZ", help="aligned mesh sequence to write")
    add_cfg_argument(parser, AlignConfig)


def main(args: argparse.Namespace) -> None:
    """Aligns and writes."""
    cfg = stage_config(args, AlignConfig)
    sequence, _ = read_sequence(args.meshes)
    count = len(sequence.frames)
    found = {part: np.zeros((count, 6)) for part in sequence.parts}
    motions: dict[str, list[Motion]] = {part: [] for part in sequence.parts}
    with contextlib.ExitStack() as stack:
        packs = {str(p.manifest["camera"]): p for p in (stack.enter_context(FramePack(path)) for path in args.frames)}
        cameras = [_camera(name, pack, sequence, args.meshes) for name, pack in packs.items()]
        cuts = np.asarray(sequence.extras.get("segments", [[0, count - 1]])).reshape(-1, 2)
        segments = [(int(first), int(last)) for first, last in cuts]
        pieces = blocks(_rows(sequence, cfg), segments, cfg.block) if cfg.iterations > 0 else []
        for rows in progress(pieces, "align", len(pieces)):
            read = _reader(packs, "rgb", [sequence.frames[row] for row in rows])
            verts = {part: np.asarray(mesh.verts[rows]) for part, mesh in sequence.parts.items()}
            faces = {part: mesh.faces for part, mesh in sequence.parts.items()}
            for part, motion in align_block(verts, faces, cameras, read, cfg).items():
                found[part][rows] = np.concatenate([motion.turn, motion.shift], axis=1)
                motions[part].append(motion)
        compared = {part: any(np.isfinite(motion.before) for motion in done) for part, done in motions.items() if done}
        if compared and not any(compared.values()):
            raise _nothing_to_compare(args.meshes, sequence, cameras)
        for part in (part for part, seen in compared.items() if not seen):
            print(
                f"{part}: no vertex is seen in two frames or more: there is nothing to compare, and it stays as it came"
            )
        report = {part: summary(done) for part, done in motions.items() if done}
        for part, said in report.items():
            shift, turn = said["shift_mm"], said["turn_deg"]
            print(
                f"{part}: moved {shift[0]:.2f} mm (up to {shift[1]:.2f}), turned {turn[0]:.2f} degrees "
                f"(up to {turn[1]:.2f})"
            )
        aligned = _moved_sequence(sequence, found)
        if cfg.modes > 0 and pieces:
            masks = {
                str(p.manifest["camera"]): p for p in (stack.enter_context(FramePack(path)) for path in args.masks)
            }
            if args.masks and set(masks) != set(packs):
                raise ConfigError.of("--masks", expected=f"masks of {', '.join(packs)}", found=", ".join(masks))
            aligned, bent = _bent_sequence(aligned, pieces, cameras, packs, masks, cfg)
            for part, (typical, most) in bent.items():
                report.setdefault(part, {})["bend_mm"] = [typical, most]
                print(f"{part}: bent by {typical:.2f} mm (up to {most:.2f})")
    inputs = {"meshes": args.meshes} | {f"frames.{i}": path for i, path in enumerate(args.frames)}
    inputs |= {f"masks.{i}": path for i, path in enumerate(args.masks)}
    record = run_record("align", config=to_mapping(cfg), inputs=inputs, extra={"align": report})
    write_sequence(args.out, aligned, record)


def _bent_sequence(
    sequence: MeshSequence, pieces: list[list[int]], cameras: list[Camera], packs: dict[str, FramePack],
    masks: dict[str, FramePack], cfg: AlignConfig,
) -> tuple[MeshSequence, dict[str, tuple[float, float]]]:  # fmt: skip
    """The sequence with its parts bent, and by how much each was: typical and largest distance [mm]."""
    parts = {name: part for name, part in sequence.parts.items() if name in PARTS}
    basis = {name: smooth_basis(part.rest, part.faces, cfg.modes) for name, part in parts.items()}
    verts = {name: np.array(part.verts) for name, part in parts.items()}
    labels = {name: PARTS.index(name) + 1 for name in parts}
    faces, rest = {n: p.faces for n, p in parts.items()}, {n: p.rest for n, p in parts.items()}
    for rows in progress(pieces, "bend", len(pieces)):
        names = [sequence.frames[row] for row in rows]
        read, label, alpha = (_reader(*of, names) for of in ((packs, "rgb"), (masks, "label"), (masks, "alpha")))

        def mask(camera: str, i: int, label: Any = label, alpha: Any = alpha) -> tuple[np.ndarray, np.ndarray] | None:
            shown, covered = label(camera, i), alpha(camera, i)
            return None if shown is None or covered is None else (shown, covered)

        block = {name: values[rows] for name, values in verts.items()}
        for name, values in bend_block(block, faces, rest, basis, labels, cameras, read, mask, cfg).items():
            verts[name][rows] = values
    extras = dict(sequence.extras)
    bent: dict[str, tuple[float, float]] = {}
    result = dict(sequence.parts)
    for name, part in parts.items():
        change = verts[name].astype(np.float64) - part.verts
        far = 1e3 * np.linalg.norm(change[np.isfinite(change).all((1, 2))], axis=-1)
        bent[name] = (round(float(np.median(far)), 4), round(float(far.max()), 4)) if far.size else (0.0, 0.0)
        result[name] = Part(part.faces, part.rest, verts[name])
        if name == "head":
            for key in ("head_rigid", "head_final"):
                if key in extras:
                    extras[key] = (np.asarray(extras[key]) + change).astype(np.float32)
    return MeshSequence(sequence.frames, result, extras), bent


def _reader(packs: dict[str, FramePack], layer: str, names: list[str]) -> Callable[[str, int], np.ndarray | None]:
    """Reads a layer of a camera (its name) in one of the frames `names` (its position); None where there is none."""
    known = {camera: set(pack.frames) for camera, pack in packs.items()}

    def read(camera: str, i: int) -> np.ndarray | None:
        return packs[camera].read(layer, names[i]) if names[i] in known.get(camera, ()) else None

    return read


def _rows(sequence: MeshSequence, cfg: AlignConfig) -> list[int]:
    """Frames to align."""
    if cfg.frames == "all":
        return list(range(len(sequence.frames)))
    if "split" not in sequence.extras:
        raise DataError.of("meshes", "split", expected="which frames are trained on", found="nothing")
    return np.flatnonzero(np.asarray(sequence.extras["split"]).astype(str) == "train").tolist()


def _nothing_to_compare(meshes: str, sequence: MeshSequence, cameras: list[Camera]) -> DataError:
    """Why no vertex of any part could be followed from one frame to another."""
    if _in_view(sequence, cameras):
        expected = "a vertex that one camera sees in two frames or more of an uncut run"
    else:
        expected = f"vertices that project into the images of {', '.join(camera.name for camera in cameras)}"
    fix = (
        'see `nbavatar check`; where it is meant, the option {"iterations": 0} of `align` leaves the meshes as they are'
    )
    return DataError.of(meshes, expected=expected, found="none", fix=fix)


def _in_view(sequence: MeshSequence, cameras: list[Camera]) -> bool:
    """Whether some vertex of some frame projects into the image of a camera, its lens aside."""
    for camera in cameras:
        for part in sequence.parts.values():
            points = np.asarray(part.verts, np.float64).reshape(-1, 3)
            pixels, depth = project(points[np.isfinite(points).all(1)], camera.K, camera.cam_from_world)
            inside = (pixels >= 0).all(1) & (pixels < [camera.width, camera.height]).all(1)
            if (inside & (depth > 0)).any():
                return True
    return False


def _camera(name: str, pack: FramePack, sequence: MeshSequence, meshes: str) -> Camera:
    """A camera as the meshes' file describes it."""
    extras = sequence.extras
    if f"camera.{name}.K" not in extras:
        known = sorted(key.split(".")[1] for key in extras if key.startswith("camera.") and key.endswith(".K"))
        raise DataError.of(meshes, f"camera.{name}", expected=f"camera {name} of {pack.path}", found=", ".join(known))
    given = extras.get(f"camera.{name}.distortion")
    distortion = None if given is None or not np.any(given) else checked_coefficients(given, f"{meshes}: {name}")
    K, pose = (np.asarray(extras[f"camera.{name}.{key}"], np.float64) for key in ("K", "cam_from_world"))
    return Camera(name, int(pack.manifest["width"]), int(pack.manifest["height"]), K, pose, distortion)


def _moved_sequence(sequence: MeshSequence, found: dict[str, np.ndarray]) -> MeshSequence:
    """The sequence with its parts moved, and the head's other states with it."""
    parts: dict[str, Part] = {}
    extras: dict[str, Any] = dict(sequence.extras)
    for name, part in sequence.parts.items():
        motion = Motion(found[name][:, :3], found[name][:, 3:], np.nan, np.nan)
        centre = np.asarray(part.verts, np.float64).mean(1)
        still = np.logical_not(found[name].any(axis=1))

        def move(
            verts: np.ndarray, motion: Motion = motion, centre: np.ndarray = centre, still: np.ndarray = still
        ) -> np.ndarray:
            result = moved(verts, motion, centre).astype(np.float32)
            result[still] = verts[still]  # to the bit
            return result

        parts[name] = Part(part.faces, part.rest, move(part.verts))
        extras[f"align.{name}"] = found[name].astype(np.float32)
        if name == "head":
            extras |= {key: move(extras[key]) for key in ("head_rigid", "head_final") if key in extras}
    return MeshSequence(sequence.frames, parts, extras)
