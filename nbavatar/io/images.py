"""PNG and other still images, by Pillow: light enough for training nodes."""

import io
import os
from pathlib import Path

import numpy as np
from PIL import Image

from nbavatar.errors import DataError

__all__ = ["decode_image", "encode_png", "linear_light"]

_FORMATS = ("PNG", "JPEG", "WEBP")


def encode_png(image: np.ndarray, *, level: int = 1) -> bytes:
    """Encodes uint8 `[H, W]`, `[H, W, 3]` (RGB) or `[H, W, 4]` (straight alpha) as PNG; `level` of zlib, 1 = fast."""
    if image.dtype != np.uint8 or image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] not in (3, 4)):
        raise TypeError(f"expected uint8 [H, W] or [H, W, 3 or 4], got {image.dtype} {list(image.shape)}")
    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image)).save(stream, "PNG", compress_level=level)
    return stream.getvalue()


def decode_image(source: bytes | str | os.PathLike[str], name: str | None = None) -> np.ndarray:
    """Decodes PNG, JPEG or WebP to uint8 `[H, W]` (grey, labels) or `[H, W, 3]` (RGB).

    An alpha channel is dropped; palette images keep their indices, which is what label masks mean.

    Args:
        source: encoded bytes or a path.
        name: what to call the source in errors; its path by default.

    Raises:
        DataError: missing, truncated or not an image.
    """
    label = name or (str(source) if not isinstance(source, bytes) else "image")
    try:
        with Image.open(io.BytesIO(source) if isinstance(source, bytes) else Path(source), formats=_FORMATS) as image:
            if image.mode == "P":
                return np.array(image)
            if image.mode in ("1", "L", "LA"):
                return np.array(image.convert("L"))
            return np.array(image.convert("RGB"))
    except FileNotFoundError as error:
        raise DataError.of(label, expected="an image", found="no such file") from error
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise DataError.of(label, expected="a whole image", found=f"one that does not decode ({error})") from error


def linear_light(colours: np.ndarray) -> np.ndarray:
    """Light in [0, 1] of sRGB bytes, float64 of their shape: the transfer function undone (IEC 61966-2-1)."""
    value = np.arange(256) / 255.0
    table = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return table[np.asarray(colours)]
