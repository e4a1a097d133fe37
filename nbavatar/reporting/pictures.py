"""Pictures of a report: reduced copies, error maps, embedding.

error map   mean over RGB of |render - truth|, sRGB in [0, 1], shown from 0 (black) to ``ERROR_MAX`` (pale yellow)
            on a ramp of rising lightness, so that it reads without colour vision and in print
"""

import base64
import io
from collections.abc import Sequence

import numpy as np

__all__ = ["ERROR_MAX", "RAMP", "data_uri", "error_map", "reduce_picture", "spread"]

ERROR_MAX = 0.25
# Anchors of the ramp, evenly spaced, sRGB 8 bit; their lightness rises in even steps.
RAMP = ((0, 0, 0), (58, 15, 92), (146, 36, 104), (221, 81, 58), (252, 165, 38), (252, 255, 190))


def error_map(prediction: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Coloured error map.

    Args:
        prediction: uint8 [H, W, 3].
        truth: float32 [H, W, 3] in [0, 1].

    Returns:
        uint8 [H, W, 3].
    """
    error = np.abs(prediction.astype(np.float32) / 255 - truth).mean(axis=-1)
    position = np.clip(error / ERROR_MAX, 0, 1)
    anchors = np.linspace(0, 1, len(RAMP))
    table = np.asarray(RAMP, dtype=np.float32)
    channels = [np.interp(position, anchors, table[:, c]) for c in range(3)]
    return np.round(np.stack(channels, axis=-1)).astype(np.uint8)


def reduce_picture(picture: np.ndarray, max_side: int) -> np.ndarray:
    """Box-filtered copy with no side above ``max_side`` [px]; smaller pictures stay as they are."""
    from PIL import Image

    height, width = picture.shape[:2]
    factor = max_side / max(height, width)
    if factor >= 1:
        return picture
    size = max(1, round(width * factor)), max(1, round(height * factor))
    return np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.BOX))


def data_uri(picture: np.ndarray) -> str:
    """``data:`` address of a picture: PNG where it is small (exact), JPEG of quality 90 elsewhere.

    Args:
        picture: uint8 [H, W, 3] or [H, W].
    """
    from PIL import Image

    stream = io.BytesIO()
    exact = max(picture.shape[:2]) <= 256
    image = Image.fromarray(np.ascontiguousarray(picture))
    if exact:
        image.save(stream, "PNG", optimize=True)
    else:
        image.save(stream, "JPEG", quality=90, subsampling=0)
    kind = "png" if exact else "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(stream.getvalue()).decode('ascii')}"


def spread(items: Sequence[str], count: int) -> list[str]:
    """At most ``count`` of the items, evenly spaced, first and last among them (the middle one if count is 1)."""
    if len(items) <= count:
        return list(items)
    if count == 1:
        return [items[len(items) // 2]]
    last = len(items) - 1
    return [items[round(i * last / (count - 1))] for i in range(count)]
