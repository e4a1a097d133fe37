"""nerfstudio's and instant-ngp's `transforms.json`.

Poses are brought back to the frame of reference in which they were made: stored = applied_scale (applied_transform
original). The unit of length is the source's; a COLMAP-made file has an arbitrary one.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nbavatar.data.foreign.naming import parse_names
from nbavatar.data.foreign.source import Lens, Shot, Source, inside, picture
from nbavatar.data.foreign.transforms import frame_lens, read_transforms
from nbavatar.errors import DataError
from nbavatar.io.pictures import picture_size

__all__ = ["read_nerfstudio"]


def read_nerfstudio(
    root: Path, *, names: str = "", within: Path | None = None, pixel_center: float = 0.5
) -> tuple[Source, bool]:
    """Reads a folder, or the file itself.

    Args:
        root: folder with `transforms.json`, or such a file.
        names: see `parse_names`; frames with `camera_index` and `timestep_index` need none.
        within: folder that the paths in the file may reach; its own folder by default.
        pixel_center: where the file puts the centre of pixel (0, 0) [px].

    Returns:
        the source, and whether it is one moving camera.

    Raises:
        DataError: a damaged file, a lens that is not ours, a picture that is not there.
    """
    path = root if root.is_file() else root / "transforms.json"
    top, frames = read_transforms(path)
    undo = _original(top, path)
    texts = []
    for number, frame in enumerate(frames):
        text = frame.get("file_path")
        if not isinstance(text, str):
            raise DataError.of(path, f"frames[{number}].file_path", expected="a path", found=repr(text)[:60])
        texts.append(text)
    moving = False
    if frames and not names and all("camera_index" in f and "timestep_index" in f for f in frames):
        pairs = [(str(f.get("camera_id", f["camera_index"])), str(f["timestep_index"])) for f in frames]
    else:
        pairs, moving = parse_names(texts, names, path)
    shots = []
    for frame, text, (camera, moment) in zip(frames, texts, pairs):
        where = f"{path}: frame {text!r}"
        image = picture(inside(path.parent, text, within or path.parent, f"{where}: file_path"), where)
        stored = frame.get("mask_path")
        mask = None
        if stored is not None:
            mask = picture(inside(path.parent, stored, within or path.parent, f"{where}: mask_path"), where)
        lens = frame_lens(top, frame, where, picture_size(image), pixel_center=pixel_center)
        shots.append(Shot(camera, moment, image, mask, undo(lens)))
    return Source(path, shots, inputs={"transforms": path}), moving


def _original(top: Mapping[str, Any], path: Path) -> Any:
    """A function that takes a lens to the frame of reference before `applied_transform` and `applied_scale`."""
    transform, scale = np.eye(4), 1.0
    if top.get("applied_transform") is not None:
        try:
            stored = np.array(top["applied_transform"], dtype=np.float64)
            transform[:3] = stored[:3] if stored.ndim == 2 else np.nan
        except (TypeError, ValueError):
            transform[:] = np.nan
        off = float(np.abs(transform[:3, :3] @ transform[:3, :3].T - np.eye(3)).max())
        if not np.isfinite(transform).all() or off > 1e-6 or np.linalg.det(transform[:3, :3]) < 0:
            raise DataError.of(
                path, "applied_transform", expected="3 x 4 numbers, a rotation and a shift",
                found=repr(top["applied_transform"])[:80],
            )  # fmt: skip
    if top.get("applied_scale") is not None:
        scale = top["applied_scale"]
        if isinstance(scale, bool) or not isinstance(scale, (int, float)) or not 1e-12 < scale < 1e12:
            raise DataError.of(path, "applied_scale", expected="a number above 0", found=repr(scale)[:60])

    def undo(lens: Lens) -> Lens:
        # x_camera = R x_stored + t with x_stored = s (A x + a): the same pixels from (R A, R a + t / s), depth over s.
        pose = lens.cam_from_world.copy()
        pose[:3, 3] /= scale
        return Lens(lens.width, lens.height, lens.K, pose @ transform, lens.distortion)

    return undo
