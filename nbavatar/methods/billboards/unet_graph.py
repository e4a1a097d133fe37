"""The U-Net as an ONNX graph, node by node: what other engines than torch run (`nbavatar.methods.billboards.engine`).

Made in milliseconds, where torch's exporter takes seconds, and of few kinds of nodes. Inputs and outputs are those of
`nbavatar export --to decoder`. Of pictures whose deepest level is one pixel, which has no variance, it knows nothing.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from nbavatar.errors import require
from nbavatar.methods.billboards.unet import UNet

__all__ = ["unet_graph"]

_OPSET = 18
_WHY = "the U-Net in another engine than torch"


class _Graph:
    """Nodes and weights of a graph in the making; values are known by their names."""

    def __init__(self) -> None:
        self.onnx = require("onnx", "onnx", _WHY)
        self.nodes: list[Any] = []
        self.weights: list[Any] = []

    def weight(self, value: Tensor) -> str:
        """A tensor of the model."""
        name = f"w{len(self.weights)}"
        array = value.detach().cpu().float().contiguous().numpy()
        self.weights.append(self.onnx.numpy_helper.from_array(array, name))
        return name

    def add(self, kind: str, *inputs: str, output: str | None = None, **attributes: Any) -> str:
        """A node; the name of its value."""
        name = output or f"v{len(self.nodes)}"
        self.nodes.append(self.onnx.helper.make_node(kind, list(inputs), [name], **attributes))
        return name

    def split(self, value: str, counts: dict[str, int]) -> None:
        """Channels of a value under names of their own."""
        sizes = f"w{len(self.weights)}"
        self.weights.append(self.onnx.numpy_helper.from_array(np.array(list(counts.values()), np.int64), sizes))
        self.nodes.append(self.onnx.helper.make_node("Split", [value, sizes], list(counts), axis=1))

    def layer(self, layer: nn.Module, value: str) -> str:
        """A module of the U-Net.

        Raises:
            TypeError: none that the U-Net has.
        """
        if isinstance(layer, nn.Sequential):
            for own in layer:
                value = self.layer(own, value)
            return value
        if isinstance(layer, nn.Conv2d):
            inputs = [self.weight(layer.weight)] + ([] if layer.bias is None else [self.weight(layer.bias)])
            padding = [int(side) for side in layer.padding]
            return self.add(
                "Conv", value, *inputs, kernel_shape=list(layer.kernel_size),
                strides=list(layer.stride), pads=[*padding, *padding],
            )  # fmt: skip
        if isinstance(layer, nn.InstanceNorm2d):
            scales = self.weight(layer.weight), self.weight(layer.bias)
            return self.add("InstanceNormalization", value, *scales, epsilon=layer.eps)
        if isinstance(layer, nn.LeakyReLU):
            return self.add("LeakyRelu", value, alpha=layer.negative_slope)
        if isinstance(layer, nn.Upsample):
            scales = self.weight(torch.tensor([1.0, 1.0, 2.0, 2.0]))
            return self.add("Resize", value, "", scales, mode="linear", coordinate_transformation_mode="half_pixel")
        raise TypeError(f"the U-Net has a {type(layer).__name__}")


def unet_graph(unet: UNet) -> bytes:
    """The model: `features` float32 (1, C+1, H, W) -> `colour` (1, 3, H, W), `opacity` (1, 1, H, W), in [0, 1].

    Args:
        unet: any form; its weights are copied.

    Raises:
        DependencyError: the package onnx is missing.
    """
    graph = _Graph()
    helper, kind = graph.onnx.helper, graph.onnx.TensorProto.FLOAT
    value, skips = graph.layer(unet.stem, "features"), []
    for stage in unet.down:
        skips.append(value)
        value = graph.layer(stage, value)
    for level in reversed(range(len(skips))):
        lift, merge = unet.lift[level], unet.merge[level]
        if unet.lean:
            value = graph.layer(unet.upsample, graph.layer(lift, value))
            value = graph.layer(merge, graph.add("Add", value, skips[level]))
        else:
            value = graph.layer(lift, graph.layer(unet.upsample, value))
            value = graph.layer(merge, graph.add("Concat", value, skips[level], axis=1))
    if unet.lean:
        parts = graph.add("Sigmoid", graph.layer(unet.head, value))
        graph.split(parts, {"colour": 3, "opacity": 1})
    else:
        graph.add("Sigmoid", graph.layer(unet.colour, value), output="colour")
        graph.add("Sigmoid", graph.layer(unet.opacity, value), output="opacity")
    inputs = [helper.make_tensor_value_info("features", kind, [1, unet.channels, "H", "W"])]
    outputs = [
        helper.make_tensor_value_info(name, kind, [1, count, "H", "W"])
        for name, count in (("colour", 3), ("opacity", 1))
    ]
    made = helper.make_graph(graph.nodes, "unet", inputs, outputs, graph.weights)
    # The version of the format that belongs to the opset, not the newest that the package can write.
    model = helper.make_model(made, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=8)
    return model.SerializeToString()
