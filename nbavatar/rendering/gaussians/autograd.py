"""The autograd function that the compiled backends of the splat share."""

from typing import Any

import torch
from torch import Tensor

from nbavatar.rendering.gaussians.projection import Projection
from nbavatar.rendering.gaussians.reference import SplatSettings

__all__ = ["blend_scene"]


def blend_scene(
    scene: type, projection: Projection, rank: Tensor, opacities: Tensor, colours: Tensor, settings: SplatSettings
) -> tuple[Tensor, Tensor]:
    """Blends by a backend's scene; arguments and results as `blend_reference`.

    Args:
        scene: made of the other arguments; has `forward()`, giving image and alpha, and `backward(*grads)`, giving the
            gradients of the projected forms, the opacities and the colours.
    """
    inputs = projection.form, opacities.contiguous(), colours.contiguous()
    return _Blend.apply(*inputs, scene, projection, rank, settings)


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, form, opacities, colours, scene, projection, rank, settings):
        ctx.scene = scene(projection, rank, opacities, colours, settings)
        ctx.save_for_backward(opacities, colours)
        return ctx.scene.forward()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads):
        _ = ctx.saved_tensors  # raises if a tensor was changed in place since the forward pass
        return *ctx.scene.backward(*grads), None, None, None, None
