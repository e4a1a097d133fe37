"""Files of the face and hand networks, from a wheel that is used as a carrier of data.

MediaPipe's networks (Apache-2.0) lie as `.tflite` files in the package `mediapipe` 0.10.21, which is located or opened
as a zip and never imported: its pins (numpy below 2, an OpenCV with windows, jax) contradict ours. Each file is
compared with the SHA-256 below before it is used.
"""

import hashlib
import importlib.metadata
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path

from nbavatar.errors import DependencyError, parsing

__all__ = ["GET", "read_detector_models", "read_matting_model"]

PACKAGE = "mediapipe"
GET = "pip download --no-deps --only-binary=:all: --python-version 3.11 mediapipe==0.10.21"

_FILES = {
    "face_detection": (
        "face_detection/face_detection_short_range.tflite",
        "bbff11cebd1eb27a1e004cae0b0e63ec8c551cbf34a4451148b4908b8db3eca8",
    ),
    "face_landmark": (
        "face_landmark/face_landmark.tflite",
        "1055cb9d4a9ca8b8c688902a3a5194311138ba256bcc94e336d8373a5f30c814",
    ),
    "palm_detection": (
        "palm_detection/palm_detection_full.tflite",
        "1b14e9422c6ad006cde6581a46c8b90dd573c07ab7f3934b5589e7cea3f89a54",
    ),
    "hand_landmark": (
        "hand_landmark/hand_landmark_full.tflite",
        "11c272b891e1a99ab034208e23937a8008388cf11ed2a9d776ed3d01d0ba00e3",
    ),
}
_MATTING = {
    "person": (
        "selfie_segmentation/selfie_segmentation.tflite",
        "9ee168ec7c8f2a16c56fe8e1cfbc514974cbbb7e434051b455635f1bd1462f5c",
    ),
}
_FOLDER = "mediapipe/modules"


def read_detector_models(path: str | os.PathLike[str] | None) -> dict[str, bytes]:
    """Contents of the four networks: `face_detection`, `face_landmark`, `palm_detection`, `hand_landmark`.

    Args:
        path: the wheel, or the folder it is installed in (`site-packages`, or its own folder `mediapipe`); None looks
            for an installed package.

    Raises:
        DependencyError: nothing there, another version, or altered files; the line says how to get the right one.
    """
    return _read(path, _FILES)


def read_matting_model(path: str | os.PathLike[str] | None) -> bytes:
    """Content of the network that tells a person from the background; arguments and errors as above."""
    return _read(path, _MATTING)["person"]


def _read(path: str | os.PathLike[str] | None, files: Mapping[str, tuple[str, str]]) -> dict[str, bytes]:
    root = _installed() if path is None else Path(path)
    if root.is_dir():
        folder = root / _FOLDER if (root / _FOLDER).is_dir() else root / "modules"
        found = {name: _file(folder / file) for name, (file, _) in files.items()}
    elif root.is_file():
        found = _zipped(root, files)
    else:
        raise DependencyError.of(root, expected=f"the wheel or the folder of {PACKAGE}", found="nothing", fix=_how())
    for name, (file, expected) in files.items():
        content = found[name]
        if content is None:
            raise DependencyError.of(root, f"{_FOLDER}/{file}", expected="this file", found="none", fix=_how())
        digest = hashlib.sha256(content).hexdigest()
        if digest != expected:
            was, wanted = f"{digest[:16]}...", f"SHA-256 {expected[:16]}..."
            raise DependencyError.of(root, f"{_FOLDER}/{file}", expected=wanted, found=was, fix=_how())
    return {name: content for name, content in found.items() if content is not None}


def _installed() -> Path:
    try:
        return Path(str(importlib.metadata.distribution(PACKAGE).locate_file("")))
    except importlib.metadata.PackageNotFoundError:
        raise DependencyError(f"detector: package {PACKAGE} is not installed; {_how()}") from None


def _how() -> str:
    return f"run: {GET}; and give the file with --models"


def _file(path: Path) -> bytes | None:
    return path.read_bytes() if path.is_file() else None


def _zipped(path: Path, wanted: Mapping[str, tuple[str, str]]) -> dict[str, bytes | None]:
    with (
        parsing(path, "a wheel (.whl)", damaged="a damaged file", fix=_how(), error=DependencyError),
        zipfile.ZipFile(path) as archive,
    ):
        names = set(archive.namelist())
        files = {name: f"{_FOLDER}/{file}" for name, (file, _) in wanted.items()}
        return {name: archive.read(file) if file in names else None for name, file in files.items()}
