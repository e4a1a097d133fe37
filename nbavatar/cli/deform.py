"""Contact deformation: where a hand presses, the head gives way; nothing is left inside anything.

Reads a mesh sequence (.npz) whose head is not deformed by contact (of `nbavatar fit` or `tracks`):

  head.verts, <hand>.verts   float32 [N, V, 3] [m]
  stiffness.head             float [V] [N/m^3], optional: stiffness of the tissue under each vertex; without it a
                             heuristic is used (distance to a skull proxy, last row of the picture), which assumes that
                             the rest pose has y up and z out of the face
  segments                   int [R, 2], optional: uncut runs of frames; nothing is carried over a cut
  contact.*, deformation.head  optional: the dataset's own, the reference of --validate; a capture's head_final likewise

Writes a mesh sequence: head.verts deformed, hands with a small rigid correction, and

  head_rigid                 float32 [N, V, 3] [m]  the head that came in
  contact.<part>             bool [N, V]            nearer to the other part than the touch distance
  correction.<hand>          float64 [N, 6]         translation [m] and rotation vector [rad] about the hand's centroid
  residual.depth_before, residual.depth_after       [N] [m] deepest vertex or edge of either part inside the other
  residual.exceeded          bool [N]               the motion needed is over a bound, or a depth over 2 x tolerance
                                                    is left
  residual.finite            bool [N]               False: the frame holds NaN and is passed on as it is
  residual.steps, residual.active                   [N] steps taken, head vertices simulated (0 = nothing to do)
  stiffness.head             float64 [V] [N/m^3]    what was used
  reference.contact.*, reference.deformation.head   what came in under these names

Frames without contact keep every bit. --exr writes float32 images for exchange: column = vertex, row = frame.
Finished pieces are kept beside the output (OUT.state/) until it is complete: the same command continues there.
"""

import argparse
import hashlib
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from nbavatar.cli.common import add_cfg_argument, progress, stage_config
from nbavatar.config.core import to_mapping
from nbavatar.config.geometry import DeformConfig
from nbavatar.data.sequences import PARTS, MeshSequence, Part, read_sequence, write_sequence
from nbavatar.errors import ConfigError, DataError
from nbavatar.io.arrays import read_arrays, write_arrays
from nbavatar.io.atomic import atomic_write
from nbavatar.io.exr import write_vertex_maps
from nbavatar.io.images import encode_png
from nbavatar.mesh.bvh import DeformingMesh
from nbavatar.mesh.topology import validate_mesh
from nbavatar.physics.contact import ContactNumbers, ContactSolver
from nbavatar.physics.pictures import contact_picture
from nbavatar.physics.sequence import SequenceSolver, enclosed_volume, pack, uncut_runs, unpack
from nbavatar.physics.tissue import bed_stiffness, soft_surface, tissue_thickness
from nbavatar.physics.validation import compare_deformation, compare_labels, head_distances, plausibility, vertex_areas
from nbavatar.provenance import code_digest, file_digest, run_record

__all__ = ["add_arguments", "main"]

# Frames in a stored piece.
_PIECE = 64
# Where a reference brings no contact labels, vertices that it moves farther than this count as touched [m].
_DENTED = 5e-4


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options."""
    parser.add_argument("--meshes", required=True, metavar="NPZ", help="mesh sequence of `nbavatar fit` or `tracks`")
    parser.add_argument("--out", required=True, metavar="NPZ", help="mesh sequence to write")
    parser.add_argument("--exr", metavar="ZIP", help="also write float images of positions and displacements")
    parser.add_argument(
        "--validate",
        nargs="?",
        const="",
        metavar="PNG",
        help="measure the result (against the reference where there is one), print the figures, keep them in the "
        "record, and draw the deepest frame from three sides (default OUT with .png)",
    )
    parser.add_argument(
        "--table", metavar="CSV", help="also write the figures of --validate: columns group, quantity, value"
    )
    add_cfg_argument(parser, DeformConfig)


def main(args: argparse.Namespace) -> None:
    """Writes the deformed sequence."""
    cfg = stage_config(args, DeformConfig)
    sequence, _ = read_sequence(args.meshes)
    for name, part in sequence.parts.items():
        validate_mesh(part.rest, part.faces, f"{args.meshes}: {name}.rest")
    hands = [name for name in sequence.parts if name in PARTS[1:]]
    record = run_record("deform", config=to_mapping(cfg), inputs={"meshes": args.meshes})
    state = None
    if "head" in sequence.parts and hands and sequence.frames:
        bed, record["stiffness"] = _bed(sequence, cfg, args.meshes)
        state = Path(f"{args.out}.state") / _key(args.meshes, cfg)
        arrays = _solve(sequence, hands, bed, cfg, state)
        result = _assemble(sequence, hands, arrays, bed)
        record["frames"] = _summary(sequence.frames, arrays)
    else:
        result = sequence
        if "head" in sequence.parts:
            head = sequence.parts["head"].verts
            result = MeshSequence(sequence.frames, sequence.parts, {**sequence.extras, "head_rigid": head})
    if args.validate is not None and state is not None:
        record["validation"] = _validate(sequence, result, hands)
        picture = args.validate or str(Path(args.out).with_suffix(".png"))
        with atomic_write(picture) as temporary:
            temporary.write_bytes(encode_png(_picture(result, hands, cfg.picture_size), level=6))
    elif args.validate:
        with atomic_write(args.validate) as temporary:
            temporary.write_bytes(encode_png(np.full((64, 64, 3), 255, np.uint8)))
    if args.table:
        with atomic_write(args.table) as temporary:
            temporary.write_text(_table({key: record.get(key, {}) for key in ("frames", "validation")}))
    if args.exr:
        maps = {}
        if "head_rigid" in result.extras:
            head = result.parts["head"].verts
            maps = {"head.position": head, "head.displacement": head - result.extras["head_rigid"]}
        write_vertex_maps(args.exr, maps, result.frames, record)
    write_sequence(args.out, result, record)
    if state is not None:
        shutil.rmtree(state.parent, ignore_errors=True)
    print(json.dumps({key: record[key] for key in ("stiffness", "frames", "validation") if key in record}, indent=1))


def _key(meshes: str, cfg: DeformConfig) -> str:
    """Digest of everything a stored piece depends on."""
    numbers = json.dumps(to_mapping(cfg), sort_keys=True)
    return hashlib.sha256(f"{file_digest(meshes)} {code_digest('deform')} {numbers}".encode()).hexdigest()[:16]


def _bed(sequence: MeshSequence, cfg: DeformConfig, where: str) -> tuple[np.ndarray, str]:
    """Stiffness under each head vertex [N/m^3], and where it comes from."""
    head = sequence.parts["head"]
    given = sequence.extras.get("stiffness.head")
    if cfg.stiffness == "data" and given is None:
        raise ConfigError.of(
            "--cfg.stiffness",
            expected=f"an array stiffness.head in {where}",
            found="none",
            fix="use anatomical or uniform",
        )
    if given is not None and cfg.stiffness in ("auto", "data"):
        if given.shape != (len(head.rest),) or not np.isfinite(given).all() or (given < 0).any():
            expected = f"{len(head.rest)} finite numbers, none negative [N/m^3]"
            raise DataError.of(where, "stiffness.head", expected=expected, found=f"{given.dtype} {list(given.shape)}")
        return given.astype(np.float64), "data"
    if cfg.stiffness == "uniform":
        thickness = np.full(len(head.rest), cfg.uniform_thickness)
        return bed_stiffness(thickness, cfg.modulus), "uniform"
    return bed_stiffness(tissue_thickness(head.rest, head.faces), cfg.modulus), "anatomical"


def _solver(sequence: MeshSequence, hands: list[str], bed: np.ndarray, cfg: DeformConfig) -> ContactSolver:
    head = sequence.parts["head"]
    rest = head.rest.astype(np.float64)
    numbers = ContactNumbers(**cfg.contact_numbers())
    parts = [(sequence.parts[name].rest.astype(np.float64), sequence.parts[name].faces) for name in hands]
    return ContactSolver(soft_surface(rest, head.faces, bed), rest, parts, numbers)


def _solve(
    sequence: MeshSequence, hands: list[str], bed: np.ndarray, cfg: DeformConfig, state: Path
) -> dict[str, np.ndarray]:
    """All frames as named arrays; finished pieces are read from `state` and written there."""
    head = sequence.parts["head"].verts
    verts = [sequence.parts[name].verts for name in hands]
    count = len(head)
    solver = SequenceSolver(_solver(sequence, hands, bed, cfg), uncut_runs(sequence.extras.get("segments"), count))
    pieces = []
    bar = progress(_ticks(count), "deform", count)
    ticks = iter(bar)
    for first in range(0, count, _PIECE):
        last = min(first + _PIECE, count) - 1
        file = state / f"{first:06d}.npz"
        if file.is_file():
            piece, _ = read_arrays(file)
            solver.resume(unpack(piece, -1), head[last], [hand[last] for hand in verts])
            for _ in range(first, last + 1):
                next(ticks)
        else:
            records = []
            for frame in solver.frames(head, verts, first, last):
                records.append(frame)
                next(ticks)
            piece = pack(records)
            write_arrays(file, piece, {})
        pieces.append(piece)
    next(ticks, None)
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}


def _ticks(count: int) -> Iterator[int]:
    yield from range(count)


def _assemble(sequence: MeshSequence, hands: list[str], arrays: dict[str, np.ndarray], bed: np.ndarray) -> MeshSequence:
    head = sequence.parts["head"]
    parts = {**sequence.parts, "head": Part(head.faces, head.rest, arrays["head"])}
    moved = ("contact.", "deformation.")
    extras = {f"reference.{k}" if k.startswith(moved) else k: v for k, v in sequence.extras.items()}
    extras |= {"head_rigid": head.verts, "contact.head": arrays["contact.head"], "stiffness.head": bed}
    for k, name in enumerate(hands):
        parts[name] = Part(sequence.parts[name].faces, sequence.parts[name].rest, arrays[f"hand.{k}"])
        extras[f"contact.{name}"] = arrays[f"contact.hand.{k}"]
        extras[f"correction.{name}"] = arrays["pose"][:, k]
    extras |= {"residual.depth_before": arrays["depth"][:, 0], "residual.depth_after": arrays["depth"][:, 1]}
    extras |= {f"residual.{name}": arrays[name] for name in ("exceeded", "finite", "steps", "active")}
    ordered = {name: parts[name] for name in sequence.parts}
    return MeshSequence(sequence.frames, ordered, extras)


def _summary(frames: list[str], arrays: dict[str, np.ndarray]) -> dict[str, object]:
    """What a person wants to know about the run."""
    solved = arrays["active"] > 0
    vertices = arrays["head"].shape[1]
    return {
        "total": len(frames),
        "simulated": int(solved.sum()),
        "simulated_share_of_vertex_frames": float(arrays["active"].sum() / max(vertices * len(frames), 1)),
        "max_depth_before_mm": float(arrays["depth"][:, 0].max() * 1e3),
        "max_depth_after_mm": float(arrays["depth"][:, 1].max() * 1e3),
        "over_a_bound": [frames[i] for i in np.flatnonzero(arrays["exceeded"])],
        "not_finite": [frames[i] for i in np.flatnonzero(~arrays["finite"])],
    }


def _validate(sequence: MeshSequence, result: MeshSequence, hands: list[str]) -> dict[str, object]:
    """Figures over the simulated frames: before and after by themselves, and over all frames against the reference."""
    head, rigid = result.parts["head"], result.extras["head_rigid"]
    mesh = DeformingMesh(head.rest, head.faces)
    others = [DeformingMesh(result.parts[name].rest, result.parts[name].faces) for name in hands]
    figures: dict[str, object] = {}
    simulated = np.flatnonzero(result.extras["residual.active"] > 0)
    for name, hand in zip(hands, others, strict=True):
        part, tracked = result.parts[name], sequence.parts[name].verts
        areas = (vertex_areas(head.rest, head.faces), vertex_areas(part.rest, part.faces))
        figures[f"{name}.before"] = plausibility(mesh, hand, areas, rigid[simulated], tracked[simulated])
        figures[f"{name}.after"] = plausibility(mesh, hand, areas, head.verts[simulated], part.verts[simulated])
    change = [enclosed_volume(mesh, head.verts[i]) / enclosed_volume(mesh, rigid[i]) - 1.0 for i in simulated]
    figures["volume_change_percent"] = {
        "worst": float(100 * max(change, key=abs, default=0.0)),
        "mean": float(100 * np.mean(change)) if change else 0.0,
    }
    reference = result.extras.get("reference.deformation.head")
    if reference is None and "head_final" in result.extras:
        # A capture that brings heads before and after contact: of any method, so long as it is another than this one.
        reference = result.extras["head_final"] - rigid
        reference = reference if reference.any() else None
    if reference is not None:
        kept = np.flatnonzero(result.extras["residual.finite"])
        labels = np.asarray(result.extras.get("reference.contact.head", np.linalg.norm(reference, axis=-1) > _DENTED))
        labels = labels.astype(bool)[kept]
        dent, touching = (head.verts - rigid)[kept], result.extras["contact.head"][kept]
        agreement = compare_deformation(dent, reference[kept], touching, labels)
        figures["reference"] = {key: value if np.isfinite(value) else None for key, value in agreement.items()}
        distance = head_distances(mesh, others, head.verts[kept], [result.parts[name].verts[kept] for name in hands])
        figures["reference_labels"] = compare_labels(distance, labels)
    return figures


def _table(figures: dict[str, Any]) -> str:
    """Figures as CSV: nested names joined by full stops, the last one as the quantity; empty where there is none."""
    rows = ["group,quantity,value"]

    def add(group: str, entry: dict[str, Any]) -> None:
        for name, value in entry.items():
            if isinstance(value, dict):
                add(f"{group}.{name}" if group else name, value)
            elif isinstance(value, list):
                rows.append(f"{group},{name},{' '.join(map(str, value))}")
            else:
                rows.append(f"{group},{name},{'' if value is None else value}")

    add("", figures)
    return "\n".join(rows) + "\n"


def _picture(result: MeshSequence, hands: list[str], size: int) -> np.ndarray:
    depth = result.extras["residual.depth_before"]
    frame = int(np.argmax(depth * result.extras["residual.finite"]))
    head = result.parts["head"]
    return contact_picture(
        head.rest,
        head.faces,
        result.extras["head_rigid"][frame],
        head.verts[frame],
        [(result.parts[name].verts[frame], result.parts[name].faces) for name in hands],
        result.extras["stiffness.head"],
        size,
    )
