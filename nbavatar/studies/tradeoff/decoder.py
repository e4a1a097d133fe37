"""The U-Net of an avatar in another memory layout or with its normalisation computed another way; same weights."""

import copy

import torch
from torch import Tensor, nn

from nbavatar.methods.billboards.unet import UNet, normalised_picture

__all__ = ["prepared_unet"]


class _PictureNorm(nn.Module):
    """A U-Net's normalisation of one picture by `normalised_picture`, in rendering too."""

    def __init__(self, norm: nn.InstanceNorm2d) -> None:
        super().__init__()
        self._norm = norm

    def forward(self, pixels: Tensor) -> Tensor:
        return normalised_picture(self._norm, pixels)


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
