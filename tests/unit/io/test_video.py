import cv2
import numpy as np
import pytest

from nbavatar.errors import DataError
from nbavatar.io.video import probe_video, read_video


def write(path, count=10, size=(64, 48), fourcc="mp4v"):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*fourcc), 25, size)
    for i in range(count):
        image = np.full((size[1], size[0], 3), (10 + 20 * i) % 256, np.uint8)
        image[:16, :16] = (255, 0, 0)  # blue in BGR
        writer.write(image)
    writer.release()
    return path


def number(frame):
    return round((float(np.mean(frame[24:, 24:])) - 10) / 20)


def test_frames_come_in_order_as_rgb(tmp_path):
    path = write(tmp_path / "a.mp4")
    frames = list(read_video(path, count=10))
    assert [number(frame) for frame in frames] == list(range(10))
    assert all(frame.shape == (48, 64, 3) and frame.dtype == np.uint8 for frame in frames)
    corner = frames[5][4:12, 4:12].reshape(-1, 3).mean(0)
    assert corner[2] > 200 and corner[0] < 60, "blue must be the last channel"
    assert (probe_video(path).width, probe_video(path).height, probe_video(path).count) == (64, 48, 10)


def test_chosen_frames_are_exact(tmp_path):
    path = write(tmp_path / "a.mp4")
    assert [number(frame) for frame in read_video(path, indices=[1, 4, 9])] == [1, 4, 9]
    gray = list(read_video(path, indices=[3], gray=True))
    assert gray[0].shape == (48, 64) and number(gray[0]) == 3


def test_another_count_is_refused_before_the_first_frame(tmp_path):
    path = write(tmp_path / "a.mp4")
    with pytest.raises(DataError, match=r"a\.mp4: frames: expected 11, found 10 in its header"):
        next(read_video(path, count=11))


def test_a_video_without_its_end_does_not_open(tmp_path):
    path = write(tmp_path / "a.mp4")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(DataError, match="truncated, damaged") as error:
        list(read_video(path))
    assert "\n" not in str(error.value)


def test_fewer_frames_than_the_header_says(tmp_path):
    """The index is whole and the pictures are not: what a download broken off in a streamable file looks like."""
    path = write(tmp_path / "a.avi", count=30, fourcc="MJPG")
    content = bytearray(path.read_bytes())
    start = content.rindex(b"idx1")
    del content[start // 2 :]
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"frames: expected 30, found \d+"):
        list(read_video(path, count=30))


@pytest.mark.parametrize("content", [b"", b"not a video at all"])
def test_no_video(tmp_path, content):
    path = tmp_path / "a.mp4"
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"a\.mp4: expected a readable video"):
        probe_video(path)
    with pytest.raises(DataError, match="no such file"):
        probe_video(tmp_path / "b.mp4")
