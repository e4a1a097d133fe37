"""Video files, decoded in order and counted.

Seeking by frame number is not exact with every codec, so frames are only ever read from the first on, and the number
that came out is compared with the number that should have. One frame is in memory at a time.
"""

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nbavatar.errors import DataError, require

__all__ = ["VideoInfo", "probe_video", "read_video"]


class VideoInfo:
    """What a video's header says: `width`, `height` [px], `count` [frames] (0 where unknown), `fps` [1/s]."""

    def __init__(self, width: int, height: int, count: int, fps: float) -> None:
        self.width, self.height, self.count, self.fps = width, height, count, fps


def probe_video(path: str | os.PathLike[str]) -> VideoInfo:
    """Reads the header of a video; decodes nothing.

    Raises:
        DataError: the file is missing, empty, or its header is damaged (an mp4 cut short lacks its index).
    """
    with _Capture(path) as capture:
        return capture.info


def read_video(
    path: str | os.PathLike[str], *, indices: Sequence[int] | None = None, count: int | None = None, gray: bool = False
) -> Iterator[np.ndarray]:
    """Yields frames in order, uint8 RGB `[H, W, 3]`, or `[H, W]` if `gray`.

    The whole video is decoded whatever `indices` asks for, because only that shows that it is whole; frames that are
    not asked for cost the decoding, but no colour conversion.

    Args:
        path: a video that FFmpeg reads.
        indices: which frames to yield, increasing; all by default.
        count: how many frames there must be; what the header says by default.
        gray: the mean of the colour channels' luma instead of colours, for mask videos.

    Raises:
        DataError: before the first frame, if the header's count is not `count`; after the last, if fewer or more
            frames came out than expected (a truncated or damaged video).
    """
    cv2 = _opencv()
    wanted = None if indices is None else set(indices)
    with _Capture(path) as capture:
        stated = capture.info.count
        if count is not None and stated > 0 and stated != count:
            raise DataError.of(path, "frames", expected=count, found=f"{stated} in its header")
        expected = count if count is not None else stated
        found = 0
        while capture.handle.grab():
            if wanted is None or found in wanted:
                good, frame = capture.handle.retrieve()
                if not good or frame is None:
                    break
                if gray:
                    yield frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
                else:
                    yield cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)
            found += 1
        if expected > 0 and found != expected:
            fix = "the video is truncated or damaged: fetch it again" if found < expected else ""
            raise DataError.of(path, "frames", expected=expected, found=f"{found} that decode", fix=fix)


class _Capture:
    """An opened video that is released whatever happens."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        cv2 = _opencv()
        file = Path(path)
        if not file.is_file():
            raise DataError.of(path, expected="a video file", found="no such file")
        self.handle: Any = cv2.VideoCapture(str(file))
        if not self.handle.isOpened():
            fix = "it is truncated, damaged or of an unknown codec: fetch it again"
            found = f"one that does not open ({file.stat().st_size} bytes)"
            raise DataError.of(path, expected="a readable video", found=found, fix=fix)
        get = self.handle.get
        self.info = VideoInfo(
            int(get(cv2.CAP_PROP_FRAME_WIDTH)),
            int(get(cv2.CAP_PROP_FRAME_HEIGHT)),
            max(0, round(get(cv2.CAP_PROP_FRAME_COUNT))),
            float(get(cv2.CAP_PROP_FPS)),
        )

    def __enter__(self) -> "_Capture":
        return self

    def __exit__(self, *_: object) -> None:
        self.handle.release()


def _opencv() -> Any:
    # FFmpeg prints its own complaints about damaged files; ours say the same in one line.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    os.environ.setdefault("OPENCV_LOG_LEVEL", "OFF")
    return require("cv2", "opencv-contrib-python-headless", "reading videos")
