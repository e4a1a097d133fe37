"""The CPU kernels against the reference: values, gradients, determinism, extremes, resources."""

import os
import time

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from nbavatar.errors import DataError, DeviceError
from nbavatar.rendering import binning
from nbavatar.rendering.billboards import cpu, cpu_blend, cpu_projection, render_billboards
from nbavatar.rendering.billboards.projection import project_billboards, texture_support
from nbavatar.rendering.billboards.reference import BlendSettings, blend_reference, critical_pixels
from nbavatar.rendering.ordering import canonical_rank, parse_order
from tests.unit.rendering.billboards.scenes import OPTIONS, camera, facing, random_billboards, stack


def compare(scene, view, K, width, height, *, value=2e-5, gradient=1e-4, most_flips=0.02, uniform=None, **options):
    """Asserts that values and gradients equal the float64 reference's, off the pixels where a decision may flip."""
    options = {**OPTIONS, "order": "ray", **options}
    inputs = [tensor.detach().clone().requires_grad_() for tensor in scene]
    wide = [tensor.detach().double().requires_grad_() for tensor in scene]
    beside, beside_wide = None, None
    if uniform is not None:
        beside, beside_wide = uniform.clone().requires_grad_(), uniform.double().requires_grad_()
    image, opacity = render_billboards(*inputs, view, K, width, height, backend="cpu", uniform=beside, **options)
    expected, expected_opacity = render_billboards(
        *wide, view, K, width, height, backend="reference", uniform=beside_wide, **options
    )
    support = texture_support(scene[4].shape[-1])
    with torch.no_grad():
        projection = project_billboards(
            *wide[:3], view, K, near=options["near"], low_pass=options["low_pass"], support=support
        )
        rank = canonical_rank(projection.depth, *wide)
        blend = BlendSettings(width, height, parse_order(options["order"]), options["near"], options["alpha_min"],
                              options["alpha_max"], options["t_min"], support)  # fmt: skip
        tolerance = 1e-5 if image.dtype == torch.float32 else 1e-10
        safe = ~critical_pixels(projection, rank, wide[4], blend, tolerance=tolerance)
    assert bool(torch.isfinite(image).all()) and bool(torch.isfinite(opacity).all())
    scale = max(1.0, float(scene[3].abs().max()) if scene[3].numel() else 0.0)
    with torch.no_grad():
        wrong = (opacity - expected_opacity).abs() > value
        wrong |= ((image - expected).abs() > value * scale).any(0)
    assert not bool((wrong & safe).any())
    assert float(wrong.float().mean()) <= most_flips
    g = torch.Generator().manual_seed(0)
    grads = [torch.randn(tensor.shape, generator=g, dtype=torch.float64) * safe for tensor in (image, opacity)]
    torch.autograd.backward((image, opacity), [grad.to(image.dtype) for grad in grads])
    torch.autograd.backward((expected, expected_opacity), grads)
    names = ["means", "quats", "half_extents", "features", "alpha"]
    if uniform is not None:
        names, inputs, wide = [*names, "uniform"], [*inputs, beside], [*wide, beside_wide]
    for name, got, want in zip(names, inputs, wide, strict=True):
        assert bool(torch.isfinite(got.grad).all()), name
        error = float((got.grad.double() - want.grad).norm())
        assert error <= gradient * float(want.grad.norm()) + 1e-9, (name, error, float(want.grad.norm()))
    return image.detach(), opacity.detach(), safe


@pytest.mark.parametrize("order", ["ray", "center", "kbuffer(1)", "kbuffer(4)", "kbuffer(1000)"])
@pytest.mark.parametrize(("texels", "channels"), [(1, 1), (2, 3), (8, 6), (16, 23)])
def test_equals_the_reference(order, texels, channels):
    scene = random_billboards(5, 40, texels, channels, torch.float32)
    view, K = camera(53, 37)  # no multiple of a tile
    compare(scene, view, K, 53, 37, order=order)


@pytest.mark.parametrize("order", ["ray", "center", "kbuffer(4)"])
@pytest.mark.parametrize(("texels", "channels", "uniform"), [(6, 6, 7), (2, 8, 3), (1, 3, 14), (3, 0, 2), (4, 17, 1)])
def test_channels_that_texels_have_in_common_equal_the_references(order, texels, channels, uniform):
    """The reference has them in every texel, which fade to zero at the texture's border as others do."""
    scene = random_billboards(5, 40, texels, channels, torch.float32)
    told = torch.randn(40, uniform, generator=torch.Generator().manual_seed(1))
    compare(scene, *camera(53, 37), 53, 37, order=order, uniform=told)


def test_gradients_of_many_tapes_add_up_for_uniform_channels_too(monkeypatch):
    scene = random_billboards(6, 20, 4, 3)
    told = torch.randn(20, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    gathered, gather = [], cpu._Scene._gather
    monkeypatch.setattr(cpu, "_TAPE", 20)
    monkeypatch.setattr(cpu._Scene, "_gather", lambda *args: (gathered.append(args), gather(*args)))
    compare(scene, *camera(70, 40), 70, 40, value=1e-12, gradient=1e-12, uniform=told)
    assert len(gathered) > 1


def test_float64_equals_the_reference_to_the_last_digits():
    scene = random_billboards(6, 40, 5, 4)
    compare(scene, *camera(53, 37), 53, 37, value=1e-12, gradient=1e-12)


@settings(max_examples=int(os.environ.get("NBAVATAR_RASTER_SCENES", "40")), deadline=None, derandomize=True,
          suppress_health_check=list(HealthCheck))  # fmt: skip
@given(
    seed=st.integers(0, 10**6),
    count=st.integers(1, 60),
    texels=st.integers(1, 9),
    channels=st.integers(1, 9),
    width=st.integers(1, 50),
    height=st.integers(1, 40),
    spread=st.sampled_from([0.1, 0.5, 1.5]),
    largest=st.sampled_from([0.005, 0.05, 0.5, 3.0]),
    order=st.sampled_from(["ray", "ray", "center", "kbuffer(3)"]),
)
def test_random_scenes(seed, count, texels, channels, width, height, spread, largest, order):
    scene = random_billboards(seed, count, texels, channels, torch.float32, spread, (largest / 4, largest))
    view, K = camera(width, height, focal=0.8 * max(width, height))
    compare(scene, view, K, width, height, order=order, most_flips=0.05)


@pytest.mark.slow
def test_two_hundred_random_scenes():
    """The same property on 200 scenes of the same strategy, without shrinking."""
    for seed in range(200):
        g = np.random.default_rng(seed)
        width, height = (int(value) for value in g.integers(1, 50, 2))
        largest = float(g.choice([0.005, 0.05, 0.5, 3.0]))
        scene = random_billboards(seed, int(g.integers(1, 60)), int(g.integers(1, 9)), int(g.integers(1, 9)),
                                  torch.float32, float(g.choice([0.1, 0.5, 1.5])), (largest / 4, largest))  # fmt: skip
        order = ("ray", "ray", "center", "kbuffer(3)")[seed % 4]
        compare(scene, *camera(width, height, focal=0.8 * max(width, height)), width, height, order=order,
                most_flips=0.05)  # fmt: skip


EXTREMES = {
    "grazing": dict(tilt=1.5707),
    "sub-pixel": dict(size=(1e-5, 1e-4)),
    "screen-filling": dict(size=(5.0, 50.0)),
    "through the near plane": dict(size=(1.0, 4.0), spread=2.0),
    "flat": dict(size=(1e-9, 0.3)),
}


@pytest.mark.parametrize("name", list(EXTREMES))
def test_extremes(name):
    settings_ = dict(EXTREMES[name])
    tilt = settings_.pop("tilt", None)
    scene = random_billboards(11, 25, 6, 3, torch.float32, **settings_)
    if tilt is not None:
        angles = torch.linspace(tilt - 1e-2, tilt + 2e-4, 25)
        scene[1] = torch.stack([torch.cos(angles / 2), angles * 0, torch.sin(angles / 2), angles * 0], 1)
        scene[0][:, :2] *= 0.05
    compare(scene, *camera(50, 40), 50, 40)


def test_depth_ratio_of_a_million():
    parts = [facing(10.0**k, extent=0.3 * 10.0**k, alpha=0.4, feature=k, dtype=torch.float32) for k in range(-1, 6)]
    scene = stack(*parts)
    scene[0][:, 0] = torch.tensor([0.05 * 10.0**k for k in range(-1, 6)])
    compare(scene, *camera(30, 30), 30, 30)


def test_far_from_the_origin():
    """World coordinates of 10 km in float32 are 1 mm apart; what is given is rendered exactly."""
    scene = random_billboards(12, 30, 4, 3, torch.float32)
    view, K = camera(40, 30, dtype=torch.float32)
    shift = torch.tensor([1e4, -2e4, 3e4])
    scene[0] = scene[0] + shift
    view[:3, 3] = -shift
    compare(scene, view, K, 40, 30)


def test_ten_thousand_layers():
    scene = random_billboards(13, 10_000, 2, 1, torch.float32, 0.0, (0.5, 0.6))
    scene[1] = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(10_000, 4).clone()
    scene[0][:, 2] = 1.0 + torch.randperm(10_000, generator=torch.Generator().manual_seed(1)) * 1e-4
    scene[4] = torch.full_like(scene[4], 0.0041)
    _, opacity, _ = compare(scene, *camera(6, 5), 6, 5, t_min=0.0, gradient=1e-3)
    assert float(opacity.max()) > 0.99


def test_layers_that_interleave_overflow_the_queues_and_stay_exact():
    """300 crossing planes all reach the same least depth: nothing is final before the last has come."""
    scene = random_billboards(14, 300, 2, 2, torch.float32, 0.02, (1.0, 1.2))
    scene[4] *= 0.02
    compare(scene, *camera(20, 18), 20, 18, alpha_min=0.0)


def test_hundreds_of_hits_that_wait_at_a_pixel_are_blended_in_order():
    """Faint billboards, each on a few pixels, in a thick layer: queues fill, are emptied in part and fill again."""
    scene = random_billboards(22, 4000, 2, 2, torch.float32, 0.05, (0.03, 0.05))
    scene[0][:, 2] += torch.linspace(0.0, 0.6, 4000)
    scene[4] *= 0.05
    compare(scene, *camera(8, 7), 8, 7, t_min=0.0, alpha_min=1e-4, most_flips=0.5)


@pytest.mark.parametrize("count", [5, 12, 70])
def test_layers_at_one_depth_are_blended_by_rank(count):
    """More than a sorting network takes, and more than the first queues hold, and only rank tells them apart."""
    scene = random_billboards(23, count, 2, 2, torch.float32, 0.0, (0.5, 0.6))
    scene[0][:, :2] = 0.05 * torch.randn(count, 2, generator=torch.Generator().manual_seed(2))
    scene[1] = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4).clone()
    scene[4] *= 0.1
    compare(scene, *camera(20, 18), 20, 18)


def test_a_picture_written_past_the_caches_is_the_same():
    """Widths that are and are not multiples of sixteen pixels take different ways to memory."""
    scene = random_billboards(24, 60, 4, 8)
    view, K = camera(1024, 512, focal=500.0)
    assert 1024 * 512 * 8 >= cpu_blend.LARGE
    image, opacity = render_billboards(*scene, view, K, 1024, 512)
    other, other_opacity = render_billboards(*scene, view, K, 1021, 512)
    assert float(opacity.max()) > 0.9
    assert torch.equal(image[..., :1021], other)
    assert torch.equal(opacity[..., :1021], other_opacity)


def test_a_replay_that_finds_other_hits_is_refused(monkeypatch):
    """The notes' memory is laid out by what the forward pass has found: nothing may be written beyond it."""
    forward = cpu._Scene.forward

    def short(scene):
        result = forward(scene)
        scene.bundles[scene.bundles.argmax()] -= 1
        return result

    monkeypatch.setattr(cpu._Scene, "forward", short)
    scene = [tensor.requires_grad_() for tensor in random_billboards(25, 40, 4, 3)]
    image, _ = render_billboards(*scene, *camera(64, 48), 64, 48)
    with pytest.raises(RuntimeError, match="other hits than the forward pass"):
        image.sum().backward()


def test_alpha_of_zero_and_one():
    scene = random_billboards(15, 30, 4, 3, torch.float32)
    scene[4] = (scene[4] > 0.5).float()
    compare(scene, *camera(40, 30), 40, 30)
    compare(scene, *camera(40, 30), 40, 30, alpha_max=1.0, t_min=0.0)
    compare(scene, *camera(40, 30), 40, 30, alpha_min=0.0)


def test_permuting_the_billboards_changes_no_bit():
    scene = random_billboards(16, 60, 4, 3, torch.float32)
    scene[0][20:40] = scene[0][19]  # equal depths, some with equal poses, some equal altogether
    for tensor in scene[1:3]:
        tensor[30:40] = tensor[29]
    for tensor in scene[3:]:
        tensor[38:40] = tensor[37]
    view, K = camera()
    order = torch.randperm(60, generator=torch.Generator().manual_seed(2))
    for mode in ("ray", "center", "kbuffer(4)"):
        for backend in ("cpu", "reference"):
            image, opacity = render_billboards(*scene, view, K, 40, 30, order=mode, backend=backend)
            mixed = [tensor[order] for tensor in scene]
            same = render_billboards(*mixed, view, K, 40, 30, order=mode, backend=backend)
            assert torch.equal(image, same[0]) and torch.equal(opacity, same[1]), (mode, backend)


def test_same_bytes_on_every_run_and_number_of_threads():
    scene = [tensor.requires_grad_() for tensor in random_billboards(17, 200, 8, 6, torch.float32)]
    view, K = camera(130, 90, focal=100.0)
    threads = torch.get_num_threads()
    results = []
    try:
        for count in (1, 2, 3, 2):
            torch.set_num_threads(count)
            image, opacity = render_billboards(*scene, view, K, 130, 90)
            grads = torch.autograd.grad((image.square().sum() + opacity.square().sum()), scene)
            results.append((image, opacity, *grads))
    finally:
        torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_hits_noted_in_several_groups_give_the_same_gradients(monkeypatch):
    scene = [tensor.requires_grad_() for tensor in random_billboards(18, 50, 4, 3)]
    view, K = camera(100, 70, focal=60.0)

    def gradients():
        image, opacity = render_billboards(*scene, view, K, 100, 70)
        return torch.autograd.grad(image.sum() + opacity.square().sum(), scene)

    whole = gradients()
    monkeypatch.setattr(cpu, "_TAPE", 500)
    for a, b in zip(whole, gradients(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)


def test_batches_head_only_and_empty_scenes():
    scene = [tensor.requires_grad_() for tensor in random_billboards(19, 10, 4, 3, torch.float32)]
    view, K = camera(dtype=torch.float32)
    moved = view.clone()
    moved[0, 3] = 0.2
    views = torch.stack([view, moved])
    image, opacity = render_billboards(*scene, views, K, 40, 30)
    assert image.shape == (2, 3, 30, 40) and opacity.shape == (2, 30, 40)
    torch.testing.assert_close(image[1], render_billboards(*scene, moved, K, 40, 30)[0], rtol=0, atol=0)
    image.sum().backward()
    empty = [tensor[:0] for tensor in scene]
    image, opacity = render_billboards(*empty, view, K, 40, 30)
    assert not bool(image.any()) and not bool(opacity.any()) and image.shape == (3, 30, 40)
    image.sum().backward()
    none, alone = render_billboards(*scene[:3], None, scene[4], view, K, 40, 30)
    assert none.shape == (0, 30, 40)
    torch.testing.assert_close(alone, render_billboards(*scene, view, K, 40, 30)[1], rtol=0, atol=0)
    alone.sum().backward()


def test_bounds_are_conservative_and_tight():
    """Every pixel that a billboard covers lies in its box, and the box has no empty border row or column."""
    scene = random_billboards(20, 100, 4, 1, size=(0.05, 0.9), spread=0.5)
    scene[4] = torch.ones_like(scene[4])
    view, K = camera(64, 48, focal=40.0)
    support = texture_support(4)
    near = 1.0  # runs through many of them
    projection = project_billboards(*scene[:3], view, K, near=near, low_pass=1.0, support=support)
    bins = binning.bin_billboards(projection, torch.arange(100), 4, 64, 48, support, torch.float64, True)
    loose, checked = 0, 0
    for i in range(100):
        single = [tensor[i : i + 1] for tensor in scene]
        _, opacity = render_billboards(*single, view, K, 64, 48, near=near, alpha_min=0.0, backend="cpu")
        everywhere = project_billboards(*single[:3], view, K, near=near, low_pass=1.0, support=support)
        everywhere.bounds[:] = torch.tensor([0.0, 0.0, 64.0, 48.0])
        whole = BlendSettings(64, 48, -1, near, 0.0, 0.99, 1e-4, support)
        _, expected = blend_reference(everywhere, torch.zeros(1, dtype=torch.int64), single[3], single[4], whole)
        torch.testing.assert_close(opacity, expected, atol=1e-9, rtol=0)
        x0, y0, x1, y1 = bins.box[i].tolist()
        rows, columns = expected.sum(1).nonzero().ravel(), expected.sum(0).nonzero().ravel()
        if len(rows):
            assert x0 <= columns[0] and columns[-1] < x1 and y0 <= rows[0] and rows[-1] < y1
            if bool((projection.bounds[i] < 0).any()) or projection.bounds[i, 2] > 64 or projection.bounds[i, 3] > 48:
                continue  # the corner that reaches furthest is off the image
            checked += 1
            gaps = (int(columns[0]) - x0, x1 - 1 - int(columns[-1]), int(rows[0]) - y0, y1 - 1 - int(rows[-1]))
            loose = max(loose, *gaps)
    assert loose <= 1 and checked > 10


def test_errors_are_one_line():
    scene = random_billboards(21, 5, 4, 3, torch.float32)
    view, K = camera(dtype=torch.float32)

    def refuse(expected, error=DataError, **changes):
        names = ("means", "quats", "half_extents", "features", "alpha")
        tensors = [changes.pop(name, tensor) for name, tensor in zip(names, scene, strict=True)]
        arguments = {"viewmat": view, "K": K, "width": 40, "height": 30, **changes}
        with pytest.raises(error, match=expected) as caught:
            render_billboards(*tensors, **arguments)
        assert "\n" not in str(caught.value)

    nan = scene[0].clone()
    nan[3, 1] = torch.nan
    refuse("means: .*row 3", means=nan)
    broken = scene[4].clone()
    broken[2] = torch.nan
    refuse("alpha: .*billboard 2", alpha=broken)
    refuse("quats: .*row 0", quats=torch.zeros(5, 4))
    refuse("features", features=scene[3][:4])
    refuse("features: .*list", features=scene[3].tolist())
    refuse("uniform: .*shape", uniform=torch.zeros(4, 2))
    refuse("uniform: .*shape", uniform=torch.zeros(5))
    refuse("half_extents", half_extents=torch.zeros(5, 3))
    refuse("order", order="kbuffer(0)")
    refuse("order", order="random")
    refuse("near", near=0.0)
    refuse("alpha_max", alpha_max=1.5)
    refuse("width", width=0)
    refuse("backend", backend="gpu")
    refuse("K: ", K=K.T.contiguous())
    refuse("viewmat", viewmat=view[:3])
    refuse("means", means=scene[0].tolist())
    refuse("backend", DeviceError, backend="cuda")


def test_a_scene_that_does_not_fit_says_so_before_allocating(monkeypatch):
    monkeypatch.setattr(binning, "available_memory", lambda: 1 << 20)
    scene = facing(1.0, extent=100.0, dtype=torch.float32)
    scene = [tensor.expand(8000, *tensor.shape[1:]).clone() for tensor in scene]
    scene[0][:, 2] += torch.arange(8000) * 1e-3
    view, K = camera(1024, 1024, dtype=torch.float32)
    start = time.perf_counter()
    with pytest.raises(DeviceError, match="GiB for the tile lists of 8000 billboards"):
        render_billboards(*scene, view, K, 1024, 1024)
    assert time.perf_counter() - start < 20


def test_every_kernel_is_prepared_as_it_is_called(monkeypatch):
    """`prepare` has one process of many compile; what is called with other types is compiled by each of them again."""
    sets: dict[str, dict] = {}
    for module in (cpu, cpu_projection):
        monkeypatch.setattr(module, "prepare", lambda name, kernels: sets.setdefault(name, kernels))
    cpu_projection._prepare.__wrapped__()
    for dtype in (torch.float32, torch.float64):
        cpu.prepare_kernels(dtype)
        scene = [tensor.requires_grad_() for tensor in random_billboards(0, 3, 2, 1, dtype)]
        image, opacity = render_billboards(*scene, *camera(dtype=dtype), 40, 30, backend="cpu")
        (image.sum() + opacity.sum()).backward()
    declared: dict = {}
    for kernels in sets.values():
        for dispatcher, signature in kernels.items():
            declared.setdefault(dispatcher, set()).add(signature)
    assert len(sets) == 3 and len(declared) == 9
    for dispatcher, signatures in declared.items():
        assert set(dispatcher.signatures) == signatures, dispatcher.py_func.__name__
