"""The harmonics against scipy's complex ones, their orthonormality, and their gradients."""

import math

import numpy as np
import pytest
import torch
from scipy.special import roots_legendre, sph_harm_y

from nbavatar.rendering.gaussians.spherical_harmonics import basis, harmonic_colours, harmonic_count


def directions(count=200):
    vectors = np.random.default_rng(0).normal(size=(count, 3))
    axes = np.concatenate([np.eye(3), -np.eye(3)])[:count]
    vectors[: len(axes)] = axes
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_equals_scipys_harmonics():
    d = directions()
    polar, azimuth = np.arccos(d[:, 2]), np.arctan2(d[:, 1], d[:, 0])
    values = basis(torch.from_numpy(d), 3)
    assert len(values) == harmonic_count(3) == 16
    numbers = [(degree, order) for degree in range(4) for order in range(-degree, degree + 1)]
    for (degree, order), value in zip(numbers, values, strict=True):
        complex_ = sph_harm_y(degree, abs(order), polar, azimuth)
        expected = complex_.real if order == 0 else math.sqrt(2) * (complex_.real if order > 0 else complex_.imag)
        np.testing.assert_allclose(value.numpy(), expected, atol=1e-14, err_msg=f"l = {degree}, m = {order}")


def test_is_orthonormal_on_the_sphere():
    """By Gauss-Legendre quadrature in z and the rectangle rule in azimuth, exact for these polynomials."""
    z, weight = roots_legendre(6)
    azimuth = np.arange(12) * (2 * np.pi / 12)
    r = np.sqrt(1 - z**2)
    d = np.stack([np.outer(r, np.cos(azimuth)), np.outer(r, np.sin(azimuth)), np.outer(z, np.ones(12))], -1)
    values = torch.stack(basis(torch.from_numpy(d), 3)).numpy().reshape(16, -1)
    gram = (values * np.repeat(weight, 12) * (2 * np.pi / 12)) @ values.T
    np.testing.assert_allclose(gram, np.eye(16), atol=1e-13)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colours_are_the_cut_off_sum(degree):
    d = directions(20)
    g = torch.Generator().manual_seed(0)
    coefficients = torch.randn(20, 16, 3, generator=g, dtype=torch.float64)
    got = harmonic_colours(coefficients, torch.from_numpy(d) * 3.0, degree)
    count = harmonic_count(degree)
    values = torch.stack(basis(torch.from_numpy(d), degree), 1)
    expected = torch.einsum("nk,nkc->nc", values, coefficients[:, :count]) + 0.5
    assert 0 < int((expected < 0).sum()) < expected.numel()
    torch.testing.assert_close(got, expected.clamp_min(0), atol=1e-14, rtol=0)


def test_a_constant_colour_needs_one_coefficient():
    coefficients = torch.zeros(1, 16, 3, dtype=torch.float64)
    coefficients[0, 0] = (torch.tensor([0.2, 0.5, 0.9]) - 0.5) * math.sqrt(4 * math.pi)
    for d in directions(5):
        colour = harmonic_colours(coefficients, torch.from_numpy(d)[None], 3)
        np.testing.assert_allclose(colour.numpy()[0], [0.2, 0.5, 0.9], atol=1e-7)


def test_gradients_equal_finite_differences():
    g = torch.Generator().manual_seed(1)
    coefficients = torch.randn(4, 16, 3, generator=g, dtype=torch.float64, requires_grad=True)
    offsets = torch.randn(4, 3, generator=g, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda c, o: harmonic_colours(c, o, 3), [coefficients, offsets])


def test_cut_off_colours_pass_no_gradient():
    coefficients = torch.zeros(1, 4, 3, dtype=torch.float64)
    coefficients[0, 0] = torch.tensor([-3.0, 0.0, 1.0])
    coefficients.requires_grad_()
    colour = harmonic_colours(coefficients, torch.tensor([[0.0, 0.0, 2.0]], dtype=torch.float64), 1)
    assert float(colour[0, 0].detach()) == 0.0
    colour.sum().backward()
    assert coefficients.grad[0, :, 0].tolist() == [0.0] * 4
    assert float(coefficients.grad[0, 0, 1]) == pytest.approx(math.sqrt(1 / (4 * math.pi)))


def test_a_camera_in_the_mean_gives_finite_values_and_gradients():
    coefficients = torch.ones(2, 16, 3, requires_grad=True)
    offsets = torch.tensor([[0.0, 0.0, 0.0], [1e-30, 0.0, 0.0]], requires_grad=True)
    colour = harmonic_colours(coefficients, offsets, 3)
    colour.sum().backward()
    for tensor in (colour, coefficients.grad, offsets.grad):
        assert bool(torch.isfinite(tensor).all())
