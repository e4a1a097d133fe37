"""Smaller avatars made of a trained one: some billboards, some parts, smaller textures, textures by footprint."""

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from nbavatar.methods.billboards.avatar import Avatar
from nbavatar.methods.billboards.billboards import Billboards
from nbavatar.methods.billboards.compression.sized import SizedBillboards, Textures
from nbavatar.methods.billboards.compression.textures import condense_textures, resample_textures

__all__ = ["avatar_bytes", "keep_billboards", "keep_parts", "resize_textures", "size_textures"]

_FAINTEST = 1e-6  # opacity whose logit stands for nothing; far below what the rasterizer draws


def keep_billboards(avatar: Avatar, kept: Tensor) -> Avatar:
    """The avatar with some of its billboards; parts without any are gone, renderer and refinement are shared.

    Args:
        avatar: trained.
        kept: ascending indices of billboards, int64.
    """
    if len(kept) == len(avatar.faces):
        return avatar
    faces, first = {}, 0
    for part, own in avatar.part_faces().items():
        chosen = kept[(kept >= first) & (kept < first + len(own))] - first
        if len(chosen):
            faces[part] = own[chosen.cpu()]
        first += len(own)
    b = avatar.billboards
    places = [value[kept] for value in _places(b)]
    with torch.no_grad():
        those = Billboards(torch.ones_like(places[2]), b.features[kept], b.alpha_logit[kept])
    return _rebuilt(avatar, faces, those, places, avatar.architecture.texels)


def keep_parts(avatar: Avatar, parts: Sequence[str]) -> Avatar:
    """The avatar with some of its parts."""
    wanted = torch.tensor([part in parts for part in avatar.parts])
    return keep_billboards(avatar, wanted[avatar.face_groups()].nonzero().squeeze(1).to(avatar.faces.device))


def resize_textures(avatar: Avatar, texels: int) -> Avatar:
    """The avatar with textures of another size (`nbavatar.methods.billboards.compression.textures`)."""
    if texels == avatar.architecture.texels:
        return avatar
    b = avatar.billboards
    with torch.no_grad():
        shown = b.features if avatar.unet is not None else torch.sigmoid(b.features)
        features, alpha = resample_textures(shown, b.alpha(), texels)
        if avatar.unet is None:
            features = torch.logit(features, eps=_FAINTEST)
        resized = Billboards(torch.ones_like(b.log_scale), features, torch.logit(alpha, eps=_FAINTEST))
    return _rebuilt(avatar, avatar.part_faces(), resized, _places(b), texels)


def size_textures(avatar: Avatar, sizes: Tensor) -> Avatar:
    """The avatar with every texture at a size of its own, up to the present one (`SizedBillboards`).

    Args:
        avatar: trained.
        sizes: texels a side, integers (F,); at least 2 where there are as many now.
    """
    b, texels = avatar.billboards, avatar.architecture.texels
    sizes = sizes.to(b.mu.device).clamp(min(2, texels), texels)
    with torch.no_grad():
        features, alpha = b.features, b.alpha()
        textures = {
            size: Textures(*condense_textures(features[own], alpha[own], size))
            for size in torch.unique(sizes).tolist()
            for own in [sizes == size]
        }
    return _rebuilt(avatar, avatar.part_faces(), SizedBillboards(texels, sizes, textures), _places(b), texels)


def avatar_bytes(avatar: Avatar) -> int:
    """Size of all its tensors [bytes]."""
    tensors = [*avatar.parameters(), *avatar.buffers()]
    return sum(tensor.numel() * tensor.element_size() for tensor in tensors)


def _rebuilt(
    avatar: Avatar, faces: dict[str, Tensor], billboards: Billboards, places: Sequence[Tensor], texels: int
) -> Avatar:
    """These billboards, placed by mu, quat and log_scale, with renderer, engine and refinement of the avatar."""
    with torch.no_grad():
        for mine, value in zip((billboards.mu, billboards.quat, billboards.log_scale), places, strict=True):
            mine.copy_(value)
    architecture = dataclasses.replace(avatar.architecture, texels=texels)
    # Built without a renderer, so that no second U-Net is made only to be dropped.
    plain = dataclasses.replace(architecture, deferred=False)
    counts = {part: avatar.vertex_counts[part] for part in faces}
    shading = avatar.shading
    if shading is not None and len(billboards.mu) < len(avatar.faces):
        shading = shading.without(list(faces), avatar.part_faces())
    result = Avatar(
        plain, faces, counts, billboards, refinement=avatar.refinement, shading=shading, record=avatar.record
    )
    result.architecture, result.unet, result.engine = architecture, avatar.unet, avatar.engine
    return result.to(avatar.faces.device).eval()


def _places(b: Billboards) -> list[Tensor]:
    return [b.mu, b.quat, b.log_scale]
