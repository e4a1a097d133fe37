"""The CPU kernels against the reference: values, gradients, determinism, extremes, resources."""

import time

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nbavatar.errors import DataError, DeviceError
from nbavatar.rendering import binning
from nbavatar.rendering.gaussians import cpu, render_gaussians
from nbavatar.rendering.gaussians.projection import project_gaussians
from nbavatar.rendering.gaussians.reference import SplatSettings, critical_pixels
from nbavatar.rendering.ordering import canonical_rank
from tests.unit.rendering.gaussians.scenes import NAMES, OPTIONS, camera, random_gaussians, single, stack, turned_camera


def compare(scene, view, K, width, height, *, value=1e-5, gradient=1e-4, most_flips=0.02, **options):
    """Asserts that values and gradients equal the float64 reference's, off the pixels where a decision may flip."""
    options = {**OPTIONS, **options}
    count, dtype = len(scene[0]), scene[0].dtype
    inputs = [tensor.detach().clone().requires_grad_() for tensor in scene]
    wide = [tensor.detach().double().requires_grad_() for tensor in scene]
    inputs.append(torch.zeros(count, 2, dtype=dtype, requires_grad=True))
    wide.append(torch.zeros(count, 2, dtype=torch.float64, requires_grad=True))
    got = render_gaussians(*inputs[:5], view, K, width, height, screen_offsets=inputs[5], backend="cpu", **options)
    want = render_gaussians(*wide[:5], view, K, width, height, screen_offsets=wide[5], backend="reference", **options)
    with torch.no_grad():
        projection = project_gaussians(
            *wide[:3], view, K, width, height, near=options["near"], low_pass=options["low_pass"]
        )
        rank = canonical_rank(projection.depth, *wide[:3], wide[4], wide[3])
        blend = SplatSettings(width, height, options["alpha_min"], options["alpha_max"], options["t_min"])
        tolerance = 1e-5 if dtype == torch.float32 else 1e-10
        safe = ~critical_pixels(projection, rank, wide[3], blend, tolerance=tolerance)
        assert got.colour.dtype == got.alpha.dtype == got.radii.dtype == dtype
        assert bool(torch.isfinite(got.colour).all()) and bool(torch.isfinite(got.alpha).all())
        torch.testing.assert_close(got.radii.double(), want.radii, rtol=1e-6, atol=0)
        scale = max(1.0, float(want.colour.abs().max()))
        wrong = (got.alpha - want.alpha).abs() > value
        wrong |= ((got.colour - want.colour).abs() > value * scale).any(0)
    assert not bool((wrong & safe).any())
    assert float(wrong.float().mean()) <= most_flips
    g = torch.Generator().manual_seed(0)
    grads = [torch.randn(tensor.shape, generator=g, dtype=torch.float64) * safe for tensor in got[:2]]
    torch.autograd.backward(got[:2], [grad.to(dtype) for grad in grads])
    torch.autograd.backward(want[:2], grads)
    for name, a, b in zip((*NAMES, "screen_offsets"), inputs, wide, strict=True):
        assert bool(torch.isfinite(a.grad).all()), name
        error = float((a.grad.double() - b.grad).norm())
        assert error <= gradient * float(b.grad.norm()) + 1e-9, (name, error, float(b.grad.norm()))
    return got.colour.detach(), got.alpha.detach(), safe


@pytest.mark.parametrize("degree", [None, 0, 1, 2, 3])
def test_equals_the_reference(degree):
    scene = random_gaussians(5, 60, degree, torch.float32)
    compare(scene, *turned_camera(53, 37, focal=40.0), 53, 37)  # no multiple of a tile


def test_float64_equals_the_reference_to_the_last_digits():
    scene = random_gaussians(6, 60, 3)
    compare(scene, *turned_camera(53, 37, focal=40.0), 53, 37, value=1e-13, gradient=1e-12)
    compare(scene, *camera(53, 37, focal=40.0), 53, 37, value=1e-13, gradient=1e-12, alpha_min=0.0, t_min=0.0)


@settings(max_examples=60)
@given(
    seed=st.integers(0, 10**6),
    count=st.integers(1, 80),
    width=st.integers(1, 50),
    height=st.integers(1, 40),
    spread=st.sampled_from([0.1, 0.5, 1.5]),
    smallest=st.sampled_from([1e-4, 0.01, 0.1]),
    largest=st.sampled_from([0.1, 0.5, 3.0]),
    low_pass=st.sampled_from([0.3, 0.3, 0.05, 2.0]),
    opaque=st.booleans(),
    skew=st.sampled_from([0.0, 0.0, 7.0]),
)
def test_random_scenes(seed, count, width, height, spread, smallest, largest, low_pass, opaque, skew):
    scene = random_gaussians(seed, count, None, torch.float32, spread, (smallest, largest))
    if opaque:
        scene[3] = 1 - 0.1 * scene[3]
    view, K = camera(width, height, focal=0.8 * max(width, height))
    K[0, 1] = skew
    compare(scene, view, K, width, height, low_pass=low_pass, most_flips=0.05)


EXTREMES = {
    "sub-pixel": dict(size=(1e-6, 1e-4)),
    "screen-filling": dict(size=(5.0, 50.0)),
    "needles": dict(size=(1e-5, 1.0)),
    "around the camera": dict(size=(0.3, 1.0), spread=2.0),
    "mostly off the image": dict(size=(0.05, 0.5), spread=4.0),
}


@pytest.mark.parametrize("name", list(EXTREMES))
def test_extremes(name):
    scene = random_gaussians(11, 40, 1, torch.float32, **EXTREMES[name])
    compare(scene, *turned_camera(50, 40, focal=45.0), 50, 40)


def test_zero_scales_are_points_and_flat_discs():
    scene = random_gaussians(12, 30, None, torch.float32)
    scene[2][:10] = 0.0
    scene[2][10:20, 2] = 0.0
    scene[2][20:, 1:] = 0.0
    compare(scene, *turned_camera(50, 40, focal=45.0), 50, 40)
    compare(scene, *turned_camera(50, 40, focal=45.0), 50, 40, low_pass=0.0)  # only the discs are left


def test_opacities_of_zero_and_one():
    scene = random_gaussians(13, 60, None, torch.float32, size=(0.05, 0.3))
    scene[3] = (scene[3] > 0.5).float()
    view, K = camera(40, 30)
    compare(scene, view, K, 40, 30)
    # uncapped, a Gaussian may be fully opaque only where a pixel meets its mean to the last digit
    compare(scene, view, K, 40, 30, alpha_max=1.0, t_min=0.0)
    compare(scene, view, K, 40, 30, alpha_min=0.0)


def test_behind_and_beside_the_camera():
    scene = random_gaussians(14, 30, 2, torch.float32)
    scene[0][:10, 2] = -1.0
    scene[0][10:15, 2] = 0.0
    scene[0][15:20, 2] = 0.009999
    image, _, _ = compare(scene, *camera(), 40, 30)
    seen = [tensor[20:] for tensor in scene]
    alone = render_gaussians(*seen, *camera(), 40, 30)
    assert torch.equal(alone.colour, image)


def test_depth_ratio_of_a_million():
    parts = [
        single(z=10.0**k, scale=0.1 * 10.0**k, opacity=0.4, x=0.05 * 10.0**k, dtype=torch.float32) for k in range(-1, 6)
    ]
    compare(stack(*parts), *camera(30, 30), 30, 30)


def test_far_from_the_origin():
    """World coordinates of 10 km in float32 are 1 mm apart; what is given is rendered exactly."""
    scene = random_gaussians(15, 30, 3, torch.float32)
    view, K = camera(40, 30, dtype=torch.float32)
    shift = torch.tensor([1e4, -2e4, 3e4])
    scene[0] = scene[0] + shift
    view[:3, 3] = -shift
    compare(scene, view, K, 40, 30)


def test_thousands_of_layers():
    scene = random_gaussians(16, 10_000, None, torch.float32, 0.0, (0.3, 0.5))
    scene[0][:, 2] = 1.0 + torch.randperm(10_000, generator=torch.Generator().manual_seed(1)) * 1e-4
    scene[3][:] = 0.0041
    _, alpha, _ = compare(scene, *camera(6, 5), 6, 5, t_min=0.0, most_flips=0.5)
    assert float(alpha.max()) > 0.99


def test_layers_taped_in_several_bands_give_the_same_gradients(monkeypatch):
    scene = [tensor.requires_grad_() for tensor in random_gaussians(18, 100, None)]
    view, K = camera(100, 70, focal=60.0)

    def gradients():
        image, alpha, _ = render_gaussians(*scene, view, K, 100, 70)
        return torch.autograd.grad(image.sum() + alpha.square().sum(), scene)

    whole = gradients()
    monkeypatch.setattr(cpu, "_TAPE", 1 << 15)
    for a, b in zip(whole, gradients(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)


def test_permuting_the_gaussians_changes_no_bit():
    scene = random_gaussians(17, 60, 3, torch.float32)
    scene[0][20:40] = scene[0][19]  # equal depths, some with equal poses, some equal altogether
    for tensor in scene[1:3]:
        tensor[30:40] = tensor[29]
    for tensor in scene[3:]:
        tensor[38:40] = tensor[37]
    view, K = turned_camera()
    order = torch.randperm(60, generator=torch.Generator().manual_seed(2))
    for backend in ("cpu", "reference"):
        image, alpha, radii = render_gaussians(*scene, view, K, 40, 30, backend=backend)
        same = render_gaussians(*[tensor[order] for tensor in scene], view, K, 40, 30, backend=backend)
        assert torch.equal(image, same.colour) and torch.equal(alpha, same.alpha), backend
        assert torch.equal(radii[order], same.radii), backend


def test_same_bytes_on_every_run_and_number_of_threads():
    scene = [tensor.requires_grad_() for tensor in random_gaussians(18, 300, 2, torch.float32)]
    view, K = turned_camera(130, 90, focal=100.0)
    threads = torch.get_num_threads()
    results = []
    try:
        for count in (1, 2, 3, 2):
            torch.set_num_threads(count)
            image, alpha, _ = render_gaussians(*scene, view, K, 130, 90)
            grads = torch.autograd.grad((image.square().sum() + alpha.square().sum()), scene)
            results.append((image, alpha, *grads))
    finally:
        torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_empty_scenes():
    scene = [tensor[:0].requires_grad_() for tensor in random_gaussians(19, 3, 1, torch.float32)]
    view, K = camera(dtype=torch.float32)
    for backend in ("cpu", "reference"):
        image, alpha, radii = render_gaussians(*scene, view, K, 40, 30, backend=backend)
        assert image.shape == (3, 30, 40) and not bool(image.any()) and not bool(alpha.any())
        assert radii.shape == (0,)
        (image.sum() + alpha.sum()).backward()


def test_radii_tell_who_is_on_the_image():
    scene = stack(single(), single(x=50.0), single(z=-1.0), single(opacity=0.0), single(x=1.2, scale=0.2))
    radii = render_gaussians(*scene, *camera(), 40, 30).radii
    assert (radii > 0).tolist() == [True, False, False, True, True]  # an opacity may come back


def test_only_active_harmonics_have_gradients():
    scene = random_gaussians(20, 20, 3, torch.float32)
    low = [*scene[:4], scene[4][:, :4].clone()]
    scene[4].requires_grad_()
    image, _, _ = render_gaussians(*scene, *camera(), 40, 30, sh_degree=1)
    assert torch.equal(image, render_gaussians(*low, *camera(), 40, 30).colour)
    image.sum().backward()
    assert float(scene[4].grad[:, 4:].abs().max()) == 0 < float(scene[4].grad[:, :4].abs().max())


def test_bad_input_is_refused_in_one_line():
    scene = random_gaussians(21, 5, 1, torch.float32)
    view, K = camera(dtype=torch.float32)
    nan = torch.tensor(float("nan"))

    def refuse(words, error: type[Exception] = DataError, change=None, **options):
        arguments = dict(zip(NAMES, scene, strict=True)) | {"viewmat": view, "K": K, "width": 40, "height": 30}
        with pytest.raises(error, match=words) as caught:
            render_gaussians(**(arguments | (change or {}) | options))
        assert "\n" not in str(caught.value)

    def changed(name, row, value):
        tensor = dict(zip(NAMES, scene, strict=True))[name].clone()
        tensor[row] = value
        return {name: tensor}

    refuse("means: .*row 2", change=changed("means", 2, nan))
    refuse("scales: .*row 3", change=changed("scales", 3, -0.1))
    refuse("scales: .*row 3", change=changed("scales", 3, 1e35))
    refuse("opacities: .*row 1", change=changed("opacities", 1, 1.5))
    refuse("quats: .*row 4", change=changed("quats", 4, 0.0))
    refuse("colours: .*row 0", change=changed("colours", 0, float("inf")))
    refuse("quats", quats=scene[1][:, :3])
    refuse("colours", colours=scene[4][:4])
    refuse("colours: .*coefficients", colours=torch.zeros(5, 7, 3))
    refuse("sh_degree", sh_degree=2)
    refuse("sh_degree", sh_degree=0, colours=scene[4][:, 0])
    refuse("opacities", opacities=scene[3][:, None])
    refuse("means", means=scene[0].tolist())
    refuse("screen_offsets", screen_offsets=torch.zeros(4, 2))
    refuse("viewmat", viewmat=view[:3])
    refuse("K: ", K=K.T.contiguous())
    refuse("near", near=0.0)
    refuse("low_pass", low_pass=-1.0)
    refuse("alpha_max", alpha_max=1.5)
    refuse("width", width=0)
    refuse("backend", backend="gpu")
    refuse("backend", DeviceError, backend="gsplat")


def test_a_scene_that_does_not_fit_says_so_before_allocating(monkeypatch):
    monkeypatch.setattr(binning, "available_memory", lambda: 1 << 20)
    scene = [tensor.expand(8000, *tensor.shape[1:]).clone() for tensor in single(scale=50.0, dtype=torch.float32)]
    scene[0][:, 2] += torch.arange(8000) * 1e-3
    view, K = camera(1024, 1024, dtype=torch.float32)
    start = time.perf_counter()
    with pytest.raises(DeviceError, match="GiB for the tile lists of 8000"):
        render_gaussians(*scene, view, K, 1024, 1024)
    assert time.perf_counter() - start < 20


def test_the_falloff_is_the_exponential():
    """One Gaussian of given deviation under alpha_min = 0: alpha against numpy's exp over 60 decades."""
    for dtype, tolerance in ((torch.float32, 2e-6), (torch.float64, 1e-13)):
        scene = single(z=1.0, scale=1.0, opacity=1.0, dtype=dtype)
        K = torch.tensor([[1.0, 0, 0.5], [0, 1.0, 0.5], [0, 0, 1]], dtype=torch.float64)
        view = torch.eye(4, dtype=torch.float64)
        alpha = render_gaussians(*scene, view, K, 16, 1, low_pass=0.0, alpha_min=0.0, alpha_max=1.0, t_min=0.0).alpha[0]
        expected = np.exp(-0.5 * np.arange(16.0) ** 2)
        expected[expected < 1e-30] = 0.0
        # alpha is one less the transmittance: small values have the transmittance's rounding
        np.testing.assert_allclose(alpha.numpy(), expected, rtol=tolerance, atol=torch.finfo(dtype).eps)
