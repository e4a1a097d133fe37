"""Drive one subject by another's poses: a mesh sequence that `nbavatar render`, `deform` and `video` take.

    --source  mesh sequence (.npz) of the subject whose shape is wanted (of `nbavatar fit`, `tracks` or `deform`)
    --target  mesh sequence of the subject whose poses are wanted; its parts need the faces of the source's
    --assets  folder of the body models: with it, and parameters in both files, shape and pose are exchanged as FLAME
              and MANO parameters; otherwise poses are carried over by deformation transfer
    --place   source: the motion is moved, by one translation, to where the source's head is on average (its cameras
              see it); target: it stays where it is [m]
    --out     mesh sequence (.npz): the target's frames, the source's rest shapes and cameras

A shell (`nbavatar shell`) rides on the head in its new poses. Hands are shifted so that they touch the source's head
where they touched the target's (see --free-hands). Contact that is deeper than the skin is the work of `nbavatar
deform --meshes OUT`. Frames of the result are nobody's training frames: no refinement of training frames is applied
to them. Directions are those of the target's world, and avatars of captures have learnt how light falls in their own:
both should have the same axis up.
"""

import argparse
from dataclasses import replace
from pathlib import Path

from nbavatar.data.decaf_files import Assets
from nbavatar.data.sequences import SHELL, MeshSequence, read_sequence, write_sequence
from nbavatar.errors import DataError
from nbavatar.provenance import run_record

__all__ = ["add_arguments", "main"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options of `nbavatar reenact`."""
    parser.add_argument("--source", required=True, metavar="NPZ", help="meshes of the subject that is shown")
    parser.add_argument("--target", required=True, metavar="NPZ", help="meshes of the subject that drives")
    parser.add_argument("--assets", metavar="DIR", help="folder of the body models")
    parser.add_argument(
        "--by", default="auto", choices=("auto", "parameters", "meshes"), help="how poses are carried over"
    )
    parser.add_argument("--place", default="source", choices=("source", "target"), help="where the motion happens")
    parser.add_argument("--free-hands", action="store_true", help="do not shift hands to keep their contact")
    parser.add_argument("--out", required=True, metavar="NPZ", help="mesh sequence to write")


def main(args: argparse.Namespace) -> int:
    """Runs `nbavatar reenact`."""
    from nbavatar.evaluation.reenact import check_topology, drive, has_parameters
    from nbavatar.fitting.shell import carried

    source, _ = read_sequence(args.source)
    target, _ = read_sequence(args.target)
    parts = check_topology(source, target, args.source, args.target)
    known = has_parameters(source, parts) and has_parameters(target, parts)
    if args.by == "parameters" and not (known and args.assets):
        missing = "--assets" if known else f"param.* of {', '.join(parts)}"
        raise DataError.of("--by parameters", expected="parameters in both files and --assets", found=f"no {missing}")
    by_parameters = args.by == "parameters" or (args.by == "auto" and known and args.assets is not None)
    bodies, files = _bodies(Assets(Path(args.assets or "")), parts, source) if by_parameters else (None, {})
    driven = drive(source, target, parts, bodies=bodies, place=args.place, keep_contact=not args.free_hands)
    if SHELL in source.parts and "head" in driven.parts:
        shell = carried(source.parts[SHELL], source.parts["head"], driven.parts["head"].verts)
        driven = replace(driven, parts={**driven.parts, SHELL: shell})
    how = "parameters" if by_parameters else "deformation transfer"
    config = {"by": how, "place": args.place, "keep_contact": not args.free_hands}
    inputs = {"source": args.source, "target": args.target, **files}
    extra = {"source": Path(args.source).stem, "target": Path(args.target).stem}
    write_sequence(args.out, driven, run_record("reenact", config=config, inputs=inputs, extra=extra))
    print(f"{args.out}: {len(driven.frames)} frames of {extra['target']} on {extra['source']}, by {how}")
    return 0


def _bodies(assets: Assets, parts: list[str], source: MeshSequence) -> tuple[dict, dict[str, Path]]:
    """Body model of every part, and the files they came from."""
    import torch

    from nbavatar.bodymodels.files import read_flame, read_mano
    from nbavatar.bodymodels.flame import Flame
    from nbavatar.bodymodels.mano import Mano, mirror_model

    bodies, files = {}, {}
    for part in parts:
        if part == "head":
            files["flame"] = assets.flame
            counts = {f"{key}_count": source.extras[f"param.head.{key}"].shape[1] for key in ("shape", "expression")}
            body = Flame.build(read_flame(files["flame"]), dtype=torch.float64, **counts)
        else:
            side = part.partition("_")[0]
            other = {"left": "right", "right": "left"}[side]
            own, mirrored = map(assets.mano, (side, other))
            path = own if own.is_file() else mirrored
            files[f"mano_{path.stem.rpartition('_')[2].lower()}"] = path
            arrays = read_mano(path)
            body = Mano.build(arrays if path == own else mirror_model(arrays), side, dtype=torch.float64)
        if body.faces.shape != source.parts[part].faces.shape:
            raise DataError.of(
                assets.folder, part, expected=f"a model of {len(source.parts[part].faces)} faces", found=len(body.faces)
            )
        bodies[part] = body
    return bodies, files
