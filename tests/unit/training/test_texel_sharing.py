"""Gradients that a billboard's texels share."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nbavatar.methods.billboards.initial import initial_avatar
from nbavatar.methods.billboards.training import BillboardTraining, shared_gradient
from tests.scenes.toy import sequence
from tests.scenes.training import train_config
from tests.unit.training.test_loop import CONFIG


@given(st.integers(0, 2**31), st.integers(1, 5), st.floats(0, 100))
def test_it_is_a_positive_definite_matrix_on_the_gradient(seed: int, texels: int, share: float) -> None:
    gradient = torch.randn(3, texels, texels, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    result = shared_gradient(gradient, share)
    flat = gradient.numpy().reshape(3, -1, 2)
    matrix = np.eye(texels**2) + share / texels**2 * np.ones((texels**2, texels**2))
    np.testing.assert_allclose(result.numpy().reshape(3, -1, 2), np.einsum("ij,fjc->fic", matrix, flat), atol=1e-9)
    assert float((result * gradient).sum()) >= float((gradient**2).sum()) * (1 - 1e-12)


@pytest.mark.parametrize("share", [0.0, 4.0])
def test_training_hands_it_to_both_textures_of_the_billboard_that_is_seen(share: float) -> None:
    meshes = sequence()
    coords = {name: part.rest for name, part in meshes.parts.items()}
    avatar = initial_avatar(meshes, coords, meshes.frames, CONFIG)
    BillboardTraining(avatar, None, train_config(CONFIG, texel_sharing=share))
    for textures in (avatar.billboards.features, avatar.billboards.alpha_logit):
        textures[1, 0, 0].sum().backward()
        assert textures.grad is not None
        count = textures.shape[1] ** 2
        torch.testing.assert_close(textures.grad[1, 1, 1], torch.full_like(textures.grad[1, 1, 1], share / count))
        torch.testing.assert_close(textures.grad[1, 0, 0], torch.full_like(textures.grad[1, 0, 0], 1 + share / count))
        assert not textures.grad[0].any()
