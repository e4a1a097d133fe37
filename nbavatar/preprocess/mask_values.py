"""What the values of masks mean: the one decision, for `check`, `ingest` and `masks` alike.

A camera's masks hold labels 0..3, or they are mattes: near 0 for the background, near one other value for the person,
soft only along edges. That value may be 1, 100, 255 or 65535; mattes are scaled so that it becomes 255. All pictures of
a camera are looked at before any of them is used, because one picture alone does not tell a label from a matte.

Among labels, 255 stands for pixels that say nothing, as in the segmentation masks of PASCAL VOC: something else is in
front there, such as a collar or a microphone.

Everything else is refused with the values that were found: other tools' label numbers, labels stretched for viewing,
labels that a lossy format has blurred.
"""

import dataclasses
from collections.abc import Collection, Sequence

import cv2
import numpy as np

from nbavatar.errors import DataError
from nbavatar.io.framepack import UNSEEN

__all__ = ["HANDS", "LABELS", "Meaning", "ValueSurvey", "labels_in", "spread"]

LABELS = 3
"""Largest label of a part."""

HANDS = frozenset({2, 3})
"""Labels of hands."""

_END = 1 / 8  # share of the matte's range that counts as an end
# Most of the foreground that may lie flat between the ends, and that may lie there at all: in masks of few values and
# of many, and in coverage, where fine hair and veils are.
_FEW_VALUES, _MANY_VALUES, _COVERAGE = (0.002, 0.6), (0.05, 0.6), (0.5, 1.0)
_FEW = 32
_SOFT = 32  # a matte of more than two values has more than so many levels
_FULL = 0.75  # a matte whose foreground is above this share of its format's range is not scaled
_STRAY = 1e-4  # least share of labels 1..3 in the foreground, the rest of which is 255
_PATCH = 0.002  # share of a picture that is flat and holds labels, when the other pictures are mattes
_FIX = (
    "store 0 background, 1 head, 2 right hand, 3 left hand, 255 something else in front, as png; or 0 and 255 for the "
    "whole person"
)


@dataclasses.dataclass(frozen=True)
class Meaning:
    """How a camera's masks are read.

    Attributes:
        kind: `label` (0..3, and 255 if `unseen`) or `person` (a matte of the whole person).
        white: stored value of a matte that stands for full coverage; 0 for labels.
        unseen: whether labels of 255 are among the masks: pixels that say nothing.
    """

    kind: str
    white: int
    unseen: bool = False

    def read(self, values: np.ndarray, where: object) -> np.ndarray:
        """Labels 0..3 and 255, or coverage 0..255: uint8 `[H, W]`.

        Args:
            values: as stored, uint8 or uint16 `[H, W]`.
            where: file, for the error line.

        Raises:
            DataError: a value among labels that is none.
        """
        if self.kind == "label":
            wrong = values[(values > LABELS) & ~((values == UNSEEN) & self.unseen)]
            if wrong.size:
                raise DataError.of(where, "values", expected=f"labels 0..{LABELS}", found=int(wrong.max()), fix=_FIX)
            return values.astype(np.uint8)
        if self.white == 255 and values.dtype == np.uint8:
            return values
        scaled = (values.astype(np.uint32) * 255 + self.white // 2) // self.white
        return np.minimum(scaled, 255).astype(np.uint8)


def spread(names: Sequence[str], most: int = 256) -> list[str]:
    """At most so many names, evenly spread: enough to see what kind of masks another camera has."""
    places = np.unique(np.linspace(0, len(names) - 1, min(most, len(names))).astype(int))
    return [names[int(place)] for place in places]


def labels_in(values: np.ndarray) -> set[int]:
    """Which of the labels 1..3 and 255 are among values; none where anything else is there beside the background."""
    there = set(np.unique(values).tolist()) - {0}
    return there if there <= {*range(1, LABELS + 1), UNSEEN} else set()


class ValueSurvey:
    """Which values the pictures of one camera hold, gathered picture by picture in any order."""

    def __init__(self) -> None:
        self._counts = np.zeros(1 << 16, np.int64)
        self._flat = np.zeros(1 << 16, np.int64)
        self._labelled: list[str] = []
        self._above = 0
        self._pictures = 0
        self._unseen = False
        self._lossy = False

    @property
    def largest(self) -> int:
        """Largest value so far, 0 if there is none."""
        return int(np.flatnonzero(self._counts)[-1]) if self._counts.any() else 0

    def add(self, values: np.ndarray, lossy: bool, name: str) -> None:
        """Looks at one picture.

        Args:
            values: uint8 or uint16 `[H, W]`.
            lossy: whether its format changes values.
            name: of the picture, for error lines.
        """
        top = int(values.max(initial=0))
        counts = np.bincount(values.reshape(-1))
        self._counts[: len(counts)] += counts
        self._pictures += 1
        self._lossy |= lossy
        if top == 0:
            return
        # Flat are pixels that differ from none of their neighbours by more than a 32nd of the range: the inside of a
        # region, never an edge, however soft.
        kernel = np.ones((3, 3), np.uint8)
        spread = cv2.dilate(values, kernel).astype(np.int32) - cv2.erode(values, kernel)
        flat = np.bincount(values[spread <= top // 32])
        self._flat[: len(flat)] += flat
        if top > LABELS:
            self._above += 1
            self._unseen |= {UNSEEN} < labels_in(np.flatnonzero(counts))
        elif flat[1 : LABELS + 1].sum() > _PATCH * values.size:
            self._labelled.append(name)

    def masks(self, where: object, parts: Collection[str]) -> Meaning:
        """Meaning of masks.

        Args:
            where: folder or video, for error lines.
            parts: parts that have a mesh. Masks of 0 and 1 alone are labels where there is a head only, and mattes of
                the whole person where anything else has a mesh.

        Raises:
            DataError: neither labels nor a matte, or both.
        """
        top = self.largest
        if top <= LABELS:
            if self._lossy and top > 0:
                if not self._labelled:  # a matte that shows nobody, and the noise of its format
                    return Meaning("person", 255)
                fix = "store labels as png, or as a video without loss (ffv1 in mkv)"
                found = f"{self._listed()} in a lossy format, which changes labels along every edge"
                raise DataError.of(where, "values", expected=f"labels 0..{LABELS} or 0..255", found=found, fix=fix)
            meaning = Meaning("person", 1) if top == 1 and set(parts) - {"head"} else Meaning("label", 0)
            return self._with_background(meaning, where)
        if self._unseen and not self._lossy and labels_in(np.flatnonzero(self._counts)) and self._parts_show():
            return self._with_background(Meaning("label", 0, unseen=True), where)
        if self._labelled and not self._lossy:
            found = f"{self._above} of {self._pictures} masks with values above 3, and labels in {self._labelled[0]}"
            raise DataError.of(where, expected="labels 0..3 in all masks, or 0..255 in all", found=found)
        few = self._few()
        expected = "labels 0..3, or a matte: 0, and one value for the person"
        meaning = Meaning("person", self._white(where, expected, _FEW_VALUES if few else _MANY_VALUES))
        return self._with_background(meaning, where)

    def coverage(self, where: object) -> Meaning:
        """Meaning of alpha images, which are mattes whatever their values.

        Raises:
            DataError: no matte.
        """
        expected = "coverage: 0, one value where it is full, and others for less of it"
        if not self.largest:
            return Meaning("person", 255)
        return self._with_background(Meaning("person", self._white(where, expected, _COVERAGE)), where)

    def _with_background(self, meaning: Meaning, where: object) -> Meaning:
        """The same meaning, if there is background in some picture: a person never fills all of them."""
        if self._counts[: meaning.white // 2 + 1].sum() == 0:
            found = f"none in {self._pictures} pictures"
            raise DataError.of(where, "values", expected="background (0) somewhere", found=found, fix=_FIX)
        return meaning

    def _parts_show(self) -> bool:
        """Whether labels of parts are more than strays: a hard matte may have a pixel of another value."""
        return bool(self._flat[1 : LABELS + 1].sum() > _STRAY * self._counts[1:].sum())

    def _few(self) -> bool:
        return not self._lossy and int((self._counts > 0).sum()) <= _FEW

    def _white(self, where: object, expected: str, most: tuple[float, float]) -> int:
        counts, top = self._counts, self.largest
        present = np.flatnonzero(counts)
        full = 255 if top <= 255 else 65535
        if len(present[present > 0]) == 1:
            return top
        peak = _peak(counts, top, full)
        white = full if peak >= _FULL * full else peak
        between = np.zeros(len(counts), bool)
        between[int(peak * _END) + 1 : int(np.ceil(peak * (1 - _END)))] = True
        between[int(peak * (1 + _END)) + 1 :] = True
        foreground = counts[int(peak * _END) + 1 :].sum()
        low = self._flat[1 : int(peak * _END) + 1].sum() / foreground  # labels beside one that stands for "unknown"
        flat, soft = self._flat[between].sum() / foreground, counts[between].sum() / foreground
        if white < _SOFT or flat > most[0] or soft > most[1] or (self._few() and low > most[0]):
            raise DataError.of(
                where,
                "values",
                expected=expected,
                found=self._listed(),
                fix=self._fix(present) if most != _COVERAGE else "",
            )
        return int(white)

    def _fix(self, present: np.ndarray) -> str:
        levels = [int(v) for v in present if self._flat[v] and v]
        step = levels[0] if levels else 0
        if step > 1 and len(levels) <= LABELS and all(v in (step, 2 * step, 3 * step) for v in levels):
            return f"they look like labels times {step}: divide them by {step}, and store them as png"
        return _FIX

    def _listed(self) -> str:
        """The values that are there, those that most pixels hold."""
        present = np.flatnonzero(self._counts)
        shown = np.sort(present[np.argsort(-self._counts[present], kind="stable")[:8]])
        more = f" and {len(present) - len(shown)} others" if len(present) > len(shown) else ""
        return f"the values {', '.join(map(str, shown))}{more}"


def _peak(counts: np.ndarray, top: int, full: int) -> int:
    """The value above half of the largest one that most pixels have; of 16 bits, the largest one in its 256th part."""
    upper = counts[: top + 1].copy()
    upper[: top // 2 + 1] = 0
    if full == 255:
        return int(upper.argmax())
    fine = np.pad(upper, (0, -len(upper) % 256)).reshape(-1, 256)
    row = int(fine.sum(axis=1).argmax())
    return 256 * row + int(np.flatnonzero(fine[row])[-1])
