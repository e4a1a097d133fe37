"""COLMAP's `cameras` and `images`, text or binary, read as COLMAP documents them.

camera: id, model, width, height, parameters
image:  id, quaternion wxyz and translation (world to camera), camera id, name, and its points, which are passed over
"""

import dataclasses
import math
import struct
from collections.abc import Iterator
from pathlib import Path

from nbavatar.errors import DataError

__all__ = ["ColmapCamera", "ColmapImage", "read_colmap_files"]

# Models by their number in binary files: name and count of parameters.
_MODELS = (
    ("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8), ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4), ("RADIAL_FISHEYE", 5), ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class ColmapCamera:
    """A lens: COLMAP's model and its parameters [px where they are lengths]."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclasses.dataclass(frozen=True)
class ColmapImage:
    """A picture: quaternion wxyz and translation from world to camera, id of its lens, name."""

    quaternion: tuple[float, ...]
    translation: tuple[float, ...]
    camera: int
    name: str


def read_colmap_files(folder: Path) -> tuple[dict[int, ColmapCamera], list[ColmapImage]]:
    """Cameras by id, and images, from `cameras` and `images` of one folder; binary files come first.

    Raises:
        DataError: neither form is whole, or a file is damaged.
    """
    for suffix, cameras, images in (
        (".bin", _cameras_of_bytes, _images_of_bytes), (".txt", _cameras_of_text, _images_of_text)
    ):  # fmt: skip
        paths = [folder / f"{name}{suffix}" for name in ("cameras", "images")]
        if all(path.is_file() for path in paths):
            return cameras(paths[0]), images(paths[1])
    raise DataError.of(folder, expected="cameras and images, both .bin or both .txt", found="neither pair")


class _Bytes:
    """A binary file that is never read beyond its end."""

    def __init__(self, path: Path) -> None:
        self._path, self._content, self._at = path, path.read_bytes(), 0

    def take(self, layout: str) -> tuple[float, ...]:
        """Little-endian values."""
        size = struct.calcsize("<" + layout)
        self._need(size)
        values = struct.unpack_from("<" + layout, self._content, self._at)
        self._at += size
        return values

    def text(self) -> str:
        """Text up to a zero byte."""
        end = self._content.find(b"\0", self._at)
        if end < 0:
            raise self.damaged("a name that ends", "none")
        try:
            text = self._content[self._at : end].decode()
        except UnicodeDecodeError:
            raise self.damaged("a name in UTF-8", repr(self._content[self._at : end])[:60]) from None
        self._at = end + 1
        return text

    def skip(self, size: int) -> None:
        """Passes over some bytes."""
        self._need(size)
        self._at += size

    def damaged(self, expected: object, found: object) -> DataError:
        """The error of this place."""
        return DataError.of(self._path, f"byte {self._at}", expected=expected, found=found)

    def _need(self, size: int) -> None:
        left = len(self._content) - self._at
        if size > left:
            raise self.damaged(f"{size} bytes more", f"{left}, the file is cut short or no such file")


def _cameras_of_bytes(path: Path) -> dict[int, ColmapCamera]:
    stream = _Bytes(path)
    cameras = {}
    for _ in range(int(stream.take("Q")[0])):
        number, model, width, height = (int(value) for value in stream.take("iiQQ"))
        if not 0 <= model < len(_MODELS):
            raise stream.damaged(f"a camera model from 0 to {len(_MODELS) - 1}", model)
        name, count = _MODELS[model]
        cameras[number] = _camera(name, width, height, stream.take(f"{count}d"), f"{path}: camera {number}")
    return cameras


def _images_of_bytes(path: Path) -> list[ColmapImage]:
    stream = _Bytes(path)
    images = []
    for _ in range(int(stream.take("Q")[0])):
        stream.take("I")
        pose, camera = stream.take("7d"), int(stream.take("I")[0])
        images.append(_image(pose, camera, stream.text(), str(path)))
        stream.skip(24 * int(stream.take("Q")[0]))
    return images


def _cameras_of_text(path: Path) -> dict[int, ColmapCamera]:
    cameras = {}
    for number, line in _lines(path):
        if not line.strip() or line.startswith("#"):
            continue
        where = f"{path}, line {number}"
        try:
            key, model, width, height, *parameters = line.split()
            values = int(key), int(width), int(height), tuple(float(word) for word in parameters)
        except ValueError:
            raise DataError.of(where, expected="id, model, width, height, parameters", found=line[:60]) from None
        cameras[values[0]] = _camera(model, values[1], values[2], values[3], where)
    return cameras


def _images_of_text(path: Path) -> list[ColmapImage]:
    images = []
    lines = _lines(path)
    for number, line in lines:
        if not line.strip() or line.startswith("#"):
            continue
        where = f"{path}, line {number}"
        try:
            words = line.strip().split(maxsplit=9)
            pose, camera, name = tuple(float(word) for word in words[1:8]), int(words[8]), words[9]
        except (ValueError, IndexError):
            raise DataError.of(where, expected="id, qw qx qy qz, tx ty tz, camera id, name", found=line[:60]) from None
        images.append(_image(pose, camera, name, where))
        next(lines, None)  # the image's points, in a line that may be empty
    return images


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    try:
        return enumerate(iter(path.read_text(encoding="utf-8").splitlines()), start=1)
    except UnicodeDecodeError as error:
        raise DataError.of(path, expected="text in UTF-8", found=f"other bytes ({error.reason})") from None


def _camera(model: str, width: int, height: int, parameters: tuple[float, ...], where: str) -> ColmapCamera:
    count = dict(_MODELS).get(model)
    if count is None:
        raise DataError.of(where, "model", expected="a camera model of COLMAP", found=model[:40])
    if len(parameters) != count or not all(map(math.isfinite, parameters)):
        raise DataError.of(where, model, expected=f"{count} finite parameters", found=str(list(parameters))[:80])
    if width < 1 or height < 1:
        raise DataError.of(where, "size", expected="a size in pixels", found=f"{width} x {height}")
    return ColmapCamera(model, width, height, parameters)


def _image(pose: tuple[float, ...], camera: int, name: str, where: str) -> ColmapImage:
    norm = math.sqrt(sum(value * value for value in pose[:4]))
    if not all(map(math.isfinite, pose)) or abs(norm - 1) > 1e-3:
        raise DataError.of(
            where, f"image {name!r}", expected="a unit quaternion and a translation", found=str(list(pose))[:90]
        )
    return ColmapImage(tuple(value / norm for value in pose[:4]), pose[4:], camera, name)
