"""Which frames of a subject are used, in what runs, and which are held out: the same for every camera and stage."""

import dataclasses
from collections.abc import Sequence
from typing import Any

from nbavatar.camera.pinhole import Camera
from nbavatar.data.capture import Capture, read_splits
from nbavatar.data.decaf import check_counts, frame_counts, read_cuts
from nbavatar.data.decaf_files import DecafSubject
from nbavatar.data.splits import choose_frames, held_out_blocks, runs_from_cuts, split_digest
from nbavatar.errors import DataError

__all__ = ["FramePlan", "manifest_of", "plan_capture", "plan_decaf"]


@dataclasses.dataclass(frozen=True)
class FramePlan:
    """The chosen frames.

    Attributes:
        frames: ids in time order.
        numbers: their numbers, in the video or in the list of `splits.json`.
        segments: first and last position of each uncut run, inclusive.
        split: id -> `train` or `test`.
        count: number of frames before the choice.
    """

    frames: list[str]
    numbers: list[int]
    segments: list[tuple[int, int]]
    split: dict[str, str]
    count: int


def plan_decaf(
    subject: DecafSubject,
    cameras: Sequence[str],
    *,
    start: int,
    every: int,
    max_frames: int,
    test_fraction: float,
    test_blocks: int,
) -> FramePlan:
    """Frames of a Decaf subject; checks first that all files of the named cameras have equally many.

    Raises:
        DataError: counts that disagree, cuts outside the video, or nothing left to use.
    """
    count = check_counts(frame_counts(subject, cameras))
    runs = runs_from_cuts(read_cuts(subject), count, str(subject.cut_file))
    numbers, segments = choose_frames(runs, start=start, every=every, max_frames=max_frames)
    if not numbers:
        raise DataError.of(subject.videos, "frames", expected=f"more than start = {start}", found=count)
    frames = [f"{number:06d}" for number in numbers]
    words = held_out_blocks(segments, fraction=test_fraction, blocks=test_blocks)
    return FramePlan(frames, numbers, segments, dict(zip(frames, words)), count)


def plan_capture(
    capture: Capture, *, start: int, every: int, max_frames: int, test_fraction: float, test_blocks: int
) -> FramePlan:
    """Frames of a capture; its own `test` list wins over `test_fraction`.

    Raises:
        DataError: a damaged `splits.json`, or nothing left to use.
    """
    path = capture.root / "splits.json"
    splits = read_splits(capture.root)
    numbers, segments = choose_frames(splits.segments, start=start, every=every, max_frames=max_frames)
    if not numbers:
        raise DataError.of(path, "frames", expected=f"more than start = {start}", found=len(splits.frames))
    frames = [splits.frames[number] for number in numbers]
    if splits.test:
        held = set(splits.test)
        words = ["test" if frame in held else "train" for frame in frames]
    else:
        words = held_out_blocks(segments, fraction=test_fraction, blocks=test_blocks)
    return FramePlan(frames, numbers, segments, dict(zip(frames, words)), len(splits.frames))


def manifest_of(
    plan: FramePlan, camera: Camera, *, stage: str, subject: str, layers: dict[str, str], record: dict[str, Any]
) -> dict[str, Any]:
    """Manifest of a frame pack of native images; see `io.framepack`."""
    return {
        "stage": stage,
        "subject": subject,
        "camera": camera.name,
        "width": camera.width,
        "height": camera.height,
        "K": camera.K.tolist(),
        "cam_from_world": camera.cam_from_world.tolist(),
        "distortion": None if camera.distortion is None else camera.distortion.tolist(),
        "frames": plan.frames,
        "split": plan.split,
        "split_digest": split_digest(plan.split),
        "segments": [list(run) for run in plan.segments],
        "layers": layers,
        "record": record,
    }
