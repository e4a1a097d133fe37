"""The networks against plain twins and finite differences, and the points of hands against brute force."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from nbavatar.methods.interact_avatar.hands import nearness, spread_points
from nbavatar.methods.interact_avatar.networks import Changes, PointFeatures, encoded


def random_weights(module: nn.Module, seed: int = 1) -> nn.Module:
    random = torch.Generator().manual_seed(seed)
    module.double()
    with torch.no_grad():
        for weights in module.parameters():
            weights.copy_(torch.randn(weights.shape, generator=random, dtype=torch.float64) / math.sqrt(5))
    return module


def inputs(*shape: int, seed: int = 2) -> Tensor:
    random = torch.Generator().manual_seed(seed)
    return torch.randn(shape, generator=random, dtype=torch.float64).requires_grad_()


def plain(perceptron: nn.Module, place: Tensor, code: Tensor) -> Tensor:
    """The same perceptron with the code written beside every row."""
    rows = torch.cat((place, code.expand(len(place), -1)), 1)
    first = torch.cat((perceptron.place.weight, perceptron.code.weight), 1)
    hidden = (rows @ first.T + perceptron.place.bias).clamp_min(0.0)
    hidden = (hidden @ perceptron.hidden.weight.T + perceptron.hidden.bias).clamp_min(0.0)
    return hidden @ perceptron.last.weight.T + perceptron.last.bias


def test_a_code_that_is_computed_once_is_a_code_beside_every_row() -> None:
    network = random_weights(Changes(5, 4, 6))
    place, normals, code = inputs(7, 5), inputs(7, 3, seed=3), inputs(4, seed=4)
    found = network(place, normals, code)
    both = plain(network.geometry, place, code), plain(network.appearance, torch.cat((place, normals), 1), code)
    expected = torch.cat(both, 1)
    torch.testing.assert_close(found, expected)
    tensors = [place, normals, code, *network.parameters()]
    slopes = inputs(7, 14, seed=5).detach()
    for one, two in zip(
        torch.autograd.grad((found * slopes).sum(), tensors),
        torch.autograd.grad((expected * slopes).sum(), tensors),
        strict=True,
    ):
        torch.testing.assert_close(one, two)


def test_gradients_of_the_changes_are_those_of_finite_differences() -> None:
    network = random_weights(Changes(3, 4, 5))
    names, weights = zip(*network.named_parameters(), strict=True)

    def run(place: Tensor, normals: Tensor, code: Tensor, *values: Tensor) -> Tensor:
        return torch.func.functional_call(network, dict(zip(names, values, strict=True)), (place, normals, code))

    assert torch.autograd.gradcheck(run, (inputs(4, 3), inputs(4, 3, seed=3), inputs(4, seed=4), *weights))


def test_gradients_of_the_point_features_are_those_of_finite_differences() -> None:
    network = random_weights(PointFeatures(4))
    names, weights = zip(*network.named_parameters(), strict=True)
    near = torch.tensor([0.0, 0.3, 1.0], dtype=torch.float64, requires_grad=True)

    def run(centres: Tensor, groups: Tensor, near: Tensor, *values: Tensor) -> Tensor:
        return torch.func.functional_call(network, dict(zip(names, values, strict=True)), (centres, groups, near))

    assert float(run(inputs(3, 3), inputs(3, 5, 3), near, *weights).detach().abs().max()) > 0.01
    assert torch.autograd.gradcheck(run, (inputs(3, 3), inputs(3, 5, 3), near, *weights))


def test_changes_start_at_exactly_zero_and_can_be_learnt() -> None:
    network = Changes(5, 4, 6, torch.Generator().manual_seed(0))
    found = network(torch.randn(9, 5), torch.randn(9, 3), torch.randn(4))
    assert found.shape == (9, 14) and bool((found == 0).all())
    found.sum().backward()
    assert network.geometry.last.weight.grad.abs().max() > 0 and network.appearance.last.weight.grad.abs().max() > 0


def test_a_hand_out_of_reach_has_no_features() -> None:
    network = PointFeatures(4, torch.Generator().manual_seed(0))
    centres, groups = torch.randn(6, 3), torch.randn(6, 5, 3)
    assert bool((network(centres, groups, torch.zeros(6)) == 0).all())
    near = torch.tensor([0.0, 0.0, 0.7, 0.2, 0.0, 0.0])
    # Points that do not count may be anywhere, and the order of points and neighbours is nobody's business.
    one = network(centres, groups, near)
    other = torch.where(near[:, None] > 0, centres, 9.0)
    order = torch.tensor([3, 2, 5, 1, 4, 0])
    two = network(other[order], groups[order][:, [4, 2, 0, 1, 3]], near[order])
    assert one.max() > 0
    torch.testing.assert_close(one, two)


def test_places_are_encoded_by_sines_of_doubling_frequencies() -> None:
    places = np.random.default_rng(0).uniform(-1, 1, (5, 3))
    found = encoded(torch.from_numpy(places)).numpy()
    for place, row in zip(places, found, strict=True):
        expected = list(place)
        for wave in (math.sin, math.cos):
            expected += [wave(math.pi * 2**octave * x) for octave in range(4) for x in place]
        np.testing.assert_allclose(row, expected, atol=1e-12)


@pytest.mark.parametrize("others", [0, 1, 40])
def test_nearness_falls_from_one_where_points_touch_to_zero_at_the_reach(others) -> None:
    random = np.random.default_rng(0)
    points, target = random.uniform(0, 0.3, (50, 3)), random.uniform(0, 0.3, (others, 3))
    if others:
        target[0] = points[0]
    found = nearness(torch.from_numpy(points), torch.from_numpy(target), 0.1).numpy()
    for point, near in zip(points, found, strict=True):
        left = max([0.0, *(1 - math.dist(point, other) / 0.1 for other in target)])
        assert near == pytest.approx(3 * left**2 - 2 * left**3, abs=1e-9)
    assert found[0] == (1.0 if others else 0.0)


def test_points_are_spread_farthest_first_with_their_nearest_neighbours() -> None:
    rest = torch.from_numpy(np.random.default_rng(0).normal(size=(30, 3)).astype(np.float32))
    points, groups = spread_points(rest, 6)
    chosen = points.tolist()
    for number in range(1, 6):
        gaps = [min(float((rest[v] - rest[c]).norm()) for c in chosen[:number]) for v in range(30)]
        assert gaps[chosen[number]] == pytest.approx(max(gaps))
    for point, members in zip(chosen, groups.tolist(), strict=True):
        order = sorted(range(30), key=lambda v: float((rest[v] - rest[point]).norm()))
        assert members[0] == point and set(members) == set(order[:8])
    points, groups = spread_points(rest[:4], 64)
    assert sorted(points.tolist()) == [0, 1, 2, 3] and groups.shape == (4, 4)
