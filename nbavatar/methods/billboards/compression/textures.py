"""Textures of another size that look alike.

A texture of T texels a side is the continuous function sum_j a_j tent_j(x) on each axis, with texel centres from -1 to
1 and zeros beyond. The best texture of another size, in least squares, is the projection of that function onto its own
tents; it is a matrix of (T', T), applied to rows and columns. For a texture that is to be shown interpolated
(`SizedBillboards`) it is the nearest function that interpolation can reach. Opacity and premultiplied features are
projected, since it is their product that reaches the picture.
"""

import functools

import torch
from torch import Tensor

from nbavatar.methods.billboards.compression.sized import enlarged

__all__ = ["condense_textures", "projection_matrix", "resample_textures"]

_FAINT = 1e-3  # below this opacity a feature cannot be recovered from its product with it


@functools.cache
def projection_matrix(source: int, target: int) -> Tensor:
    """L2 projection between tents, float64 (target, source).

    Args:
        source, target: texels a side, at least 1; equal sizes give the identity.
    """
    if source == target:
        return torch.eye(source, dtype=torch.float64)
    return torch.linalg.solve(_products(target, target), _products(target, source))


@functools.cache
def condensing_matrix(source: int, target: int) -> Tensor:
    """Best texels, in least squares of the interpolated texture, float64 (target, source)."""
    reach = enlarged(torch.eye(target, dtype=torch.float64)[:, :, None].expand(-1, -1, target), source)[:, :, 0].T
    weighted = reach.T @ _products(source, source)
    return torch.linalg.solve(weighted @ reach, weighted)


def resample_textures(features: Tensor, alpha: Tensor, texels: int) -> tuple[Tensor, Tensor]:
    """Features (F, T, T, C) and opacity (F, T, T) in [0, 1], at `texels` a side; same dtype.

    A feature stays within the range that its billboard's texture had.
    """
    if alpha.shape[-1] == texels:
        return features, alpha
    return _projected(features, alpha, projection_matrix(alpha.shape[-1], texels).to(alpha))


def condense_textures(features: Tensor, alpha: Tensor, texels: int) -> tuple[Tensor, Tensor]:
    """As `resample_textures`, to be shown interpolated at the present size: the nearest there."""
    if alpha.shape[-1] == texels:
        return features, alpha
    return _projected(features, alpha, condensing_matrix(alpha.shape[-1], texels).to(alpha))


def _projected(features: Tensor, alpha: Tensor, matrix: Tensor) -> tuple[Tensor, Tensor]:
    opacity = torch.einsum("ir,jc,frc->fij", matrix, matrix, alpha).clamp(0.0, 1.0)
    product = torch.einsum("ir,jc,frck->fijk", matrix, matrix, features * alpha[..., None])
    plain = torch.einsum("ir,jc,frck->fijk", matrix, matrix, features)
    solid = opacity[..., None] > _FAINT
    result = torch.where(solid, product / opacity[..., None].clamp_min(_FAINT), plain)
    low, high = features.amin((1, 2), keepdim=True), features.amax((1, 2), keepdim=True)
    return torch.minimum(torch.maximum(result, low), high), opacity


def _products(first: int, second: int) -> Tensor:
    """Integrals of the products of two sizes' tents, (first, second)."""
    knots = torch.unique(torch.cat((_knots(first), _knots(second))))
    left, right = knots[:-1], knots[1:]
    # Products of two tents are quadratic between knots, where Simpson's rule is exact.
    points = torch.stack((left, (left + right) / 2, right))
    weights = (right - left) / 6 * torch.tensor([[1.0], [4.0], [1.0]], dtype=torch.float64)
    return (_tents(points.flatten(), first) * weights.flatten()[:, None]).T @ _tents(points.flatten(), second)


def _knots(texels: int) -> Tensor:
    """Where the tents of a texture bend."""
    if texels == 1:
        return torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)
    step = 2.0 / (texels - 1)
    return torch.linspace(-1.0 - step, 1.0 + step, texels + 2, dtype=torch.float64)


def _tents(points: Tensor, texels: int) -> Tensor:
    """Value of each tent at each point, (P, texels)."""
    centres = _knots(texels)[1:-1]
    step = 1.0 if texels == 1 else 2.0 / (texels - 1)
    return (1.0 - (points[:, None] - centres).abs() / step).clamp_min(0.0)
