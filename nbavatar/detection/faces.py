"""Faces: search, turn upright, place the mesh.

Constants of the crops are those of MediaPipe's graphs (`face_detection_front_detection_to_roi`,
`face_landmark_landmarks_to_roi`, Apache-2.0): the box, or the mesh's box, along the line of the eyes, times 1.5.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np

from nbavatar.detection.anchors import joined, suppress
from nbavatar.detection.networks import Landmarker, Searcher
from nbavatar.detection.squares import Square, square_around

__all__ = ["Face", "FaceFinder", "square_of_mesh"]

_SCALE = 1.5
_OVERLAP = 0.3
_EYE_CORNERS = (33, 263)


@dataclasses.dataclass(frozen=True)
class Face:
    """One face.

    Attributes:
        mesh: float64 `[468, 3]` x, y [px] in the image, and depth [px], smaller is nearer.
        score: how sure the network is that there is a face, in [0, 1].
    """

    mesh: np.ndarray
    score: float


class FaceFinder:
    """Finds the most certain face of an image.

    Args:
        models: name -> content, with `face_detection` and `face_landmark`.
        search: score from which a box is looked at.
        least: score from which a face counts.
        rounds: how often the mesh is placed, each time in the square that the last one gives.
    """

    def __init__(self, models: Mapping[str, bytes], *, search: float, least: float, rounds: int) -> None:
        outputs = ("regressors", "classificators")
        self._boxes = Searcher(models["face_detection"], "face_detection", 128, (8, 16, 16, 16), -1.0, outputs)
        names = {"points": "conv2d_21", "score": "conv2d_31"}
        self._mesh = Landmarker(models["face_landmark"], "face_landmark", 192, names, logits=True)
        self._search, self._least, self._rounds = search, least, rounds

    def find(self, image: np.ndarray, windows: Sequence[Sequence[Square]], last: Face | None = None) -> Face | None:
        """The face, or None.

        Args:
            image: uint8 `[H, W, 3]` RGB.
            windows: upright squares to search, in groups; a group is looked at where those before it show no face.
            last: the face of the frame before, whose place is tried first.
        """
        if last is not None:
            face = self._place(image, square_of_mesh(last.mesh))
            if face is not None:
                return face
        for group in windows:
            found = suppress(joined([self._boxes.search(image, window, self._search) for window in group]), _OVERLAP)
            squares = [_square_of_box(box, points) for box, points in zip(found.boxes, found.points, strict=True)]
            faces = [face for square in squares if (face := self._place(image, square)) is not None]
            if faces:
                return max(faces, key=lambda face: face.score)
        return None

    def _place(self, image: np.ndarray, square: Square) -> Face | None:
        square, score = self._mesh.place(image, square, square_of_mesh, self._rounds)
        return Face(self._mesh.points(square), score) if score >= self._least else None


def square_of_mesh(mesh: np.ndarray) -> Square:
    """Square in which to place a mesh `[468, 2 or 3]` [px] anew."""
    (x0, y0), (x1, y1) = mesh[list(_EYE_CORNERS), :2]
    return square_around(mesh[:, :2], math.atan2(y1 - y0, x1 - x0), scale=_SCALE)


def _square_of_box(box: np.ndarray, points: np.ndarray) -> Square:
    """Square of a detection: its box, turned as the line from the right to the left eye (key points 0 and 1)."""
    dx, dy = points[1] - points[0]
    side = _SCALE * max(box[2] - box[0], box[3] - box[1])
    return Square(float(box[0] + box[2]) / 2, float(box[1] + box[3]) / 2, float(side), math.atan2(dy, dx))
