"""The CUDA kernels against the reference: in numba's simulator, and the same cases on a GPU where there is one.

The simulator has to be chosen before numba is loaded, so one other process runs all cases there
(`python -m tests.unit.rendering.billboards.test_cuda_simulator`) and tells how each went.
"""

import importlib
import json
import subprocess
import sys
import time
import traceback

import pytest
import torch

from nbavatar.errors import DependencyError, DeviceError
from nbavatar.rendering.billboards import render_billboards
from nbavatar.rendering.billboards.projection import project_billboards, texture_support
from nbavatar.rendering.billboards.reference import BlendSettings, critical_pixels
from nbavatar.rendering.ordering import canonical_rank, parse_order
from tests.unit.rendering.billboards.scenes import OPTIONS, camera, facing, random_billboards, stack
from tests.unit.rendering.simulation import ROOT, simulate

NAMES = ("means", "quats", "half_extents", "features", "alpha")
WIDTH, HEIGHT = 19, 13  # two tiles, neither of them whole


def small_camera(width=WIDTH, height=HEIGHT):
    return camera(width, height, focal=0.8 * width)


def compare(device, scene, view, K, width=WIDTH, height=HEIGHT, *, value=2e-5, gradient=1e-4, **options):
    """Asserts that values and gradients equal the float64 reference's, off the pixels where a decision may flip."""
    options = {**OPTIONS, "order": "ray", **options}
    inputs = [tensor.detach().to(device, copy=True).requires_grad_() for tensor in scene]
    wide = [tensor.detach().double().requires_grad_() for tensor in scene]
    results = render_billboards(*inputs, view.to(device), K.to(device), width, height, backend="cuda", **options)
    expected = render_billboards(*wide, view, K, width, height, backend="reference", **options)
    support = texture_support(scene[4].shape[-1])
    with torch.no_grad():
        projection = project_billboards(
            *wide[:3], view, K, near=options["near"], low_pass=options["low_pass"], support=support
        )
        rank = canonical_rank(projection.depth, *wide)
        blend = BlendSettings(width, height, parse_order(options["order"]), options["near"], options["alpha_min"],
                              options["alpha_max"], options["t_min"], support)  # fmt: skip
        tolerance = 1e-10 if results[1].dtype == torch.float64 else 1e-5
        safe = ~critical_pixels(projection, rank, wide[4], blend, tolerance=tolerance)
        assert float(safe.float().mean()) > 0.8
        scale = max(1.0, float(scene[3].abs().max()) if scene[3].numel() else 1.0)
        for got, want in zip(results, expected, strict=True):
            assert bool(torch.isfinite(got).all())
            error = (got.detach().cpu().double() - want).abs() * safe
            assert error.numel() == 0 or float(error.max()) <= value * scale, float(error.max())
    g = torch.Generator().manual_seed(0)
    grads = [torch.randn(tensor.shape, generator=g, dtype=torch.float64) * safe for tensor in expected]
    torch.autograd.backward(results, [grad.to(device, got.dtype) for grad, got in zip(grads, results, strict=True)])
    torch.autograd.backward(expected, grads)
    for name, got, want in zip(NAMES, inputs, wide, strict=True):
        assert bool(torch.isfinite(got.grad).all()), name
        error = float((got.grad.cpu().double() - want.grad).norm())
        assert error <= gradient * float(want.grad.norm()) + 1e-9, (name, error, float(want.grad.norm()))
    return results[0].detach().cpu(), results[1].detach().cpu()


def order_case(order, texels, channels):
    def case(device):
        compare(device, random_billboards(5, 14, texels, channels, torch.float32), *small_camera(), order=order)

    return case


def case_float64(device):
    """To the last digits: what is left of the difference is rounding alone."""
    compare(device, random_billboards(6, 6, 3, 2), *small_camera(), value=1e-12, gradient=1e-11)


def case_no_billboards(device):
    scene = [tensor[:0].to(device).requires_grad_() for tensor in random_billboards(0, 1, 4, 3, torch.float32)]
    view, K = small_camera()
    image, opacity = render_billboards(*scene, view.to(device), K.to(device), WIDTH, HEIGHT, backend="cuda")
    assert image.shape == (3, HEIGHT, WIDTH) and not bool(image.any()) and not bool(opacity.any())
    image.sum().backward()


def case_nothing_in_view(device):
    scene = random_billboards(1, 4, 2, 1, torch.float32)
    scene[0][:, 2] = -3.0
    _, opacity = compare(device, scene, *small_camera())
    assert not bool(opacity.any())


def case_near_plane(device):
    """Billboards that run through the near plane and past the camera."""
    scene = random_billboards(11, 5, 3, 2, torch.float32, spread=2.0, size=(1.0, 4.0))
    _, opacity = compare(device, scene, *small_camera())
    assert float(opacity.max()) > 0.5
    compare(device, random_billboards(3, 8, 3, 1, torch.float32), *small_camera(), near=1.9)


def case_sub_pixel(device):
    scene = random_billboards(12, 20, 4, 2, torch.float32, size=(1e-4, 1e-2))
    _, opacity = compare(device, scene, *small_camera(), alpha_min=0.0)
    assert float(opacity.max()) > 0


def case_alpha_only(device):
    """No channels at all, and alpha of exactly 0 and 1, capped and not."""
    scene = random_billboards(15, 6, 4, 0, torch.float32)
    scene[4] = (scene[4] > 0.5).float()
    compare(device, scene, *small_camera())
    compare(device, scene, *small_camera(), alpha_max=1.0, t_min=0.0)


def case_layers_beyond_the_queue(device):
    """50 crossing planes on every pixel: the queue of 16 overflows, again and again, and the order stays exact."""
    scene = random_billboards(14, 50, 2, 2, torch.float32, 0.02, (1.0, 1.2))
    scene[4] = 0.15 * scene[4] + 0.01
    _, opacity = compare(device, scene, *small_camera(5, 4), 5, 4, alpha_min=0.0)
    assert float(opacity.max()) > 0.9


def case_early_stop(device):
    """Behind an opaque wall nothing is blended and nothing gets a gradient."""
    wall = facing(1.0, extent=3.0, alpha=0.999, texels=2, dtype=torch.float32)
    behind = facing(1.5, extent=3.0, feature=5.0, texels=2, dtype=torch.float32)
    for order in ("ray", "center", "kbuffer(1)"):
        scene = [tensor.to(device).requires_grad_() for tensor in stack(wall, behind)]
        view, K = (tensor.to(device) for tensor in small_camera(6, 5))
        image, _ = render_billboards(*scene, view, K, 6, 5, order=order, t_min=0.5, alpha_max=0.99, backend="cuda")
        image.sum().backward()
        torch.testing.assert_close(image.detach().cpu(), torch.full((1, 5, 6), 0.99), atol=1e-6, rtol=0)
        assert not bool(scene[3].grad[1].any())
        assert not bool(scene[4].grad.any())  # the wall's alpha is capped


def case_ties(device):
    """Equal depths, equal poses, equal altogether: a permutation of the billboards changes nothing."""
    scene = random_billboards(16, 14, 2, 2, torch.float32)
    scene[0][5:] = scene[0][4]
    for tensor in scene[1:3]:
        tensor[8:] = tensor[7]
    for tensor in scene[3:]:
        tensor[12:] = tensor[11]
    view, K = small_camera(10, 8)
    mixed = torch.randperm(14, generator=torch.Generator().manual_seed(2))
    for order in ("ray", "center", "kbuffer(4)"):
        # twins are told apart by the bytes of their textures, so the reference gets them in float32 too
        expected = render_billboards(*scene, view, K, 10, 8, order=order, backend="reference")
        given, permuted = ([tensor[rows].to(device) for tensor in scene] for rows in (slice(None), mixed))
        results = [
            render_billboards(*tensors, view.to(device), K.to(device), 10, 8, order=order, backend="cuda")
            for tensors in (given, permuted)
        ]
        for want, got, same in zip(expected, *results, strict=True):
            assert torch.equal(got, same), order
            torch.testing.assert_close(got.cpu(), want, atol=6e-5, rtol=0)


def case_half_precision(device):
    """float16 and bfloat16 textures are read as they are and summed in float32."""
    for dtype in (torch.float16, torch.bfloat16):
        scene = random_billboards(17, 5, 4, 3, torch.float32)
        scene[3:] = [tensor.to(dtype) for tensor in scene[3:]]
        half = [tensor.to(device, copy=True).requires_grad_() for tensor in scene]
        single = [tensor.to(device, torch.float32, copy=True).requires_grad_() for tensor in scene]
        view, K = (tensor.to(device) for tensor in small_camera(8, 6))
        results = [render_billboards(*s, view, K, 8, 6, backend="cuda") for s in (half, single)]
        assert results[0][0].dtype == dtype
        for got, want in zip(results[0], results[1], strict=True):
            assert torch.equal(got, want.to(dtype))  # rounded once, at the very end
        for image, opacity in results:
            (image.float().sum() + opacity.float().sum()).backward()
        for name, got, want in zip(NAMES, half, single, strict=True):
            assert got.grad.dtype == got.dtype
            error = float((got.grad.float() - want.grad).norm() / want.grad.norm())
            assert error <= (0.01 if got.dtype == dtype else 1e-4), (name, error)


def case_tape_in_groups(device):
    """Hits noted a row of tiles at a time give the gradients of all at once."""
    from nbavatar.rendering.billboards import cuda

    scene = [tensor.to(device).requires_grad_() for tensor in random_billboards(18, 8, 3, 2)]
    view, K = (tensor.to(device) for tensor in small_camera(9, 40))
    grads = []
    tape = cuda._TAPE
    try:
        for limit in (tape, 1):
            cuda._TAPE = limit
            image, opacity = render_billboards(*scene, view, K, 9, 40, backend="cuda")
            grads.append(torch.autograd.grad(image.sum() + opacity.square().sum(), scene))
    finally:
        cuda._TAPE = tape
    for got, want in zip(*grads, strict=True):
        assert bool(want.any())
        torch.testing.assert_close(got, want, rtol=1e-10, atol=1e-12)


def case_batch(device):
    scene = [tensor.to(device) for tensor in random_billboards(19, 6, 2, 2, torch.float32)]
    view, K = (tensor.to(device) for tensor in small_camera())
    moved = view.clone()
    moved[0, 3] = 0.2
    image, _ = render_billboards(*scene, torch.stack([view, moved]), K, WIDTH, HEIGHT, backend="cuda")
    alone, _ = render_billboards(*scene, moved, K, WIDTH, HEIGHT, backend="cuda")
    assert torch.equal(image[1], alone)


def case_long_queue(device):
    scene = [tensor.to(device) for tensor in random_billboards(20, 400, 1, 1, torch.float32)]
    view, K = (tensor.to(device) for tensor in small_camera())
    with pytest.raises(DeviceError, match="n <= 255") as caught:
        render_billboards(*scene, view, K, 4, 4, order="kbuffer(300)", backend="cuda")
    assert "\n" not in str(caught.value)


def case_overflow_is_flagged(device):
    """Lists that are too short, as a replayed graph may meet, raise the flag instead of writing beyond their end."""
    from nbavatar.rendering.billboards import cuda

    bounded = cuda._Scene._bounded
    scene = [tensor.to(device).requires_grad_() for tensor in random_billboards(21, 8, 2, 1, torch.float32)]
    view, K = (tensor.to(device) for tensor in small_camera())
    try:
        for short in ("tile entries", "hits"):
            cuda._Scene._bounded = lambda self, what, total, short=short: (
                3 if what == short else bounded(self, what, total)
            )
            assert not cuda.overflowed(device)
            image, _ = render_billboards(*scene, view, K, WIDTH, HEIGHT, backend="cuda")
            grads = torch.autograd.grad(image.sum(), scene)
            assert all(bool(torch.isfinite(grad).all()) for grad in grads)
            assert cuda.overflowed(device) and not cuda.overflowed(device), short
    finally:
        cuda._Scene._bounded = bounded


CASES = {name.removeprefix("case_"): case for name, case in list(globals().items()) if name.startswith("case_")}
CASES |= {
    f"{order}, T={texels}, C={channels}": order_case(order, texels, channels)
    for order, texels, channels in (
        ("ray", 1, 1), ("ray", 4, 3), ("ray", 3, 7), ("center", 2, 1), ("center", 4, 7), ("kbuffer(1)", 4, 3),
        ("kbuffer(3)", 1, 7), ("kbuffer(1000)", 3, 1),
    )
}  # fmt: skip


@pytest.fixture(scope="module")
def simulated():
    return simulate("tests.unit.rendering.billboards.test_cuda_simulator")


@pytest.mark.parametrize("name", list(CASES))
def test_simulated_kernels_equal_the_reference(name, simulated):
    assert simulated[name]["error"] is None, simulated[name]["error"]


LOADED = """
import sys, torch
from nbavatar.rendering.billboards import render_billboards
from tests.unit.rendering.billboards.scenes import camera, random_billboards
for backend in ("auto", "reference"):
    render_billboards(*random_billboards(0, 2, 2, 1), *camera(4, 4), 4, 4, backend=backend)
assert not [name for name in sys.modules if name.startswith("nbavatar.rendering.billboards.cuda")]
"""


def test_rendering_on_the_cpu_does_not_load_the_cuda_backend():
    subprocess.run([sys.executable, "-c", LOADED], cwd=ROOT, check=True, timeout=300)


def test_what_is_missing_is_named_in_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "numba.cuda", None)  # as if it were not installed
    monkeypatch.delitem(sys.modules, "nbavatar.rendering.billboards.cuda", raising=False)
    with pytest.raises(DependencyError, match="numba-cuda") as caught:
        importlib.import_module("nbavatar.rendering.billboards.cuda")
    assert "\n" not in str(caught.value)


@pytest.mark.gpu
@pytest.mark.parametrize("name", list(CASES))
def test_kernels_equal_the_reference(name):
    CASES[name]("cuda:0")


@pytest.mark.gpu
def test_a_full_scene_equals_the_reference():
    compare("cuda:0", random_billboards(30, 300, 16, 6, torch.float32), *camera(200, 150, focal=160.0), 200, 150)


@pytest.mark.gpu
def test_runs_on_the_current_stream():
    """Inputs made on a side stream behind a long wait are complete when the kernels read them."""
    scene = [tensor.cuda() for tensor in random_billboards(31, 40, 4, 3, torch.float32)]
    view, K = (tensor.cuda() for tensor in small_camera())
    expected = render_billboards(*scene, view, K, WIDTH, HEIGHT)
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        late = torch.zeros_like(scene[3])
        torch.cuda._sleep(50_000_000)
        late.copy_(scene[3])
        image, _ = render_billboards(*scene[:3], late, scene[4], view, K, WIDTH, HEIGHT)
    stream.synchronize()
    torch.testing.assert_close(image, expected[0], rtol=0, atol=0)


@pytest.mark.gpu
def test_blending_is_captured_in_a_graph():
    """A graph of the blending, forward and backward, replayed on other textures, gives what a plain run gives."""
    from nbavatar.rendering.billboards.cuda import blend_cuda, overflowed

    scene = [tensor.cuda() for tensor in random_billboards(32, 60, 4, 3, torch.float32)]
    view, K = (tensor.cuda() for tensor in small_camera())
    support = texture_support(4)
    with torch.no_grad():
        projection = project_billboards(*scene[:3], view, K, near=0.01, low_pass=1.0, support=support)
        rank = canonical_rank(projection.depth, *scene)
    blend = BlendSettings(WIDTH, HEIGHT, -1, 0.01, 1 / 255, 0.99, 1e-4, support)
    textures = [tensor.clone().requires_grad_() for tensor in scene[3:]]

    def step():
        image, opacity = blend_cuda(projection, rank, *textures, blend)
        return image, opacity, *torch.autograd.grad(image.sum() + opacity.sum(), textures)

    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(3):
            step()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured = step()
    with torch.no_grad():
        textures[0].mul_(0.5)
    graph.replay()
    assert not overflowed()
    for got, want in zip(captured, step(), strict=True):
        torch.testing.assert_close(got, want, rtol=1e-4, atol=1e-5)


def run_all(names):
    """Runs cases in this process, under the simulator, and prints what went wrong as JSON."""
    torch.set_num_threads(1)
    report = {}
    for name in names:
        start, error = time.perf_counter(), None
        try:
            CASES[name]("cpu")
        except Exception:
            error = traceback.format_exc()
        report[name] = {"error": error, "seconds": round(time.perf_counter() - start, 2)}
    print(json.dumps(report))


if __name__ == "__main__":
    run_all(sys.argv[1:] or CASES)
