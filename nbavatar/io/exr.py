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

from nbavatar.errors import DataError, StorageError, require
from nbavatar.io.atomic import atomic_write, storage_errors, temporary_beside
from nbavatar.io.records import canonical_json

__all__ = ["half_error", "read_vertex_maps", "write_vertex_maps"]

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
    try:
        with zipfile.ZipFile(path) as archive, tempfile.TemporaryDirectory() as folder:
            layout = json.loads(archive.read("manifest.json"))
            for name, entry in layout["maps"].items():
                rows = []
                for first in range(0, len(layout["frames"]), entry["rows"]):
                    with storage_errors(folder):
                        file = archive.extract(f"{name}.{first:06d}.exr", folder)
                    with openexr.File(file) as image:
                        rows.append(np.array(image.channels()["RGB"].pixels, np.float32))
                maps[name] = np.concatenate(rows) if rows else np.zeros((0, entry["vertices"], 3), np.float32)
    except FileNotFoundError as error:
        raise DataError.of(path, expected="vertex maps (.exr.zip)", found="no such file") from error
    except (zipfile.BadZipFile, KeyError, ValueError, RuntimeError) as error:
        raise DataError.of(path, expected="vertex maps (.exr.zip)", found=f"a damaged one ({error})") from error
    return maps, list(layout["frames"]), dict(layout["record"])


def half_error(values: np.ndarray) -> float:
    """Largest difference that 16-bit floats would make, in the values' unit; why positions are never stored so."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0
    with np.errstate(over="ignore"):
        return float(np.abs(finite.astype(np.float16).astype(np.float32) - finite).max())
