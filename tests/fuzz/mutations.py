"""Damaged files: bytes flipped, cut, doubled and overwritten by extremes; structured ones also damaged inside.

A checksum would hide most damage from the code behind it, so zips are written anew around damaged members, and JSON
around damaged values. Everything follows from the seed of the generator.
"""

import io
import json
import random
import struct
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

__all__ = ["mutate"]

_EXTREMES = [0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, (1 << 63) - 1, (1 << 64) - 1]
_VALUES: list[Any] = [
    None, True, False, -1, 0, 1, 3, 2**31, 2**70, -(10**30), 1e-320, 1e308, float("inf"), float("nan"), 0.5, "", "a",
    "../../etc", "\0", "\ud800", "e" * 5000, "1e5", "٣", [], {}, [[]], [None], {"": None}, [0, 1, 2, 3], "head", "08",
]  # fmt: skip
_WORDS = [
    b"", b"\0", b"-1", b"0", b"1e999", b"nan", b"null", b"~", b"\xff", b"\xef\xbb\xbf", b"\t", b",", b":", b"- ", b"[",
    b"]", b"{", b"}", b"'", b'"', b"#", b"&a ", b"*a", b"!!python/object/apply:os.system ['true']", b"!!binary x",
    b"\r", b"\n\n", b"9" * 5000, b"2024-13-45", b"<<: ", b"? ", b"|", b"%YAML 9", b"\x85", b"\xe2\x80\xa8", b"/" * 50,
]  # fmt: skip


def mutate(content: bytes, kind: str, rng: random.Random) -> bytes:
    """A damaged copy.

    Args:
        content: whole and good.
        kind: `bytes`, `text`, `json` or `zip`.
        rng: decides.
    """
    if kind == "zip" and rng.random() < 0.8:
        return _zip(content, rng)
    if kind == "json" and rng.random() < 0.8:
        return _json(content, rng)
    if kind == "text" and rng.random() < 0.7:
        return _text(content, rng)
    return _bytes(content, rng)


def _bytes(content: bytes, rng: random.Random) -> bytes:
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 4, 16))):
        if not data:
            break
        # Headers are where the sizes are: half of the damage is done there.
        at = rng.randrange(min(len(data), 160)) if rng.random() < 0.5 else rng.randrange(len(data))
        rng.choice(_DAMAGES)(data, at, rng)
    return bytes(data)


def _flip(data: bytearray, at: int, rng: random.Random) -> None:
    data[at] ^= 1 << rng.randrange(8)


def _set(data: bytearray, at: int, rng: random.Random) -> None:
    data[at] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, 10, 32, rng.randrange(256)))


def _cut(data: bytearray, at: int, rng: random.Random) -> None:
    del data[at:]


def _drop(data: bytearray, at: int, rng: random.Random) -> None:
    del data[at : at + rng.choice((1, 2, 4, 8, 64))]


def _double(data: bytearray, at: int, rng: random.Random) -> None:
    data[at:at] = data[at : at + rng.choice((1, 4, 16, 256))]


def _insert(data: bytearray, at: int, rng: random.Random) -> None:
    data[at:at] = rng.randbytes(rng.choice((1, 2, 8)))


def _overwrite(data: bytearray, at: int, rng: random.Random) -> None:
    width, letter = rng.choice(((1, "B"), (2, "H"), (4, "I"), (8, "Q")))
    value = rng.choice(_EXTREMES) & ((1 << (8 * width)) - 1)
    data[at : at + width] = struct.pack(rng.choice("<>") + letter, value)


def _swap(data: bytearray, at: int, rng: random.Random) -> None:
    other, length = rng.randrange(len(data)), rng.choice((1, 4, 16))
    data[at : at + length], data[other : other + length] = data[other : other + length], data[at : at + length]


_DAMAGES: list[Callable[[bytearray, int, random.Random], None]] = [
    _flip, _flip, _flip, _set, _set, _cut, _drop, _double, _insert, _overwrite, _overwrite, _swap,
]  # fmt: skip


def _text(content: bytes, rng: random.Random) -> bytes:
    lines = content.split(b"\n")
    for _ in range(rng.choice((1, 1, 2, 5))):
        at = rng.randrange(len(lines))
        line, action = lines[at], rng.randrange(6)
        if action == 0:
            lines.insert(at, rng.choice(lines))
        elif action == 1 and len(lines) > 1:
            del lines[at]
        elif action == 2:
            lines[at] = rng.choice((b" ", b"  ", b"\t", b"    ")) + line
        elif action == 3:
            lines[at] = line.lstrip()
        else:
            where = rng.randrange(len(line) + 1)
            lines[at] = line[:where] + rng.choice(_WORDS) + line[where + rng.choice((0, 0, 1, 3, 9)) :]
    return b"\n".join(lines)


def _json(content: bytes, rng: random.Random) -> bytes:
    try:
        value = json.loads(content)
    except RecursionError:  # damaged like that before
        return content
    except ValueError:  # one value a line
        lines = content.split(b"\n")
        at = rng.randrange(len(lines))
        lines[at] = _json(lines[at], rng) if lines[at].startswith(b"{") else _bytes(lines[at] or b" ", rng)
        return b"\n".join(lines)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        value = _changed(value, rng)
    text = json.dumps(value)
    if rng.random() < 0.02:
        deep = "[" * 100_000
        text = text.replace("[", deep, 1) if "[" in text else deep + text
    return text.encode()


def _changed(value: Any, rng: random.Random) -> Any:
    """A copy with one place changed, any place as likely as the next on its level."""
    if isinstance(value, (dict, list)) and value and rng.random() < 0.9:
        keys = list(value) if isinstance(value, dict) else list(range(len(value)))
        key = rng.choice(keys)
        copy: Any = dict(value) if isinstance(value, dict) else list(value)
        action = rng.randrange(8)
        if action == 0:
            del copy[key]
        elif action == 1 and isinstance(copy, dict):
            copy[rng.choice(("", "extra", "../x", str(rng.choice(keys)) + "s"))] = copy.pop(key)
        elif action == 1:
            copy.insert(key, copy[key])
        else:
            copy[key] = _changed(copy[key], rng)
        return copy
    if isinstance(value, (int, float)) and not isinstance(value, bool) and rng.random() < 0.4:
        return rng.choice(
            (
                -value,
                value + 1,
                value * 1e6,
                str(value),
                [value],
                0.5 * value,
            )
        )
    return rng.choice(_VALUES)


def _zip(content: bytes, rng: random.Random) -> bytes:
    """The archive with damaged members and right checksums, or with entries that are missing, doubled or compressed."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = [(entry.filename, archive.read(entry)) for entry in archive.infolist()]
    for _ in range(rng.choice((1, 1, 2))):
        if not members:
            break
        at = rng.randrange(len(members))
        name, data = members[at]
        action = rng.randrange(12)
        if action == 0:
            del members[at]
        elif action == 1:
            members[at] = (rng.choice(("", "../x", "/x", name + "s", members[0][0], "a" * 300)), data)
        elif action == 2:
            members.append((name, data))
        else:
            members[at] = (name, mutate(data, "json" if name.endswith(".json") else "bytes", rng))
    stream = io.BytesIO()
    method = rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))
    with zipfile.ZipFile(stream, "w", method) as archive:
        for name, data in members:
            entry = zipfile.ZipInfo(name or "empty", (1980, 1, 1, 0, 0, 0))
            entry.compress_type = method
            archive._didModify = True
            archive.NameToInfo.pop(entry.filename, None)  # a second entry of one name, without a warning
            archive.writestr(entry, data)
    whole = stream.getvalue()
    if rng.random() < 0.1:  # one bad byte in compressed data that the checksum does not cover yet
        return _bytes(whole, rng)
    if rng.random() < 0.05:
        return whole.replace(struct.pack("<I", zlib.crc32(members[0][1])) if members else b"PK", b"\1\2\3\4")
    return whole
