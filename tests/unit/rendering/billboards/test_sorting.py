"""The order of blending: sorting networks, and the queues of pixels that use them, against plain sorts."""

import numba
import numpy as np
import pytest
import torch

from nbavatar.jit.lane_memory import load
from nbavatar.jit.lanes import LANES, broadcast, mask_bits
from nbavatar.jit.memory import pointer
from nbavatar.rendering.sorting import LONGEST, comparisons, network
from tests.unit.rendering.billboards.stages import patches, scene_of, settings

_NONE = np.float32(-np.inf)
_sort = network(LONGEST)


@numba.njit
def _sort_queues(keys, opacities, ids, held, plane, none):
    """Sorts the queues of the first eight pixels; returns the mask of those with a tie."""
    held = load(pointer(held, 0), 0)
    return mask_bits(_sort(pointer(keys, 0), pointer(opacities, 0), pointer(ids, 0), 0, plane, held, broadcast(none)))


@pytest.mark.parametrize("count", range(LONGEST + 1))
def test_comparisons_sort_whatever_they_are_given(count):
    # 0-1 principle (Knuth 5.3.4, theorem Z): what sorts all zeros and ones sorts everything.
    numbers = np.arange(2**count)[:, None] >> np.arange(count) & 1
    for i, j in comparisons(count):
        assert i < j
        numbers[:, i], numbers[:, j] = numbers[:, [i, j]].min(1), numbers[:, [i, j]].max(1)
    assert (np.diff(numbers, axis=1) >= 0).all()


def test_more_than_a_network_holds():
    numbers = np.random.default_rng(0).permutation(1000)
    for i, j in comparisons(1000):
        numbers[i], numbers[j] = min(numbers[i], numbers[j]), max(numbers[i], numbers[j])
    assert (numbers == np.arange(1000)).all()


def test_queues_of_any_length_are_sorted_with_what_belongs_to_them():
    random = np.random.default_rng(1)
    plane = LANES + 3
    keys = random.standard_normal((LONGEST, plane)).astype(np.float32)
    held = np.array([0, 1, 2, 5, 8, 11, 15, 16], np.int32)
    opacities, ids = 2 * keys, np.arange(keys.size, dtype=np.int32).reshape(keys.shape)
    given, given_ids = keys.copy(), ids.copy()
    assert _sort_queues(keys.ravel(), opacities.ravel(), ids.ravel(), held, plane, _NONE) == 0
    for lane, count in enumerate(held):
        order = np.argsort(-given[:count, lane])
        assert (keys[:count, lane] == given[order, lane]).all()
        assert (opacities[:count, lane] == 2 * given[order, lane]).all()
        assert (ids[:count, lane] == given_ids[order, lane]).all()
        assert (keys[count:, lane] == _NONE).all()
    assert (keys[:, LANES:] == given[:, LANES:]).all()


def test_ties_are_told():
    keys = np.tile(np.arange(LONGEST, dtype=np.float32)[:, None], (1, LANES))
    keys[3, 2], keys[9, 5], keys[12, 7] = keys[11, 2], keys[1, 5], keys[5, 7]
    held = np.array([LONGEST] * 7 + [12], np.int32)  # the last lane's tie lies behind its end
    opacities, ids = keys.copy(), np.zeros(keys.shape, np.int32)
    assert _sort_queues(keys.ravel(), opacities.ravel(), ids.ravel(), held, LANES, _NONE) == 1 << 2 | 1 << 5


def order_of_hits(queue, keys, ranks):
    """Order in which hits, given as they come, are blended: by key, equal ones by rank; or as a queue gives them up."""
    if queue < 0:
        return sorted(range(len(keys)), key=lambda i: (-keys[i], ranks[i]))
    waiting, order = [], []
    for i in range(len(keys)):
        waiting.append(i)
        if len(waiting) > queue:
            order.append(min(waiting, key=lambda j: (-keys[j], ranks[j])))
            waiting.remove(order[-1])
    return order + sorted(waiting, key=lambda j: (-keys[j], ranks[j]))


@pytest.mark.parametrize(("queue", "count"), [(-1, 2), (-1, 4), (-1, 7), (-1, 15), (-1, 40), (1, 12), (3, 12)])
def test_pixels_blend_their_hits_in_order(queue, count):
    """Crossing planes: another order at every pixel; with a tie between two. The features tell which hit came when."""
    depth = 1.0 + 0.001 * np.random.default_rng(3).permutation(count)
    projection = patches(3, count, radius=(400.0, 500.0), depth=depth, tilt=0.01)
    projection.plane[1] = projection.plane[0]  # hits of equal keys, which rank tells apart
    features = torch.eye(count, dtype=torch.float64)[:, None, None].expand(count, 2, 2, count).contiguous()
    alpha = torch.full((count, 2, 2), 0.1, dtype=torch.float64)
    projection.fade[:] = 1.0
    rank = np.random.default_rng(4).permutation(count)
    scene = scene_of(projection, features, alpha, settings(queue, 2, t_min=0.0), rank)
    image, _ = scene.forward()
    found, orders = 0, set()
    for x, y in [(0, 0), (36, 0), (17, 20), (0, 33), (36, 33), (9, 31)]:
        keys = projection.plane[:, 2].numpy() @ (x + 0.5, y + 0.5, 1.0)
        come = scene.bins.order
        order = [int(come[k]) for k in order_of_hits(queue, keys[come], scene.bins.rank[come])]
        weights = image[:, y, x].numpy()[order]
        np.testing.assert_allclose(weights, 0.1 * 0.9 ** np.arange(count), rtol=1e-9)
        orders.add(tuple(order))
        found += 1
    assert found == 6 and (count < 4 or len(orders) > 1)
