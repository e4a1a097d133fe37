"""Contact sheet of a detection: one row a frame, one column a camera, keypoints drawn over the images.

Head green, right hand orange, left hand magenta; bones of the hands as lines. Filled dots have a confidence of 0.5 or
more, hollow ones less.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from PIL import Image, ImageDraw

__all__ = ["draw_keypoints", "sheet_frames"]

_COLOURS = {"head": (60, 230, 90), "right_hand": (255, 150, 0), "left_hand": (230, 60, 200)}
_FINGERS = ((0, 13, 14, 15, 16), (0, 1, 2, 3, 17), (0, 4, 5, 6, 18), (0, 10, 11, 12, 19), (0, 7, 8, 9, 20))
_SURE = 0.5


def sheet_frames(count: int, shown: int) -> list[int]:
    """Positions of `shown` of `count` frames, spread over all."""
    return sorted({round(float(i)) for i in np.linspace(0, count - 1, min(shown, count))})


def draw_keypoints(rows: Sequence[Sequence[tuple[str, np.ndarray, Mapping[str, np.ndarray]]]], tile: int) -> np.ndarray:
    """Draws the sheet.

    Args:
        rows: pictures, one row a frame: title, image uint8 `[H, W, 3]`, and part -> `[L, 3]` x, y [px], confidence.
        tile: height of a picture [px].

    Returns:
        uint8 `[H', W', 3]`.
    """
    strips = [np.concatenate([_draw(*picture, tile) for picture in row], axis=1) for row in rows]
    width = max(strip.shape[1] for strip in strips)
    return np.concatenate([np.pad(s, ((0, 0), (0, width - s.shape[1]), (0, 0))) for s in strips])


def _draw(title: str, image: np.ndarray, keypoints: Mapping[str, np.ndarray], tile: int) -> np.ndarray:
    height, width = image.shape[:2]
    scale = tile / height
    picture = Image.fromarray(image).resize((max(1, round(width * scale)), tile), Image.Resampling.BILINEAR)
    draw = ImageDraw.Draw(picture)
    radius = max(1.0, tile / 240)
    for part, points in keypoints.items():
        colour, xy = _COLOURS[part], points[:, :2] * scale
        if part != "head":
            for finger in _FINGERS:
                for a, b in zip(finger, finger[1:], strict=False):
                    if points[a, 2] > 0 and points[b, 2] > 0:
                        draw.line((*xy[a].tolist(), *xy[b].tolist()), fill=colour)
        for (x, y), sure in zip(xy.tolist(), points[:, 2].tolist(), strict=True):
            if sure > 0:
                box = (x - radius, y - radius, x + radius, y + radius)
                draw.ellipse(box, fill=colour if sure >= _SURE else None, outline=colour)
    draw.text((4, 3), title, fill=(255, 255, 255), stroke_width=1, stroke_fill=(0, 0, 0))
    return np.asarray(picture)
