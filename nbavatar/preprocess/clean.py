"""Repair of masks: noise of lossy video, holes, islands, flicker."""

import cv2
import numpy as np

from nbavatar.io.framepack import parts_in, unseen_in

__all__ = ["clean_labels", "repair_flicker", "spread_labels", "threshold_matte"]


def threshold_matte(matte: np.ndarray, threshold: int) -> np.ndarray:
    """Foreground of a grey matte, bool `[H, W]`.

    A 3 x 3 median first takes away the ringing that video compression leaves beside edges; it moves straight edges not
    at all and rounds corners by less than a pixel.
    """
    return cv2.medianBlur(np.ascontiguousarray(matte), 3) > threshold


def clean_labels(label: np.ndarray, support: np.ndarray, *, hole_fraction: float, island_fraction: float) -> np.ndarray:
    """Fills holes and removes islands of part labels.

    A hole is a background region that touches no image border. It is filled, with what the meshes say, if it is smaller
    than `hole_fraction` of all parts together and lies mostly within the meshes' silhouettes: gaps between fingers or
    strands are real, holes in a cheek are not. An island is a piece of a part that is not its largest; it is removed
    if it is smaller than `island_fraction` of the part, unless it lies mostly within the part's own silhouette (a
    fingertip that is seen beyond another finger) or touches pixels that say nothing, behind which it may go on.

    Args:
        label: uint8 `[H, W]`, 0 = background, 255 = unknown, which stays so.
        support: uint8 `[H, W]`, labels of the projected meshes.
        hole_fraction: share of the area of all parts.
        island_fraction: share of the area of the part.

    Returns:
        uint8 `[H, W]`, a new array.
    """
    result = label.copy()
    parts, unseen = parts_in(label), unseen_in(label)
    total = int(parts.sum())
    beside = cv2.dilate(unseen.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0 if unseen.any() else unseen
    for value in np.unique(label[parts]):
        count, pieces, stats, _ = cv2.connectedComponentsWithStats((label == value).astype(np.uint8), connectivity=8)
        if count <= 2:
            continue
        areas = stats[:, cv2.CC_STAT_AREA].copy()
        areas[0] = 0
        own = np.bincount(pieces[support == value], minlength=count)
        drop = (areas < island_fraction * areas.sum()) & (2 * own < areas)
        drop[[0, int(areas.argmax())]] = False
        drop[pieces[beside]] = False
        result[drop[pieces]] = 0
    count, pieces, stats, _ = cv2.connectedComponentsWithStats((result == 0).astype(np.uint8), connectivity=4)
    height, width = label.shape
    left, top = stats[:, cv2.CC_STAT_LEFT], stats[:, cv2.CC_STAT_TOP]
    right, bottom = left + stats[:, cv2.CC_STAT_WIDTH], top + stats[:, cv2.CC_STAT_HEIGHT]
    areas = stats[:, cv2.CC_STAT_AREA]
    inner = (left > 0) & (top > 0) & (right < width) & (bottom < height)
    inside = np.bincount(pieces[support > 0], minlength=count)
    fill = inner & (areas < hole_fraction * total) & (2 * inside >= areas)
    fill[0] = False
    holes = fill[pieces]
    if not holes.any():
        return result
    nearest = spread_labels(np.where(unseen, np.uint8(0), result))
    return np.where(holes, np.where(support > 0, support, nearest), result)


def repair_flicker(before: np.ndarray, label: np.ndarray, after: np.ndarray, support: np.ndarray) -> np.ndarray:
    """Repairs what is wrong in one frame only.

    Where the frames before and after show the same part and this one does not, theirs is taken if this frame's meshes
    say the same. Anything that moves fast moves the meshes as well, and is left alone; so is what has no mesh, such as
    hair.

    Args:
        before, label, after: uint8 `[H, W]`, labels of three consecutive frames.
        support: uint8 `[H, W]`, labels of this frame's projected meshes, 0 where there is none.

    Returns:
        uint8 `[H, W]`.
    """
    return np.where((before == after) & (before > 0) & (support == before), before, label)


def spread_labels(label: np.ndarray) -> np.ndarray:
    """The nearest label at every pixel, uint8 `[H, W]`; all zero if there is none."""
    if not label.any():
        return label
    away = np.where(label > 0, np.uint8(0), np.uint8(1))
    _, nearest = cv2.distanceTransformWithLabels(away, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    nearest = np.asarray(nearest, dtype=np.int64)
    table = np.zeros(int(nearest.max()) + 1, dtype=np.uint8)
    table[nearest[label > 0]] = label[label > 0]
    return table[nearest]
