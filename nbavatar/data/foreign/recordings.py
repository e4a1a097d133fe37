"""Recordings and masks that lie beside a calibration: `DIR/<camera>/<frame>.<type>`."""

from pathlib import Path

from nbavatar.data.foreign.source import Shot, Source
from nbavatar.errors import DataError
from nbavatar.io.pictures import PICTURE_TYPES, picture_size

__all__ = ["with_recordings"]


def with_recordings(source: Source, images: Path | None, masks: Path | None) -> Source:
    """The source with the pictures, or the masks, of these folders in place of its own.

    Args:
        source: its shots say what each camera's calibration is.
        images: folder of recordings; each camera's calibration has to be one, and holds for all its pictures.
        masks: folder of masks of the same names.

    Raises:
        DataError: a camera has no folder there, several calibrations, or pictures of another size.
    """
    shots = source.shots
    if images is not None:
        first: dict[str, Shot] = {}
        for shot in shots:
            if not first.setdefault(shot.camera, shot).lens.same(shot.lens):
                raise DataError.of(source.path, f"camera {shot.camera}", expected="one calibration", found="several")
        shots = []
        for camera, shot in first.items():
            for frame, file in _listed(images, camera).items():
                if picture_size(file) != (shot.lens.width, shot.lens.height):
                    size = "{} x {}".format(*picture_size(file))
                    raise DataError.of(
                        file, "size", expected=f"{shot.lens.width} x {shot.lens.height} as calibrated", found=size
                    )
                shots.append(Shot(camera, frame, file, None, shot.lens))
    if masks is not None:
        found = {camera: _listed(masks, camera) for camera in {shot.camera for shot in shots}}
        for shot in shots:
            if shot.frame not in found[shot.camera]:
                where = masks / shot.camera / f"{shot.frame}.png"
                raise DataError.of(where, expected="a mask for each picture", found="none")
        shots = [Shot(s.camera, s.frame, s.image, found[s.camera][s.frame], s.lens) for s in shots]
    source.shots = shots
    return source


def _listed(folder: Path, camera: str) -> dict[str, Path]:
    place = folder / Path(camera).name
    if camera != Path(camera).name or not place.is_dir():
        raise DataError.of(place, expected=f"a folder with the pictures of camera {camera}", found="none")
    files: dict[str, Path] = {}
    for path in sorted(place.iterdir()):
        if path.suffix.lower() in PICTURE_TYPES:
            if path.stem in files:
                raise DataError.of(path, expected="one picture a frame", found=f"{files[path.stem].name} too")
            files[path.stem] = path
    if not files:
        raise DataError.of(place, expected=f"pictures ({', '.join(PICTURE_TYPES)})", found="none")
    return files
