"""Still pictures as users bring them, read for a purpose: colours, or one value a pixel.

Only the kinds of files that are meant are opened, whatever their names say, and nothing is decoded before its size is
known to be right. EXIF orientation is applied, so that pixels lie as viewers show them. Numbers are kept: 16 bits are
scaled to 8 where colours are wanted, and stay as they are where values are.
"""

import contextlib
import dataclasses
import os
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from nbavatar.errors import DataError, parsing

__all__ = ["MOST_PIXELS", "PICTURE_TYPES", "Plane", "picture_size", "read_colours", "read_plane"]

PICTURE_TYPES = (".jpg", ".jpeg", ".png", ".webp")
"""Endings of the files that are read, in lower case."""

_FORMATS = ("JPEG", "PNG", "WEBP")
MOST_PIXELS = 89_000_000
_SHOWN_OF = 10_000  # pixels whose colours are sorted for an error line
_ORIENTATION = 0x0112
_NEUTRAL = {False: 0, True: 12}  # largest difference between the channels of grey pixels, without and with loss
_KINDS = {
    b"version https://git-lfs": ("a pointer of Git LFS in its place", "fetch the file itself with: git lfs pull"),
    b"%!PS": ("PostScript", ""),
    b"%PDF": ("a PDF", ""),
    b"GIF8": ("a GIF", "convert it to png"),
    b"BM": ("a BMP", "convert it to png"),
    b"II*\0": ("a TIFF", "convert it to png"),
    b"MM\0*": ("a TIFF", "convert it to png"),
    b"v/1\x01": ("an OpenEXR file", "convert it to png"),
    b"<": ("text", ""),
}


@dataclasses.dataclass(frozen=True)
class Plane:
    """One value a pixel.

    Attributes:
        values: uint8 or uint16 `[H, W]`, as stored: the alpha channel where there is one that varies, else the grey
            values, else the indices of a palette of colours.
        lossy: whether the file's format changes values (JPEG, most WebP).
    """

    values: np.ndarray
    lossy: bool


def read_colours(path: str | os.PathLike[str], size: tuple[int, int] | None = None) -> np.ndarray:
    """Reads sRGB colours, uint8 `[H, W, 3]`; an alpha channel is left out.

    Args:
        path: a JPEG, PNG or WebP.
        size: width and height that it must have [px]; None for any.

    Raises:
        DataError: missing, damaged, another kind of file, another size, or values that are no colours.
    """
    with _opened(path, size) as (image, turn):
        if image.mode.startswith("I"):
            deep = _whole(image, path)
            grey = ((deep.astype(np.uint32) * 255 + 32767) // 65535).astype(np.uint8)
            return _turned(np.repeat(grey[..., None], 3, axis=2), turn)
        if image.mode == "F":
            raise DataError.of(path, expected="colours of 8 or 16 bits", found="floating-point values")
        return _turned(np.array(image.convert("RGB")), turn)


def read_plane(path: str | os.PathLike[str], size: tuple[int, int] | None = None) -> Plane:
    """Reads one value a pixel: labels, a matte, coverage.

    Args:
        path: a JPEG, PNG or WebP.
        size: width and height that it must have [px]; None for any.

    Raises:
        DataError: missing, damaged, another kind of file, another size, or colours.
    """
    with _opened(path, size) as (image, turn):
        lossy = _is_lossy(image, path)
        if "transparency" in image.info or image.mode in ("LA", "La", "PA", "RGBA", "RGBa"):
            alpha = np.array(image.convert("RGBA").getchannel("A"))
            if alpha.size and alpha.min() < 255:
                return Plane(_turned(alpha, turn), lossy and image.format == "JPEG")
            image = image.convert({"LA": "L", "La": "L", "RGBA": "RGB", "RGBa": "RGB", "PA": "P"}.get(image.mode))
        if image.mode == "P":
            values = _indices(image)
        elif image.mode.startswith("I"):
            values = _whole(image, path)
        elif image.mode in ("1", "L"):
            values = np.array(image.convert("L"))
        elif image.mode == "RGB":
            values = _neutral(np.array(image), lossy, path)
        else:
            found = "floating-point values" if image.mode == "F" else f"a picture of mode {image.mode}"
            raise DataError.of(path, expected="one whole number a pixel", found=found)
        return Plane(_turned(values, turn), lossy)


def picture_size(path: str | os.PathLike[str]) -> tuple[int, int]:
    """Width and height [px], from the file's header alone.

    Raises:
        DataError: missing, another kind of file, or one that viewers turn (EXIF orientation), so that it is not said
            which way a calibration by another program means it.
    """
    with _opened(path, None) as (image, turn):
        if turn > 1:
            fix = "store the picture upright and without the tag, and calibrate with what is stored"
            raise DataError.of(path, "EXIF orientation", expected="1 (upright)", found=turn, fix=fix)
        return image.size


@contextlib.contextmanager
def _opened(path: str | os.PathLike[str], size: tuple[int, int] | None) -> Iterator[tuple[Image.Image, int]]:
    """The opened picture, of the right size once it is turned, and its EXIF orientation."""
    # Pillow warns of what it goes on with; what it cannot go on with it raises.
    with warnings.catch_warnings(), parsing(path, "a whole image", damaged="one that does not decode"):
        warnings.simplefilter("ignore")
        try:
            image = Image.open(Path(path), formats=_FORMATS)
        except Image.UnidentifiedImageError as error:
            found, fix = _kind_of(path)
            raise DataError.of(path, expected="a whole image (jpg, png or webp)", found=found, fix=fix) from error
        with image:
            turn = image.getexif().get(_ORIENTATION, 1)
            turn = turn if turn in range(1, 9) else 1
            _check_size(path, image, turn, size)
            yield image, turn


def _check_size(path: str | os.PathLike[str], image: Image.Image, turn: int, size: tuple[int, int] | None) -> None:
    width, height = image.size if turn < 5 else image.size[::-1]
    if size is not None and (width, height) != size:
        turned = f", turned by its EXIF orientation {turn}" if turn > 1 else ""
        expected = f"{size[0]} x {size[1]} as its camera says"
        raise DataError.of(path, "size", expected=expected, found=f"{width} x {height}{turned}")
    if width * height > MOST_PIXELS:
        raise DataError.of(path, "size", expected=f"at most {MOST_PIXELS} pixels", found=f"{width} x {height}")
    if image.format in ("PNG", "WEBP") and getattr(image, "n_frames", 1) > 1:
        raise DataError.of(path, expected="a still image", found="a moving one")


def _kind_of(path: str | os.PathLike[str]) -> tuple[str, str]:
    """What a file is that is no picture, and what to do about it."""
    with open(path, "rb") as stream:
        head = stream.read(64)
    if not head:
        return "an empty file", ""
    if head[4:12] in (b"ftypavif", b"ftypheic", b"ftypheix", b"ftypmif1"):
        return "an AVIF or HEIC picture", "convert it to png"
    if head.startswith((b"\x89PNG", b"\xff\xd8\xff", b"RIFF")):
        return "one that does not decode", "it is damaged: fetch it again"
    return next((kind for start, kind in _KINDS.items() if head.startswith(start)), ("another kind of file", ""))


def _is_lossy(image: Image.Image, path: str | os.PathLike[str]) -> bool:
    if image.format != "WEBP":
        return image.format != "PNG"
    with open(path, "rb") as stream:
        return b"VP8L" not in stream.read(4096)


def _whole(image: Image.Image, path: str | os.PathLike[str]) -> np.ndarray:
    """The values of a picture of more than 8 bits, uint16 `[H, W]`."""
    values = np.array(image)
    if values.size and (values.min() < 0 or values.max() > 65535):
        found = f"{values.min()} to {values.max()}"
        raise DataError.of(path, expected="values of at most 16 bits", found=found)
    return values.astype(np.uint16)


def _indices(image: Image.Image) -> np.ndarray:
    """Values of a picture with a palette, uint8 `[H, W]`.

    Palettes of colours number labels, and the numbers count. A palette of greys may belong to a matte that was made
    smaller: then the greys count, unless there are three or four that number 0..3, beside 255 or not.
    """
    index = np.array(image)
    used = np.unique(index)
    palette = np.array(image.getpalette("RGB") or [], dtype=np.uint8).reshape(-1, 3)
    if len(used) and used.max() < len(palette):
        shown = palette[used].astype(int)
        numbers = used[used < 255]
        if (np.ptp(shown, axis=1) == 0).all() and (len(numbers) <= 2 or numbers.max() > 3):
            return palette[index, 0]
    return index


def _neutral(colours: np.ndarray, lossy: bool, path: str | os.PathLike[str]) -> np.ndarray:
    """The greys of an RGB picture, uint8 `[H, W]`."""
    spread = colours.max(axis=2) - colours.min(axis=2)
    if spread.max(initial=0) > _NEUTRAL[lossy]:
        coloured = np.flatnonzero(spread.reshape(-1) > _NEUTRAL[lossy])
        some = coloured[:: 1 + len(coloured) // _SHOWN_OF]
        kinds, counts = np.unique(colours.reshape(-1, 3)[some], axis=0, return_counts=True)
        shown = ", ".join(str(tuple(map(int, kinds[i]))) for i in np.argsort(-counts, kind="stable")[:4])
        more = " and others" if len(kinds) > 4 else ""
        fix = "store one number a pixel: labels 0..3, or 0 and 255 for the person"
        raise DataError.of(path, expected="one value a pixel", found=f"colours: {shown}{more}", fix=fix)
    return colours[..., 1]


def _turned(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Pixels `[H, W, ...]` as a viewer shows them that knows the EXIF orientation."""
    if orientation in (2, 7):
        pixels = pixels[:, ::-1]
    elif orientation in (4, 5):
        pixels = pixels[::-1]
    quarters = {3: 2, 5: 3, 6: 3, 7: 3, 8: 1}.get(orientation, 0)
    return np.ascontiguousarray(np.rot90(pixels, quarters) if quarters else pixels)
