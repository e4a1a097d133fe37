"""Picture of an estimated light, for a person to look at."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from nbavatar.data.lights import Light

__all__ = ["Shot", "light_picture"]

_LOBE = 60.0  # sharpness of a light's spot on the map: some 10 degrees
_SKIN = 0.35  # albedo of the grey meshes
_MARGIN = 0.05  # around the meshes, of their size


class Shot(NamedTuple):
    """One view.

    Attributes:
        image: photograph, uint8 (h, w, 3).
        shine: light on the meshes, 1 in the mean, float (h, w); NaN beside them.
    """

    image: np.ndarray
    shine: np.ndarray


def light_picture(shots: Sequence[Shot], light: Light, cam_from_world: np.ndarray, size: int) -> np.ndarray:
    """Photographs above the grey meshes in the light, and the lights on a map of all directions.

    Args:
        shots: of one camera.
        light: may have no lights at all: its map is black, and the meshes' light is as given.
        cam_from_world: of that camera (4, 4); the middle of the map is light that comes from it, and up is up in its
            pictures.
        size: side of a tile [px].

    Returns:
        uint8 (2 size, (n + 4) size, 3).
    """
    columns = [np.concatenate(_tiles(shot, size)) for shot in shots]
    return np.concatenate([*columns, _map(light, cam_from_world[:3, :3], 2 * size)], axis=1)


def _tiles(shot: Shot, size: int) -> list[np.ndarray]:
    """Photograph and grey meshes, both cut to where the meshes are."""
    import cv2

    there = np.isfinite(shot.shine)
    grey = np.where(there, np.clip(_SKIN * np.nan_to_num(shot.shine), 0.0, 1.0) ** (1 / 2.2), 1.0)
    shaded = np.repeat((255.0 * grey).round().astype(np.uint8)[..., None], 3, axis=-1)
    rows, columns = np.flatnonzero(there.any(1)), np.flatnonzero(there.any(0))
    height, width = there.shape
    if len(rows):
        side = int((1 + 2 * _MARGIN) * max(np.ptp(rows), np.ptp(columns))) + 2
        top, left = (int(0.5 * (found[0] + found[-1]) - side / 2) for found in (rows, columns))
        top, left = max(0, min(top, height - side)), max(0, min(left, width - side))
        cut = np.s_[top : top + side, left : left + side]
    else:
        cut = np.s_[:, :]
    tiles = []
    for picture in (shot.image, shaded):
        part = picture[cut]
        scale = size / max(part.shape[:2])
        small = cv2.resize(
            part, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        )
        tile = np.full((size, size, 3), 255, np.uint8)
        tile[: min(size, len(small)), : min(size, small.shape[1])] = small[:size, :size]
        tiles.append(tile)
    return tiles


def _map(light: Light, rotation: np.ndarray, height: int) -> np.ndarray:
    """Lights as soft spots on a map of all directions, uint8 (height, 2 height, 3), the strongest white."""
    up = (0.5 - (np.arange(height) + 0.5) / height) * np.pi
    right = ((np.arange(2 * height) + 0.5) / height - 1.0) * np.pi
    # Camera axes: x right, y down, z away from the camera; light that comes from it has the direction -z.
    level = np.cos(up)[:, None]
    axes = np.broadcast_arrays(level * np.sin(right), -np.sin(up)[:, None], -level * np.cos(right))
    there = np.stack(axes, axis=-1)
    shown = np.zeros((height, 2 * height))
    for direction, weight in zip(light.directions.astype(np.float64) @ rotation.T, light.weights, strict=True):
        shown += weight * np.exp(_LOBE * (there @ direction - 1.0))
    shown = (shown / max(shown.max(), 1e-12)) ** (1 / 2.2)
    return np.repeat((255.0 * shown).round().astype(np.uint8)[..., None], 3, axis=-1)
