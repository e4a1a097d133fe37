"""The detector: images of one camera in, keypoints in this project's order out."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from nbavatar.config.detection import DetectConfig
from nbavatar.config.preprocess import MATTE_THRESHOLD
from nbavatar.detection.correspondence import FACE_TRUST, face_landmarks, hand_joints
from nbavatar.detection.faces import Face, FaceFinder, square_of_mesh
from nbavatar.detection.hands import Hand, HandFinder
from nbavatar.detection.squares import Square
from nbavatar.detection.visibility import facing
from nbavatar.detection.windows import frame_windows, mask_window
from nbavatar.errors import DataError
from nbavatar.io.framepack import unseen_in

__all__ = ["COUNTS", "Detector", "keep_parts"]

COUNTS = {"head": 68, "right_hand": 21, "left_hand": 21}
"""Keypoints of each part."""

_LABELS = {"right_hand": 2, "left_hand": 3}
# Hands near a face are searched in a square of this many faces.
_REACH = 3.0
# Share of a hand's joints that have to lie on a hand (labels), or on the person (mattes).
_ON_HAND, _ON_PERSON = 0.4, 0.6
# Smallest number of labelled pixels that can be a hand.
_LEAST_HAND = 30
# A face point is fully trusted where its surface is turned towards the camera by this cosine, and hidden below 0.
_FRONT = 0.3


class Detector:
    """Finds keypoints, frame by frame.

    Args:
        models: contents of the networks (`nbavatar.data.detector_models`).
        cfg: options.
    """

    def __init__(self, models: Mapping[str, bytes], cfg: DetectConfig) -> None:
        numbers = {"search": cfg.search_score, "rounds": cfg.rounds}
        self._cfg, self._sides = cfg, [part for part in _LABELS if part in cfg.parts]
        self._face = FaceFinder(models, least=cfg.face_score, **numbers)
        self._hand = HandFinder(models, least=cfg.hand_score, **numbers) if self._sides else None

    def run(
        self, frames: Iterable[tuple[np.ndarray, np.ndarray | None, bool]], starts: Sequence[int]
    ) -> Iterator[dict[str, np.ndarray]]:
        """Keypoints of a camera's frames, in time order.

        Args:
            frames: image uint8 `[H, W, 3]` RGB; mask uint8 `[H, W]` or None; whether the mask has labels (0 background,
                1 head, 2 right, 3 left hand, 255 unknown) or is a matte of the person.
            starts: positions of frames that nothing may be carried into, such as those after a cut.

        Yields:
            part -> float32 `[L, 3]`: x, y [px, of the image given], confidence in [0, 1]; zeros where missing.
        """
        face: Face | None = None
        hands: list[Hand] = []
        for number, (image, mask, labels) in enumerate(frames):
            if number in starts or not self._cfg.follow:
                face, hands = None, []
            if not self._cfg.masks:
                mask = None
            face = self._find_face(image, mask, labels, face)
            hands = self._find_hands(image, mask, labels, face, hands)
            yield self._keypoints(image, mask, labels, face, hands)

    def _find_face(self, image: np.ndarray, mask: np.ndarray | None, labels: bool, last: Face | None) -> Face | None:
        whole = frame_windows(image.shape[1], image.shape[0])
        if mask is not None:
            own = mask_window(mask == 1 if labels else mask > MATTE_THRESHOLD)
            whole = [own, *whole] if own else whole
        return self._face.find(image, whole, last)

    def _find_hands(
        self, image: np.ndarray, mask: np.ndarray | None, labels: bool, face: Face | None, last: Sequence[Hand]
    ) -> list[Hand]:
        if self._hand is None:
            return []
        windows, most = frame_windows(image.shape[1], image.shape[0]), 2
        if face is not None:
            square = square_of_mesh(face.mesh)
            windows[0].append(Square(square.x, square.y, _REACH * square.side))
        if mask is not None and labels:
            every = [np.equal(mask, value) for value in _LABELS.values()]
            shown: list[np.ndarray] = [hand for hand in every if np.count_nonzero(hand) >= _LEAST_HAND]
            windows, most = [[window for hand in shown for window in mask_window(hand)]], len(shown)
            if not shown:
                return []
        elif mask is not None:
            windows[0] = mask_window(mask > MATTE_THRESHOLD, windows[0][1:]) or windows[0]
        found = self._hand.find(image, windows, last, most=most)
        return found if mask is None else [hand for hand in found if _lies_on(hand, mask, labels)]

    def _keypoints(
        self, image: np.ndarray, mask: np.ndarray | None, labels: bool, face: Face | None, hands: Sequence[Hand]
    ) -> dict[str, np.ndarray]:
        result = {part: np.zeros((count, 3), np.float32) for part, count in COUNTS.items() if part in self._cfg.parts}
        if face is not None and "head" in result:
            turned = np.clip(facing(face.mesh) / _FRONT, 0.0, 1.0)
            trust = face.score * FACE_TRUST * (self._cfg.hidden + (1 - self._cfg.hidden) * turned)
            result["head"] = _inside(face_landmarks(face.mesh)[:, :2], trust, image)
        for part, hand in _assign(hands, mask if labels else None).items():
            if part in result:
                result[part] = _inside(hand_joints(hand.joints)[:, :2], np.full(21, hand.score), image)
        return result


def keep_parts(
    keypoints: Mapping[str, Mapping[str, np.ndarray]], least_share: float
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The keypoints of the parts that are there.

    Args:
        keypoints: part -> camera -> `[N, L, 3]`.
        least_share: share of frames in which two cameras have to see a part, or it is taken for a mistake.

    Returns:
        `keypoints.<part>.<camera>`, and for the record, part -> frames seen by two cameras, kept or not, and frames by
        camera.

    Raises:
        DataError: no part is left.
    """
    kept: dict[str, np.ndarray] = {}
    report: dict[str, Any] = {}
    for part, cameras in keypoints.items():
        seen = {camera: (values[..., 2] > 0).any(1) for camera, values in cameras.items()}
        pairs = int((np.sum(list(seen.values()), axis=0) >= 2).sum())
        frames = len(next(iter(cameras.values())))
        keep = pairs > 0 and pairs >= least_share * frames
        report[part] = {
            "frames_in_two_cameras": pairs,
            "kept": keep,
            "frames": {camera: int(values.sum()) for camera, values in seen.items()},
        }
        if keep:
            kept |= {f"keypoints.{part}.{camera}": values for camera, values in cameras.items()}
    if not kept:
        frames = "; ".join(f"{part} in {report[part]['frames_in_two_cameras']}" for part in report)
        fix = "lower face_score and hand_score, or look at what the images show"
        raise DataError.of(
            "keypoints", expected="a part that two cameras see", found=f"none ({frames} frames)", fix=fix
        )
    return kept, report


def _assign(hands: Sequence[Hand], labels: np.ndarray | None) -> dict[str, Hand]:
    """Side -> hand, by the labels under the joints where there are any, else by the network's word."""
    sides = {}
    scores = [_right_by_labels(hand, labels) if labels is not None else hand.right for hand in hands]
    if len(hands) > 1:
        first, second = (0, 1) if scores[0] >= scores[1] else (1, 0)
        return {"right_hand": hands[first], "left_hand": hands[second]}
    for hand, right in zip(hands, scores, strict=True):
        sides["right_hand" if right >= 0.5 else "left_hand"] = hand
    return sides


def _right_by_labels(hand: Hand, labels: np.ndarray) -> float:
    under = _under(hand, labels)
    right, left = (int((under == _LABELS[side]).sum()) for side in ("right_hand", "left_hand"))
    return right / (right + left) if right + left else hand.right


def _lies_on(hand: Hand, mask: np.ndarray, labels: bool) -> bool:
    """Whether enough of a hand's joints within the image lie where the mask has a hand, or the person."""
    under = _under(hand, mask)
    if not len(under):
        return False
    if labels:
        under = under[~unseen_in(under)]
        return bool(len(under) and (under >= 2).mean() >= _ON_HAND)
    return bool((under > MATTE_THRESHOLD).mean() >= _ON_PERSON)


def _under(hand: Hand, mask: np.ndarray) -> np.ndarray:
    """Values of a mask under the joints that lie in the image."""
    column, row = np.floor(hand.joints[:, :2]).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < mask.shape[1]) & (row < mask.shape[0])
    return mask[row[inside], column[inside]]


def _inside(xy: np.ndarray, confidence: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Keypoints `[L, 3]`; what lies beyond the image is a guess of the network and counts as missing."""
    height, width = image.shape[:2]
    inside = (xy >= 0).all(1) & (xy < [width, height]).all(1)
    keys = np.concatenate([xy, np.where(inside, confidence, 0.0)[:, None]], axis=1)
    keys[keys[:, 2] <= 0] = 0.0
    return keys.astype(np.float32)
