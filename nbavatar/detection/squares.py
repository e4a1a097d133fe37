"""Turned squares of an image: what a network sees, and the way back to pixels.

Positions follow the project's convention: pixel (0, 0) covers [0, 1) x [0, 1), in crops and images alike.
"""

import dataclasses
import math

import numpy as np

__all__ = ["Square", "cut_square", "square_around", "to_crop", "to_image"]


@dataclasses.dataclass(frozen=True)
class Square:
    """A square region of an image.

    Attributes:
        x, y: centre [px].
        side: length of a side [px].
        angle: direction of the crop's x axis in the image, from x towards y (clockwise as one looks at it) [rad].
    """

    x: float
    y: float
    side: float
    angle: float = 0.0

    @property
    def axes(self) -> np.ndarray:
        """Columns are the crop's x and y axes in the image, `[2, 2]`."""
        c, s = math.cos(self.angle), math.sin(self.angle)
        return np.array([[c, -s], [s, c]])


def to_image(points: np.ndarray, square: Square, size: int) -> np.ndarray:
    """Positions in a crop of `size` px a side `[..., 2]` as positions in the image `[..., 2]` [px]."""
    centred = (np.asarray(points, dtype=np.float64) / size - 0.5) * square.side
    return centred @ square.axes.T + [square.x, square.y]


def to_crop(points: np.ndarray, square: Square, size: int) -> np.ndarray:
    """Positions in the image `[..., 2]` as positions in a crop of `size` px a side; the inverse of `to_image`."""
    centred = (np.asarray(points, dtype=np.float64) - [square.x, square.y]) @ square.axes
    return (centred / square.side + 0.5) * size


def cut_square(image: np.ndarray, square: Square, size: int, *, replicate: bool = False) -> np.ndarray:
    """The square as an upright image.

    Large squares are sampled more finely and averaged, so that nothing aliases.

    Args:
        image: uint8 `[H, W, 3]`.
        square: which region; it may stick out of the image.
        size: side of the result [px].
        replicate: beyond the image, repeat its border instead of black.

    Returns:
        uint8 `[size, size, 3]`.
    """
    import cv2

    fine = size * max(1, round(square.side / size))
    scale = square.side / fine
    matrix = np.zeros((2, 3))
    matrix[:, :2] = square.axes * scale
    # OpenCV counts from pixel centres: both ends of the map move by half a pixel.
    matrix[:, 2] = to_image(np.array([0.5, 0.5]), square, fine) - 0.5
    border = cv2.BORDER_REPLICATE if replicate else cv2.BORDER_CONSTANT
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    crop = cv2.warpAffine(image, matrix, (fine, fine), flags=flags, borderMode=border)
    return crop if fine == size else cv2.resize(crop, (size, size), interpolation=cv2.INTER_AREA)


def square_around(points: np.ndarray, angle: float, *, scale: float, shift: float = 0.0) -> Square:
    """Square over points, seen in axes turned by `angle`.

    Args:
        points: `[n, 2]` [px].
        angle: of the square [rad].
        scale: side over the longer side of the points' box.
        shift: how far the centre moves along the square's y axis, in heights of the points' box.
    """
    axes = Square(0.0, 0.0, 1.0, angle).axes
    turned = np.asarray(points, dtype=np.float64) @ axes
    low, high = turned.min(0), turned.max(0)
    width, height = high - low
    centre = axes @ ((low + high) / 2 + [0.0, shift * height])
    return Square(float(centre[0]), float(centre[1]), scale * float(max(width, height, 1.0)), angle)
