"""The compiled projection and harmonics against the torch ones that define them."""

import pytest
import torch

from nbavatar.rendering.gaussians.cpu_projection import harmonic_colours_cpu, project_gaussians_cpu
from nbavatar.rendering.gaussians.projection import project_gaussians
from nbavatar.rendering.gaussians.spherical_harmonics import harmonic_colours
from tests.unit.rendering.gaussians.scenes import random_gaussians, turned_camera

FIELDS = ("form", "variances", "depth", "visible", "radii")


def scene(count, size):
    means, quats, scales, _, _ = random_gaussians(1, count, spread=1.0, size=size)
    means[::7, 2] = -1.0  # behind the camera
    return [tensor.requires_grad_() for tensor in (means, quats, scales)]


@pytest.mark.parametrize(("size", "low_pass"), [((1e-3, 0.5), 0.3), ((1e-6, 2.0), 0.3), ((0.01, 0.5), 0.0)])
@pytest.mark.parametrize("skew", [0.0, 6.0])
def test_projection_equals_torch_in_values_and_gradients(size, low_pass, skew):
    view, K = turned_camera(40, 30)
    K[0, 1] = skew
    ours, torchs = scene(200, size), scene(200, size)
    offsets = [torch.full((200, 2), 0.25, dtype=torch.float64, requires_grad=True) for _ in range(2)]
    got = project_gaussians_cpu(*ours, view, K, 40, 30, near=0.01, low_pass=low_pass, screen_offsets=offsets[0])
    want = project_gaussians(*torchs, view, K, 40, 30, near=0.01, low_pass=low_pass, screen_offsets=offsets[1])
    assert 20 < int((~want.visible).sum()) < 100
    for name in FIELDS:
        torch.testing.assert_close(getattr(got, name), getattr(want, name), rtol=1e-12, atol=1e-12, msg=name)
    clamped = (want.form[:, 3] < -6) | (want.form[:, 3] > 46) | (want.form[:, 4] < -4.5) | (want.form[:, 4] > 34.5)
    assert int((clamped & want.visible).sum()) > 20
    weights = torch.randn(200, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    (got.form * weights).sum().backward()
    (want.form * weights * want.visible[:, None]).sum().backward()
    for name, a, b in zip(("means", "quats", "scales", "offsets"), (*ours, offsets[0]), (*torchs, offsets[1])):
        gradient = a.grad * want.visible[:, None] if name == "offsets" else a.grad
        torch.testing.assert_close(gradient, b.grad, rtol=1e-9, atol=1e-9 * float(b.grad.abs().max()), msg=name)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_harmonics_equal_torch_in_values_and_gradients(degree, dtype):
    g = torch.Generator().manual_seed(degree)
    coefficients = torch.randn(50, 16, 3, generator=g, dtype=torch.float64).to(dtype)
    offsets = torch.randn(50, 3, generator=g, dtype=torch.float64)
    offsets[0] = 0.0
    weights = torch.randn(50, 3, generator=g, dtype=torch.float64)
    results = []
    for function, kind in ((harmonic_colours_cpu, dtype), (harmonic_colours, torch.float64)):
        leaves = [coefficients.to(kind, copy=True).requires_grad_(), offsets.clone().requires_grad_()]
        colours = function(*leaves, degree)
        assert colours.dtype == kind
        (colours * weights).sum().backward()
        moved = leaves[1].grad if leaves[1].grad is not None else torch.zeros(50, 3)
        results.append([colours.double(), leaves[0].grad.double(), moved.double()])
    tolerance = 1e-13 if dtype == torch.float64 else 1e-6
    assert 0 < int((results[1][0] == 0).sum()) < 100
    for got, want in zip(*results, strict=True):
        torch.testing.assert_close(got, want, rtol=tolerance, atol=10 * tolerance)


def test_a_gaussians_bits_do_not_depend_on_its_place():
    means, quats, scales, _, _ = random_gaussians(2, 1)
    copies = [tensor.expand(1003, -1).contiguous() for tensor in (means, quats, scales)]
    projection = project_gaussians_cpu(*copies, *turned_camera(), 40, 30, near=0.01, low_pass=0.3)
    for name in FIELDS:
        values = getattr(projection, name)
        assert torch.equal(values, values[:1].expand_as(values)), name
