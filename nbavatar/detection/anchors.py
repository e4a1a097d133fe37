"""Single-shot detection: anchors, decoding, suppression of doubles.

The layout is that of MediaPipe's face and palm detectors (graph options of `SsdAnchorsCalculator` and
`TensorsToDetectionsCalculator`, Apache-2.0): on every cell of a feature map sit two anchors for each layer of its
stride, all of unit size, so that an anchor is no more than a centre.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

__all__ = ["Detections", "anchor_centres", "decode", "joined", "suppress"]

_SCORE_LIMIT = 100.0


@dataclasses.dataclass(frozen=True)
class Detections:
    """Candidates of a detector.

    Attributes:
        boxes: float64 `[n, 4]` x0, y0, x1, y1.
        points: float64 `[n, k, 2]` key points.
        scores: float64 `[n]` in [0, 1].
    """

    boxes: np.ndarray
    points: np.ndarray
    scores: np.ndarray

    def rows(self, which: np.ndarray) -> "Detections":
        """Some of them."""
        return Detections(self.boxes[which], self.points[which], self.scores[which])


def anchor_centres(size: int, strides: Sequence[int]) -> np.ndarray:
    """Centres of all anchors, float64 `[n, 2]` in [0, 1].

    Args:
        size: side of the network's input [px].
        strides: of the layers, increasing; layers of one stride share a feature map, cell by cell.
    """
    centres = []
    for stride in dict.fromkeys(strides):
        cells = -(-size // stride)
        middle = (np.arange(cells) + 0.5) / cells
        x, y = np.meshgrid(middle, middle)
        grid = np.stack([x, y], -1).reshape(-1, 2)
        centres.append(np.repeat(grid, 2 * list(strides).count(stride), axis=0))
    return np.concatenate(centres)


def decode(values: np.ndarray, logits: np.ndarray, anchors: np.ndarray, size: int, least: float) -> Detections:
    """Candidates above a score.

    Args:
        values: `[n, 4 + 2 k]`: centre x, y, width, height, then key points, all in pixels from the anchor.
        logits: `[n]`.
        anchors: `[n, 2]` of `anchor_centres`.
        size: side of the network's input [px].
        least: score from which a candidate counts.

    Returns:
        in pixels of the network's input.
    """
    scores = 1 / (1 + np.exp(-np.clip(np.asarray(logits, dtype=np.float64), -_SCORE_LIMIT, _SCORE_LIMIT)))
    kept = np.flatnonzero(scores >= least)
    values = np.asarray(values, dtype=np.float64)[kept]
    middle = anchors[kept] * size
    centre, half = middle + values[:, :2], values[:, 2:4] / 2
    boxes = np.concatenate([centre - half, centre + half], axis=1)
    points = values[:, 4:].reshape(len(kept), (values.shape[1] - 4) // 2, 2) + middle[:, None]
    return Detections(boxes, points, scores[kept])


def joined(groups: Sequence[Detections]) -> Detections:
    """Candidates of several searches (at least one) together."""
    boxes, points, scores = ([getattr(g, name) for g in groups] for name in ("boxes", "points", "scores"))
    return Detections(np.concatenate(boxes), np.concatenate(points), np.concatenate(scores))


def suppress(found: Detections, overlap: float) -> Detections:
    """One of each group of boxes that overlap by more than `overlap` (intersection over union), best first."""
    import cv2

    if not len(found.scores):
        return found
    boxes = np.concatenate([found.boxes[:, :2], found.boxes[:, 2:] - found.boxes[:, :2]], axis=1)
    kept = cv2.dnn.NMSBoxes(boxes.tolist(), found.scores.tolist(), 0.0, overlap)
    return found.rows(np.asarray(kept, dtype=np.int64).reshape(-1))
