"""The compiled projection against its definition in torch, whatever the billboards."""

import pytest
import torch

from nbavatar.rendering.billboards import render_billboards
from nbavatar.rendering.billboards.cpu_projection import project_billboards_cpu
from nbavatar.rendering.billboards.projection import project_billboards
from tests.unit.rendering.billboards.scenes import camera, random_billboards

SCENES = {
    "ordinary": dict(size=(0.05, 0.3)),
    "sub-pixel": dict(size=(1e-5, 1e-3)),
    "slivers": dict(size=(1e-6, 0.3)),
    "through the near plane": dict(size=(0.5, 4.0), spread=2.0),
    "screen-filling": dict(size=(5.0, 50.0)),
}


def _scene(name, dtype=torch.float32):
    """Billboards in odd poses, and a camera in general position."""
    scene = random_billboards(3, 400, 1, 1, dtype, **SCENES[name])
    scene[1][:20] = torch.tensor([1.0, 0.0, 0.0, 0.0])  # seen face on: equal singular values
    scene[1][20:40] = torch.tensor([0.5, 0.5, 0.5, 0.5])
    scene[2][:10, 1] = scene[2][:10, 0]
    scene[0][20:24] = 0.0  # the camera lies in their plane
    view, K = camera(53, 37)
    view[:3, :3] = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(4)).double())[0]
    view[:3, 3] = torch.tensor([0.1, -0.2, 0.3])
    K[0, 1] = 0.7
    return scene[:3], view, K


@pytest.mark.parametrize("low_pass", [0.0, 1.0, 30.0])
@pytest.mark.parametrize("name", list(SCENES))
def test_equals_the_definition(name, low_pass):
    scene, view, K = _scene(name)
    options = {"near": 0.5, "low_pass": low_pass, "support": 1.4}
    expected = project_billboards(*scene, view, K, **options)
    found = project_billboards_cpu(*scene, view, K, **options)
    assert torch.equal(found.depth, expected.depth) and torch.equal(found.nearest, expected.nearest)
    if low_pass == 0:
        assert torch.equal(found.plane, expected.plane) and torch.equal(found.fade, expected.fade)
    # torch's square roots may differ in the last digit; what follows from them cancels a few more
    size = expected.plane.abs().amax((1, 2), keepdim=True)
    assert float(((found.plane - expected.plane).abs() / size).nan_to_num().max()) < 1e-13
    torch.testing.assert_close(found.fade, expected.fade, rtol=1e-13, atol=0)
    # the definition also moves corners about the centre by nothing, which rounds
    torch.testing.assert_close(found.bounds, expected.bounds, rtol=1e-12, atol=1e-9)
    assert torch.equal(found.bounds[:, 0] <= found.bounds[:, 2], expected.bounds[:, 0] <= expected.bounds[:, 2])


@pytest.mark.parametrize("low_pass", [0.0, 1.0, 30.0])
@pytest.mark.parametrize("name", list(SCENES))
def test_gradients_equal_the_definition(name, low_pass):
    scene, view, K = _scene(name, torch.float64)
    g = torch.Generator().manual_seed(9)
    grads = [torch.randn(400, *shape, generator=g, dtype=torch.float64) for shape in ((3, 3), ())]
    found, expected = [], []
    for results, project in ((expected, project_billboards), (found, project_billboards_cpu)):
        leaves = [tensor.clone().requires_grad_() for tensor in scene]
        projection = project(*leaves, view, K, near=0.5, low_pass=low_pass, support=1.4)
        outputs = [projection.plane, projection.fade]
        tracked = [i for i, output in enumerate(outputs) if output.requires_grad]  # fade is 1 without a low-pass
        results += torch.autograd.grad([outputs[i] for i in tracked], leaves, [grads[i] for i in tracked])
    for a, b in zip(found, expected, strict=True):
        assert bool(torch.isfinite(a).all())
        # A billboard a millionth of the low-pass wide: large terms cancel, in both, to 6 of their 16 digits.
        assert float(((a - b).norm(dim=-1) / b.norm(dim=-1).clamp_min(1e-300)).max()) < 1e-8


def test_gradients_that_are_not_asked_for():
    (means, quats, extents), view, K = _scene("ordinary")
    plane = project_billboards_cpu(means.requires_grad_(), quats, extents, view, K, near=0.5, low_pass=1.0, support=1.4)
    (by_means,) = torch.autograd.grad(plane.plane.sum(), means)
    assert by_means.dtype == torch.float32 and float(by_means.norm()) > 0
    assert not plane.bounds.requires_grad and not plane.depth.requires_grad


def test_an_image_does_not_depend_on_whether_gradients_are_asked_for():
    scene = random_billboards(5, 60, 4, 3, torch.float32, size=(0.005, 0.3))
    view, K = camera()
    plain = render_billboards(*scene, view, K, 40, 30)
    tracked = render_billboards(*[tensor.requires_grad_() for tensor in scene], view, K, 40, 30)
    assert all(torch.equal(a, b.detach()) for a, b in zip(plain, tracked, strict=True))


def test_no_billboards():
    scene = [tensor[:0] for tensor in random_billboards(6, 1, 1, 1)]
    projection = project_billboards_cpu(*scene[:3], *camera(), near=0.01, low_pass=1.0, support=1.0)
    assert projection.plane.shape == (0, 3, 3) and projection.bounds.shape == (0, 4)
