"""The definition of right, against independent arithmetic, closed forms and finite differences."""

import math

import numpy as np
import pytest
import torch

from nbavatar.rendering.gaussians import render_gaussians
from nbavatar.rendering.gaussians.projection import project_gaussians
from tests.unit.rendering.gaussians.scenes import (
    NAMES,
    OPTIONS,
    camera,
    covariance_by_differences,
    pixel_of,
    random_gaussians,
    render_by_hand,
    single,
    stack,
    turned_camera,
)


def render(scene, view, K, width, height, **options):
    return render_gaussians(*scene, view, K, width, height, backend="reference", **{**OPTIONS, **options})


def test_equals_pixels_blended_by_hand():
    scene = random_gaussians(3, count=15, spread=0.2)
    view, K = turned_camera(19, 15, focal=16.0)
    image, alpha, _ = render(scene, view, K, 19, 15, near=2.2)
    expected_image, expected_alpha = render_by_hand(scene, view, K, 19, 15, **{**OPTIONS, "near": 2.2})
    assert 0.3 < expected_alpha.max() and not np.allclose(expected_alpha, render(scene, view, K, 19, 15)[1])
    # central differences of the projection are good to about 1e-9
    torch.testing.assert_close(image.numpy(), expected_image, atol=1e-7, rtol=0)
    torch.testing.assert_close(alpha.numpy(), expected_alpha, atol=1e-7, rtol=0)


def test_opaque_layers_end_a_pixel_as_by_hand():
    scene = random_gaussians(4, count=40, spread=0.15, size=(0.1, 0.5))
    scene[3][:] = 1.0
    view, K = camera(13, 11, focal=12.0)
    image, alpha, _ = render(scene, view, K, 13, 11)
    expected_image, expected_alpha = render_by_hand(scene, view, K, 13, 11, **OPTIONS)
    torch.testing.assert_close(image.numpy(), expected_image, atol=1e-7, rtol=0)
    torch.testing.assert_close(alpha.numpy(), expected_alpha, atol=1e-7, rtol=0)
    assert 0.99 < alpha.max() <= 1 - OPTIONS["t_min"] + 1e-12


@pytest.mark.parametrize("skew", [0.0, 5.0])
def test_projected_covariance_equals_finite_differences_of_the_pinhole(skew):
    means, quats, scales, _, _ = random_gaussians(5, count=50, spread=0.25, size=(1e-3, 0.5))
    view, K = turned_camera()
    K[0, 1] = skew
    projection = project_gaussians(means, quats, scales, view, K, 40, 30, near=0.01, low_pass=0.3)
    assert bool(projection.visible.all())
    for i in range(50):
        p, s, k, x, y = projection.form[i].numpy()
        np.testing.assert_allclose([x, y], pixel_of(means[i].numpy(), view.numpy(), K.numpy()), atol=1e-10)
        if not (-4 < x < 44 and -3 < y < 33):
            continue  # there the Jacobian is clamped
        expected = covariance_by_differences(*(t[i].numpy() for t in (means, quats, scales)), view.numpy(), K.numpy(),
                                             0.3)  # fmt: skip
        rows = np.array([[p, s], [0, k]])
        np.testing.assert_allclose(rows.T @ rows @ expected, np.eye(2), atol=2e-7)
        np.testing.assert_allclose(projection.variances[i], expected.diagonal(), rtol=1e-7)
        largest = np.linalg.eigvalsh(expected)[1]
        assert float(projection.radii[i]) == pytest.approx(3 * math.sqrt(largest), rel=1e-7)


def test_one_gaussian_at_its_centre_and_one_deviation_off():
    """Focal length f, ball of radius r at depth z on the axis: variance (f r / z)^2 + 0.3."""
    K = torch.tensor([[40.0, 0.0, 8.5], [0.0, 40.0, 6.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
    view = torch.eye(4, dtype=torch.float64)
    image, alpha, radii = render(single(z=2.0, scale=0.1, opacity=0.8), view, K, 17, 13)
    variance = (40 * 0.1 / 2) ** 2 + 0.3
    assert float(alpha[6, 8]) == pytest.approx(0.8, abs=1e-14)
    assert float(alpha[6, 11]) == pytest.approx(0.8 * math.exp(-9 / (2 * variance)), abs=1e-14)
    assert float(alpha[4, 7]) == pytest.approx(0.8 * math.exp(-5 / (2 * variance)), abs=1e-14)
    assert image[:, 6, 8].tolist() == pytest.approx([0.8, 0.4, 0.2], abs=1e-14)
    assert float(radii) == pytest.approx(3 * math.sqrt(variance), abs=1e-12)


def test_layers_blend_as_computed_by_hand():
    """Three balls on the axis, given back to front: red 0.5, green 0.25, blue 0.9 at the centre pixel."""
    K = torch.tensor([[40.0, 0.0, 4.5], [0.0, 40.0, 4.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
    view = torch.eye(4, dtype=torch.float64)
    scene = stack(
        single(z=3.0, opacity=0.9, colour=(0, 0, 1)),
        single(z=2.5, opacity=0.25, colour=(0, 1, 0)),
        single(z=2.0, opacity=0.5, colour=(1, 0, 0)),
    )
    image, alpha, _ = render(scene, view, K, 9, 9)
    assert image[:, 4, 4].tolist() == pytest.approx([0.5, 0.5 * 0.25, 0.5 * 0.75 * 0.9], abs=1e-14)
    assert float(alpha[4, 4]) == pytest.approx(1 - 0.5 * 0.75 * 0.1, abs=1e-14)


def test_a_pixel_ends_before_its_transmittance_falls_under_the_limit():
    """Opacities 0.99, 0.985, 0.99: the second leaves 1.5e-4, the third would leave 1.5e-6 and is not blended."""
    K = torch.tensor([[40.0, 0.0, 4.5], [0.0, 40.0, 4.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
    view = torch.eye(4, dtype=torch.float64)
    scene = stack(*[single(z=2.0 + k, opacity=o) for k, o in enumerate((0.99, 0.985, 0.99))])
    assert float(render(scene, view, K, 9, 9).alpha[4, 4]) == pytest.approx(1 - 0.01 * 0.015, abs=1e-14)
    on = render(scene, view, K, 9, 9, t_min=0.0)
    assert float(on.alpha[4, 4]) == pytest.approx(1 - 0.01 * 0.015 * 0.01, abs=1e-14)


def test_the_low_pass_widens_a_point_to_its_own_size():
    """A Gaussian of no extent is the low-pass itself: exp(-d^2 / 0.6)."""
    K = torch.tensor([[40.0, 0.0, 4.5], [0.0, 40.0, 4.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
    view = torch.eye(4, dtype=torch.float64)
    alpha = render(single(scale=0.0, opacity=0.9), view, K, 9, 9).alpha
    assert float(alpha[4, 4]) == pytest.approx(0.9, abs=1e-14)
    assert float(alpha[4, 5]) == pytest.approx(0.9 * math.exp(-1 / 0.6), abs=1e-14)
    assert float(alpha[5, 5]) == pytest.approx(0.9 * math.exp(-2 / 0.6), abs=1e-14)
    assert float(render(single(scale=0.0), view, K, 9, 9, low_pass=0.0).alpha.max()) == 0.0


def mixed(colour, alpha, _):
    """Eight random mixtures of all values of a picture: as telling as all of them, and soon checked."""
    values = torch.cat([colour.ravel(), alpha.ravel()])
    generator = torch.Generator().manual_seed(1)
    return torch.randn(8, len(values), generator=generator, dtype=torch.float64) @ values


@pytest.mark.parametrize(("degree", "low_pass", "alpha_min"), [(None, 0.3, 0.0), (0, 0.0, 1 / 255), (1, 0.3, 0.0)])
def test_gradients_equal_finite_differences(degree, low_pass, alpha_min):
    scene = random_gaussians(7, count=3, degree=degree, size=(0.05, 0.4))
    view, K = turned_camera(5, 4, focal=5.0)
    offsets = torch.zeros(3, 2, dtype=torch.float64, requires_grad=True)
    inputs = [tensor.requires_grad_() for tensor in (*scene,)]

    def function(*tensors):
        options = {"low_pass": low_pass, "alpha_min": alpha_min, "screen_offsets": tensors[5]}
        return mixed(*render(tensors[:5], view, K, 5, 4, **options))

    assert torch.autograd.gradcheck(function, [*inputs, offsets], atol=1e-6)


def test_gradients_of_the_clamped_jacobian_equal_finite_differences():
    """Means beyond the margin of the image, large enough to reach into it."""
    scene = random_gaussians(8, count=4, size=(0.7, 1.4))
    scene[0][:, :2] = torch.tensor([[3.0, 0.0], [-2.5, 0.3], [0.4, 2.5], [2.6, -2.8]])
    view, K = camera(5, 4, focal=5.0)
    inputs = [tensor.requires_grad_() for tensor in scene]
    assert float(render(scene, view, K, 5, 4).alpha.detach().max()) > 0.01
    assert torch.autograd.gradcheck(lambda *t: mixed(*render(t, view, K, 5, 4, alpha_min=0.0)), inputs, atol=1e-6)


def test_a_capped_alpha_gets_no_gradient_but_its_colour_does():
    K = torch.tensor([[40.0, 0.0, 4.5], [0.0, 40.0, 4.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
    scene = [tensor.requires_grad_() for tensor in single(opacity=1.0)]
    image, alpha, _ = render(scene, torch.eye(4, dtype=torch.float64), K, 9, 9)
    assert float(alpha[4, 4].detach()) == pytest.approx(0.99, abs=1e-14)
    (image[:, 4, 4].sum() + alpha[4, 4]).backward()
    for name, tensor in zip(NAMES, scene, strict=True):
        expected = 2.97 if name == "colours" else 0.0
        assert float(tensor.grad.abs().sum()) == pytest.approx(expected, abs=1e-12), name


def test_faint_alphas_are_skipped():
    K = torch.tensor([[40.0, 0.0, 4.5], [0.0, 40.0, 4.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
    view = torch.eye(4, dtype=torch.float64)
    assert float(render(single(opacity=0.0039), view, K, 9, 9).alpha.max()) == 0.0
    assert float(render(single(opacity=0.0040), view, K, 9, 9).alpha.max()) == pytest.approx(0.004, abs=1e-14)
    alpha = render(single(opacity=0.9, scale=0.05), view, K, 9, 9).alpha
    assert float(alpha[alpha > 0].min()) >= 1 / 255
    assert int((alpha > 0).sum()) == sum(
        0.9 * math.exp(-(i * i + j * j) / 2.6) >= 1 / 255 for i in range(-4, 5) for j in range(-4, 5)
    )


def test_screen_offsets_move_the_picture_and_receive_its_gradient():
    scene = random_gaussians(9, count=6)
    view, K = camera(20, 16, focal=15.0)
    offsets = torch.zeros(6, 2, dtype=torch.float64, requires_grad=True)
    image, alpha, _ = render(scene, view, K, 20, 16, screen_offsets=offsets, alpha_min=0.0)
    weights = torch.randn(4, 16, 20, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    (gradient,) = torch.autograd.grad((torch.cat([image, alpha[None]]) * weights).sum(), offsets)
    step = 1e-6
    for i in range(6):
        for axis in range(2):
            moved = torch.zeros(6, 2, dtype=torch.float64)
            values = []
            for sign in (1, -1):
                moved[i, axis] = sign * step
                image, alpha, _ = render(scene, view, K, 20, 16, screen_offsets=moved, alpha_min=0.0)
                values.append(float((torch.cat([image, alpha[None]]) * weights).sum()))
            slope = (values[0] - values[1]) / (2 * step)
            assert float(gradient[i, axis]) == pytest.approx(slope, abs=1e-6)


@pytest.mark.parametrize("backend", ["reference", "auto"])
def test_an_off_centre_principal_point_is_a_crop_of_the_larger_picture(backend):
    scene = random_gaussians(10, count=40, degree=3, spread=0.05)  # means inside the clamp of the crop as well
    view, K = turned_camera(60, 50, focal=120.0)
    K[:2, 2] += torch.tensor([34.0, 23.0]) - pixel_of(np.array([0.0, 0.0, 2.0]), view.numpy(), K.numpy())
    whole = render_gaussians(*scene, view, K, 60, 50, backend=backend)
    left, top, width, height = 22, 13, 26, 21
    K = K.clone()
    K[0, 2] -= left
    K[1, 2] -= top
    part = render_gaussians(*scene, view, K, width, height, backend=backend)
    assert float(part.alpha.max()) > 0.3
    rows, columns = slice(top, top + height), slice(left, left + width)
    torch.testing.assert_close(part.colour, whole.colour[:, rows, columns], atol=1e-12, rtol=0)
    torch.testing.assert_close(part.alpha, whole.alpha[rows, columns], atol=1e-12, rtol=0)
