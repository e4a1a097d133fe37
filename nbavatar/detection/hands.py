"""Hands: search palms, turn fingers up, place the joints.

Constants of the crops are those of MediaPipe's graphs (`palm_detection_detection_to_roi`,
`hand_landmark_landmarks_to_roi`, Apache-2.0): the palm's box, moved half its height towards the fingers, times 2.6; or
the box of wrist, knuckles and first joints, moved a tenth, times 2.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np

from nbavatar.detection.anchors import joined, suppress
from nbavatar.detection.networks import Landmarker, Searcher
from nbavatar.detection.squares import Square, square_around

__all__ = ["Hand", "HandFinder", "distinct", "square_of_joints"]

_OVERLAP = 0.3
# Two hands are one where their joints are nearer than this share of its size, on average.
_APART = 0.25
# Weight of what earlier frames said about a hand's side.
_MEMORY = 0.8
_PALM_SCALE, _PALM_SHIFT = 2.6, -0.5
_JOINT_SCALE, _JOINT_SHIFT = 2.0, -0.1
_FIRM = (0, 1, 2, 3, 5, 6, 9, 10, 13, 14, 17, 18)
"""Joints, in MediaPipe's order, that bound a hand's square: fingertips move too much."""


@dataclasses.dataclass(frozen=True)
class Hand:
    """One hand.

    Attributes:
        joints: float64 `[21, 3]` in MediaPipe's order: x, y [px] in the image, and depth [px] from the wrist.
        score: how sure the network is that there is a hand, in [0, 1].
        right: how sure it is that it is the person's right hand, in [0, 1].
    """

    joints: np.ndarray
    score: float
    right: float


class HandFinder:
    """Finds the hands of an image.

    Args:
        models: name -> content, with `palm_detection` and `hand_landmark`.
        search: score from which a palm is looked at.
        least: score from which a hand counts.
        rounds: how often the joints are placed, each time in the square that the last ones give.
    """

    def __init__(self, models: Mapping[str, bytes], *, search: float, least: float, rounds: int) -> None:
        outputs = ("Identity", "Identity_1")
        self._palms = Searcher(models["palm_detection"], "palm_detection", 192, (8, 16, 16, 16), 0.0, outputs)
        names = {"points": "Identity", "score": "Identity_1", "side": "Identity_2"}
        self._joints = Landmarker(models["hand_landmark"], "hand_landmark", 224, names, logits=False)
        self._search, self._least, self._rounds = search, least, rounds

    def find(
        self, image: np.ndarray, windows: Sequence[Sequence[Square]], last: Sequence[Hand] = (), *, most: int = 2
    ) -> list[Hand]:
        """The hands, most certain first.

        Args:
            image: uint8 `[H, W, 3]` RGB.
            windows: upright squares to search, in groups; a group is looked at where those before it show no hand.
            last: hands of the frame before, whose places are tried first; what is known of their sides is kept in mind.
            most: how many to find at most; when as many are followed, nothing is searched.
        """
        hands = []
        for before in last:
            hand = self._place(image, square_of_joints(before.joints))
            if hand is not None:
                right = _MEMORY * before.right + (1 - _MEMORY) * hand.right
                hands.append(dataclasses.replace(hand, right=right))
        hands = distinct(hands)
        for group in windows:
            if len(hands) >= most:
                break
            palms = suppress(joined([self._palms.search(image, window, self._search) for window in group]), _OVERLAP)
            squares = [_square_of_palm(box, points) for box, points in zip(palms.boxes, palms.points, strict=True)]
            found = [hand for square in squares if (hand := self._place(image, square)) is not None]
            # Those that are followed come first: a double of one must not take its place, nor its memory.
            hands = distinct([*hands, *found])
            if hands:
                break
        return sorted(hands, key=lambda hand: -hand.score)[:most]

    def _place(self, image: np.ndarray, square: Square) -> Hand | None:
        square, score = self._joints.place(image, square, square_of_joints, self._rounds)
        if score < self._least:
            return None
        return Hand(self._joints.points(square), score, self._joints.value("side"))


def distinct(hands: Sequence[Hand]) -> list[Hand]:
    """Hands without doubles; of two whose joints lie on each other the first stays."""
    kept: list[Hand] = []
    for hand in hands:
        size = np.ptp(hand.joints[:, :2], axis=0).max()
        apart = [np.linalg.norm(hand.joints[:, :2] - other.joints[:, :2], axis=1).mean() for other in kept]
        if all(distance > _APART * size for distance in apart):
            kept.append(hand)
    return kept


def square_of_joints(joints: np.ndarray) -> Square:
    """Square in which to place joints `[21, 2 or 3]` (MediaPipe's order) [px] anew, fingers up."""
    xy = joints[:, :2]
    knuckles = ((xy[5] + xy[13]) / 2 + xy[9]) / 2
    return square_around(xy[list(_FIRM)], _upright(knuckles - xy[0]), scale=_JOINT_SCALE, shift=_JOINT_SHIFT)


def _square_of_palm(box: np.ndarray, points: np.ndarray) -> Square:
    """Square of a detection, from its box and the line from wrist to middle knuckle (key points 0 and 2)."""
    angle = _upright(points[2] - points[0])
    width, height = box[2] - box[0], box[3] - box[1]
    centre = (box[:2] + box[2:]) / 2 + Square(0, 0, 1, angle).axes @ [0.0, _PALM_SHIFT * height]
    return Square(float(centre[0]), float(centre[1]), _PALM_SCALE * float(max(width, height)), angle)


def _upright(direction: np.ndarray) -> float:
    """Angle of the square whose upward direction is the given one."""
    return math.atan2(direction[0], -direction[1])
