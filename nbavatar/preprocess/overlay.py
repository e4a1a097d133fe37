"""Pictures to look at: meshes over images, contact sheets."""

from collections.abc import Sequence

import cv2
import numpy as np

from nbavatar.io.framepack import parts_in

__all__ = ["PART_COLORS", "contact_sheet", "mask_outline", "shade"]

PART_COLORS = np.array([[0, 0, 0], [240, 120, 60], [70, 150, 255], [90, 220, 120]], dtype=np.float32)
"""RGB of background, head, right hand, left hand."""


def shade(
    image: np.ndarray, face: np.ndarray, normals: np.ndarray, part: np.ndarray, *, strength: float = 0.6
) -> np.ndarray:
    """Lays a shaded mesh over an image.

    Args:
        image: uint8 RGB `[H, W, 3]`.
        face: int `[H, W]`, face at each pixel, -1 where there is none.
        normals: float `[F, 3]`, unit normals of the faces in camera axes.
        part: uint8 `[F]`, part label of each face.
        strength: 0 shows the image, 1 hides it under the mesh.

    Returns:
        uint8 RGB `[H, W, 3]`.
    """
    seen = face >= 0
    light = 0.25 + 0.75 * np.abs(normals[face, 2])
    color = PART_COLORS[part[face]] * light[..., None]
    mixed = (1 - strength) * image + strength * color
    result = np.where(seen[..., None], mixed, image)
    edges = np.zeros_like(seen)
    edges[:, 1:] |= (face[:, 1:] != face[:, :-1]) & seen[:, 1:] & seen[:, :-1]
    return np.where(edges[..., None], result * 0.9, result).clip(0, 255).astype(np.uint8)


def mask_outline(image: np.ndarray, label: np.ndarray, color: Sequence[int] = (255, 255, 0)) -> np.ndarray:
    """Draws the outline of every part of a label image, uint8 RGB `[H, W, 3]`; none of what says nothing (255)."""
    result = image.copy()
    width = max(1, round(max(image.shape[:2]) / 500))
    for value in np.unique(label[parts_in(label)]):
        shapes, _ = cv2.findContours((label == value).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(result, shapes, -1, tuple(int(c) for c in color), width)
    return result


def contact_sheet(tiles: Sequence[Sequence[tuple[str, np.ndarray]]], *, cell: int) -> np.ndarray:
    """Rows of captioned pictures, each scaled to fit a square of `cell` pixels; uint8 RGB."""
    bar, rows = 18, []
    columns = max((len(row) for row in tiles), default=0)
    for row in tiles:
        small = [_fitted(picture, cell) for _, picture in row]
        height = max(picture.shape[0] for picture in small)
        canvas = np.full((height + bar, columns * cell, 3), 24, dtype=np.uint8)
        for i, ((caption, _), picture) in enumerate(zip(row, small)):
            high, wide = picture.shape[:2]
            x, y = i * cell + (cell - wide) // 2, bar + (height - high) // 2
            canvas[y : y + high, x : x + wide] = picture
            place = (i * cell + 4, bar - 5)
            cv2.putText(canvas, caption, place, cv2.FONT_HERSHEY_SIMPLEX, 0.42, (230, 230, 230), 1, cv2.LINE_AA)
        rows.append(canvas)
    return np.concatenate(rows) if rows else np.zeros((bar, bar, 3), dtype=np.uint8)


def _fitted(picture: np.ndarray, cell: int) -> np.ndarray:
    scale = cell / max(picture.shape[:2])
    size = max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale))
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
