"""Rasterization alone: which pixels see a billboard, its alpha and its features there, against four taps in NumPy."""

import numpy as np
import pytest

from tests.unit.rendering.billboards.stages import hits_at, patches, pixels, scene_of, settings, textures


@pytest.mark.parametrize(("texels", "channels"), [(1, 1), (2, 9), (5, 3)])
def test_features_and_alphas_of_single_billboards(texels, channels):
    """One billboard at a time: its image is alpha times feature, whatever blending makes of several."""
    s = settings(0, texels, alpha_max=0.7)
    for seed in range(4):
        projection = patches(seed, 1)
        features, alpha = textures(seed, 1, texels, channels)
        scene = scene_of(projection, features, alpha, s)
        image, _ = scene.forward()
        expected, seen = np.zeros(image.shape), 0
        for x, y in pixels():
            for _, _, a, feature in hits_at(projection, features, alpha, s, x, y):
                expected[:, y, x] = a * feature
                seen += 1
        np.testing.assert_allclose(image.numpy(), expected, rtol=0, atol=1e-12)
        assert scene.samples == seen > 30


def test_near_plane_and_faint_samples_are_cut_pixel_by_pixel():
    projection = patches(3, 1, radius=(30.0, 31.0), depth=[1.0], tilt=0.05)
    features, alpha = textures(3, 1, 4, 2)
    s = settings(0, 4, near=1.0, alpha_min=0.4)
    image, _ = scene_of(projection, features, alpha, s).forward()
    expected = {(x, y) for x, y in pixels() if hits_at(projection, features, alpha, s, x, y)}
    assert {(x, y) for x, y in pixels() if bool(image[:, y, x].any())} == expected
    everywhere = settings(0, 4, alpha_min=0.0)
    assert 30 < len(expected) < sum(bool(hits_at(projection, features, alpha, everywhere, x, y)) for x, y in pixels())
