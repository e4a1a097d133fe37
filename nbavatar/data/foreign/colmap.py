"""COLMAP's reconstructions: calibrated pictures, one pose each.

Poses are world to camera with OpenCV's axes, pixel centres lie at +0.5, as ours do. The unit of length is arbitrary.
"""

from pathlib import Path, PurePosixPath

import numpy as np
import torch

from nbavatar.data.foreign.colmap_files import ColmapCamera, ColmapImage, read_colmap_files
from nbavatar.data.foreign.naming import parse_names
from nbavatar.data.foreign.source import Lens, Shot, Source, inside, picture
from nbavatar.errors import DataError
from nbavatar.io.pictures import picture_size
from nbavatar.math.rotations import quaternion_to_matrix

__all__ = ["read_colmap"]

_FOLDERS = ("", "sparse/0", "sparse", "colmap/sparse/0", "dense/sparse")
# Where each model's parameters are: fx, fy, cx, cy, and OpenCV's coefficients.
_LAYOUTS = {
    "SIMPLE_PINHOLE": ((0, 0, 1, 2), ()),
    "PINHOLE": ((0, 1, 2, 3), ()),
    "SIMPLE_RADIAL": ((0, 0, 1, 2), (3,)),
    "RADIAL": ((0, 0, 1, 2), (3, 4)),
    "OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7)),
    "FULL_OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7, 8, 9, 10, 11)),
}


def read_colmap(
    root: Path, *, names: str = "", within: Path | None = None, pixel_center: float = 0.5
) -> tuple[Source, bool]:
    """Reads a workspace: `cameras` and `images` (.bin or .txt) in it or in `sparse/0`, pictures in `images/`.

    Args:
        root: the workspace.
        names: see `parse_names`.
        within: folder that the paths in the files may reach; `root` by default.
        pixel_center: where the files put the centre of pixel (0, 0) [px]; COLMAP's own have it at 0.5.

    Returns:
        the source, and whether it is one moving camera.

    Raises:
        DataError: a damaged file, a lens that is not ours, a picture that is not there or of another size.
    """
    folder = _model_folder(root)
    cameras, images = read_colmap_files(folder)
    path = next(folder / f"images{suffix}" for suffix in (".bin", ".txt") if (folder / f"images{suffix}").is_file())
    pairs, moving = parse_names([image.name for image in images], names, path)
    pictures = root / "images" if (root / "images").is_dir() else root
    shots = []
    for image, (camera, moment) in zip(images, pairs):
        where = f"{path}: image {image.name!r}"
        if image.camera not in cameras:
            raise DataError.of(where, "camera", expected="a camera of the other file", found=image.camera)
        lens = _lens(cameras[image.camera], image, where, pixel_center)
        file = picture(inside(pictures, image.name, within or root, where), where)
        size = picture_size(file)
        if size != (lens.width, lens.height):
            raise DataError.of(
                file, "size", expected=f"{lens.width} x {lens.height} as COLMAP says", found=f"{size[0]} x {size[1]}"
            )
        mask = next((m for m in _masks(root, image.name, within or root, where) if m.is_file()), None)
        shots.append(Shot(camera, moment, file, mask, lens))
    source = Source(path, shots, inputs={"images": path, "cameras": path.with_stem("cameras")})
    if (folder.parent / "1").is_dir() and folder.name == "0":
        source.notes.append(f"{folder.parent} holds several reconstructions; {folder.name} is taken")
    return source, moving


def _model_folder(root: Path) -> Path:
    for name in _FOLDERS:
        folder = root / name
        if any((folder / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
            return folder
    expected = f"cameras.bin or cameras.txt in it or in {', '.join(_FOLDERS[1:])}"
    raise DataError.of(root, expected=expected, found="none of them")


def _masks(root: Path, name: str, allowed: Path, where: str) -> list[Path]:
    """Where a picture's mask may be: COLMAP adds `.png` to the whole name."""
    texts = (f"{name}.png", str(PurePosixPath(name).with_suffix(".png")))
    return [inside(root / "masks", text, allowed, f"{where}: mask") for text in texts]


def _lens(camera: ColmapCamera, image: ColmapImage, where: str, pixel_center: float) -> Lens:
    if camera.model not in _LAYOUTS:
        raise DataError.of(
            where, "camera model", expected=f"one of {', '.join(_LAYOUTS)}", found=camera.model,
            fix="let COLMAP undistort the pictures (image_undistorter), or calibrate with OPENCV",
        )  # fmt: skip
    matrix, lens = _LAYOUTS[camera.model]
    fx, fy, cx, cy = (camera.parameters[i] for i in matrix)
    shift = 0.5 - pixel_center
    coefficients = np.array([camera.parameters[i] for i in lens])
    pose = np.eye(4)
    pose[:3, :3] = quaternion_to_matrix(torch.tensor(image.quaternion, dtype=torch.float64)).numpy()
    pose[:3, 3] = image.translation
    K = np.array([[fx, 0, cx + shift], [0, fy, cy + shift], [0, 0, 1]], dtype=np.float64)
    distortion = np.pad(coefficients, (0, max(0, 4 - len(coefficients)))) if coefficients.any() else None
    return Lens(camera.width, camera.height, K, pose, distortion)
