"""Billboards whose textures are kept at sizes of their own.

A texture of t texels a side stands for the one of T texels that bilinear interpolation between the same corners gives
(align_corners); this is what the rasterizer, which takes one T for all, is handed. So a picture is exactly that of what
is kept, and bytes on disk and in memory between pictures are those of the smaller textures.
"""

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from nbavatar.methods.billboards.billboards import Billboards

__all__ = ["SizedBillboards", "Textures", "enlarged"]

_FAINTEST = 1e-6  # opacity whose logit stands for nothing; far below what the rasterizer draws


class Textures(NamedTuple):
    """Textures of one size t: features before their activation (N, t, t, C), opacity in [0, 1] (N, t, t)."""

    features: Tensor
    opacity: Tensor


class SizedBillboards(Billboards):
    """Billboards to render with, not to train: their textures are no parameters.

    Attributes:
        mu, quat, log_scale: as in `Billboards`.
        sizes: texels a side of each texture, uint8 (F,).
    """

    sizes: Tensor

    def __init__(self, texels: int, sizes: Tensor, textures: Mapping[int, Textures]) -> None:
        """Takes textures over; places are those of an untrained billboard.

        Args:
            texels: T, what the rasterizer is handed.
            sizes: texels a side of each texture, at most T, integers (F,).
            textures: size -> textures of the billboards of that size, in order.
        """
        nn.Module.__init__(self)
        dtype = next(iter(textures.values())).opacity.dtype
        self._start(torch.ones(len(sizes), 2, dtype=dtype))
        self.texels = texels
        self.register_buffer("sizes", sizes.to(torch.uint8))
        for size, own in sorted(textures.items()):
            self.register_buffer(f"features_{size}", own.features)
            self.register_buffer(f"opacity_{size}", own.opacity)

    @staticmethod
    def of_state(texels: int, state: Mapping[str, Tensor], prefix: str) -> "SizedBillboards":
        """Billboards of the shapes in a state, whose names begin with `prefix`; values still to be loaded."""
        start = f"{prefix}features_"
        named = {int(name[len(start) :]): value for name, value in state.items() if name.startswith(start)}
        textures = {t: Textures(value, state[f"{prefix}opacity_{t}"]) for t, value in named.items()}
        return SizedBillboards(texels, state[f"{prefix}sizes"], textures)

    @property
    def features(self) -> Tensor:
        """Features at the rasterizer's size, (F, T, T, C)."""
        return self._whole("features")

    @property
    def alpha_logit(self) -> Tensor:
        """Logits of the opacity at the rasterizer's size, (F, T, T)."""
        return torch.logit(self.alpha(), eps=_FAINTEST)

    def alpha(self) -> Tensor:
        """Opacity textures in [0, 1] at the rasterizer's size, (F, T, T)."""
        return self._whole("opacity")

    def _whole(self, kind: str) -> Tensor:
        parts, places = [], []
        for size in torch.unique(self.sizes).tolist():
            parts.append(enlarged(self.get_buffer(f"{kind}_{size}"), self.texels))
            places.append((self.sizes == size).nonzero().squeeze(1))
        return torch.cat(parts)[torch.cat(places).argsort()]


def enlarged(textures: Tensor, texels: int) -> Tensor:
    """Textures (N, t, t) or (N, t, t, C) at `texels` a side, interpolated between the same corners."""
    if textures.shape[1] == texels:
        return textures
    last = textures.permute(0, 3, 1, 2) if textures.ndim == 4 else textures[:, None]
    large = functional.interpolate(last, size=(texels, texels), mode="bilinear", align_corners=True)
    return large.permute(0, 2, 3, 1) if textures.ndim == 4 else large[:, 0]
