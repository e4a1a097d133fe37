"""An avatar's tensors as one `.safetensors` file; docs/export.md is the schema."""

import json
from typing import Any

import torch

from nbavatar.errors import require
from nbavatar.methods.base import MeshAvatar
from nbavatar.methods.storage import FORMAT

__all__ = ["tensor_file"]


def tensor_file(avatar: MeshAvatar, record: dict[str, Any]) -> bytes:
    """The file's bytes: the state of the avatar, its faces, and what else its `content` has.

    Args:
        avatar: of any method.
        record: provenance of the export.
    """
    safetensors = require("safetensors.torch", "safetensors", "nbavatar export --to tensors")
    tensors: dict[str, torch.Tensor] = {f"faces.{part}": faces for part, faces in avatar.part_faces().items()}
    tensors |= {f"state.{name}": value for name, value in avatar.state_dict().items() if name != "faces"}
    facts: dict[str, Any] = {}
    for name, value in avatar.content().items():
        if isinstance(value, torch.Tensor):
            tensors[f"content.{name}"] = value
        else:
            facts[name] = value
    metadata = {
        "kind": "nbavatar avatar",
        "format": str(FORMAT),
        "method": avatar.method,
        "parts": json.dumps(avatar.parts),
        "vertex_counts": json.dumps(avatar.vertex_counts),
        "content": json.dumps(facts, sort_keys=True),
        "record": json.dumps(avatar.record, sort_keys=True),
        "export": json.dumps(record, sort_keys=True),
    }
    # Copies: the format refuses tensors that share their memory.
    stored = {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}
    return safetensors.save(stored, metadata)
