"""The U-Net of an avatar in another memory layout or with its normalisation computed another way; same weights."""

import copy

import torch
from torch import Tensor, nn
from torch.nn import functional

from nbavatar.avatar.unet import UNet

__all__ = ["prepared_unet"]


class _PictureNorm(nn.Module):
    """Instance normalisation of one picture as a batch normalisation, the same sums over the same pixels.

    torch's own copies a channels-last tensor to channels first and back, which on a CPU takes longer than the
    convolutions beside it; its batch normalisation works in either layout.
    """

    def __init__(self, norm: nn.InstanceNorm2d) -> None:
        super().__init__()
        self.weight, self.bias, self.eps = norm.weight, norm.bias, norm.eps

    def forward(self, pixels: Tensor) -> Tensor:
        if pixels.shape[-1] * pixels.shape[-2] == 1:  # a single pixel has no variance
            return pixels
        return functional.batch_norm(pixels, None, None, self.weight, self.bias, training=True, eps=self.eps)


def prepared_unet(unet: UNet | None, *, channels_last: bool, batch_norm: bool) -> UNet | None:
    """The U-Net as a setting wants it; itself where nothing differs, else a copy.

    Args:
        unet: channels last, or None.
        channels_last: memory layout of weights and pictures; else channels first.
        batch_norm: normalise one picture at a time by batch normalisation; equal up to rounding.
    """
    if unet is None or (channels_last and not batch_norm):
        return unet
    other = copy.deepcopy(unet)
    if not channels_last:
        other = other.to(memory_format=torch.contiguous_format)
    if batch_norm:
        for parent in list(other.modules()):
            for name, child in list(parent.named_children()):
                if isinstance(child, nn.InstanceNorm2d):
                    setattr(parent, name, _PictureNorm(child))
    return other.eval()
