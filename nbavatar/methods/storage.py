"""One file that holds an avatar, whatever its method.

`model.pt` opens with ``torch.load(..., weights_only=True)``: tensors, numbers and text, nothing executable. Here it is
read by `nbavatar.io.tensors`, which also compares every size with the bytes that are there.
"""

import json
import os
from typing import Any

import torch
from torch import Tensor

from nbavatar.errors import DataError, describe, parsing
from nbavatar.io.atomic import atomic_write
from nbavatar.io.tensors import read_tensors
from nbavatar.methods.base import MeshAvatar
from nbavatar.methods.registry import METHODS, avatar_class

__all__ = ["FORMAT", "load_avatar", "save_avatar"]

FORMAT = 1
_KIND = "nbavatar avatar"


def save_avatar(path: str | os.PathLike[str], avatar: MeshAvatar) -> None:
    """Write an avatar to one file, atomically."""
    content = {
        "kind": _KIND,
        "format": FORMAT,
        "method": avatar.method,
        "faces": avatar.part_faces(),
        "vertex_counts": avatar.vertex_counts,
        "record": json.dumps(avatar.record, sort_keys=True),
        # Detached clones: a view would drag its whole storage into the file.
        "state": {name: value.detach().cpu().clone() for name, value in avatar.state_dict().items() if name != "faces"},
        **avatar.content(),
    }
    # Into a stream, whose errors are the system's: torch's own writer does not name them.
    with atomic_write(path) as temporary, open(temporary, "wb") as stream:
        torch.save(content, stream)


def load_avatar(path: str | os.PathLike[str], device: str | torch.device = "cpu") -> Any:
    """Read an avatar of any kind (`MeshAvatar`).

    Raises:
        DataError: missing, damaged, not an avatar, of another format version, or of a method that is not known.
    """
    content = read_tensors(path, "an avatar (model.pt)")
    if not isinstance(content, dict) or content.get("kind") != _KIND:
        raise DataError.of(path, "kind", expected=f"'{_KIND}'", found="something else")
    if content.get("format") != FORMAT:
        found = describe(content.get("format"))
        raise DataError.of(path, "format", expected=FORMAT, found=found, fix="train it again with this version")
    method = content.get("method", "billboards")
    if not isinstance(method, str) or method not in METHODS:
        raise DataError.of(path, "method", expected=f"one of {', '.join(METHODS)}", found=describe(method))
    with parsing(path, "a whole avatar", damaged="contents that disagree"):
        state: dict[str, Tensor] = content["state"]
        avatar: MeshAvatar = avatar_class(method).rebuild(content, state, json.loads(content["record"]))
        avatar.restore({**state, "faces": avatar.faces})
    return avatar.to(device).eval()
