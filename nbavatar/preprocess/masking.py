"""From mattes and meshes to the label and coverage of every frame of one camera, three frames in memory at a time."""

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

import cv2
import numpy as np

from nbavatar.io.framepack import UNSEEN, mark_unseen, parts_in, unseen_in
from nbavatar.preprocess.clean import clean_labels, repair_flicker
from nbavatar.preprocess.clothes import ClothesModel
from nbavatar.preprocess.part_masks import PartCutter

__all__ = ["MaskNumbers", "MaskStatistics", "cut_masks"]


@dataclasses.dataclass(frozen=True)
class MaskNumbers:
    """Thresholds of the clean-up; see `config.preprocess.MasksConfig`."""

    threshold: int
    hole_fraction: float
    island_fraction: float
    temporal: bool
    soft_alpha: bool
    covered: str = "background"


@dataclasses.dataclass
class MaskStatistics:
    """What the clean-up did, summed over frames [px]."""

    labelled: int = 0
    dropped: int = 0
    clothes: int = 0
    removed: int = 0
    filled: int = 0
    flicker: int = 0
    unseen: int = 0
    empty_frames: list[str] = dataclasses.field(default_factory=list)


@dataclasses.dataclass
class _Frame:
    name: str
    mask: np.ndarray
    coverage: np.ndarray | None
    label: np.ndarray
    support: np.ndarray


def cut_masks(
    masks: Iterable[tuple[str, np.ndarray, np.ndarray | None]],
    cutter: PartCutter,
    runs: Sequence[Sequence[str]],
    numbers: MaskNumbers,
    statistics: MaskStatistics,
    *,
    matte: bool,
    images: Callable[[str], np.ndarray] | None = None,
    clothes: ClothesModel | None = None,
) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Yields (frame, label uint8 `[H, W]`, alpha uint8 `[H, W]`) in the order of `masks`.

    Pixels that say nothing have the label 255: those of the masks with labels, and of mattes, if `numbers.covered` is
    `unknown`, where a part's mesh lies behind something that is neither head nor hand.

    Args:
        masks: (frame, mask, coverage or None) in time order.
        cutter: the camera's.
        runs: frames of each uncut run; flicker is not repaired across cuts.
        numbers: thresholds.
        statistics: filled in on the way.
        matte: whether the masks are mattes of the whole person, 0..255, to be cut by the meshes; else they hold labels
            already and are only cleaned.
        images: reads the colour image of a frame, for `clothes`.
        clothes: removes cloth from the neck of mattes; None leaves it there.
    """
    run_of: Mapping[str, int] = {frame: number for number, run in enumerate(runs) for frame in run}
    window: list[_Frame] = []
    for name, mask, coverage in masks:
        colours = images if clothes is not None else None
        window.append(_prepare(name, mask, coverage, matte, cutter, numbers, statistics, colours, clothes))
        if len(window) == 3:
            yield _finish(window[0], window[1], window[2], run_of, matte, numbers, statistics)
            window.pop(0)
        elif len(window) == 1:
            first = window[0]
        else:
            yield _finish(None, first, window[1], run_of, matte, numbers, statistics)
    if window:
        yield _finish(None, window[-1], None, run_of, matte, numbers, statistics)


def _prepare(
    name: str,
    mask: np.ndarray,
    coverage: np.ndarray | None,
    matte: bool,
    cutter: PartCutter,
    numbers: MaskNumbers,
    statistics: MaskStatistics,
    images: Callable[[str], np.ndarray] | None,
    clothes: ClothesModel | None,
) -> _Frame:
    outlines = cutter.silhouettes(name)
    if matte:
        label = cutter.cut(mask, outlines, numbers.threshold)
        if images is not None and clothes is not None:
            image, person = images(name), mask > numbers.threshold
            clothes.learn(image, outlines.face & person, outlines.torso & person)
            cloth = clothes.cloth(image, outlines.neck & (label == 1))
            statistics.clothes += int(cloth.sum())
            label[cloth] = 0
            outlines.support[cloth] = 0
        other = (mask > numbers.threshold) & (label == 0)
        statistics.dropped += int(other.sum())
        if numbers.covered == "unknown":
            label[other & outlines.meshes()] = UNSEEN
    else:
        label = mask
    cleaned = clean_labels(
        label, outlines.support, hole_fraction=numbers.hole_fraction, island_fraction=numbers.island_fraction
    )
    statistics.removed += int(((label > 0) & (cleaned == 0)).sum())
    statistics.filled += int(((label == 0) & (cleaned > 0)).sum())
    return _Frame(name, mask, coverage, cleaned, outlines.support)


def _finish(
    before: _Frame | None,
    now: _Frame,
    after: _Frame | None,
    run_of: Mapping[str, int],
    matte: bool,
    numbers: MaskNumbers,
    statistics: MaskStatistics,
) -> tuple[str, np.ndarray, np.ndarray]:
    label = now.label
    # Labels that were given are not second-guessed.
    if numbers.temporal and matte and before is not None and after is not None:
        if run_of.get(before.name) == run_of.get(now.name) == run_of.get(after.name):
            label = repair_flicker(before.label, now.label, after.label, now.support)
            statistics.flicker += int((label != now.label).sum())
    unseen, part = unseen_in(label), parts_in(label)
    if now.coverage is not None:
        alpha = np.where(part, now.coverage, np.uint8(0))
    else:
        alpha = np.where(part, np.uint8(255), np.uint8(0))
        if numbers.soft_alpha and matte:
            alpha = _soften(alpha, now.mask)
    label = np.where(alpha > 0, label, np.uint8(0))
    if unseen.any():  # what is half a part and half its cover has neither's colour, and is no edge of the part
        unseen |= (cv2.dilate(unseen.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0) & (label > 0) & (alpha < 255)
    mark_unseen(label, alpha, unseen)
    statistics.unseen += int(unseen.sum())
    labelled = int((alpha > 0).sum())
    statistics.labelled += labelled
    if not labelled:
        statistics.empty_frames.append(now.name)
    return now.name, label, alpha


def _soften(alpha: np.ndarray, matte: np.ndarray) -> np.ndarray:
    """The matte's grey values in a two-pixel rim of the coverage; inside it stays full."""
    inside = cv2.erode(alpha, np.ones((5, 5), np.uint8), borderValue=255)
    return np.where(inside > 0, alpha, np.where(alpha > 0, matte, np.uint8(0)))
