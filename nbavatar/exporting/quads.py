"""Billboards as textured quads: what a standard viewer can show of an avatar without deferred rendering.

All textures lie in one picture. Each has a rim of one transparent black texel, and its quad ends in the middle of
that rim: bilinear filtering then gives what the rasterizer gives, the fading over one texel included.
"""

import math
from collections.abc import Iterable, Mapping

import numpy as np
import torch
from torch import Tensor

from nbavatar.errors import DataError
from nbavatar.io.gltf import Shape
from nbavatar.io.images import encode_png
from nbavatar.math.rotations import normalize_quaternion, quaternion_to_matrix
from nbavatar.methods.billboards.avatar import Avatar

__all__ = ["quads"]

_CORNERS = torch.tensor([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])  # (u, v)
_LARGEST = 16384  # side of a texture that graphics cards take [px]


def quads(avatar: Avatar, poses: Iterable[tuple[str | None, Mapping[str, Tensor]]]) -> Shape:
    """Quads of all billboards, posed on frames.

    Args:
        avatar: of billboards, without deferred rendering.
        poses: frame id (or None) and vertices per part, float (V, 3) [m]; a billboard whose part is missing in a frame
            is shrunk to a point there.

    Raises:
        DataError: of another method, with deferred rendering, or with more texels than a texture may have.
    """
    if not isinstance(avatar, Avatar) or avatar.unet is not None:
        found, fix = f"method {avatar.method}", "export --to splats"
        if isinstance(avatar, Avatar):
            found, fix = (
                "a U-Net that decodes them",
                "viewers cannot run it: export --to decoder, tensors or meshes",
            )
        raise DataError.of(
            "billboards", expected="billboards that hold colours (trained with deferred: false)", found=found, fix=fix
        )  # fmt: skip
    with torch.no_grad():
        features, opacity = avatar.textures()
        picture, uv = _atlas(features, opacity)
        count, texels = opacity.shape[0], opacity.shape[1]
        reach = 1.0 + 2.0 / (texels - 1) if texels > 1 else 1.0
        frames = [_corners(avatar, frame, verts, reach) for frame, verts in poses]
    first = 4 * np.arange(count)[:, None, None]
    faces = (first + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    return Shape("billboards", np.stack(frames), faces, uv=uv, texture=encode_png(picture))


def _corners(avatar: Avatar, frame: str | None, verts: Mapping[str, Tensor], reach: float) -> np.ndarray:
    """Corners of all quads, float32 (4 F, 3) [m]."""
    posed, keep = avatar.pose(verts, frame)
    axes = quaternion_to_matrix(normalize_quaternion(posed.quats))[:, :, :2] * posed.half_extents[:, None]
    offsets = torch.einsum("cu,fiu->fci", reach * _CORNERS.to(axes), axes)
    corners = posed.means[:, None] + offsets
    if keep is not None:
        whole = posed.means.mean(0).expand(avatar.primitives, 4, 3).clone()
        whole[keep] = corners
        corners = whole
    return corners.reshape(-1, 3).float().cpu().numpy()


def _atlas(features: Tensor, opacity: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """All textures in one picture uint8 (H, W, 4), and texture coordinates of the quads' corners float32 (4 F, 2)."""
    count, texels = opacity.shape[0], opacity.shape[1]
    # A single texel is a tent over [-1, 1]: its rim lies at the ends of the quad as well.
    tile = texels + 2
    columns = math.ceil(math.sqrt(count))
    rows = -(-count // columns)
    if columns * tile > _LARGEST:
        raise DataError.of(
            "billboards", "textures", expected=f"at most {_LARGEST} px a side", found=f"{columns * tile} px",
            fix="reduce the texels or the billboards with `nbavatar tradeoff` first",
        )  # fmt: skip
    rgba = torch.cat((features[..., :3].clamp(0, 1), opacity[..., None]), -1)
    tiles = torch.zeros(rows * columns, tile, tile, 4)
    tiles[:count, 1:-1, 1:-1] = rgba.float().cpu()
    picture = tiles.reshape(rows, columns, tile, tile, 4).permute(0, 2, 1, 3, 4).reshape(rows * tile, columns * tile, 4)
    number = np.arange(count)
    start = np.stack([number % columns, number // columns], 1)[:, None] * tile + 0.5
    corner = (_CORNERS.numpy() + 1) / 2 * (tile - 1)
    uv = (start + corner) / np.array([columns * tile, rows * tile])
    return (picture * 255.0 + 0.5).to(torch.uint8).numpy(), uv.reshape(-1, 2).astype(np.float32)
