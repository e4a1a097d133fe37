"""A person's matte by MediaPipe's small network for selfies, run by OpenCV.

The network sees 256 x 256 pixels. So it looks twice, the second time at the box of the person that it found, and its
soft edge is fitted to the picture's by a guided filter (He et al. 2010). It is meant for one person near the camera;
fingers and strands of hair are finer than it sees.
"""

import cv2
import numpy as np

from nbavatar.detection.networks import Network

__all__ = ["PersonMatting"]

_SIDE = 256
_OUTPUT = "activation_10"
_MARGIN = 0.15  # around the person's box, as a share of its longer side
_STEEP = (0.25, 0.75)  # along its edge the matte rises between these


class PersonMatting:
    """The network.

    Args:
        content: of its file (`data.detector_models.read_matting_model`).
        refine: look twice and fit the edge to the picture.

    Raises:
        DependencyError: this build of OpenCV cannot read it.
    """

    def __init__(self, content: bytes, *, refine: bool = True) -> None:
        self._network, self._refine = Network(content, "selfie_segmentation"), refine

    def matte(self, image: np.ndarray) -> np.ndarray:
        """The matte uint8 `[H, W]` (0 background, 255 person) of a picture uint8 `[H, W, 3]` RGB."""
        sure = self._look(image)
        if self._refine:
            x0, y0, x1, y1 = _box(sure > 0.5, _MARGIN)
            if (x1 - x0) * (y1 - y0) < 0.8 * sure.size and x1 > x0:
                near = self._look(image[y0:y1, x0:x1])
                sure = np.zeros_like(sure)
                sure[y0:y1, x0:x1] = near
            radius = max(2, round(max(sure.shape) / _SIDE * 2))
            sure = _fit_edges(image, sure, radius)
        return _decided(sure, max(2, round(max(sure.shape) / _SIDE)))

    def _look(self, image: np.ndarray) -> np.ndarray:
        """How sure the network is of each pixel, float32 `[H, W]` in [0, 1]."""
        height, width = image.shape[:2]
        smaller = max(height, width) > _SIDE
        shown = cv2.resize(image, (_SIDE, _SIDE), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)
        self._network.show(shown, 0.0)
        found = self._network.output(_OUTPUT).reshape(_SIDE, _SIDE)
        return np.clip(cv2.resize(found, (width, height), interpolation=cv2.INTER_LINEAR), 0.0, 1.0)


def _decided(sure: np.ndarray, rim: int) -> np.ndarray:
    """A matte that is soft along its edge only: what the network is unsure of elsewhere falls to the likelier side."""
    person = (sure > 0.5).astype(np.uint8)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * rim + 1, 2 * rim + 1))
    edge = cv2.dilate(person, kernel) > cv2.erode(person, kernel)
    low, high = _STEEP
    soft = np.clip((sure - low) / (high - low), 0.0, 1.0)
    return np.round(np.where(edge, soft, person) * 255).astype(np.uint8)


def _box(inside: np.ndarray, margin: float) -> tuple[int, int, int, int]:
    """x0, y0, x1, y1 [px] around the true pixels, widened and within the image; all zero where there are none."""
    rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    if not len(rows):
        return 0, 0, 0, 0
    more = round(margin * max(int(np.ptp(rows)), int(np.ptp(columns))) + 1)
    height, width = inside.shape
    return (
        max(0, int(columns[0]) - more), max(0, int(rows[0]) - more),
        min(width, int(columns[-1]) + 1 + more), min(height, int(rows[-1]) + 1 + more),
    )  # fmt: skip


def _fit_edges(image: np.ndarray, soft: np.ndarray, radius: int, *, eps: float = 1e-4) -> np.ndarray:
    """The guided filter: in every window the result is linear in the picture's brightness.

    Args:
        image: uint8 `[H, W, 3]`.
        soft: float32 `[H, W]`.
        radius: of the window [px].
        eps: variance of the brightness below which a window counts as flat [1].
    """
    guide = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255
    window = (2 * radius + 1, 2 * radius + 1)

    def mean(values: np.ndarray) -> np.ndarray:
        return cv2.blur(values, window, borderType=cv2.BORDER_REFLECT)

    guide_mean, soft_mean = mean(guide), mean(soft)
    slope = (mean(guide * soft) - guide_mean * soft_mean) / (mean(guide * guide) - guide_mean**2 + eps)
    return mean(slope) * guide + mean(soft_mean - slope * guide_mean)
