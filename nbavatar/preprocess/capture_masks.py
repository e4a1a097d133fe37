"""Masks and alpha images of one camera of a capture: what they mean, and reading them."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nbavatar.camera.pinhole import Camera
from nbavatar.config.preprocess import MATTE_THRESHOLD
from nbavatar.data.capture import Capture, read_splits, read_topology
from nbavatar.data.pictures import find_picture
from nbavatar.errors import DataError
from nbavatar.io.framepack import unseen_in
from nbavatar.io.pictures import read_plane
from nbavatar.preprocess.mask_values import HANDS, Meaning, ValueSurvey, labels_in, spread

__all__ = ["CameraMasks", "open_masks"]

_COMPARED = 16  # frames in which masks and coverage are compared
_LEAST_COVERED = 0.5


@dataclasses.dataclass(frozen=True)
class CameraMasks:
    """One camera's masks and alpha images.

    Attributes:
        root: the capture's folder.
        camera: whose; all pictures have its size.
        mask: what its masks mean; None where it has none.
        coverage: what its alpha images mean; None where it has none.
    """

    root: Path
    camera: Camera
    mask: Meaning | None
    coverage: Meaning | None

    def read_mask(self, frame: str) -> np.ndarray | None:
        """Labels 0..3 and 255, or a matte 0..255 of the person (see `mask.kind`), uint8 `[H, W]`; None without one."""
        return self._read("masks", frame, self.mask)

    def read_coverage(self, frame: str) -> np.ndarray | None:
        """Coverage 0..255, uint8 `[H, W]`; None where there are no alpha images."""
        return self._read("alpha", frame, self.coverage)

    def summary(self) -> dict[str, Any]:
        """What they mean, for the record of a stage."""
        found = {"masks": self.mask, "alpha": self.coverage}
        return {name: dataclasses.asdict(meaning) for name, meaning in found.items() if meaning is not None}

    def _read(self, kind: str, frame: str, meaning: Meaning | None) -> np.ndarray | None:
        if meaning is None:
            return None
        path = _picture(self.root, kind, self.camera.name, frame)
        return meaning.read(read_plane(path, (self.camera.width, self.camera.height)).values, path)


def open_masks(capture: Capture, camera: Camera, frames: Sequence[str]) -> CameraMasks:
    """Looks at all masks and alpha images of some frames of a camera.

    Raises:
        DataError: some frames have a mask, or an alpha image, and others have none; a file that is no such picture; or
            values that mean nothing.
    """
    masks, alpha = (_survey(capture, camera, kind, frames) for kind in ("masks", "alpha"))
    meaning = None
    if masks is not None:
        parts: Sequence[str] = ()
        if masks.largest == 1 and not _labelled_elsewhere(capture, camera):
            parts = list(read_topology(capture.root))
        meaning = masks.masks(capture.root / "masks" / camera.name, parts)
    coverage = None if alpha is None else alpha.coverage(capture.root / "alpha" / camera.name)
    opened = CameraMasks(capture.root, camera, meaning, coverage)
    if meaning is not None and coverage is not None:
        _compare(opened, spread(frames, _COMPARED))
    return opened


def _compare(masks: CameraMasks, frames: Sequence[str]) -> None:
    """Refuses alpha images that are another picture than the masks: inverted, of other frames, of another camera."""
    least = 0 if masks.mask is not None and masks.mask.kind == "label" else MATTE_THRESHOLD
    masked, covered, elsewhere = 0, 0, 0
    for frame in frames:
        mask, alpha = masks.read_mask(frame), masks.read_coverage(frame)
        if mask is not None and alpha is not None:
            if masks.mask is not None and masks.mask.unseen:
                mask, alpha = (np.where(unseen_in(mask), np.uint8(0), plane) for plane in (mask, alpha))
            masked += int((mask > least).sum())
            covered += int(((mask > least) & (alpha > MATTE_THRESHOLD)).sum())
            elsewhere += int(((mask <= least) & (alpha > MATTE_THRESHOLD)).sum())
    if masked and covered < _LEAST_COVERED * masked:
        where = masks.root / "alpha" / masks.camera.name
        found = f"{covered / masked:.0%} of the masks' pixels covered, and {elsewhere} pixels elsewhere"
        fix = "are they inverted?" if elsewhere > masked else "do they belong to these frames?"
        raise DataError.of(where, expected="coverage where the masks are", found=found, fix=fix)


def _survey(capture: Capture, camera: Camera, kind: str, frames: Sequence[str]) -> ValueSurvey | None:
    """Values of all pictures of a kind; None where there is no picture."""
    folder = capture.root / kind / camera.name
    there = [find_picture(folder, frame) is not None for frame in frames]
    if not any(there):
        return None
    survey = ValueSurvey()
    for frame in frames:
        path = _picture(capture.root, kind, camera.name, frame)
        plane = read_plane(path, (camera.width, camera.height))
        survey.add(plane.values, plane.lossy, path.name)
    return survey


def _picture(root: Path, kind: str, camera: str, frame: str) -> Path:
    path = find_picture(root / kind / camera, frame)
    if path is None:
        what = {"masks": "a mask", "alpha": "an alpha image"}[kind]
        wanted = root / kind / camera / f"{frame}.png"
        raise DataError.of(wanted, expected=f"{what} as for the other frames", found="none")
    return path


def _labelled_elsewhere(capture: Capture, camera: Camera) -> bool:
    """Whether another camera's masks hold the labels of hands, in some of the frames: this one may just not see any."""
    for frame in spread(read_splits(capture.root).frames):
        for other in capture.cameras.values():
            path = find_picture(capture.root / "masks" / other.name, frame)
            if other.name != camera.name and path is not None:
                values = read_plane(path, (other.width, other.height)).values
                if labels_in(values) & HANDS:
                    return True
    return False
