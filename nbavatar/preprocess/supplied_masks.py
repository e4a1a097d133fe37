"""Masks that the user made with other tools, by folder of images or by video, for one camera."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from nbavatar.camera.pinhole import Camera
from nbavatar.config.inputs import supplied_place
from nbavatar.data.pictures import find_picture, list_pictures
from nbavatar.errors import DataError
from nbavatar.io.pictures import Plane, read_plane
from nbavatar.io.video import probe_video, read_video
from nbavatar.preprocess.mask_values import HANDS, Meaning, ValueSurvey, labels_in, spread

__all__ = ["supplied_masks"]


def supplied_masks(
    folder: str | Path,
    subject: str,
    camera: Camera,
    frames: Sequence[str],
    parts: Sequence[str],
    known: Meaning | None = None,
) -> tuple[Iterator[np.ndarray], Meaning]:
    """Masks of one camera, and what they mean (see `mask_values`): one uint8 `[H, W]` a frame, in order.

    Looked for, in this order: `<folder>/<subject>/<camera>/`, `<folder>/<subject>/<camera>.<video>`,
    `<folder>/<camera>/`, `<folder>/<camera>.<video>`. An image belongs to the frame of its name, or of the same number
    with other zero padding. In a video the frame number must be the frame id. All of them are looked at before the
    first is returned.

    Args:
        folder: with masks of one subject, or of several.
        subject: whose.
        camera: its size is the masks' size.
        frames: ids.
        parts: parts that have a mesh.
        known: what this camera's masks mean, where all of them have been looked at before; a few frames alone may not
            tell.

    Raises:
        DataError: nothing there, a frame without a mask, another size, a video that is too short, or values that mean
            nothing.
    """
    place = _find(Path(folder), subject, camera.name)
    read = _from_images if place.is_dir() else _from_video
    if known is not None:
        return (known.read(plane.values, path) for path, plane in read(place, frames, camera)), known
    survey = ValueSurvey()
    for path, plane in read(place, frames, camera):
        survey.add(plane.values, plane.lossy, path.name)
    if survey.largest == 1 and place.is_dir() and _labelled_beside(place):
        parts = ()
    meaning = survey.masks(place, parts)
    return (meaning.read(plane.values, path) for path, plane in read(place, frames, camera)), meaning


def _find(base: Path, subject: str, camera: str) -> Path:
    """The folder or video that holds a camera's masks."""
    place = supplied_place(str(base), subject, camera)
    if place is None:
        expected = f"{subject}/{camera}/<frame>.png, {camera}/<frame>.png or such videos"
        raise DataError.of(base, expected=expected, found="none of them")
    return place


def _from_images(folder: Path, frames: Sequence[str], camera: Camera) -> Iterator[tuple[Path, Plane]]:
    numbered = {int(stem): stem for stem in list_pictures(folder) if stem.isdecimal()}
    for frame in frames:
        path = find_picture(folder, frame)
        if path is None and frame.isdecimal() and int(frame) in numbered:
            path = find_picture(folder, numbered[int(frame)])
        if path is None:
            raise DataError.of(folder, f"frame {frame}", expected=f"a mask such as {frame}.png", found="none")
        yield path, read_plane(path, (camera.width, camera.height))


def _from_video(path: Path, frames: Sequence[str], camera: Camera) -> Iterator[tuple[Path, Plane]]:
    if not all(frame.isdecimal() for frame in frames):
        raise DataError.of(path, expected="frame ids that are numbers, to find them in a video", found=frames[0])
    found, lossy = 0, probe_video(path).lossy
    for mask in read_video(path, indices=[int(frame) for frame in frames], gray=True):
        found += 1
        if mask.shape != (camera.height, camera.width):
            expected, got = f"{camera.width} x {camera.height}", f"{mask.shape[1]} x {mask.shape[0]}"
            raise DataError.of(path, "size", expected=expected, found=got)
        yield path, Plane(mask, lossy)
    if found != len(frames):
        raise DataError.of(path, "frames", expected=f"frame {frames[found]}", found="a video that ends before it")


def _labelled_beside(folder: Path) -> bool:
    """Whether another camera's images hold the labels of hands, in some frames: this one may just not see any."""
    for other in sorted(folder.parent.iterdir()):
        if other.is_dir() and other != folder:
            for name in spread(list(list_pictures(other))):
                path = find_picture(other, name)
                if path is not None and labels_in(read_plane(path).values) & HANDS:
                    return True
    return False
