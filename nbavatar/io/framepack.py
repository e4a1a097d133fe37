"""Frame packs: the one container for images between stages.

A stored zip per (subject, camera) with PNGs `<layer>/<frame>.png` and `manifest.json`. A zip,
because thousands of loose frames slow every file system and the workflow; stored, because PNG
is compressed already; PNG, because it is lossless and everything opens it.

    layer   content                                      pixels
    rgb     colour, sRGB, straight alpha                 uint8 [H, W, 3]
    person  matte of the whole person, as delivered      uint8 [H, W]
    label   0 background, 1 head, 2 right, 3 left hand,  uint8 [H, W]
            255 unknown
    alpha   coverage of the labelled parts, 255 = full   uint8 [H, W]

Pixels that say nothing have the label 255: what lies outside the camera's image in a crop that sticks out of it, and
what something else covers that is no part. The manifest tells by `unseen` whether there is any.
"""

import contextlib
import json
import os
import struct
import zipfile
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from nbavatar.errors import DataError, describe, parsing
from nbavatar.io.archives import open_archive, read_record
from nbavatar.io.atomic import atomic_write
from nbavatar.io.forms import check_form, matrix_form
from nbavatar.io.images import decode_image, encode_png
from nbavatar.io.pictures import MOST_PIXELS
from nbavatar.io.records import canonical_json
from nbavatar.names import check_name

__all__ = ["FORMAT", "UNSEEN", "FramePack", "FramePackWriter", "mark_unseen", "parts_in", "unseen_in"]

FORMAT = 1
UNSEEN = 255
"""Label of pixels that say nothing."""
_MANIFEST = "manifest.json"
_EPOCH = (1980, 1, 1, 0, 0, 0)
_REQUIRED = ("stage", "subject", "camera", "width", "height", "cam_from_world", "frames", "layers")


def mark_unseen(label: np.ndarray, alpha: np.ndarray, unseen: np.ndarray) -> None:
    """Marks, in place, pixels that say nothing about the parts: label 255, no coverage.

    Args:
        label, alpha: uint8 `[H, W]`.
        unseen: bool `[H, W]`.
    """
    label[unseen], alpha[unseen] = UNSEEN, 0


def unseen_in(label: np.ndarray) -> np.ndarray:
    """Pixels that `mark_unseen` has marked in labels, bool of their shape."""
    return label == UNSEEN


def parts_in(label: np.ndarray) -> np.ndarray:
    """Pixels of labels that show a part, bool of their shape."""
    return (label > 0) & ~unseen_in(label)


class FramePackWriter:
    """Writes a frame pack; the file appears only when the `with` block succeeds.

    Args:
        path: target zip.
        manifest: everything but `format`. May still be changed (through `.manifest`) until the block ends.
    """

    def __init__(self, path: str | os.PathLike[str], manifest: Mapping[str, Any]) -> None:
        self.manifest: dict[str, Any] = {"format": FORMAT, **manifest}
        self._path = path
        self._stack = contextlib.ExitStack()
        self._written: set[str] = set()

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as opening:
            temporary = opening.enter_context(atomic_write(self._path))
            self._archive = opening.enter_context(zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED))
            self._stack = opening.pop_all()
        return self

    def add(self, layer: str, frame: str, image: np.ndarray) -> None:
        """Adds one image, uint8 `[H, W]` or `[H, W, 3]`."""
        name = f"{layer}/{frame}.png"
        if name in self._written:
            raise ValueError(f"{name} was added already")
        self._written.add(name)
        self._archive.writestr(zipfile.ZipInfo(name, _EPOCH), encode_png(image))

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._stack:  # closes the archive; then the file gets its name, or is removed
            if error is not None:
                raise error
            missing = [key for key in _REQUIRED if key not in self.manifest]
            lost = [
                f"{layer}/{frame}"
                for layer in self.manifest.get("layers", ())
                for frame in self.manifest.get("frames", ())
                if f"{layer}/{frame}.png" not in self._written
            ]
            if missing or lost:
                raise ValueError(f"frame pack lacks keys {missing}, images {lost[:3]}")
            self._archive.writestr(zipfile.ZipInfo(_MANIFEST, _EPOCH), canonical_json(self.manifest))


class FramePack:
    """A frame pack opened for reading.

    Attributes:
        manifest: the whole manifest.
        frames: frame ids in time order.
        layers: names of the image layers.

    Raises:
        DataError: missing, truncated, another format version, or without a required key.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        with parsing(path, "a frame pack (.zip)", damaged="a damaged file"), contextlib.ExitStack() as opening:
            self._archive = opening.enter_context(open_archive(self.path))
            self.manifest: dict[str, Any] = json.loads(read_record(self._archive, _MANIFEST))
            _check_manifest(self.manifest, self.path)
            opening.pop_all()  # stays open
        self.frames: list[str] = list(self.manifest["frames"])
        self.layers: list[str] = list(self.manifest["layers"])
        check_name(str(self.manifest["subject"]), path, "subject", error=DataError)
        # Renders are of several cameras, and their frames are <camera>/<frame>.
        for camera in str(self.manifest["camera"]).split(","):
            check_name(camera, path, "camera", error=DataError)
        self._check_size()
        for piece in {piece for frame in self.frames for piece in str(frame).split("/")}:
            check_name(piece, path, "frames", error=DataError)

    def _check_size(self) -> None:
        """Compares the size that all pictures are said to have with the first that is there."""
        width, height = self.manifest["width"], self.manifest["height"]
        for name in [f"{layer}/{self.frames[0]}.png" for layer in self.layers if self.frames]:
            if name not in self._archive.NameToInfo:
                continue
            with parsing(self.path, "a whole image", field=name, damaged="damage"), self._archive.open(name) as stream:
                found = struct.unpack(">II", stream.read(24)[16:])
            if found != (width, height):
                expected, shown = f"{width} x {height} as in the manifest", f"{found[0]} x {found[1]}"
                raise DataError.of(self.path, name, expected=expected, found=shown)
        if width * height > MOST_PIXELS:
            found = f"{width} x {height}"
            raise DataError.of(self.path, "width, height", expected=f"at most {MOST_PIXELS} pixels", found=found)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._archive.close()

    def close(self) -> None:
        """Closes the file."""
        self._archive.close()

    def read(self, layer: str, frame: str) -> np.ndarray:
        """Decodes one image to uint8 `[H, W]` or `[H, W, 3]`."""
        name = f"{layer}/{frame}.png"
        if name not in self._archive.NameToInfo:
            raise DataError.of(self.path, name, expected="this image", found="none of that name")
        with parsing(self.path, "a whole image", field=name, damaged="damage"):
            encoded = self._archive.read(name)
        return decode_image(encoded, f"{self.path}: {name}")

    def unseen(self, frame: str) -> np.ndarray | None:
        """Pixels that say nothing about the parts, bool `[H, W]`; None where there are none in any frame."""
        return unseen_in(self.read("label", frame)) if self.manifest.get("unseen") else None

    def intrinsics(self, frame: str) -> np.ndarray:
        """Camera matrix of one frame, float64 `[3, 3]` [px], of the images in this pack."""
        per_frame = self.manifest.get("K_per_frame")
        stored = self.manifest.get("K") if per_frame is None else per_frame.get(frame)
        if stored is None:
            raise DataError.of(self.path, f"K of frame {frame}", expected="a camera matrix", found="none")
        return np.array(stored, dtype=np.float64)

    @property
    def cam_from_world(self) -> np.ndarray:
        """World-to-camera transform, float64 `[4, 4]`, translation in [m]."""
        stored = self.manifest["cam_from_world"]
        if stored is None:
            raise DataError.of(self.path, "cam_from_world", expected="one camera's place", found="a pack of several")
        return np.array(stored, dtype=np.float64)

    def split(self, name: str) -> list[str]:
        """Frame ids of the split `train` or `test`, in time order."""
        split = self.manifest.get("split", {})
        return [frame for frame in self.frames if split.get(frame, "train") == name]


_FORM = {
    "stage": str,
    "subject": str,
    "camera": str,
    "width": int,
    "height": int,
    "cam_from_world": (None, matrix_form(4, 4)),  # null in renders of several cameras
    "cam_from_world_per_frame?": (None, {str: matrix_form(4, 4)}),
    "K?": (None, matrix_form(3, 3)),
    "K_per_frame?": (None, {str: matrix_form(3, 3)}),
    "distortion?": (None, [float]),
    "frames": [str],
    "layers": (dict, [str]),
    "split?": {str: str},
    "segments?": [(Ellipsis, 2, int)],
    "record?": (None, {"config?": (None, dict), "tuned?": (None, dict), "training?": (None, dict), "variant?": object}),
    "variant?": (None, str),
    "background?": (None, (Ellipsis, 3, float)),
}


def _check_manifest(manifest: Any, path: Path) -> None:
    if isinstance(manifest, dict) and manifest.get("format") != FORMAT:
        found = describe(manifest.get("format"))
        raise DataError.of(path, "format", expected=FORMAT, found=found, fix="make it again with this version")
    check_form(manifest, _FORM, path)
    for key in ("width", "height"):
        if manifest[key] < 1:
            raise DataError.of(path, key, expected="a size [px]", found=manifest[key])
    count = len(manifest["frames"])
    if any(not 0 <= first <= last < count for first, last in manifest.get("segments", ())):
        expected = f"first and last of {count} frames"
        raise DataError.of(path, "segments", expected=expected, found=describe(manifest["segments"]))
