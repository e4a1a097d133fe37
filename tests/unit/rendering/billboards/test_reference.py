"""The definition of right, against independent arithmetic, closed forms and finite differences."""

import pytest
import torch

from nbavatar.rendering.billboards import render_billboards
from nbavatar.rendering.billboards.projection import project_billboards
from nbavatar.rendering.billboards.reference import _queue_order
from tests.unit.rendering.billboards.scenes import OPTIONS, camera, facing, random_billboards, render_by_hand, stack


def render(scene, view, K, width, height, **options):
    return render_billboards(*scene, view, K, width, height, backend="reference", **{**OPTIONS, **options})


@pytest.mark.parametrize("texels", [1, 2, 5])
def test_equals_rays_traced_by_hand(texels):
    scene = random_billboards(3, count=12, texels=texels, channels=2)
    view, K = camera(17, 13, focal=15.0)
    options = {**OPTIONS, "low_pass": 0.0, "near": 1.7}  # the near plane runs through the scene
    image, opacity = render(scene, view, K, 17, 13, **options)
    expected_image, expected_opacity = render_by_hand(scene, view, K, 17, 13, **options)
    assert expected_opacity.max() > 0.3
    torch.testing.assert_close(image.numpy(), expected_image, atol=1e-10, rtol=0)
    torch.testing.assert_close(opacity.numpy(), expected_opacity, atol=1e-10, rtol=0)


@pytest.mark.parametrize(
    ("order", "texels", "low_pass"), [("ray", 1, 0.0), ("ray", 3, 1.0), ("kbuffer(2)", 2, 4.0), ("center", 3, 1.0)]
)
def test_gradients_equal_finite_differences(order, texels, low_pass):
    scene = random_billboards(0, count=3, texels=texels, channels=1, size=(0.02, 0.25))
    view, K = camera(8, 6, focal=14.0)
    inputs = [tensor.requires_grad_() for tensor in scene]
    assert torch.autograd.gradcheck(
        lambda *tensors: render(tensors, view, K, 8, 6, order=order, low_pass=low_pass, alpha_min=0.0), inputs,
        atol=1e-5,
    )  # fmt: skip


@pytest.mark.parametrize("flip", [False, True])
def test_both_faces_are_seen(flip):
    scene = facing(1.0)
    if flip:
        scene[1] = torch.tensor([[0.0, 1.0, 0.0, 0.0]], dtype=torch.float64)  # half a turn about x
    view, K = camera(16, 16)
    image, opacity = render(scene, view, K, 16, 16)
    assert float(opacity[8, 8]) == pytest.approx(0.5, abs=1e-12)
    assert float(image[0, 8, 8]) == pytest.approx(0.5, abs=1e-12)


def test_layers_multiply():
    scene = stack(*[facing(1.0 + 0.1 * k, alpha=0.3, feature=float(k)) for k in range(5)])
    view, K = camera(8, 8)
    image, opacity = render(scene, view, K, 8, 8)
    assert float(opacity[4, 4]) == pytest.approx(1 - 0.7**5, abs=1e-12)
    assert float(image[0, 4, 4]) == pytest.approx(sum(0.3 * 0.7**k * k for k in range(5)), abs=1e-12)


def test_a_capped_alpha_gets_no_gradient_but_its_feature_does():
    scene = [tensor.requires_grad_() for tensor in facing(1.0, alpha=1.0)]
    view, K = camera(8, 8)
    image, opacity = render(scene, view, K, 8, 8)
    assert float(opacity.detach().max()) == pytest.approx(0.99, abs=1e-12)
    (opacity[4, 4] + image[0, 4, 4]).backward()
    assert float(scene[4].grad.abs().sum()) == 0.0
    assert float(scene[3].grad.sum()) == pytest.approx(0.99, abs=1e-12)


def test_faint_samples_are_skipped_and_opaque_pixels_finished():
    view, K = camera(8, 8)
    assert float(render(facing(1.0, alpha=0.0039), view, K, 8, 8)[1].max()) == 0.0
    assert float(render(facing(1.0, alpha=0.0040), view, K, 8, 8)[1].max()) > 0.0
    opaque = stack(*[facing(1.0 + 0.1 * k, alpha=0.99) for k in range(2)], facing(2.0, feature=1e6))
    opaque[2][:] = 2.0
    image, _ = render(opaque, view, K, 8, 8)  # 0.01^2 is not under 1e-4, or just: the third counts only if not
    finished, _ = render(opaque, view, K, 8, 8, t_min=1.1e-4)
    assert float(finished[0, 4, 4]) == pytest.approx(0.99 + 0.0099, abs=1e-12)
    assert float(image[0, 4, 4]) >= float(finished[0, 4, 4])


def test_near_plane_clips_by_pixel():
    """A floor that passes under the camera: its near part is cut along a line, nothing else is lost."""
    scene = facing(0.0, extent=3.0, alpha=0.8)
    scene[0] = torch.tensor([[0.0, 0.5, 0.0]], dtype=torch.float64)
    half = 0.5**0.5
    scene[1] = torch.tensor([[half, half, 0.0, 0.0]], dtype=torch.float64)  # a quarter turn about x: normal along y
    view, K = camera(32, 32, focal=16.0, off_centre=False)
    _, opacity = render(scene, view, K, 32, 32, near=1.0, low_pass=0.0)
    depth = 0.5 * 1.1 * 16.0 / (torch.arange(32) + 0.5 - 16.0)  # of the floor at each row
    expected = (depth >= 1.0) & (depth < 2.9)
    column = opacity[:, 16] > 0.7
    assert bool((column == expected)[depth.abs() < 2.9].all())
    assert int(column.sum()) > 2


@pytest.mark.parametrize("size", [0.02, 0.1, 0.4])
def test_small_billboards_keep_their_light_wherever_they_stand(size):
    """Sum of alpha over the image of a billboard `size` pixels wide, moved across a pixel: energy and steadiness."""
    view, K = camera(16, 16, focal=16.0, off_centre=False)
    ramp = torch.exp(-0.5 * (torch.linspace(-1, 1, 8, dtype=torch.float64) / 0.45) ** 2)
    sums = []
    for shift in torch.linspace(0, 1, 7)[:-1]:
        scene = facing(1.0, extent=size / 2 / 16.0, texels=8)
        scene[4][0] = 0.9 * ramp[:, None] * ramp
        scene[0][0, 0] = float(shift) / 16.0
        sums.append(float(render(scene, view, K, 16, 16, low_pass=1.5, alpha_min=0.0)[1].sum()))
    texel_area = (size / 7) ** 2 * 1.1  # fy = 1.1 fx
    energy = float(scene[4].sum()) * texel_area
    assert max(sums) / min(sums) < 1.05
    assert sum(sums) / len(sums) == pytest.approx(energy, rel=0.05)
    unfiltered = [float(render(scene, view, K, 16, 16, low_pass=0.0)[1].sum()) for _ in range(1)]
    assert unfiltered[0] == 0.0 or size > 0.3  # without it the billboard falls between the pixels


def test_low_pass_leaves_large_billboards_alone():
    scene = random_billboards(1, size=(0.3, 0.4), count=8)
    view, K = camera()
    kept = project_billboards(*scene[:3], view, K, near=0.01, low_pass=0.0, support=1.5)
    same = project_billboards(*scene[:3], view, K, near=0.01, low_pass=0.05, support=1.5)
    chosen = same.fade == 1
    assert int(chosen.sum()) > 4
    torch.testing.assert_close(kept.plane[chosen], same.plane[chosen], rtol=0, atol=0)


def test_edge_on_billboards_fade_to_nothing():
    view, K = camera(16, 16, focal=64.0, off_centre=False)
    sums = []
    for tilt in (1e-2, 1e-4, 1e-6, 1e-9, 0.0):
        angle = torch.tensor(torch.pi / 2 - tilt, dtype=torch.float64)
        scene = facing(1.0, extent=0.05)
        scene[1] = torch.stack([torch.cos(angle / 2), torch.zeros(()), torch.sin(angle / 2), torch.zeros(())])[None]
        sums.append(float(render(scene, view, K, 16, 16, alpha_min=0.0)[1].sum()))
    assert sums == sorted(sums, reverse=True)
    assert sums[0] > 0 and sums[-1] < 1e-5
    assert sums[1] / sums[0] == pytest.approx(1e-2, rel=0.1)  # in proportion to the width on screen


def test_queue_sorts_what_is_at_most_its_length_out_of_place():
    g = torch.Generator().manual_seed(0)
    key = torch.rand(20, 50, generator=g, dtype=torch.float64)
    hit = torch.rand(20, 50, generator=g) < 0.8
    key[~hit] = torch.inf
    full = torch.sort(key, dim=0, stable=True).indices
    order = _queue_order(key, hit, 19)
    rank = torch.arange(20)[:, None].expand_as(order)
    assert bool((torch.sort(order, dim=0).values == rank).all())  # a permutation
    hits = hit.sum(0)
    for column in range(50):
        assert order[: hits[column], column].tolist() == full[: hits[column], column].tolist()
    # a queue of one swaps neighbours: sequence 2 1 4 3 is sorted by it
    small = torch.tensor([[2.0], [1.0], [4.0], [3.0]], dtype=torch.float64)
    assert _queue_order(small, torch.ones(4, 1, dtype=torch.bool), 1)[:, 0].tolist() == [1, 0, 3, 2]
