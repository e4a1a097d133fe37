"""The deferred renderer R: a U-Net from rasterized features to colour and opacity.

Supplement, "Renderer architecture": stride-2 convolutions with Instance Normalization and LeakyReLU on the way
down, bilinear upsampling followed by 3x3 convolutions on the way up (no transposed convolutions, so no
checkerboard), skip connections at every level, and two heads with sigmoids. A leaner form is an option.

    input   float [B, C+1, H, W]   premultiplied features and the alpha of the billboards; H, W multiples of 2^depth
    result  colour float [B, 3, H, W] and opacity float [B, 1, H, W], both in [0, 1]

The full-resolution stem has no normalisation: it keeps the absolute feature values, which Instance Normalization
would remove, available to the last decoder stage. A level that has shrunk to a single pixel has no variance; its
normalisation is left out there, so a 32-pixel image works at depth 5.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from nbavatar.methods.billboards.convolution import Convolution

__all__ = ["FORMS", "UNet", "macs"]

FORMS = ("paper", "lean")
"""Forms of the way up, see `UNet`."""

_SLOPE = 0.2


class _Norm(nn.InstanceNorm2d):
    """Instance normalisation that leaves a single-pixel map as it is, for it has no variance.

    That of one picture is computed as a batch normalisation, the same sums over the same pixels. torch's own copies a
    channels-last tensor to channels first and back, which on a CPU takes longer than the convolutions beside it: a
    step takes 1.3 to 1.6 times, a picture 1.35 times as long with it. Batch normalisation works in either layout.
    """

    def forward(self, input: Tensor) -> Tensor:
        if input.shape[-1] * input.shape[-2] == 1:
            return input
        if len(input) == 1:
            return functional.batch_norm(input, None, None, self.weight, self.bias, training=True, eps=self.eps)
        return super().forward(input)


def _stage(channels_in: int, channels_out: int, *, stride: int = 1, norm: bool = True, convs: int = 1) -> nn.Sequential:
    """Convolution(s) 3x3, normalisation and LeakyReLU; the first convolution carries the stride."""
    layers: list[nn.Module] = []
    for index in range(convs):
        first = index == 0
        layers.append(
            Convolution(
                channels_in if first else channels_out, channels_out, stride=stride if first else 1, bias=not norm
            )
        )
        if norm:
            layers.append(_Norm(channels_out, affine=True))
        layers.append(nn.LeakyReLU(_SLOPE, inplace=True))
    return nn.Sequential(*layers)


class _Lift(nn.Conv2d):
    """Convolution 1x1, as a product of matrices where the channels lie together: on one thread torch has no fast kernel
    for it.
    """

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__(channels_in, channels_out, 1)

    def forward(self, input: Tensor) -> Tensor:
        if not input.is_contiguous(memory_format=torch.channels_last):
            return super().forward(input)
        pixels = functional.linear(input.permute(0, 2, 3, 1), self.weight.flatten(1), self.bias)
        return pixels.permute(0, 3, 1, 2)


class UNet(nn.Module):
    """Renderer R of the paper.

    Args:
        channels: C+1, the input channels (features and alpha).
        width: channels of the full-resolution level; level i has min(width * 2^i, max_width).
        depth: number of stride-2 stages (the paper: 5).
        max_width: cap of the channels of the deep levels.
        convs: convolutions a level on the way down; the way up has one after the upsampling and ``convs`` after the
            skip.
        form: `paper`, or `lean`: on the way up a 1x1 convolution before the upsampling takes the place of the 3x3 one
            after it, skips are added instead of put beside (as in LinkNet, Chaurasia and Culurciello 2017), and
            colour and opacity are one convolution. Most of the paper's form is spent at full resolution; of that
            two fifths are left.
    """

    def __init__(
        self,
        channels: int,
        *,
        width: int = 32,
        depth: int = 5,
        max_width: int = 512,
        convs: int = 2,
        form: str = "paper",
    ) -> None:
        super().__init__()
        self.lean = form == "lean"
        widths = [min(width * 2**level, max_width) for level in range(depth + 1)]
        self.channels, self.multiple = channels, 2**depth
        self.stem = _stage(channels, widths[0], norm=False)
        self.down = nn.ModuleList(_stage(widths[i], widths[i + 1], stride=2, convs=convs) for i in range(depth))
        lift = _Lift if self.lean else _stage
        self.lift = nn.ModuleList(lift(widths[i + 1], widths[i]) for i in range(depth))
        joined = 1 if self.lean else 2
        self.merge = nn.ModuleList(_stage(joined * widths[i], widths[i], norm=i > 0, convs=convs) for i in range(depth))
        if self.lean:
            self.head = nn.Conv2d(widths[0], 4, 3, padding=1)
        else:
            self.colour = nn.Conv2d(widths[0], 3, 3, padding=1)
            self.opacity = nn.Conv2d(widths[0], 1, 3, padding=1)
        self.upsample = nn.Upsample(scale_factor=2, mode="bilinear", align_corners=False)

    def hidden_weights(self) -> list[Tensor]:
        """Weights (N, D, k, k) of all convolutions but those that make colour and opacity."""
        last = (self.head,) if self.lean else (self.colour, self.opacity)
        return [m.weight for m in self.modules() if isinstance(m, nn.Conv2d) and m not in last]

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Decode features (B, C+1, H, W) to colour (B, 3, H, W) and opacity (B, 1, H, W).

        Under autocast to half precision an activation beyond 65504 would end in NaN; such a batch is decoded again in
        the weights' own precision. The result is never narrower than float32.

        Raises:
            ValueError: H or W is not a multiple of 2^depth.
        """
        height, width = features.shape[-2:]
        if height % self.multiple or width % self.multiple:
            raise ValueError(
                f"U-Net input: height and width must be multiples of {self.multiple}, found {height}x{width}"
            )
        colour, opacity = self._logits(features)
        if colour.dtype == torch.float16 and not bool(torch.isfinite(colour).all() & torch.isfinite(opacity).all()):
            with torch.autocast(features.device.type, enabled=False):
                colour, opacity = self._logits(features)
        return torch.sigmoid(_widened(colour)), torch.sigmoid(_widened(opacity))

    def _logits(self, features: Tensor) -> tuple[Tensor, Tensor]:
        value = self.stem(features)
        skips = []
        for stage in self.down:
            skips.append(value)
            value = stage(value)
        for level in reversed(range(len(skips))):
            if self.lean:
                value = self.merge[level](self.upsample(self.lift[level](value)) + skips[level])
            else:
                value = self.lift[level](self.upsample(value))
                value = self.merge[level](torch.cat((value, skips[level]), dim=1))
        if self.lean:
            head = self.head(value)
            return head[:, :3], head[:, 3:]
        return self.colour(value), self.opacity(value)


def _widened(values: Tensor) -> Tensor:
    """The values in float32 where they are narrower."""
    return values.float() if values.dtype in (torch.float16, torch.bfloat16) else values


def macs(network: UNet, height: int, width: int) -> int:
    """Count the multiply-accumulates of one image of height x width pixels (convolutions only)."""
    total = 0

    def count(module: nn.Module, _inputs: object, output: Tensor) -> None:
        nonlocal total
        assert isinstance(module, nn.Conv2d)
        total += output.shape[-2] * output.shape[-1] * module.weight.numel()

    hooks = [m.register_forward_hook(count) for m in network.modules() if isinstance(m, nn.Conv2d)]
    try:
        weight = network.stem[0].weight
        assert isinstance(weight, Tensor)
        scale = max(1, min(height, width) // (2 * network.multiple))
        small_h, small_w = (
            max(network.multiple, s // scale // network.multiple * network.multiple) for s in (height, width)
        )
        with torch.no_grad():
            network(torch.zeros(1, weight.shape[1], small_h, small_w, dtype=weight.dtype, device=weight.device))
    finally:
        for hook in hooks:
            hook.remove()
    return round(total * (height * width) / (small_h * small_w))
