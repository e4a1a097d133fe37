"""Windows cut out of images, lens distortion removed on the way, and exact area resizing.

A window may stick out of the image, and an undistorted image ends in curves; what lies outside is 0, and nothing is
known of it: neither training nor evaluation may take it for background.

With pixel centres at +0.5 the camera matrix of the result is that of `camera.pinhole.crop_intrinsics` followed by
`scale_intrinsics`, with no half-pixel terms.
"""

from collections.abc import Sequence

import cv2
import numpy as np

from nbavatar.camera.distortion import undistortion_map
from nbavatar.camera.pinhole import crop_intrinsics

__all__ = ["Window", "blank_unseen", "resize_area", "resize_labels", "resize_unseen"]

_RIM = 2  # pixels at an image's border that cubic interpolation mixes with what lies outside


class Window:
    """Cuts the same window out of many images of one camera.

    Args:
        x0: left column of the window [px]; may be negative.
        y0: top row [px]; may be negative.
        side: width and height of the window [px].
        K: camera matrix of the images, needed with `distortion`.
        distortion: lens coefficients to remove, or None. The window is then placed in the undistorted image, which has
            the same camera matrix.
    """

    def __init__(self, x0: int, y0: int, side: int, K: np.ndarray, distortion: np.ndarray | None = None) -> None:
        self.x0, self.y0, self.side = x0, y0, side
        self._map = None
        if distortion is not None:
            self._map = undistortion_map(K, distortion, crop_intrinsics(K, x0, y0), side, side)

    def cut(self, image: np.ndarray, *, labels: bool = False) -> np.ndarray:
        """The window of a uint8 image `[H, W]` or `[H, W, 3]`, at native scale; `labels` are never mixed."""
        if self._map is not None:
            kind = cv2.INTER_NEAREST if labels else (cv2.INTER_CUBIC if image.ndim == 3 else cv2.INTER_LINEAR)
            return cv2.remap(image, *self._map, interpolation=kind, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        height, width = image.shape[:2]
        result = np.zeros((self.side, self.side, *image.shape[2:]), dtype=image.dtype)
        left, top = max(self.x0, 0), max(self.y0, 0)
        right, bottom = min(self.x0 + self.side, width), min(self.y0 + self.side, height)
        if right > left and bottom > top:
            rows, columns = slice(top - self.y0, bottom - self.y0), slice(left - self.x0, right - self.x0)
            result[rows, columns] = image[top:bottom, left:right]
        return result

    def unseen(self, height: int, width: int, size: int) -> np.ndarray:
        """Pixels of the window, resized to `size`, that images of this size do not determine: bool `[size, size]`."""
        image = np.full((height, width), 255, dtype=np.uint8)
        if self._map is not None:
            image[:_RIM] = image[-_RIM:] = image[:, :_RIM] = image[:, -_RIM:] = 0
        return resize_area(np.where(self.cut(image) < 255, np.uint8(255), np.uint8(0)), size) > 0


def blank_unseen(image: np.ndarray, unseen: np.ndarray | None, background: Sequence[float]) -> np.ndarray:
    """A picture uint8 `[H, W, 3]` with the background (sRGB in [0, 1]) at pixels of which there is no truth.

    So it can be compared with a truth that has the background there as well. One of another size is left as it is:
    whoever compares says so.
    """
    if unseen is None or unseen.shape != image.shape[:2]:
        return image
    return np.where(unseen[..., None], np.round(255 * np.asarray(background)).astype(np.uint8), image)


def resize_area(image: np.ndarray, size: int) -> np.ndarray:
    """Resizes a square uint8 image to `size`: the mean over each pixel's area when shrinking, cubic when growing."""
    side = image.shape[0]
    if side == size:
        return image
    return cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA if size < side else cv2.INTER_CUBIC)


def resize_unseen(unseen: np.ndarray, size: int) -> np.ndarray:
    """Resizes a mask of pixels that say nothing, bool `[S, S]`: of a pixel that has a part of one nothing is known."""
    if unseen.shape[0] == size:
        return unseen
    return resize_area(np.where(unseen, np.uint8(255), np.uint8(0)), size) > 0


def resize_labels(label: np.ndarray, alpha: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Resizes part labels and their coverage together.

    Each pixel gets the label that covers most of its area among the parts, and 0 only where no part touches it; so
    every pixel with coverage belongs to a part.

    Args:
        label: uint8 `[S, S]`, 0 = background.
        alpha: uint8 `[S, S]`, coverage.
        size: new side [px].

    Returns:
        label, alpha: uint8 `[size, size]`.
    """
    alpha = np.where(label > 0, alpha, np.uint8(0))
    if label.shape[0] == size:
        return np.where(alpha > 0, label, np.uint8(0)), alpha
    resized = resize_area(alpha, size)
    best = np.zeros((size, size), dtype=np.float32)
    result = np.zeros((size, size), dtype=np.uint8)
    for value in np.unique(label[label > 0]):
        weight = np.where(label == value, np.float32(1), np.float32(0))
        kind = cv2.INTER_AREA if size < label.shape[0] else cv2.INTER_LINEAR
        area = cv2.resize(weight, (size, size), interpolation=kind)
        more = area > best
        result[more], best[more] = value, area[more]
    covered = (resized > 0) & (result > 0)
    return np.where(covered, result, np.uint8(0)), np.where(covered, resized, np.uint8(0))
