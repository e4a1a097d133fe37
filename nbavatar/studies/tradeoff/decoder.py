"""The U-Net of an avatar in another memory layout; same weights."""

import copy

import torch

from nbavatar.methods.billboards.unet import UNet

__all__ = ["prepared_unet"]


def prepared_unet(unet: UNet | None, *, channels_last: bool) -> UNet | None:
    """The U-Net as a setting wants it; itself where nothing differs, else a copy.

    Args:
        unet: channels last, or None.
        channels_last: memory layout of weights and pictures; else channels first.
    """
    if unet is None or channels_last:
        return unet
    return copy.deepcopy(unet).to(memory_format=torch.contiguous_format).eval()
