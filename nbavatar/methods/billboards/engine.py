"""The U-Net run by an inference engine in place of torch: the same numbers up to rounding, in about half the time.

    eager          torch, operation by operation: always there, the reference, and what pictures that are judged are
                   made with unless another engine is asked for
    openvino       Intel's; the fastest on x86 (`nbavatar bench decoder`)
    onnxruntime    Microsoft's; on any processor

An engine decodes on the CPU, in float32, without gradients; everything else goes to torch. It takes the weights as
they are when it decodes first, and again whenever they have changed since. The same engine on the same machine with the
same number of threads gives the same bits each time.
"""

import importlib.util
from collections.abc import Callable
from importlib import metadata
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nbavatar.config.evaluation import AUTO, EAGER, ENGINES
from nbavatar.errors import ConfigError, require
from nbavatar.methods.billboards.unet import UNet
from nbavatar.methods.billboards.unet_graph import unet_graph

__all__ = ["RUNNERS", "DecoderEngine", "chosen_engine", "installed_engines"]

RUNNERS = ENGINES[2:]
"""Engines that are packages of their own, in order of preference."""
_WHY = "--engine {name}"
_Run = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


def installed_engines() -> list[str]:
    """Engines beside torch whose packages are here, the fastest first."""
    ready = importlib.util.find_spec("onnx") is not None
    return [name for name in RUNNERS if ready and importlib.util.find_spec(name) is not None]


def chosen_engine(name: str, device: str = "cpu") -> str:
    """The engine behind a name: itself, or for `auto` the fastest that is installed; on a GPU, torch.

    Raises:
        ConfigError: no such engine, or one by name on a GPU.
        DependencyError: its package is not installed.
    """
    if name not in ENGINES:
        raise ConfigError.of("--engine", expected=f"one of {', '.join(ENGINES)}", found=name)
    if device != "cpu":
        if name not in (AUTO, EAGER):
            raise ConfigError.of("--engine", expected="auto or eager on a GPU", found=name)
        return EAGER
    if name == AUTO:
        return next(iter(installed_engines()), EAGER)
    if name != EAGER:
        for package in ("onnx", name):
            require(package, package, _WHY.format(name=name))
    return name


class DecoderEngine:
    """An engine with the weights of one U-Net.

    Attributes:
        name: of the package with its version, such as `openvino 2026.4.1`, for records.
        decoded: pictures so far.
    """

    def __init__(self, kind: str) -> None:
        """Args: kind: `openvino` or `onnxruntime`."""
        self._make = {"openvino": _openvino, "onnxruntime": _onnxruntime}[kind]
        self.name = f"{kind} {metadata.version(kind)}"
        self.decoded = 0
        self._weights: list[tuple[int, int]] = []
        self._run: _Run | None = None

    def takes(self, features: Tensor, unet: UNet) -> bool:
        """Whether it decodes this: on the CPU, without gradients, of more than one pixel at the deepest level."""
        lowest = min(features.shape[-2:]) // unet.multiple
        on_cpu = features.device.type == "cpu" and features.dtype == torch.float32
        return on_cpu and lowest > 1 and not torch.is_grad_enabled()

    def __call__(self, unet: UNet, features: Tensor) -> tuple[Tensor, Tensor]:
        """Colour (1, 3, H, W) and opacity (1, 1, H, W), as `UNet.forward` gives them.

        Args:
            unet: whose weights are used.
            features: that `takes` agrees to, float32 (1, C+1, H, W).
        """
        # Tensors count the writes to them, in place too; those of inference mode are never written.
        weights = [(value.data_ptr(), 0 if value.is_inference() else value._version) for value in unet.parameters()]
        if self._run is None or weights != self._weights:
            self._run, self._weights = self._make(unet_graph(unet), torch.get_num_threads()), weights
        colour, opacity = self._run(features.contiguous().numpy())
        self.decoded += 1
        return torch.from_numpy(colour), torch.from_numpy(opacity)


def _onnxruntime(graph: bytes, threads: int) -> _Run:
    onnxruntime: Any = require("onnxruntime", "onnxruntime", _WHY.format(name="onnxruntime"))
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3  # errors
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # see nbavatar.waiting
    session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])

    def run(features: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        colour, opacity = session.run(["colour", "opacity"], {"features": features})
        return colour, opacity

    return run


def _openvino(graph: bytes, threads: int) -> _Run:
    openvino: Any = require("openvino", "openvino", _WHY.format(name="openvino"))
    core = openvino.Core()
    # Left alone it would compute in bfloat16 where the processor can.
    settings = {"INFERENCE_PRECISION_HINT": "f32", "INFERENCE_NUM_THREADS": threads, "NUM_STREAMS": 1}
    request = core.compile_model(core.read_model(graph), "CPU", settings).create_infer_request()

    def run(features: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found = request.infer({"features": features}, share_inputs=True)
        return found["colour"].copy(), found["opacity"].copy()

    return run
