"""Alpha blending alone: weights, colours and transmittances of hits in a known order. Its adjoint is the replay."""

import numpy as np
import pytest
import torch

from tests.unit.rendering.billboards.stages import HEIGHT, WIDTH, hits_at, patches, pixels, scene_of, settings, textures


def blended(projection, features, alpha, s, order):
    """Image, opacity and number of hits: T = 1, then colour += T a f and T *= 1 - a, until T is under t_min."""
    image, opacity, count = np.zeros((features.shape[-1], HEIGHT, WIDTH)), np.zeros((HEIGHT, WIDTH)), 0
    for x, y in pixels():
        transmittance = 1.0
        hits = {i: (a, feature) for i, _, a, feature in hits_at(projection, features, alpha, s, x, y)}
        for i in order:
            if i in hits and transmittance >= s.t_min:
                a, feature = hits[i]
                image[:, y, x] += transmittance * a * feature
                transmittance *= 1.0 - a
                count += 1
        opacity[y, x] = 1.0 - transmittance
    return image, opacity, count


@pytest.mark.parametrize("channels", [0, 3, 10])
@pytest.mark.parametrize("queue", [0, 2, -1])
def test_layers_in_a_known_order(queue, channels):
    """Far enough apart in depth that every order of blending takes them one after the other."""
    depth = np.random.default_rng(1).permutation(np.arange(1.0, 3.0, 0.25))
    projection = patches(1, 8, radius=(20.0, 40.0), depth=depth, tilt=0.001)
    features, alpha = textures(1, 8, 2, channels)
    s = settings(queue, 2, t_min=0.02)
    scene = scene_of(projection, features, alpha, s)
    image, opacity = scene.forward()
    expected, expected_opacity, count = blended(projection, features, alpha, s, np.argsort(depth))
    np.testing.assert_allclose(image.numpy(), expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(opacity.numpy(), expected_opacity, rtol=0, atol=1e-12)
    assert scene.samples == count
    assert 0.9 < float(opacity.max()) and count > 3 * WIDTH * HEIGHT


def test_a_finished_pixel_takes_no_more():
    """Two layers of alpha 0.99 leave 1e-4: a third counts only under a smaller t_min."""
    projection = patches(2, 3, radius=(500.0, 501.0), depth=[1.0, 2.0, 3.0], tilt=0.0)
    projection.fade[:] = 1.0
    features = torch.tensor([0.0, 0.0, 1e6]).double().reshape(3, 1, 1, 1).expand(3, 2, 2, 1).contiguous()
    alpha = torch.ones(3, 2, 2).double()
    for queue in (0, 1, -1):
        finished, _ = scene_of(projection, features, alpha, settings(queue, 2, t_min=1.1e-4)).forward()
        more, _ = scene_of(projection, features, alpha, settings(queue, 2, t_min=0.9e-4)).forward()
        assert not bool(finished.any())
        torch.testing.assert_close(more, torch.full_like(more, 1e6 * 0.99 * 0.01**2))
