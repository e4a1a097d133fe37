"""What the head's mesh lacks and the masks show (hair), carved from the training masks and added as a part of its own.

Reads
  --meshes   mesh sequence (.npz, `nbavatar align` or `tracks`)
  --masks    frame packs (.zip, `nbavatar masks`) of the training cameras, layers label and alpha, as recorded; only
             frames of the split `train` are looked at
and writes
  --out      the mesh sequence, with the part `shell` where something reaches beyond the head's mesh: faces, positions
             in the head's rest frame [m], and in the world in every frame in which the head is [m]. Without, the
             sequence is as it came. The record says which, and why.
  --picture  the head with the shell from four sides

All that is found is relative to the head's size; nothing depends on the unit of length. The head's pixels behind
another part or anything else, and what lies outside an image, are no evidence.
"""

import argparse
import contextlib
from pathlib import Path

import numpy as np

from nbavatar.cli.common import add_cfg_argument, stage_config
from nbavatar.config.core import to_mapping
from nbavatar.config.geometry import ShellConfig
from nbavatar.data.sequences import PARTS, SHELL, MeshSequence, Part, read_sequence, write_sequence
from nbavatar.errors import DataError
from nbavatar.fitting.evidence import Lens, evidence_of
from nbavatar.fitting.hull import Silhouette
from nbavatar.fitting.shell import Rest, Shell, carve_shell, rest_of, ride
from nbavatar.fitting.shell_picture import shell_picture
from nbavatar.io.atomic import atomic_write
from nbavatar.io.framepack import FramePack
from nbavatar.io.images import encode_png
from nbavatar.preprocess.sources import camera_of
from nbavatar.provenance import run_record

__all__ = ["add_arguments", "main"]

_HEAD = PARTS[0]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options."""
    parser.add_argument("--meshes", required=True, metavar="NPZ", help="mesh sequence of `nbavatar align` or `tracks`")
    parser.add_argument("--masks", nargs="+", required=True, metavar="ZIP", help="masks of the training cameras")
    parser.add_argument("--out", required=True, metavar="NPZ", help="mesh sequence to write")
    parser.add_argument("--picture", metavar="PNG", help="also draw head and shell")
    add_cfg_argument(parser, ShellConfig)


def main(args: argparse.Namespace) -> None:
    """Carves, adds and writes."""
    cfg = stage_config(args, ShellConfig)
    sequence, _ = read_sequence(args.meshes)
    if SHELL in sequence.parts:
        raise DataError.of(args.meshes, SHELL, expected="meshes without a shell", found="one already")
    shell, rest = Shell(np.zeros((0, 3)), np.zeros((0, 3), np.int64), {"absent": "there is no head"}), None
    if _HEAD in sequence.parts and cfg.reach > 0:
        with contextlib.ExitStack() as stack:
            packs = [stack.enter_context(FramePack(path)) for path in args.masks]
            shell, rest = _carved(sequence, packs, cfg)
    elif cfg.reach <= 0:
        shell.said["absent"] = "reach is 0"
    result = sequence
    if len(shell.faces):
        head = sequence.parts[_HEAD]
        assert rest is not None
        part = Part(shell.faces, shell.verts.astype(np.float32), ride(shell, rest, head.verts))
        result = MeshSequence(sequence.frames, {**sequence.parts, SHELL: part}, sequence.extras)
    inputs = {"meshes": args.meshes} | {f"masks.{i}": path for i, path in enumerate(args.masks)}
    record = run_record("shell", config=to_mapping(cfg), inputs=inputs, extra={"shell": shell.said})
    write_sequence(args.out, result, record)
    if args.picture:
        head = sequence.parts.get(_HEAD)
        base = (np.zeros((0, 3)), np.zeros((0, 3), np.int64)) if head is None else (head.rest, head.faces)
        with atomic_write(args.picture) as temporary:
            Path(temporary).write_bytes(encode_png(shell_picture(*base, shell, cfg.picture_size), level=6))
    if "absent" in shell.said:
        print(f"no shell: {shell.said['absent']}")
    else:
        mean, most = shell.said["height_mm"]
        print(f"shell of {len(shell.faces)} faces, {mean:.1f} mm off the mesh in the mean and up to {most:.1f} mm")


def _carved(sequence: MeshSequence, packs: list[FramePack], cfg: ShellConfig) -> tuple[Shell, Rest]:
    """The shell, and the head's motion."""
    head = sequence.parts[_HEAD]
    there = np.isfinite(head.verts).all((1, 2))
    views: list[tuple[int, int]] = []
    cameras = []
    for index, pack in enumerate(packs):
        cameras.append(camera_of(pack))
        rows = [row for row in sequence.index(pack.split("train")) if there[row]]
        share = max(1, cfg.views // len(packs))
        few = np.unique(np.linspace(0, len(rows) - 1, min(share, len(rows))).round().astype(int)) if rows else []
        views += [(index, rows[i]) for i in few]
    rows = sorted({row for _, row in views})
    verts = sequence.extras.get("head_rigid", head.verts)
    rest = rest_of(head.rest, head.faces, verts, rows)
    lenses = [Lens(camera, cfg.lines) for camera in cameras]

    def view(i: int) -> Silhouette:
        index, row = views[i]
        pack, frame = packs[index], sequence.frames[row]
        there = {
            name: (part.verts[row].astype(np.float64), part.faces)
            for name, part in sequence.parts.items()
            if np.isfinite(part.verts[row]).all()
        }
        pose = cameras[index].cam_from_world
        evidence = evidence_of(
            pack.read("label", frame), pack.read("alpha", frame), PARTS.index(_HEAD) + 1, lenses[index], pose, there,
            _HEAD, cfg.reach * rest.radius,
        )  # fmt: skip
        world_from_rest = np.eye(4)
        world_from_rest[:3, :3], world_from_rest[:3, 3] = rest.rotation[row], rest.shift[row]
        return Silhouette(evidence, lenses[index].K, pose @ world_from_rest)

    # The shoulders of a whole person are no hair.
    whole = any(pack.manifest.get("keep") == "person" for pack in packs)
    shell = carve_shell(rest, head.faces, [row for _, row in views], view, cfg, above_neck=whole)
    if len(shell.faces):  # the skin's own motion, contact too
        rest = rest._replace(verts=rest_of(head.rest, head.faces, head.verts, rows).verts)
    return shell, rest
