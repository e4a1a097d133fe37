"""The U-Net of an avatar as an ONNX model.

    input    features  float32 (1, C+1, H, W)   premultiplied features and the billboards' alpha (the last channel);
                                                H and W multiples of 2^depth, and at least twice that. Where the
                                                metadata says `normals`, three channels more: the faces' unit normals,
                                                world, premultiplied too, between features and alpha; where it says
                                                `shading`, one more behind them: 2 E^(1/2.2) - 1 of the light E on the
                                                faces; where it says `gloss`, three more: the direction, unit, world,
                                                that each face mirrors the line of sight to; premultiplied
    outputs  colour    float32 (1, 3, H, W)     I_R in [0, 1], sRGB
             opacity   float32 (1, 1, H, W)     I_alpha in [0, 1]

The picture is colour * opacity + (1 - opacity) * background.
"""

import io
import json
import logging
import warnings
from typing import Any

import torch

from nbavatar.errors import DataError, require
from nbavatar.methods.base import MeshAvatar
from nbavatar.methods.billboards.avatar import Avatar

__all__ = ["decoder_model"]

_OPSET = 18


def decoder_model(avatar: MeshAvatar, record: dict[str, Any]) -> bytes:
    """The ONNX file's bytes; its metadata holds what one needs to know to feed it.

    Args:
        avatar: of billboards, with deferred rendering.
        record: provenance of the export.

    Raises:
        DataError: the avatar has no decoder.
        DependencyError: the packages of the extra `export` are missing.
    """
    if not isinstance(avatar, Avatar) or avatar.unet is None:
        found = "none: its billboards hold colours" if avatar.method == "billboards" else f"method {avatar.method}"
        raise DataError.of("decoder", expected="an avatar with a U-Net", found=found)
    onnx = require("onnx", "onnx", "nbavatar export --to decoder")
    require("onnxscript", "onnxscript", "nbavatar export --to decoder")
    unet, multiple = avatar.unet, avatar.multiple
    size = 4 * multiple
    example = torch.zeros(1, avatar.architecture.decoded_channels, size, size)
    rows, columns = torch.export.Dim("rows", min=2, max=512), torch.export.Dim("columns", min=2, max=512)
    # The exporter's own remarks (packages that it could also use, functions of torch that will go) are not the user's.
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            unet,
            (example,),
            input_names=["features"],
            output_names=["colour", "opacity"],
            opset_version=_OPSET,
            dynamic_shapes=({2: multiple * rows, 3: multiple * columns},),
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    a = avatar.architecture
    known = {
        "multiple": multiple,
        "channels": a.channels,
        "normals": a.normals,
        "shading": a.shading,
        "gloss": a.gloss,
        "export": record,
    }
    onnx.helper.set_model_props(model, {name: json.dumps(value, sort_keys=True) for name, value in known.items()})
    stream = io.BytesIO()
    onnx.save_model(model, stream)
    return stream.getvalue()
