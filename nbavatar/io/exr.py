"""Float images of vertex data, for exchange and viewing: OpenEXR files in one stored zip.

An image is V wide and F high: column v is vertex v, row f a frame. Channels R, G, B hold x, y, z; 32-bit float,
lossless ZIP compression, so the round trip is exact. Any viewer of OpenEXR opens it; a horizontal line is one vertex
set, a column the path of one vertex over time.
"""

import json
import os
import tempfile
import zipfile
from collections.abc import Mapping
from typing import Any

import numpy as np

from nbavatar.errors import StorageError, parsing, require
from nbavatar.io.archives import open_archive, read_record
from nbavatar.io.atomic import atomic_write, storage_errors, temporary_beside
from nbavatar.io.forms import check_form
from nbavatar.io.records import canonical_json

__all__ = ["half_error", "read_vertex_maps", "write_vertex_maps"]

_FORM = {"frames": [str], "maps": {str: {"vertices": int, "rows": int}}, "record": dict}
# Rows of one image: 512 frames of a head are 31 MB before compression.
_ROWS = 512
_EPOCH = (1980, 1, 1, 0, 0, 0)


def write_vertex_maps(
    path: str | os.PathLike[str], maps: Mapping[str, np.ndarray], frames: list[str], record: Mapping[str, Any]
) -> None:
    """Writes vertex data of a sequence.

    Args:
        path: target, by custom `*.exr.zip`. Inside: `<name>.<first row>.exr` and `manifest.json`.
        maps: name -> float32 (N, V, 3), such as `head.position` and `head.displacement` [m].
        frames: N frame ids.
        record: provenance, kept in the manifest.
    """
    openexr: Any = require("OpenEXR", "OpenEXR", "float images of the deformation")
    layout: dict[str, Any] = {
        "format": 1,
        "layout": "column = vertex, row = frame, channels R G B = x y z [m], float32",
        "frames": frames,
        "maps": {},
        "record": dict(record),
    }
    with atomic_write(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive:
        for name, values in maps.items():
            if values.dtype != np.float32 or values.ndim != 3 or values.shape[2] != 3:
                raise TypeError(f"'{name}' must be float32 [N, V, 3], got {values.dtype} {list(values.shape)}")
            layout["maps"][name] = {"vertices": values.shape[1], "rows": _ROWS, "half_error": half_error(values)}
            for first in range(0, len(values), _ROWS):
                content = _image(openexr, path, np.ascontiguousarray(values[first : first + _ROWS]))
                archive.writestr(zipfile.ZipInfo(f"{name}.{first:06d}.exr", _EPOCH), content)
        archive.writestr(zipfile.ZipInfo("manifest.json", _EPOCH), canonical_json(layout))


def _image(openexr: Any, path: str | os.PathLike[str], pixels: np.ndarray) -> bytes:
    """One image as a file's contents, by way of a file beside the target: OpenEXR writes to named files only."""
    scratch = temporary_beside(path)
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    try:
        with openexr.File(header, {"RGB": pixels}) as image:
            image.write(str(scratch))
        return scratch.read_bytes()
    except RuntimeError as error:  # what OpenEXR makes of every error of the system
        reason = " ".join(str(error).split())
        fix = "free space and run the same command again"
        raise StorageError.of(path, expected="room to write", found=f"none ({reason})", fix=fix) from error
    finally:
        scratch.unlink(missing_ok=True)


def read_vertex_maps(path: str | os.PathLike[str]) -> tuple[dict[str, np.ndarray], list[str], dict[str, Any]]:
    """Reads what `write_vertex_maps` wrote.

    Returns:
        name -> float32 (N, V, 3), frame ids, record.

    Raises:
        DataError: missing or damaged.
    """
    openexr: Any = require("OpenEXR", "OpenEXR", "float images of the deformation")
    maps = {}
    with (
        tempfile.TemporaryDirectory() as folder,
        parsing(path, "vertex maps (.exr.zip)"),
        open_archive(path) as archive,
    ):
        layout = json.loads(read_record(archive, "manifest.json"))
        check_form(layout, _FORM, path, "manifest.json")
        count = len(layout["frames"])
        for name, entry in layout["maps"].items():
            values = np.zeros((count, entry["vertices"], 3), np.float32)
            for first in range(0, count, max(entry["rows"], 1)):
                file, encoded = os.path.join(folder, "image.exr"), archive.read(f"{name}.{first:06d}.exr")
                with storage_errors(folder), open(file, "wb") as stream:
                    stream.write(encoded)
                with openexr.File(file) as image:
                    part = values[first : first + entry["rows"]]
                    part[:] = _pixels(image, part.shape)
            maps[name] = values
    return maps, list(layout["frames"]), dict(layout["record"])


def _pixels(image: Any, shape: tuple[int, ...]) -> np.ndarray:
    pixels = np.asarray(image.channels()["RGB"].pixels)
    if pixels.shape != shape or pixels.dtype.kind != "f":
        raise ValueError(f"an image of {pixels.dtype} {list(pixels.shape)} instead of {list(shape)}")
    return pixels


def half_error(values: np.ndarray) -> float:
    """Largest difference that 16-bit floats would make, in the values' unit; why positions are never stored so."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0
    with np.errstate(over="ignore"):
        return float(np.abs(finite.astype(np.float16).astype(np.float32) - finite).max())
