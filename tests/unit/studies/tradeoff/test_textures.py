"""Textures of another size, against numerical integration and the rasterizer's own sampling."""

import numpy as np
import pytest
import torch

from nbavatar.methods.billboards.compression.sized import enlarged
from nbavatar.methods.billboards.compression.textures import (
    condense_textures,
    condensing_matrix,
    projection_matrix,
    resample_textures,
)


def sample(values: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Linear interpolation between texel centres at -1..1 and zeros one texel beyond, by numpy."""
    count = len(values)
    step = 2.0 / (count - 1) if count > 1 else 1.0
    middle = np.linspace(-1, 1, count) if count > 1 else np.zeros(1)
    knots = np.concatenate(([middle[0] - step], middle, [middle[-1] + step]))
    return np.interp(points, knots, np.concatenate(([0.0], values, [0.0])))


@pytest.mark.parametrize(("source", "target"), [(8, 4), (16, 5), (7, 3), (4, 1), (3, 8)])
def test_the_projection_is_the_nearest_function_in_least_squares(source: int, target: int, rng) -> None:
    values = rng.normal(size=source)
    result = projection_matrix(source, target).numpy() @ values
    points = np.linspace(-3.2, 3.2, 64001)
    wanted = sample(values, points)
    tents = np.stack([sample(np.eye(target)[i], points) for i in range(target)], 1)
    # A dense least-squares fit is the same projection up to its step of 1e-4.
    expected = np.linalg.lstsq(tents, wanted, rcond=None)[0]
    np.testing.assert_allclose(result, expected, atol=2e-3 * np.abs(values).max())
    best = np.mean((tents @ result - wanted) ** 2)
    for _ in range(20):
        assert best <= np.mean((tents @ (result + 0.05 * rng.normal(size=target)) - wanted) ** 2)


def test_equal_size_changes_nothing_and_ranges_hold() -> None:
    features, alpha = torch.randn(5, 8, 8, 3), torch.rand(5, 8, 8)
    assert resample_textures(features, alpha, 8)[0] is features
    smaller, opacity = resample_textures(features, alpha, 3)
    assert smaller.shape == (5, 3, 3, 3) and opacity.shape == (5, 3, 3)
    assert float(opacity.min()) >= 0 and float(opacity.max()) <= 1
    for i in range(5):
        for c in range(3):
            assert float(smaller[i, ..., c].min()) >= float(features[i, ..., c].min())
            assert float(smaller[i, ..., c].max()) <= float(features[i, ..., c].max())


def test_a_constant_feature_stays_constant_whatever_the_opacity() -> None:
    features = torch.full((4, 8, 8, 2), 0.7)
    smaller, _ = resample_textures(features, torch.rand(4, 8, 8), 4)
    torch.testing.assert_close(smaller, torch.full((4, 4, 4, 2), 0.7))


@pytest.mark.parametrize(("source", "target"), [(8, 4), (16, 2), (7, 3), (8, 7)])
def test_condensed_textures_are_the_nearest_that_interpolation_reaches(source: int, target: int, rng) -> None:
    values = rng.normal(size=source)
    kept = condensing_matrix(source, target).numpy() @ values
    centres = np.linspace(-1, 1, source)

    def error(texels: np.ndarray) -> float:
        """Squared distance, where a texture is shown, of what interpolation makes of these texels (numpy's own)."""
        shown = np.interp(centres, np.linspace(-1, 1, target), texels)
        points = np.linspace(-1.5, 1.5, 3001)
        return float(np.mean((sample(shown, points) - sample(values, points)) ** 2))

    for _ in range(50):
        # Near the best any change is worse; the sum over points differs from the integral by some 1e-6.
        assert error(kept) <= error(kept + 0.05 * rng.normal(size=target)) + 1e-6


def test_what_interpolation_made_is_condensed_without_loss() -> None:
    small = torch.rand(3, 4, 4)
    features = torch.randn(3, 4, 4, 2)
    shown = enlarged(small, 8)
    # One feature all over: only then is the product with the opacity within reach of interpolation.
    flat = features[:, :1, :1].expand(-1, 8, 8, -1)
    again, opacity = condense_textures(flat, shown, 4)
    torch.testing.assert_close(opacity, small, atol=1e-5, rtol=0)
    torch.testing.assert_close(again, flat[:, :4, :4], atol=1e-4, rtol=0)
    assert condense_textures(flat, shown, 8)[1] is shown
