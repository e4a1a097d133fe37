"""glTF 2.0 in one binary file (`.glb`) to write: meshes, a texture, and shapes that follow one another in time.

A mesh that moves is its first shape and a morph target for each later one; the animation fades from target to target,
which is linear interpolation of the vertices between frames. Nothing but the specification's core is used, and the
extension KHR_materials_unlit where colours are to be shown as they are.
"""

import dataclasses
import json
import os
import struct
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from nbavatar.io.atomic import atomic_write
from nbavatar.io.images import linear_light

__all__ = ["Shape", "write_glb"]

_COMPONENTS = {"f4": 5126, "u4": 5125, "u2": 5123, "u1": 5121}
_KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_VERTICES, _INDICES = 34962, 34963  # what a buffer view is for
_LINEAR, _CLAMP = 9729, 33071


@dataclasses.dataclass(frozen=True)
class Shape:
    """One mesh of the file.

    Attributes:
        name: of its node.
        positions: float32 [N, V, 3] [m], one shape a frame.
        faces: int [F, 3].
        colours: uint8 [V, 3], sRGB, or None.
        uv: float32 [V, 2], (0, 0) is the upper left corner of the texture, or None.
        texture: PNG file's bytes, with its alpha, or None.
    """

    name: str
    positions: np.ndarray
    faces: np.ndarray
    colours: np.ndarray | None = None
    uv: np.ndarray | None = None
    texture: bytes | None = None


class _Buffer:
    """The binary chunk and the parts of the document that say what lies where in it."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, content: bytes, target: int | None = None) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        entry: dict[str, Any] = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content)}
        self.views.append(entry | ({"target": target} if target else {}))
        self.data += content
        return len(self.views) - 1

    def accessor(self, values: np.ndarray, target: int | None = None, *, bounds: bool = False, **more: Any) -> int:
        values = np.ascontiguousarray(values)
        table = values.reshape(len(values), -1)
        little = table.astype(table.dtype.newbyteorder("<"))
        entry: dict[str, Any] = {
            "bufferView": self.view(little.tobytes(), target),
            "componentType": _COMPONENTS[table.dtype.str[1:]],
            "count": len(table),
            "type": _KINDS[table.shape[1]],
            **more,
        }
        if bounds:
            entry |= {"min": table.min(0).tolist(), "max": table.max(0).tolist()}
        self.accessors.append(entry)
        return len(self.accessors) - 1


def write_glb(
    path: str | os.PathLike[str], shapes: Sequence[Shape], *, fps: float, extras: Mapping[str, Any] | None = None
) -> None:
    """Writes a `.glb` file; with more than one frame it holds an animation called `frames`.

    Args:
        path: the file.
        shapes: all with the same number of frames.
        fps: frames a second.
        extras: kept under `asset.extras`, JSON-ready.
    """
    counts = {len(shape.positions) for shape in shapes}
    if len(counts) != 1:
        raise ValueError(f"shapes of {sorted(counts)} frames")
    frames, buffer = counts.pop(), _Buffer()
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "nbavatar", "extras": dict(extras or {})},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(shapes)))}],
        "nodes": [{"name": shape.name, "mesh": i} for i, shape in enumerate(shapes)],
        "meshes": [],
        "materials": [],
    }
    for shape in shapes:
        document["meshes"].append(_mesh(shape, buffer, document))
    if frames > 1:
        document["animations"] = [_animation(len(shapes), frames, fps, buffer)]
    binary = bytes(buffer.data + b"\0" * (-len(buffer.data) % 4))
    document |= {"accessors": buffer.accessors, "bufferViews": buffer.views, "buffers": [{"byteLength": len(binary)}]}
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode("utf-8")
    text += b" " * (-len(text) % 4)
    with atomic_write(path) as temporary, open(temporary, "wb") as stream:
        stream.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(binary)))
        stream.write(struct.pack("<I4s", len(text), b"JSON") + text)
        stream.write(struct.pack("<I4s", len(binary), b"BIN\0") + binary)


def _mesh(shape: Shape, buffer: _Buffer, document: dict[str, Any]) -> dict[str, Any]:
    positions = np.asarray(shape.positions, np.float32)
    attributes = {"POSITION": buffer.accessor(positions[0], _VERTICES, bounds=True)}
    if shape.uv is not None:
        attributes["TEXCOORD_0"] = buffer.accessor(np.asarray(shape.uv, np.float32), _VERTICES)
    if shape.colours is not None:
        opaque = np.ones((len(shape.colours), 4), np.float32)
        opaque[:, :3] = linear_light(shape.colours)  # vertex colours of glTF are linear
        attributes["COLOR_0"] = buffer.accessor(opaque, _VERTICES)
    material: dict[str, Any] = {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.9}}
    if shape.texture is not None:
        document["images"] = [{"bufferView": buffer.view(shape.texture), "mimeType": "image/png"}]
        sampler = {"magFilter": _LINEAR, "minFilter": _LINEAR, "wrapS": _CLAMP, "wrapT": _CLAMP}
        document |= {"samplers": [sampler], "textures": [{"source": 0, "sampler": 0}]}
        document["extensionsUsed"] = ["KHR_materials_unlit"]
        material["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0}
        material |= {"alphaMode": "BLEND", "doubleSided": True, "extensions": {"KHR_materials_unlit": {}}}
    document["materials"].append(material)
    primitive: dict[str, Any] = {
        "attributes": attributes,
        "indices": buffer.accessor(np.asarray(shape.faces, np.uint32).reshape(-1), _INDICES),
        "material": len(document["materials"]) - 1,
    }
    mesh: dict[str, Any] = {"name": shape.name, "primitives": [primitive]}
    if len(positions) > 1:
        moved = positions[1:] - positions[0]
        primitive["targets"] = [{"POSITION": buffer.accessor(step, _VERTICES, bounds=True)} for step in moved]
        mesh["weights"] = [0.0] * len(moved)
    return mesh


def _animation(nodes: int, frames: int, fps: float, buffer: _Buffer) -> dict[str, Any]:
    times = buffer.accessor(np.arange(frames, dtype=np.float32) / np.float32(fps), bounds=True)
    weights = buffer.accessor(np.eye(frames, dtype=np.float32)[:, 1:].reshape(-1))
    return {
        "name": "frames",
        "samplers": [{"input": times, "output": weights, "interpolation": "LINEAR"}],
        "channels": [{"sampler": 0, "target": {"node": i, "path": "weights"}} for i in range(nodes)],
    }
