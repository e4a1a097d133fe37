"""Contact physics: frames a second with and without contact, depth left, volume lost.

A head and a hand of simple shapes, of FLAME's and MANO's vertex counts by default. The fingers press the cheek 2 to
20 mm deep, slide, and let go; then they hover. --meshes takes a mesh sequence of your own instead. Frames run one
after the other in one thread, as in the pipeline.
"""

import argparse
import time

import numpy as np

from nbavatar.config.geometry import DeformConfig
from nbavatar.data.sequences import read_sequence
from nbavatar.mesh.bvh import DeformingMesh
from nbavatar.physics.contact import ContactNumbers, ContactSolver
from nbavatar.physics.sequence import SequenceSolver, enclosed_volume
from nbavatar.physics.shapes import capsule_hand, press, round_head
from nbavatar.physics.tissue import bed_stiffness, soft_surface, tissue_thickness

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options."""
    parser.add_argument("--head", type=int, default=5023, metavar="V", help="vertices of the head, about")
    parser.add_argument("--hand", type=int, default=778, metavar="V", help="vertices of the hand, about")
    parser.add_argument("--frames", type=int, default=40, help="frames with contact, and as many without")
    parser.add_argument("--meshes", metavar="NPZ", help="mesh sequence to run instead")


def run(args: argparse.Namespace) -> dict[str, float | int]:
    """Measures; the first frames compile the kernels and are not counted."""
    config = DeformConfig()
    numbers = ContactNumbers(**config.contact_numbers())
    if args.meshes:
        sequence, _ = read_sequence(args.meshes)
        names = [name for name in sequence.parts if name != "head"]
        part = sequence.parts["head"]
        rest, faces, heads = part.rest, part.faces, part.verts
        rests = [(sequence.parts[n].rest.astype(np.float64), sequence.parts[n].faces) for n in names]
        hands = [sequence.parts[n].verts for n in names]
    else:
        rest, faces = round_head(args.head)
        hand_rest, hand_faces = capsule_hand(args.hand)
        rests = [(hand_rest, hand_faces)]
        half = np.arange(args.frames) / max(args.frames - 1, 1)
        depths = 0.002 + 0.018 * np.sin(np.pi * half)
        frames = [press(hand_rest, d, 0.02 * t) for d, t in zip(depths, half, strict=True)]
        frames += [press(hand_rest, -0.004 - 0.03 * t) for t in half]
        hands = [np.stack(frames).astype(np.float32)]
        heads = np.repeat(rest[None].astype(np.float32), len(frames), axis=0)
    rest = rest.astype(np.float64)
    bed = bed_stiffness(tissue_thickness(rest, faces), config.modulus)
    contact = ContactSolver(soft_surface(rest, faces, bed), rest, rests, numbers)
    deep = (
        int(np.argmax([contact.solve(heads[i], [h[i] for h in hands]).depth[0] for i in range(0, len(heads), 5)])) * 5
    )
    contact.solve(heads[deep], [h[deep] for h in hands])
    solver = SequenceSolver(contact, [(0, len(heads) - 1)])
    mesh = DeformingMesh(rest, faces)
    seconds: dict[bool, list[float]] = {True: [], False: []}
    depth, volume = 0.0, 0.0
    for i in range(len(heads)):
        begin = time.perf_counter()
        (record,) = solver.frames(heads, hands, i, i)
        seconds[record.active > 0].append(time.perf_counter() - begin)
        depth = max(depth, record.depth[1])
        if record.active:
            change = enclosed_volume(mesh, record.head) / enclosed_volume(mesh, heads[i]) - 1.0
            volume = max(volume, change, key=abs)
    return {
        "contact_fps": len(seconds[True]) / sum(seconds[True]) if seconds[True] else 0.0,
        "free_fps": len(seconds[False]) / sum(seconds[False]) if seconds[False] else 0.0,
        "max_penetration_mm": 1e3 * depth,
        "volume_change_percent": 100.0 * volume,
        "contact_frames": len(seconds[True]),
        "free_frames": len(seconds[False]),
        "head_vertices": len(rest),
        "hand_vertices": sum(len(r) for r, _ in rests),
    }
