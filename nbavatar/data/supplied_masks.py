"""Masks that the user made with other tools, by folder of images or by video, for one camera."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from nbavatar.errors import DataError
from nbavatar.io.images import decode_image
from nbavatar.io.video import read_video

__all__ = ["supplied_masks"]

_IMAGES = (".png", ".webp", ".jpg", ".jpeg")
_VIDEOS = (".mp4", ".mkv", ".avi", ".mov", ".webm")


def supplied_masks(
    folder: str | Path, subject: str, camera: str, frames: Sequence[str], width: int, height: int
) -> Iterator[np.ndarray]:
    """Yields one uint8 mask `[H, W]` a frame, in order.

    Looked for, in this order: `<folder>/<subject>/<camera>/`, `<folder>/<subject>/<camera>.<video>`,
    `<folder>/<camera>/`, `<folder>/<camera>.<video>`. An image belongs to the frame of its name, or of the same number
    with other zero padding. In a video the frame number must be the frame id.

    Raises:
        DataError: nothing there, a frame without a mask, another size, or a video that is too short.
    """
    base = Path(folder)
    for place in (base / subject, base):
        if (place / camera).is_dir():
            return _from_images(place / camera, frames, width, height)
        for suffix in _VIDEOS:
            if (place / f"{camera}{suffix}").is_file():
                return _from_video(place / f"{camera}{suffix}", frames, width, height)
    expected = f"{subject}/{camera}/<frame>.png, {camera}/<frame>.png or such videos"
    raise DataError.of(base, expected=expected, found="none of them")


def _from_images(folder: Path, frames: Sequence[str], width: int, height: int) -> Iterator[np.ndarray]:
    files = {path.stem: path for path in sorted(folder.iterdir()) if path.suffix.lower() in _IMAGES}
    numbered = {int(stem): path for stem, path in files.items() if stem.isdigit()}
    for frame in frames:
        path = files.get(frame) or (numbered.get(int(frame)) if frame.isdigit() else None)
        if path is None:
            raise DataError.of(folder, f"frame {frame}", expected=f"a mask such as {frame}.png", found="none")
        mask = decode_image(path)
        yield _checked(mask if mask.ndim == 2 else mask[..., 0], path, width, height)


def _from_video(path: Path, frames: Sequence[str], width: int, height: int) -> Iterator[np.ndarray]:
    if not all(frame.isdigit() for frame in frames):
        raise DataError.of(path, expected="frame ids that are numbers, to find them in a video", found=frames[0])
    found = 0
    for mask in read_video(path, indices=[int(frame) for frame in frames], gray=True):
        found += 1
        yield _checked(mask, path, width, height)
    if found != len(frames):
        raise DataError.of(path, "frames", expected=f"frame {frames[found]}", found="a video that ends before it")


def _checked(mask: np.ndarray, path: Path, width: int, height: int) -> np.ndarray:
    if mask.shape != (height, width):
        raise DataError.of(path, "size", expected=f"{width} x {height}", found=f"{mask.shape[1]} x {mask.shape[0]}")
    return mask
