"""Loss terms against numbers worked out by hand."""

import math

import numpy as np
import pytest
import torch

from nbavatar.methods.billboards.losses import (
    _nearest,
    _nearest_of_many,
    knn_graph,
    loss_delta,
    loss_dice,
    loss_dice_haha,
    loss_knn,
)
from nbavatar.methods.photometric import loss_dssim, loss_l1, loss_mse


def test_loss_mse_equals_hand_value_and_spreads_over_the_whole_picture() -> None:
    image, target = torch.zeros(3, 1, 2), torch.zeros(3, 1, 2)
    image[0, 0, 0] = 0.5  # one squared difference of 0.25 among 6 values
    assert loss_mse(image, target).item() == pytest.approx(0.25 / 6)
    assert loss_mse(image, target, pixels=20).item() == pytest.approx(0.25 / 60)


def test_loss_l1_equals_hand_value_and_spreads_over_the_whole_picture() -> None:
    image, target = torch.zeros(3, 1, 2), torch.zeros(3, 1, 2)
    image[0, 0, 0], image[2, 0, 1] = 0.5, -0.25
    assert loss_l1(image, target).item() == pytest.approx(0.75 / 6)
    assert loss_l1(image, target, pixels=20).item() == pytest.approx(0.75 / 60)


def plain_dssim(x: np.ndarray, y: np.ndarray, pixels: int) -> float:
    """1 - SSIM, window after window as Wang et al. 2004 write it (equations 13 to 16), float64, zeros beyond."""
    offsets = np.mgrid[-5:6, -5:6]
    weights = np.exp(-(offsets**2).sum(0) / (2 * 1.5**2))
    weights /= weights.sum()
    x, y = (np.pad(values, ((0, 0), (5, 5), (5, 5))) for values in (x, y))
    total = 0.0
    for c, i, j in np.ndindex(x.shape[0], x.shape[1] - 10, x.shape[2] - 10):
        a, b = x[c, i : i + 11, j : j + 11], y[c, i : i + 11, j : j + 11]
        mean_a, mean_b = (weights * a).sum(), (weights * b).sum()
        spread_a, spread_b = ((weights * (v - m) ** 2).sum() for v, m in ((a, mean_a), (b, mean_b)))
        shared = (weights * (a - mean_a) * (b - mean_b)).sum()
        luminance = (2 * mean_a * mean_b + 1e-4) / (mean_a**2 + mean_b**2 + 1e-4)
        total += 1.0 - luminance * (2 * shared + 9e-4) / (spread_a + spread_b + 9e-4)
    return total / (len(x) * pixels)


@pytest.mark.parametrize("size", [(14, 17), (5, 8), (1, 1)])  # smaller than a window too, as coarse stages may be
def test_loss_dssim_equals_plain_windows_in_value_and_gradient(rng, size: tuple[int, int]) -> None:
    x, y = (rng.uniform(size=(3, *size)) for _ in range(2))
    x[:, :1], y[:, :1] = 0.25, 0.5  # flat places too
    found = torch.from_numpy(x).requires_grad_()
    loss = loss_dssim(found, torch.from_numpy(y), pixels=400)
    loss.backward()
    assert loss.item() == pytest.approx(plain_dssim(x, y, 400), rel=1e-10)
    narrow = torch.from_numpy(x).float().requires_grad_()
    loss_dssim(narrow, torch.from_numpy(y).float(), pixels=400).backward()
    largest = found.grad.abs().max()
    assert (narrow.grad - found.grad).abs().max() < 1e-4 * largest  # differences of moments lose three of seven digits
    for place in {(0, 0, 0), (1, size[0] // 2, size[1] // 2), (2, size[0] - 1, size[1] - 1)}:
        step = np.zeros_like(x)
        step[place] = 1e-5
        slope = (plain_dssim(x + step, y, 400) - plain_dssim(x - step, y, 400)) / 2e-5
        assert found.grad[place].item() == pytest.approx(slope, rel=1e-6, abs=1e-9)
    assert loss_dssim(found, found).item() == pytest.approx(0.0, abs=1e-12)


def test_loss_dice_of_all_ones_is_not_free() -> None:
    target = torch.zeros(4, 4)
    target[:2] = 1.0
    ones = torch.ones(4, 4)
    # 1 - 2*8 / (16 + 8) = 1/3
    assert loss_dice(ones, target).item() == pytest.approx(1 / 3)
    assert loss_dice(target, target).item() == pytest.approx(0.0, abs=1e-7)
    assert loss_dice(torch.zeros(4, 4), target).item() == pytest.approx(1.0)


def test_loss_dice_haha_lets_false_positives_go_free() -> None:
    target = torch.zeros(4, 4)
    target[:2] = 1.0
    # 1 - (2*8 + 1) / (8 + 8 + 1) = 0: the trap that the other form avoids.
    assert loss_dice_haha(torch.ones(4, 4), target).item() == pytest.approx(0.0)


def test_loss_dice_counts_coverage_outside_the_window() -> None:
    inside = torch.ones(2, 2)
    assert loss_dice(inside, inside, missed=4.0).item() == pytest.approx(1 - 8 / 12)


def test_loss_dice_of_empty_masks_is_zero_with_finite_gradient() -> None:
    predicted = torch.zeros(3, 3, requires_grad=True)
    loss = loss_dice(predicted, torch.zeros(3, 3))
    loss.backward()
    assert loss.item() == pytest.approx(0.0)
    assert torch.isfinite(predicted.grad).all()


def test_loss_dice_gradient_pushes_down_outside_and_up_inside() -> None:
    target = torch.tensor([[1.0, 0.0]])
    predicted = torch.full((1, 2), 0.5, requires_grad=True)
    loss_dice(predicted, target).backward()
    assert predicted.grad[0, 0] < 0 < predicted.grad[0, 1]


def test_knn_graph_matches_brute_force_and_keeps_parts_apart(rng) -> None:
    points = torch.from_numpy(rng.normal(size=(40, 3)))
    groups = torch.arange(40) % 2
    graph = knn_graph(points, groups, 3)
    assert (graph[:, 0] == torch.arange(40)).all()
    assert (groups[graph] == groups[:, None]).all()
    for i in range(40):
        same = [j for j in range(40) if groups[j] == groups[i]]
        expected = sorted(same, key=lambda j: float((points[j] - points[i]).norm()))[:3]
        assert graph[i].tolist() == expected


def test_knn_graph_without_self_and_with_tiny_groups() -> None:
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [3, 0, 0], [9, 9, 9]])
    groups = torch.tensor([0, 0, 0, 1])
    graph = knn_graph(points, groups, 2, include_self=False)
    assert graph.tolist() == [[1, 2], [0, 2], [1, 0], [3, 3]]


@pytest.mark.parametrize("count", [5, 3000, 5000])
def test_knn_in_slabs_equals_all_distances(count) -> None:
    points = torch.rand(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(count))
    points[:, 1] *= 3.0
    points[count // 2 :, 1] += 2.0  # a gap wider than a slab
    assert torch.equal(_nearest_of_many(points, 4), _nearest(points, 4))
    assert _nearest_of_many(torch.zeros(3000, 3, dtype=torch.float64), 3)[:, 0].tolist() == list(range(3000))


def test_knn_graph_puts_the_point_itself_first_among_coincident_ones() -> None:
    graph = knn_graph(torch.zeros(5, 3), torch.zeros(5, dtype=torch.int64), 3)
    assert (graph[:, 0] == torch.arange(5)).all()


def test_loss_knn_equals_hand_value() -> None:
    means = torch.tensor([[0.0, 0, 0], [2.0, 0, 0]])
    quats = torch.tensor([[1.0, 0, 0, 0], [0.0, 1, 0, 0]])
    extents = torch.tensor([[1.0, 1.0], [3.0, 1.0]])
    neighbours = torch.tensor([[0, 1], [1, 0]])
    # Unbiased deviation of two values a, b is |a - b| / sqrt(2); 2 of 4 quaternion and 1 of 2 extent components differ.
    quaternion = (1 / math.sqrt(2)) * 2 / 4
    extent = (2 / math.sqrt(2)) / 2
    distance = (0 + 4) / 2
    value = loss_knn(means, quats, extents, neighbours).item()
    assert value == pytest.approx(quaternion + extent + distance, rel=2e-4)  # the epsilon of the root


def test_loss_knn_ignores_the_sign_of_a_quaternion() -> None:
    # Rotations less than a right angle apart, as neighbours on a surface are.
    quats = torch.nn.functional.normalize(torch.randn(6, 4) + torch.tensor([3.0, 0, 0, 0]), dim=1)
    flipped = quats * torch.tensor([1.0, -1, 1, -1, -1, 1])[:, None]
    means, extents = torch.randn(6, 3), torch.rand(6, 2)
    graph = knn_graph(means, torch.zeros(6, dtype=torch.int64), 3)
    torch.testing.assert_close(loss_knn(means, quats, extents, graph), loss_knn(means, flipped, extents, graph))


def test_loss_knn_has_finite_gradient_where_all_neighbours_agree() -> None:
    means = torch.zeros(3, 3, requires_grad=True)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(3, 1).requires_grad_()
    extents = torch.ones(3, 2, requires_grad=True)
    loss = loss_knn(means, quats, extents, torch.tensor([[0, 1, 2]] * 3))
    loss.backward()
    assert loss.item() == pytest.approx(0.0, abs=1e-6)
    for value in (means, quats, extents):
        assert torch.isfinite(value.grad).all()


def test_loss_knn_is_invariant_to_rigid_motion_up_to_quaternion_frame() -> None:
    means, extents = torch.randn(8, 3), torch.rand(8, 2)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(8, 1)
    graph = knn_graph(means, torch.zeros(8, dtype=torch.int64), 3)
    moved = means @ torch.linalg.qr(torch.randn(3, 3))[0].T + 5.0
    torch.testing.assert_close(
        loss_knn(means, quats, extents, graph), loss_knn(moved, quats, extents, graph), rtol=1e-4, atol=1e-5
    )


def test_loss_delta_equals_hand_value() -> None:
    assert loss_delta(torch.tensor([[1.0, 2, 2], [0, 0, 0]])).item() == pytest.approx(4.5)
