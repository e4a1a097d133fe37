"""Video files, decoded in order and counted; and written, one frame at a time.

Seeking by frame number is not exact with every codec, so frames are only ever read from the first on, and the number
that came out is compared with the number that should have. One frame is in memory at a time, in reading and writing.

Written videos are VP9 in an mp4 container (`vp09`): browsers and players of every kind show it, and the OpenCV wheels
carry its encoder, which they do for no H.264. `mp4v` (MPEG-4 part 2) is twenty times as fast and for players only.
"""

import contextlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nbavatar.errors import DataError, parsing, require
from nbavatar.io.atomic import atomic_write, storage_errors

__all__ = ["CODECS", "VideoInfo", "VideoWriter", "probe_video", "read_video"]

CODECS = ("vp09", "mp4v")
_LOSSLESS = ("FFV1", "FFVH", "HFYU", "MPNG", "PNG", "PNG1", "UTVI", "ULRG", "ULRA", "ULY0", "ULY2", "ULY4")

_HEAD = 4096  # bytes: a file that can hold them can be made
_PROBE = 1 << 20  # bytes: more than an encoder keeps back before it writes


class VideoInfo:
    """What a video's header says: `width`, `height` [px], `count` [frames] (0 where unknown), `fps` [1/s], `codec`."""

    def __init__(self, width: int, height: int, count: int, fps: float, codec: str) -> None:
        self.width, self.height, self.count, self.fps, self.codec = width, height, count, fps, codec

    @property
    def lossy(self) -> bool:
        """Whether the codec changes values; one that may or may not (H.264) is said to."""
        return self.codec.upper().strip() not in _LOSSLESS


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


class VideoWriter:
    """Writes an mp4 under a temporary name and renames it when it is whole; a context manager.

    The encoder reports no error of the disk, so what was written is read back, every frame of it, before it gets its
    name.

    Args:
        path: file to write, `.mp4`.
        fps: frames a second [1/s].
        codec: `vp09` or `mp4v`; four letters of another one that this OpenCV encodes do too.

    Raises:
        DataError: frames of different sizes, no frame at all, no encoder for the codec, or not all frames come back.
        StorageError: there is no room for it.
    """

    def __init__(self, path: str | os.PathLike[str], fps: float, codec: str = "vp09") -> None:
        self._path, self._fps, self._codec = path, fps, codec
        self._stack = contextlib.ExitStack()
        self._temporary = Path()
        self._handle: Any = None
        self._size = (0, 0)
        self._whole = False
        self.count = 0

    def __enter__(self) -> "VideoWriter":
        with contextlib.ExitStack() as opening:
            self._temporary = opening.enter_context(atomic_write(self._path))
            # An encoder that cannot make its file says that it does not know the codec.
            self._temporary.write_bytes(bytes(_HEAD))
            self._stack = opening.pop_all()
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        with self._stack:
            if error is not None:
                if self._handle is not None:
                    self._handle.release()
                raise error
            self.finish()

    def add(self, frame: np.ndarray) -> None:
        """Appends one frame, uint8 RGB `[H, W, 3]`; odd sizes grow by a repeated row or column, as codecs want."""
        cv2 = _opencv()
        height, width = frame.shape[:2]
        padded = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        size = padded.shape[1], padded.shape[0]
        if self._handle is None:
            code = cv2.VideoWriter_fourcc(*self._codec)
            self._handle = cv2.VideoWriter(str(self._temporary), cv2.CAP_FFMPEG, code, self._fps, size)
            if not self._handle.isOpened():
                fix = f"choose another codec: {', '.join(CODECS)}"
                raise DataError.of(self._path, "codec", expected="an encoder", found=f"none for {self._codec}", fix=fix)
            self._size = size
        if size != self._size:
            expected = "x".join(map(str, self._size))
            raise DataError.of(self._path, f"frame {self.count}", expected=expected, found=f"{size[0]}x{size[1]}")
        self._handle.write(cv2.cvtColor(padded, cv2.COLOR_RGB2BGR))
        self.count += 1

    def finish(self) -> None:
        """Ends the file and reads it back; it gets its name when the `with` block ends."""
        if self._whole:
            return
        if self._handle is None:
            raise DataError.of(self._path, "frames", expected="one frame or more", found="none")
        self._handle.release()
        try:
            for _ in read_video(self._temporary, indices=(), count=self.count):
                pass
        except DataError as error:
            with storage_errors(self._path), open(self._temporary, "ab") as stream:  # asks the system for the reason
                stream.write(bytes(_PROBE))
                stream.flush()
                os.fsync(stream.fileno())
            found = "a file of which not all come back (the disk was full for a time, or the encoder failed)"
            fix = "run the same command again"
            raise DataError.of(self._path, "frames", expected=self.count, found=found, fix=fix) from error
        self._whole = True


class _Capture:
    """An opened video that is released whatever happens."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        cv2 = _opencv()
        file = Path(path)
        if not file.is_file():
            raise DataError.of(path, expected="a video file", found="no such file")
        self.handle: Any = cv2.VideoCapture(str(file))
        fix = "it is truncated, damaged or of an unknown codec: fetch it again"
        with parsing(path, "a readable video", damaged="one that does not open", fix=fix):
            if not self.handle.isOpened():
                raise ValueError(f"{file.stat().st_size} bytes")
        get = self.handle.get
        self.info = VideoInfo(
            int(get(cv2.CAP_PROP_FRAME_WIDTH)),
            int(get(cv2.CAP_PROP_FRAME_HEIGHT)),
            max(0, round(get(cv2.CAP_PROP_FRAME_COUNT))),
            float(get(cv2.CAP_PROP_FPS)),
            int(get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little", signed=True).decode("latin-1"),
        )

    def __enter__(self) -> "_Capture":
        return self

    def __exit__(self, *_: object) -> None:
        self.handle.release()


def _opencv() -> Any:
    # FFmpeg prints its own complaints about damaged files; ours say the same in one line.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    os.environ.setdefault("OPENCV_LOG_LEVEL", "OFF")
    return require("cv2", "opencv-contrib-python-headless", "reading and writing videos")
