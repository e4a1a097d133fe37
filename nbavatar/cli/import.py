"""Turn data in another program's format into a capture.

  nbavatar import vhap SRC OUT --flame generic_model.pkl    VHAP's export (GaussianAvatars): FLAME parameters or OBJ
  nbavatar import nerfstudio SRC OUT --scale M              transforms.json of nerfstudio or instant-ngp
  nbavatar import colmap SRC OUT --scale M                  cameras and images of COLMAP, text or binary
  nbavatar import meshes SRC OUT                            OBJ or PLY files, or the meshes.npz of `nbavatar fit`, into
                                                            OUT, a capture without meshes

Writes OUT, which must not exist yet: cameras.json, images/, masks/, meshes/, splits.json (see README.md) and
import.json, which says where all came from. Pictures become links to SRC unless --copy is given. Cameras are brought to
OpenCV's axes, pixel centres at +0.5 and metres; lenses that are no pinhole with OpenCV's polynomial (fisheyes) are
refused.

Camera and frame of a picture are read from its path by --names, such as '{camera}/{frame}' or '{frame}_{camera}'.
'{camera}' alone: every picture is a camera; give the recordings with --images. '{frame}' alone: one camera that moves;
its axes become the world's and the meshes, which are then needed, move instead.

Meshes of nerfstudio's and COLMAP's users come with --meshes DIR: DIR/FRAME.obj (the head) or DIR/PART/FRAME.obj with
PART head, right_hand, left_hand; .ply too; the same faces in all frames, in the cameras' frame of reference.
"""

import argparse
from pathlib import Path

from nbavatar.cli.common import progress
from nbavatar.data.capture import read_splits
from nbavatar.data.foreign.capture_folder import write_capture, write_meshes
from nbavatar.data.foreign.colmap import read_colmap
from nbavatar.data.foreign.mesh_files import JoinedMeshes, open_meshes
from nbavatar.data.foreign.nerfstudio import read_nerfstudio
from nbavatar.data.foreign.recordings import with_recordings
from nbavatar.data.foreign.source import Source
from nbavatar.data.foreign.vhap import read_vhap
from nbavatar.errors import ConfigError, DataError
from nbavatar.provenance import run_record

__all__ = ["add_arguments", "main"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options."""
    parser.add_argument("format", choices=("vhap", "nerfstudio", "colmap", "meshes"), help="what SRC holds")
    parser.add_argument("source", metavar="SRC", help="folder to read")
    parser.add_argument("out", metavar="OUT", help="folder of the capture to make")
    parser.add_argument("--flame", metavar="PKL", help="vhap: FLAME's model file, where SRC has flame_param")
    parser.add_argument("--names", default="", metavar="TEXT", help="nerfstudio, colmap: camera and frame in paths")
    parser.add_argument("--images", metavar="DIR", help="nerfstudio, colmap: recordings, DIR/CAMERA/FRAME.jpg")
    parser.add_argument("--masks", metavar="DIR", help="masks to take, DIR/CAMERA/FRAME.png")
    parser.add_argument(
        "--meshes", metavar="PATH", help="meshes to take: a folder of OBJ or PLY, or a mesh sequence (.npz)"
    )
    parser.add_argument("--scale", type=_positive, default=1.0, metavar="M", help="metres per unit of SRC (default 1)")
    parser.add_argument(
        "--mesh-scale", type=_positive, metavar="M", help="metres per unit of the mesh files (default: --scale)"
    )
    parser.add_argument("--repair", action="store_true", help="mend the faces of mesh files (winding, doubles)")
    parser.add_argument(
        "--max-faces", type=_faces, metavar="N", help="make mesh files with more faces a part coarser (pymeshlab)"
    )
    parser.add_argument(
        "--pixel-center", type=float, choices=(0.0, 0.5), default=0.5,
        help="where SRC puts the centre of pixel (0, 0) [px]: 0.5, or 0 as OpenCV's calibration does",
    )  # fmt: skip
    parser.add_argument("--within", metavar="DIR", help="folder that paths in SRC's files may reach (default SRC)")
    parser.add_argument("--copy", action="store_true", help="copy pictures instead of linking to them")


def main(args: argparse.Namespace) -> None:
    """Writes the capture."""
    root, out = Path(args.source), Path(args.out)
    if not root.exists():
        raise DataError.of(root, expected="a folder to import", found="no such folder")
    mesh_scale = args.scale if args.mesh_scale is None else args.mesh_scale
    _refuse_idle(args)
    if args.format == "meshes":
        files = open_meshes(root, scale=mesh_scale, repair=args.repair, max_faces=args.max_faces)
        frames = {frame: frame for frame in read_splits(out).frames}
        write_meshes(files, out, frames, progress=progress)
        _say(files.notes, f"{out / 'meshes'}: {len(frames)} frames of {', '.join(files.topology())}")
        return
    source, moving = _read(args, root)
    if args.images or args.masks:
        source = with_recordings(source, _folder(args.images), _folder(args.masks))
    if args.meshes:
        files = open_meshes(Path(args.meshes), scale=mesh_scale, repair=args.repair, max_faces=args.max_faces)
        source.notes.extend(files.notes)
        source.meshes = files if source.meshes is None else JoinedMeshes([source.meshes, files])
    options = {key: value for key, value in vars(args).items() if key not in ("source", "out")}
    extra = {"source": str(root.resolve())}
    notes = write_capture(
        source, out, scale=args.scale, copy=args.copy, moving=moving, progress=progress,
        record=lambda: run_record("import", config=options, inputs=source.inputs, extra=extra),
    )  # fmt: skip
    if source.meshes is None:
        notes.append(f"there are no meshes; add them with: nbavatar import meshes DIR {out}")
    if not any(shot.mask for shot in source.shots):
        notes.append("there are no masks; `nbavatar segment` makes some")
    _say([*source.notes, *notes], f"{out}: look at it with: nbavatar check {out} --out overlays")


def _read(args: argparse.Namespace, root: Path) -> tuple[Source, bool]:
    within = Path(args.within) if args.within else None
    if args.format == "vhap":
        flame = Path(args.flame) if args.flame else None
        return read_vhap(root, flame=flame, within=within, pixel_center=args.pixel_center), False
    read = read_nerfstudio if args.format == "nerfstudio" else read_colmap
    return read(root, names=args.names, within=within, pixel_center=args.pixel_center)


def _refuse_idle(args: argparse.Namespace) -> None:
    """Options that the format has no use for are a misunderstanding."""
    idle = {
        "vhap": ("names", "images", "scale"),
        "nerfstudio": ("flame",),
        "colmap": ("flame",),
        "meshes": ("flame", "names", "images", "masks", "meshes", "within", "copy"),
    }[args.format]
    for name in idle:
        if getattr(args, name) != (1.0 if name == "scale" else None) and getattr(args, name):
            raise ConfigError.of(f"--{name}", expected=f"an option of another format than {args.format}", found="it")

    if args.max_faces is not None and args.format != "meshes" and not args.meshes:
        raise ConfigError.of("--max-faces", expected="mesh files, by --meshes", found="none")


def _faces(text: str) -> int:
    value = int(text)
    if value < 4:
        raise argparse.ArgumentTypeError(f"expected 4 faces or more, found {text}")
    return value


def _folder(text: str | None) -> Path | None:
    return Path(text) if text else None


def _positive(text: str) -> float:
    value = float(text)
    if not 1e-12 < value < 1e12:
        raise argparse.ArgumentTypeError(f"expected a number above 0, found {text}")
    return value


def _say(notes: list[str], end: str) -> None:
    for line in dict.fromkeys(notes):
        print(f"note: {line}")
    print(end)
