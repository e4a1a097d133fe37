"""Event files of TensorBoard, written without it: scalars and PNG pictures over steps.

A file is a sequence of records: length (uint64), masked CRC-32C of the length, data, masked CRC-32C of the data, all
little endian (TFRecord). The data is one `Event` message in the wire format of protocol buffers:

    Event    1 wall_time double [s], 2 step int64, 3 file_version string (first record only), 5 summary Summary,
             7 session_log (1 status: 1 = start)
    Summary  1 value Value, repeated
    Value    1 tag string, 2 simple_value float, 4 image Image
    Image    1 height, 2 width, 3 colorspace (3 = RGB) int32, 4 encoded_image_string bytes

Messages, field numbers and the masking constant are those of TensorFlow's `event.proto`, `summary.proto` and
`record_writer.cc`; the polynomial is Castagnoli's (RFC 3720, appendix B.4).
"""

import math
import os
import struct
import time
from collections.abc import Mapping
from pathlib import Path

from nbavatar.io.atomic import no_links, storage_errors

__all__ = ["EventFile", "crc32c"]

_POLYNOMIAL = 0x82F63B78  # reflected


def _crc_table() -> list[int]:
    table = []
    for value in range(256):
        for _ in range(8):
            value = (value >> 1) ^ (_POLYNOMIAL if value & 1 else 0)
        table.append(value)
    return table


_TABLE = _crc_table()


def crc32c(data: bytes) -> int:
    """CRC-32C (Castagnoli) of bytes, uint32."""
    value = 0xFFFFFFFF
    for byte in data:
        value = _TABLE[(value ^ byte) & 0xFF] ^ (value >> 8)
    return value ^ 0xFFFFFFFF


class EventFile:
    """Appends to one event file; every record is flushed, so a killed run loses nothing that it logged.

    Args:
        folder: where the file goes; made when missing. A run that goes on adds a file of its own there.
        step: where the run starts; what older files of the folder hold from this step on counts no more.
    """

    def __init__(self, folder: str | os.PathLike[str], step: int = 0) -> None:
        now = time.time()
        Path(folder).mkdir(parents=True, exist_ok=True)
        self.path = Path(folder) / f"events.out.tfevents.{time.time_ns():020d}.{os.getpid()}.nbavatar"
        self._write(_double(1, now) + _bytes(3, b"brain.Event:2"))
        self._write(_double(1, now) + _varint(2, step) + _bytes(7, _varint(1, 1)))

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Log numbers by tag; those that are not finite are left out."""
        finite = {tag: value for tag, value in values.items() if math.isfinite(value)}
        self._summary(step, [_bytes(1, tag.encode()) + _float(2, value) for tag, value in finite.items()])

    def image(self, step: int, tag: str, png: bytes, width: int, height: int) -> None:
        """Log one RGB picture, PNG bytes of width x height [px]."""
        picture = _varint(1, height) + _varint(2, width) + _varint(3, 3) + _bytes(4, png)
        self._summary(step, [_bytes(1, tag.encode()) + _bytes(4, picture)])

    def _summary(self, step: int, values: list[bytes]) -> None:
        summary = b"".join(_bytes(1, value) for value in values)
        self._write(_double(1, time.time()) + _varint(2, step) + _bytes(5, summary))

    def _write(self, data: bytes) -> None:
        length = struct.pack("<Q", len(data))
        with storage_errors(self.path), open(self.path, "ab", opener=no_links) as stream:
            stream.write(length + _masked(length) + data + _masked(data))


def _masked(data: bytes) -> bytes:
    value = crc32c(data)
    return struct.pack("<I", (((value >> 15) | (value << 17)) + 0xA282EAD8) & 0xFFFFFFFF)


def _number(value: int) -> bytes:
    """Base-128 digits of a non-negative integer, least first."""
    digits = bytearray()
    while value > 0x7F:
        digits.append(value & 0x7F | 0x80)
        value >>= 7
    digits.append(value)
    return bytes(digits)


def _varint(field: int, value: int) -> bytes:
    return _number(field << 3) + _number(value)


def _double(field: int, value: float) -> bytes:
    return _number(field << 3 | 1) + struct.pack("<d", value)


def _bytes(field: int, value: bytes) -> bytes:
    return _number(field << 3 | 2) + _number(len(value)) + value


def _float(field: int, value: float) -> bytes:
    return _number(field << 3 | 5) + struct.pack("<f", value)
