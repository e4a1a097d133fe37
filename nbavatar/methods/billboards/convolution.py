"""Convolution 3x3 whose gradient by the weights is computed channels first, where that is faster.

Pictures lie channels last in the U-Net, the faster layout for a convolution and its gradient by the pixels. Its
gradient by the weights is an exception on a CPU without AVX-512: torch's (oneDNN 3.12) takes three to seven times as
long as the convolution itself from 64 channels on. Copied to channels first it takes once to twice as long, copies
included; the sums are the same up to their order.
"""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

__all__ = ["Convolution", "convolve", "worthwhile"]

_CHANNELS = (32, 64)  # least of the narrower and of the wider side
_PIXELS = 64 * 64  # least input; smaller ones fit the caches in either layout


class Convolution(nn.Conv2d):
    """Convolution 3x3 with padding 1, as `torch.nn.Conv2d` has it; see `convolve`."""

    def __init__(self, channels_in: int, channels_out: int, *, stride: int = 1, bias: bool = True) -> None:
        super().__init__(channels_in, channels_out, 3, stride, 1, bias=bias)

    def forward(self, input: Tensor) -> Tensor:
        """Pictures (B, C, H, W) convolved."""
        if self.training and torch.is_grad_enabled() and worthwhile(input, self.weight):
            return convolve(input, self.weight, self.bias, self.stride[0])
        return super().forward(input)


def worthwhile(pixels: Tensor, weight: Tensor) -> bool:
    """Whether the gradient by the weights is faster channels first."""
    narrow, wide = sorted(weight.shape[:2])
    return (
        pixels.device.type == "cpu"
        and torch.backends.cpu.get_cpu_capability() == "AVX2"
        and pixels.dtype == weight.dtype == torch.float32
        and not torch.is_autocast_enabled("cpu")
        and narrow >= _CHANNELS[0]
        and wide >= _CHANNELS[1]
        and pixels.shape[-2] * pixels.shape[-1] >= _PIXELS
        and pixels.is_contiguous(memory_format=torch.channels_last)
    )


def convolve(pixels: Tensor, weight: Tensor, bias: Tensor | None, stride: int) -> Tensor:
    """`torch.nn.functional.conv2d` with padding 1; the gradient by the weights is computed channels first.

    Args:
        pixels: (B, C, H, W).
        weight: (D, C, 3, 3).
        bias: (D,) or None.
        stride: of both sides.
    """
    result: Tensor = _Convolve.apply(pixels, weight, bias, stride)
    return result


class _Convolve(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, pixels: Tensor, weight: Tensor, bias: Tensor | None, stride: int) -> Tensor:
        ctx.save_for_backward(pixels, weight)
        ctx.stride, ctx.biased = stride, bias is not None
        return functional.conv2d(pixels, weight, bias, stride, 1)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = gradients
        pixels, weight = ctx.saved_tensors
        by_pixels = by_weight = by_bias = None
        if ctx.needs_input_grad[0]:
            by_pixels = _backward(gradient, pixels, weight, ctx.stride, [True, False, False])[0]
        if ctx.needs_input_grad[1]:
            first = [values.contiguous() for values in (gradient, pixels, weight)]
            by_weight = _backward(*first, ctx.stride, [False, True, False])[1]
        if ctx.biased and ctx.needs_input_grad[2]:
            by_bias = gradient.sum((0, 2, 3))
        return by_pixels, by_weight, by_bias, None


def _backward(gradient: Tensor, pixels: Tensor, weight: Tensor, stride: int, wanted: list[bool]) -> Any:
    return torch.ops.aten.convolution_backward(
        gradient, pixels, weight, None, [stride] * 2, [1, 1], [1, 1], False, [0, 0], 1, wanted
    )
