"""The optional backend against our own: on a GPU for real; elsewhere what it refuses, and its radii."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from nbavatar.errors import DataError, DependencyError, DeviceError
from nbavatar.rendering.gaussians import render_gaussians
from nbavatar.rendering.gaussians.gsplat_backend import _radii, render_gsplat
from nbavatar.rendering.gaussians.reference import SplatSettings
from tests.unit.rendering.gaussians.scenes import NAMES, camera, random_gaussians, turned_camera


@pytest.mark.gpu
@pytest.mark.parametrize("degree", [None, 3])
def test_equals_our_own_on_a_gpu(degree):
    """Values to float32's rounding and gradients to 1e-3, off pixels where rounding flips a hit."""
    pytest.importorskip("gsplat")
    scene = random_gaussians(1, 300, degree, torch.float32)
    scene[3] *= 0.95  # under either cap
    view, K = turned_camera(130, 90, focal=100.0)
    grads = torch.randn(4, 90, 130, generator=torch.Generator().manual_seed(0))
    results = []
    for backend, device in (("gsplat", "cuda"), ("cpu", "cpu")):
        inputs = [tensor.to(device).requires_grad_() for tensor in scene]
        offsets = torch.zeros(300, 2, device=device, requires_grad=True)
        image, alpha, radii = render_gaussians(
            *inputs, view.to(device), K.to(device), 130, 90, backend=backend, screen_offsets=offsets
        )
        values = torch.cat([image, alpha[None]])
        (values * grads.to(device)).sum().backward()
        results.append([values.detach().cpu(), radii.cpu(), *(t.grad.cpu() for t in (*inputs, offsets))])
    ours, theirs = results[1], results[0]
    differs = (ours[0] - theirs[0]).abs().amax(0) > 1e-4
    assert float(differs.float().mean()) < 0.01
    torch.testing.assert_close(theirs[1], ours[1], rtol=1e-4, atol=1e-3)
    for name, a, b in zip((*NAMES, "screen_offsets"), theirs[2:], ours[2:], strict=True):
        assert float((a - b).norm() / b.norm()) < 1e-2, name


def test_asks_for_the_package_and_for_a_gpu(monkeypatch):
    scene = random_gaussians(2, 3, None, torch.float32)
    view, K = camera(dtype=torch.float32)
    with pytest.raises(DeviceError, match="tensors on cuda"):
        render_gaussians(*scene, view, K, 40, 30, backend="gsplat")
    monkeypatch.setitem(sys.modules, "gsplat", None)
    settings = SplatSettings(40, 30, 1 / 255, 0.99, 1e-4)
    with pytest.raises(DependencyError, match="run: python -m pip install gsplat"):
        render_gsplat(*scene, view, K, settings, near=0.01, low_pass=0.3, screen_offsets=None)


def test_refuses_what_gsplat_has_not(monkeypatch):
    scene = random_gaussians(3, 3, None, torch.float32)
    view, K = camera(dtype=torch.float32)
    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace())

    def refuse(words, K, *numbers):
        settings = SplatSettings(40, 30, *numbers)
        with pytest.raises(DataError, match=words):
            render_gsplat(*scene, view, K, settings, near=0.01, low_pass=0.3, screen_offsets=None)

    refuse("alpha_min", K, 0.01, 0.99, 1e-4)
    refuse("t_min", K, 1 / 255, 0.99, 0.0)
    skewed = K.clone()
    skewed[0, 1] = 3.0
    refuse("skew", skewed, 1 / 255, 0.99, 1e-4)


def test_radii_from_conics_equal_eigenvalues():
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(20, 2, 2))
    covariances = roots @ roots.transpose(0, 2, 1) + 0.3 * np.eye(2)
    inverse = np.linalg.inv(covariances)
    conics = torch.from_numpy(np.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], 1))
    boxes = torch.ones(20, 2, dtype=torch.int32)
    boxes[3] = 0
    expected = 3 * np.sqrt(np.linalg.eigvalsh(covariances)[:, 1])
    expected[3] = 0
    np.testing.assert_allclose(_radii(boxes, conics.float()).numpy(), expected, rtol=1e-4)
    np.testing.assert_allclose(_radii(boxes[:, 0], conics.float()).numpy(), expected, rtol=1e-4)


class _TorchGsplat:
    """The package's interface on the reference's arithmetic, to run the backend's own lines without a GPU."""

    @staticmethod
    def fully_fused_projection(means, covars, quats, scales, viewmats, Ks, width, height, *, eps2d, near_plane):
        from nbavatar.rendering.gaussians.projection import project_gaussians

        assert covars is None
        seen = project_gaussians(
            means, quats, scales, viewmats[0], Ks[0], width, height, near=near_plane, low_pass=eps2d
        )
        p, s, k, x, y = seen.form.float().unbind(-1)
        conics = torch.stack([p * p, p * s, s * s + k * k], -1)[None]
        boxes = torch.where(seen.visible[:, None], 3.33 * seen.variances.sqrt(), 0.0).ceil().int()[None]
        return boxes, torch.stack([x, y], -1)[None], seen.depth.float()[None], conics, None

    @staticmethod
    def isect_tiles(means2d, radii, depths, tile_size, tile_width, tile_height):
        return None, torch.zeros(1), torch.argsort(depths[0])

    @staticmethod
    def isect_offset_encode(entries, images, tile_width, tile_height):
        return torch.zeros(images, tile_height, tile_width)

    @staticmethod
    def rasterize_to_pixels(means2d, conics, colours, opacities, width, height, tile_size, offsets, members):
        assert offsets.shape == (1, -(-height // tile_size), -(-width // tile_size))
        x, y = torch.arange(width) + 0.5, torch.arange(height)[:, None] + 0.5
        image, through = torch.zeros(height, width, 3), torch.ones(height, width)
        for i in members.tolist():
            dx, dy = x - means2d[0, i, 0], y - means2d[0, i, 1]
            a, b, c = conics[0, i]
            alpha = opacities[0, i] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
            alpha = torch.where(alpha >= 1 / 255, alpha.clamp_max(0.99), 0.0)
            image = image + (through * alpha)[..., None] * colours[0, i]
            through = through * (1 - alpha)
        return image[None], (1 - through)[None, ..., None]


def test_calls_the_package_as_it_is_documented(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", _TorchGsplat)
    scene = [tensor.requires_grad_() for tensor in random_gaussians(4, 12, None, torch.float32, spread=0.15)]
    scene[3].data *= 0.5  # no pixel ends early
    view, K = turned_camera(40, 30, dtype=torch.float32)
    offsets = torch.zeros(12, 2, requires_grad=True)
    settings = SplatSettings(40, 30, 1 / 255, 0.99, 1e-4)
    image, alpha, radii = render_gsplat(*scene, view, K, settings, near=0.01, low_pass=0.3, screen_offsets=offsets)
    expected = render_gaussians(*scene, view, K, 40, 30, backend="reference", screen_offsets=offsets)
    torch.testing.assert_close(image, expected.colour, atol=1e-5, rtol=0)
    torch.testing.assert_close(alpha, expected.alpha, atol=1e-5, rtol=0)
    torch.testing.assert_close(radii, expected.radii, rtol=1e-3, atol=0)
    (gradient,) = torch.autograd.grad(image.sum(), offsets, retain_graph=True)
    (wanted,) = torch.autograd.grad(expected.colour.sum(), offsets)
    torch.testing.assert_close(gradient, wanted, atol=1e-4, rtol=1e-3)
    empty = [tensor.detach()[:0] for tensor in scene]
    nothing = render_gsplat(*empty, view, K, settings, near=0.01, low_pass=0.3, screen_offsets=None)
    assert nothing[0].shape == (3, 30, 40) and not bool(nothing[1].any()) and nothing[2].shape == (0,)
