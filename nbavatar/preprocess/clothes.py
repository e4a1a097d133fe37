"""Clothes told from skin by colour, learned on the fly from the same camera.

Necks of head meshes reach below collars. What lies there is skin or cloth, and both can be seen elsewhere in the
picture: skin (and hair) over the upper head, cloth on the torso below the neck. Two colour histograms collect them
over the frames, and pixels of the neck are judged by their likelihood ratio, averaged over a small neighbourhood.
"""

import cv2
import numpy as np

__all__ = ["ClothesModel"]

_BINS = 16
_ENOUGH = 400  # pixels of either kind before anything is judged


class ClothesModel:
    """Colours of the head and of the torso of one camera.

    Args:
        evidence: how many times likelier cloth than head has to be, as a natural logarithm, to be taken for cloth.
    """

    def __init__(self, evidence: float) -> None:
        self._evidence = evidence
        self._counts = np.zeros((2, _BINS**3))

    def learn(self, image: np.ndarray, head: np.ndarray, torso: np.ndarray) -> None:
        """Adds one frame.

        Args:
            image: uint8 `[H, W, 3]`.
            head: bool `[H, W]`, surely head.
            torso: bool `[H, W]`, surely torso.
        """
        bins = _bins(image)
        for row, region in enumerate((head, torso)):
            self._counts[row] += np.bincount(bins[region], minlength=_BINS**3)

    def cloth(self, image: np.ndarray, region: np.ndarray) -> np.ndarray:
        """Which pixels of `region` (bool `[H, W]`) are cloth; all false while too little has been seen."""
        totals = self._counts.sum(axis=1)
        if totals.min() < _ENOUGH or not region.any():
            return np.zeros_like(region)
        smooth = [_blur(counts) for counts in self._counts]
        # One pixel in a thousand may have any colour at all: unseen colours decide nothing.
        skin, cloth = ((0.999 * c / c.sum() + 0.001 / _BINS**3) for c in smooth)
        ratio = np.log(cloth / skin).astype(np.float32)[_bins(image)]
        weight = region.astype(np.float32)
        size = max(3, round(max(image.shape[:2]) / 200)) | 1
        mean = cv2.blur(ratio * weight, (size, size)) / np.maximum(cv2.blur(weight, (size, size)), 1e-6)
        return region & (mean > self._evidence)


def _bins(image: np.ndarray) -> np.ndarray:
    index = (image // (256 // _BINS)).astype(np.int64)
    return (index[..., 0] * _BINS + index[..., 1]) * _BINS + index[..., 2]


def _blur(counts: np.ndarray) -> np.ndarray:
    """Spreads each bin over its neighbours, so that few pixels fill a plausible volume of colours."""
    cube = counts.reshape(_BINS, _BINS, _BINS)
    for axis in range(3):
        padded = np.pad(cube, [(1, 1) if a == axis else (0, 0) for a in range(3)], mode="edge")
        cut = [slice(None)] * 3
        parts = []
        for shift in range(3):
            cut[axis] = slice(shift, shift + _BINS)
            parts.append(padded[tuple(cut)])
        cube = 0.25 * parts[0] + 0.5 * parts[1] + 0.25 * parts[2]
    return cube.reshape(-1)
