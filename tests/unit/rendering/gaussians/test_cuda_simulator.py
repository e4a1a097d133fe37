"""The CUDA kernel against the reference: in numba's simulator, and the same cases on a GPU where there is one.

The simulator has to be chosen before numba is loaded, so one other process runs all cases there
(`python -m tests.unit.rendering.gaussians.test_cuda_simulator`) and tells how each went.
"""

import json
import traceback

import pytest
import torch

from nbavatar.rendering.gaussians import render_gaussians
from nbavatar.rendering.gaussians.projection import project_gaussians
from nbavatar.rendering.gaussians.reference import SplatSettings, critical_pixels
from nbavatar.rendering.ordering import canonical_rank
from tests.unit.rendering.gaussians.scenes import NAMES, OPTIONS, camera, random_gaussians, single, stack, turned_camera
from tests.unit.rendering.simulation import simulate

WIDTH, HEIGHT = 19, 13  # two tiles, neither of them whole


def compare(device, scene, view, K, width=WIDTH, height=HEIGHT, *, value=2e-5, gradient=1e-4, **options):
    """Asserts that values and gradients equal the float64 reference's, off the pixels where a decision may flip."""
    options = {**OPTIONS, **options}
    inputs = [tensor.detach().to(device, copy=True).requires_grad_() for tensor in scene]
    wide = [tensor.detach().double().requires_grad_() for tensor in scene]
    got = render_gaussians(*inputs, view.to(device), K.to(device), width, height, backend="cuda", **options)
    want = render_gaussians(*wide, view, K, width, height, backend="reference", **options)
    with torch.no_grad():
        seen = project_gaussians(*wide[:3], view, K, width, height, near=options["near"], low_pass=options["low_pass"])
        rank = canonical_rank(seen.depth, *wide[:3], wide[4], wide[3])
        blend = SplatSettings(width, height, options["alpha_min"], options["alpha_max"], options["t_min"])
        tolerance = 1e-10 if got.alpha.dtype == torch.float64 else 1e-5
        safe = ~critical_pixels(seen, rank, wide[3], blend, tolerance=tolerance)
        assert float(safe.float().mean()) > 0.8
        for a, b in zip(got[:2], want[:2], strict=True):
            assert float(((a.cpu().double() - b).abs() * safe).max()) <= value
    g = torch.Generator().manual_seed(0)
    grads = [torch.randn(tensor.shape, generator=g, dtype=torch.float64) * safe for tensor in want[:2]]
    torch.autograd.backward(got[:2], [grad.to(device, a.dtype) for grad, a in zip(grads, got[:2], strict=True)])
    torch.autograd.backward(want[:2], grads)
    for name, a, b in zip(NAMES, inputs, wide, strict=True):
        assert bool(torch.isfinite(a.grad).all()), name
        error = float((a.grad.cpu().double() - b.grad).norm())
        assert error <= gradient * float(b.grad.norm()) + 1e-9, (name, error, float(b.grad.norm()))


def case_harmonics(device):
    compare(device, random_gaussians(1, 20, 2, torch.float32), *turned_camera(WIDTH, HEIGHT, focal=16.0))


def case_float64(device):
    scene = random_gaussians(2, 12)
    compare(device, scene, *turned_camera(WIDTH, HEIGHT, focal=16.0), value=1e-12, gradient=1e-11)


def case_opaque_layers_end_a_pixel(device):
    scene = random_gaussians(3, 30, None, torch.float32, spread=0.1, size=(0.2, 0.6))
    scene[3] = 1 - 0.05 * scene[3]
    compare(device, scene, *camera(WIDTH, HEIGHT, focal=16.0))


def case_capped_and_uncapped(device):
    scene = stack(*[single(z=2.0 + k, opacity=1.0, x=0.07 * k, dtype=torch.float32) for k in range(3)])
    compare(device, scene, *camera(WIDTH, HEIGHT, focal=16.0))
    compare(device, scene, *camera(WIDTH, HEIGHT, focal=16.0), alpha_min=0.0, t_min=0.0, alpha_max=1.0)


def case_points_discs_and_what_is_behind(device):
    scene = random_gaussians(4, 12, None, torch.float32)
    scene[2][:4] = 0.0
    scene[2][4:8, 2] = 0.0
    scene[0][8:, 2] = -1.0
    compare(device, scene, *camera(WIDTH, HEIGHT, focal=16.0))


def case_no_gaussians(device):
    scene = [tensor[:0].to(device).requires_grad_() for tensor in random_gaussians(5, 2, None, torch.float32)]
    view, K = (tensor.to(device) for tensor in camera())
    image, alpha, _ = render_gaussians(*scene, view, K, 40, 30, backend="cuda")
    assert image.shape == (3, 30, 40) and not bool(alpha.any())
    image.sum().backward()


def case_hits_noted_in_groups(device):
    from nbavatar.rendering.billboards import cuda

    scene = [tensor.to(device).requires_grad_() for tensor in random_gaussians(6, 10)]
    view, K = (tensor.to(device) for tensor in turned_camera(WIDTH, 35, focal=16.0))

    def gradients():
        image, alpha, _ = render_gaussians(*scene, view, K, WIDTH, 35, backend="cuda")
        return torch.autograd.grad(image.sum() + alpha.square().sum(), scene)

    whole, limit = gradients(), cuda._TAPE
    try:
        cuda._TAPE = 200
        for a, b in zip(whole, gradients(), strict=True):
            torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-10)
    finally:
        cuda._TAPE = limit


CASES = {name.removeprefix("case_"): case for name, case in list(globals().items()) if name.startswith("case_")}


@pytest.fixture(scope="module")
def simulated():
    return simulate("tests.unit.rendering.gaussians.test_cuda_simulator")


@pytest.mark.parametrize("name", list(CASES))
def test_simulated_kernel_equals_the_reference(name, simulated):
    assert simulated[name] is None, simulated[name]


@pytest.mark.gpu
@pytest.mark.parametrize("name", list(CASES))
def test_kernel_equals_the_reference(name):
    CASES[name]("cuda:0")


@pytest.mark.gpu
def test_a_full_scene_equals_the_reference():
    compare("cuda:0", random_gaussians(30, 500, 3, torch.float32), *turned_camera(200, 150, focal=160.0), 200, 150)


def _run_all() -> dict[str, str | None]:
    results: dict[str, str | None] = {}
    for name, case in CASES.items():
        try:
            case("cpu")
            results[name] = None
        except Exception:
            results[name] = traceback.format_exc()
    return results


if __name__ == "__main__":
    print(json.dumps(_run_all()))
