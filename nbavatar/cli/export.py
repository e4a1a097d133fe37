"""An avatar or its meshes in the files of other programs.

    --to splats      Gaussians as 3DGS .ply, one file a frame (every method of Gaussians)
    --to billboards  textured quads as .glb (billboards trained with deferred: false)
    --to meshes      the posed meshes, vertices in contact red: .obj, .ply or .glb, one file a frame, or one .glb
    --to tensors     every tensor of the avatar as .safetensors; docs/export.md is the schema
    --to decoder     the U-Net as .onnx: features (1, C+1, H, W) in, colour and opacity out

MODEL is a model.pt of `nbavatar train`; meshes need none. --meshes is a mesh sequence (.npz), --frames are frames of
it: ids, or first:last:step by their places (all by default). --out is a folder, which then gets one file a frame, named
by its id, or a file: with .glb the frames become an animation (morph targets; Blender and browsers play it).

Lengths are metres in the world of the capture. Last comes one line on what a standard viewer cannot show.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nbavatar.errors import ConfigError, DataError, did_you_mean

if TYPE_CHECKING:
    from nbavatar.data.sequences import MeshSequence

__all__ = ["add_arguments", "main"]

_KINDS = ("splats", "billboards", "meshes", "tensors", "decoder")
_SUFFIX = {"tensors": ".safetensors", "decoder": ".onnx"}
_LOST = {
    "splats": "splats hold the picture of these frames; that they follow the meshes stays in model.pt",
    "billboards": "viewers blend in linear light and by their own order of quads, so soft edges differ a little",
    "meshes": "meshes are what the avatar rides on, not its picture",
    "tensors": "no viewer shows tensors: pictures need nbavatar's rasterizer{decoder}",
    "decoder": "the decoder turns rasterized features into colour; rasterizing them is nbavatar's part",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options of `nbavatar export`."""
    parser.add_argument("model", nargs="?", metavar="MODEL", help="trained avatar (.pt); not needed for meshes")
    parser.add_argument("--to", required=True, choices=_KINDS, help="what to write")
    parser.add_argument("--meshes", metavar="NPZ", help="mesh sequence: for splats, billboards, meshes")
    parser.add_argument("--out", required=True, metavar="PATH", help="file or folder to write")
    parser.add_argument("--frames", nargs="+", metavar="ID", help="frame ids, or first:last:step by place")
    parser.add_argument("--type", default="glb", choices=("obj", "ply", "glb"), help="of the mesh files in a folder")
    parser.add_argument("--fps", type=float, default=25.0, help="frames a second of an animation")


def main(args: argparse.Namespace) -> int:
    """Runs `nbavatar export`."""
    _check(args)
    if args.to in _SUFFIX:
        written, decoder = _whole(args)
        count = 1
    else:
        written, decoder, count = args.out, False, _posed(args)
    frames = "" if args.to in _SUFFIX else f"{count} frame{'s' if count != 1 else ''}, "
    print(f"{written}: {args.to}, {frames}{_size(Path(written)) / 1e6:.2f} MB")
    print("note: " + _LOST[args.to].format(decoder=" and its U-Net" if decoder else ""))
    return 0


def _check(args: argparse.Namespace) -> None:
    """The options fit each other, before anything is read."""
    out = Path(args.out)
    if args.to != "meshes" and args.model is None:
        raise ConfigError.of("nbavatar export", "MODEL", expected=f"an avatar for --to {args.to}", found="none")
    if args.to not in _SUFFIX and args.meshes is None:
        raise ConfigError.of("--meshes", expected=f"a mesh sequence for --to {args.to}", found="none")
    allowed = {"splats": (".ply",), "billboards": (".glb",), "meshes": (".obj", ".ply", ".glb")}
    suffixes = allowed.get(args.to) or (_SUFFIX[args.to],)
    if out.suffix not in (*suffixes, *([""] if args.to in allowed else [])) or (out.suffix and out.is_dir()):
        folder = " or a folder" if args.to in allowed else ""
        raise ConfigError.of("--out", expected=f"a name that ends in {', '.join(suffixes)}{folder}", found=args.out)
    if not 0 < args.fps < 1e6:
        raise ConfigError.of("--fps", expected="a positive number", found=args.fps)


def _record(args: argparse.Namespace) -> dict[str, Any]:
    from nbavatar.provenance import run_record

    inputs = {name: path for name, path in (("model", args.model), ("meshes", args.meshes)) if path}
    record = run_record("export", config={"to": args.to, "fps": args.fps}, inputs=inputs)
    return {name: record[name] for name in ("command", "config", "code", "inputs", "versions")}


def _whole(args: argparse.Namespace) -> tuple[str, bool]:
    """What depends on no frame; the file, and whether the avatar has a decoder."""
    from nbavatar.exporting.decoder import decoder_model
    from nbavatar.exporting.tensors import tensor_file
    from nbavatar.io.atomic import atomic_write
    from nbavatar.methods.storage import load_avatar

    avatar = load_avatar(args.model)
    make = tensor_file if args.to == "tensors" else decoder_model
    content = make(avatar, _record(args))
    with atomic_write(args.out) as temporary:
        temporary.write_bytes(content)
    return args.out, getattr(avatar, "unet", None) is not None


def _posed(args: argparse.Namespace) -> int:
    """What is posed on frames; how many there were."""
    from nbavatar.data.sequences import read_sequence

    sequence, _ = read_sequence(args.meshes)
    rows = _rows(args.frames, sequence.frames, args.meshes)
    out = Path(args.out)
    if len(rows) > 1 and out.suffix in (".ply", ".obj"):
        raise ConfigError.of("--out", expected=f"a folder for {len(rows)} frames", found=args.out,
                             fix="or choose one with --frames")  # fmt: skip
    comment = f"nbavatar export of {args.model or args.meshes}, metres, world of the capture"
    writers = {"splats": _write_splats, "billboards": _write_billboards, "meshes": _write_meshes}
    writers[args.to](args, sequence, rows, out, comment)
    return len(rows)


def _rows(chosen: list[str] | None, frames: list[str], path: str) -> list[int]:
    """Places of the frames that were asked for."""
    if chosen is None:
        return list(range(len(frames)))
    rows: list[int] = []
    for word in chosen:
        if word in frames:
            rows.append(frames.index(word))
        elif ":" in word:
            try:
                rows += range(len(frames))[slice(*(int(part) if part else None for part in word.split(":")))]
            except (ValueError, TypeError):
                raise ConfigError.of("--frames", expected="first:last:step in whole numbers", found=word) from None
        else:
            raise DataError.of(path, f"frame {word}", expected="a frame of the sequence", found="none",
                               fix=did_you_mean(word, frames))  # fmt: skip
    if not rows:
        raise DataError.of(path, "--frames", expected="one frame or more", found="none")
    return rows


def _files(out: Path, suffix: str, sequence: "MeshSequence", rows: list[int]) -> Iterator[tuple[int, Path]]:
    """Row and file of each frame: `out` itself, or a file in it."""
    for row in rows:
        yield row, out if out.suffix else out / f"{sequence.frames[row]}{suffix}"


def _write_splats(args: argparse.Namespace, sequence: "MeshSequence", rows: list[int], out: Path, comment: str) -> None:
    from nbavatar.exporting.splats import splat_columns
    from nbavatar.io.plyfiles import write_ply

    avatar, poses = _avatar_poses(args, sequence, rows)
    for (_, path), (frame, verts) in zip(_files(out, ".ply", sequence, rows), poses, strict=True):
        write_ply(path, splat_columns(avatar, verts, frame), comments=[comment])


def _write_billboards(
    args: argparse.Namespace, sequence: "MeshSequence", rows: list[int], out: Path, comment: str
) -> None:
    import dataclasses

    from nbavatar.exporting.quads import quads
    from nbavatar.io.gltf import write_glb

    avatar, poses = _avatar_poses(args, sequence, rows)
    shape, extras = quads(avatar, poses), {"comment": comment}
    if out.suffix:
        write_glb(out, [shape], fps=args.fps, extras=extras)
        return
    for i, (_, path) in enumerate(_files(out, ".glb", sequence, rows)):
        still = dataclasses.replace(shape, positions=shape.positions[i : i + 1])
        write_glb(path, [still], fps=args.fps, extras=extras)


def _write_meshes(args: argparse.Namespace, sequence: "MeshSequence", rows: list[int], out: Path, comment: str) -> None:
    from nbavatar.exporting.meshes import contact_of, shapes_of
    from nbavatar.io.gltf import write_glb
    from nbavatar.io.meshwriters import write_shapes

    if out.suffix == ".glb" and len(rows) > 1:
        write_glb(out, shapes_of(sequence, rows), fps=args.fps, extras={"comment": comment})
        return
    for row, path in _files(out, f".{args.type}", sequence, rows):
        shapes = shapes_of(sequence, [row])
        if not shapes:
            raise DataError.of(args.meshes, f"frame {sequence.frames[row]}", expected="a part", found="none")
        write_shapes(path, shapes, [contact_of(sequence, shape.name, [row])[0] for shape in shapes], comment)


def _avatar_poses(args: argparse.Namespace, sequence: "MeshSequence", rows: list[int]) -> tuple[Any, Any]:
    """The avatar, and frame and vertices of each row, one after another."""
    from nbavatar.evaluation.render import check_parts, posed_vertices
    from nbavatar.methods.storage import load_avatar

    avatar = load_avatar(args.model)
    check_parts(avatar, sequence)
    refined = "driver" not in sequence.extras
    poses = ((sequence.frames[row] if refined else None, posed_vertices(avatar, sequence, row)) for row in rows)
    return avatar, poses


def _size(path: Path) -> int:
    """Bytes of a file, or of the files in a folder."""
    return sum(p.stat().st_size for p in path.iterdir() if p.is_file()) if path.is_dir() else path.stat().st_size
