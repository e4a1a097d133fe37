"""Event files against an independent reader of their bytes, and the checksum against published values."""

import struct

import pytest

from nbavatar.io.eventfile import EventFile, crc32c


def unmasked(value):
    turned = (value - 0xA282EAD8) & 0xFFFFFFFF
    return ((turned >> 17) | (turned << 15)) & 0xFFFFFFFF


def records(path):
    """Data of every record; asserts both checksums."""
    content, place = path.read_bytes(), 0
    while place < len(content):
        head = content[place : place + 8]
        (length,) = struct.unpack("<Q", head)
        assert unmasked(struct.unpack_from("<I", content, place + 8)[0]) == crc32c(head)
        data = content[place + 12 : place + 12 + length]
        assert unmasked(struct.unpack_from("<I", content, place + 12 + length)[0]) == crc32c(data)
        place += 16 + length
        yield data


def message(data):
    """Fields of a protocol buffer as (number, raw value)."""

    def number(place):
        value = shift = 0
        while True:
            value |= (data[place] & 0x7F) << shift
            place, shift = place + 1, shift + 7
            if not data[place - 1] & 0x80:
                return value, place

    fields, place = [], 0
    while place < len(data):
        key, place = number(place)
        if key & 7 == 0:
            value, place = number(place)
        elif key & 7 == 1:
            (value,), place = struct.unpack_from("<d", data, place), place + 8
        elif key & 7 == 5:
            (value,), place = struct.unpack_from("<f", data, place), place + 4
        else:
            size, place = number(place)
            value, place = data[place : place + size], place + size
        fields.append((key >> 3, value))
    assert place == len(data)
    return fields


# RFC 3720, appendix B.4, and the check value of the CRC catalogue.
@pytest.mark.parametrize(
    ("data", "value"),
    [
        (b"123456789", 0xE3069283),
        (bytes(32), 0x8A9136AA),
        (b"\xff" * 32, 0x62A8AB43),
        (bytes(range(32)), 0x46DD794E),
        (b"", 0),
    ],
)
def test_crc32c_equals_published_values(data, value):
    assert crc32c(data) == value


def test_scalars_and_pictures_are_read_back(tmp_path):
    events = EventFile(tmp_path / "curves", step=300)
    events.scalars(325, {"train/loss": 0.25, "train/psnr": float("nan"), "train/steps": 70000.0})
    events.image(400, "preview", b"not really a png" * 20, 640, 480)
    version, start, scalars, image = (message(data) for data in records(events.path))
    assert dict(version)[3] == b"brain.Event:2"
    assert dict(start)[2] == 300 and message(dict(start)[7]) == [(1, 1)]
    assert dict(scalars)[2] == 325
    values = [dict(message(value)) for _, value in message(dict(scalars)[5])]
    assert values == [{1: b"train/loss", 2: 0.25}, {1: b"train/steps", 2: 70000.0}]
    (value,) = (dict(message(value)) for _, value in message(dict(image)[5]))
    assert value[1] == b"preview"
    assert message(value[4]) == [(1, 480), (2, 640), (3, 3), (4, b"not really a png" * 20)]


def test_every_record_is_on_disk_at_once_and_files_do_not_collide(tmp_path):
    first, second = EventFile(tmp_path), EventFile(tmp_path)
    first.scalars(1, {"a": 1.0})
    assert first.path != second.path
    assert len(list(records(first.path))) == 3 and len(list(records(second.path))) == 2
