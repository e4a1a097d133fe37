"""The replay alone, the adjoint of blending: the tape's weights and dL/da against sums written out, hit by hit."""

import pytest
import torch

from tests.unit.rendering.billboards.stages import (
    HEIGHT,
    WIDTH,
    hits_at,
    patches,
    pixels,
    replayed,
    scene_of,
    settings,
    taped_hits,
    textures,
)


@pytest.mark.parametrize("channels", [0, 3, 10])
@pytest.mark.parametrize("queue", [0, 2, -1])
def test_tape_holds_weights_and_adjoints_of_the_alphas(queue, channels):
    """dL/da_k = T_k v_k - sum over j > k of T_j a_j v_j / (1 - a_k), with v = f . dL/dC + dL/dA."""
    depth = [2.75, 1.0, 2.25, 1.5, 3.0, 1.25, 2.0]
    projection = patches(5, 7, radius=(15.0, 40.0), depth=depth, tilt=0.001)
    features, alpha = textures(5, 7, 2, channels)
    s = settings(queue, 2, t_min=0.02)
    scene = scene_of(projection, features, alpha, s)
    scene.forward()
    g = torch.Generator().manual_seed(6)
    grad_image = torch.randn(channels, HEIGHT, WIDTH, generator=g, dtype=torch.float64)
    grad_opacity = torch.randn(HEIGHT, WIDTH, generator=g, dtype=torch.float64)
    found = taped_hits(scene, replayed(scene, grad_image, grad_opacity)[1])
    expected = {}
    for x, y in pixels():
        hits = sorted(hits_at(projection, features, alpha, s, x, y), key=lambda hit: -hit[1])
        transmittance, kept = 1.0, []
        for i, _, a, feature in hits:
            if transmittance >= s.t_min:
                v = float(feature @ grad_image[:, y, x].numpy() + float(grad_opacity[y, x]))
                kept.append((i, a, transmittance, v))
                transmittance *= 1.0 - a
        for k, (i, a, t, v) in enumerate(kept):
            rest = sum(t_j * a_j * v_j for _, a_j, t_j, v_j in kept[k + 1 :])
            expected[x, y, i] = (t * a, t * v - rest / (1.0 - a))
    assert found.keys() == expected.keys() and len(found) > 2 * WIDTH * HEIGHT
    for key, values in expected.items():
        assert found[key] == pytest.approx(values, rel=1e-9, abs=1e-11), key
