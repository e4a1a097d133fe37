"""Binning alone: records, boxes and lists against plain NumPy, billboard by billboard and tile by tile."""

import numpy as np
import pytest
import torch

from nbavatar.rendering.binning import TILE_HEIGHT, TILE_WIDTH, bin_billboards
from tests.unit.rendering.billboards.stages import HEIGHT, WIDTH, patches

COUNT = 40


def binned(texels, by_nearest, width=300, height=200):
    """Patches on an image of many tiles, with random boxes for bounds, some of them off the image, some invisible."""
    projection = patches(1, COUNT, radius=(2.0, 90.0))
    g = np.random.default_rng(2)
    move = np.eye(3)
    move[:2, :2] *= (WIDTH / width, HEIGHT / height)
    projection.plane[:] = projection.plane @ torch.from_numpy(move)
    corner, size = g.uniform(-50, 300, (COUNT, 2)), g.uniform(0, 150, (COUNT, 2))
    projection.bounds[:] = torch.from_numpy(np.hstack([corner, corner + size]))
    projection.bounds[:3] = torch.tensor([1.0, 1.0, 0.0, 0.0])
    rank = torch.from_numpy(g.permutation(COUNT))
    support = 1.0 if texels == 1 else 1.0 + 2.0 / (texels - 1)
    bins = bin_billboards(projection, rank, texels, width, height, support, torch.float64, by_nearest)
    return projection, rank.numpy(), support, bins


@pytest.mark.parametrize("texels", [1, 5])
def test_records_hold_texel_coordinates_and_keys(texels):
    projection, _, _, bins = binned(texels, True)
    seen = bins.box[:, 2] > bins.box[:, 0]
    assert 10 < seen.sum() < COUNT
    reference = None
    for i in np.flatnonzero(seen):
        record, plane = bins.record[i], projection.plane[i].numpy()
        x_origin, y_origin = (bins.box[i, 0] + bins.box[i, 2]) // 2, (bins.box[i, 1] + bins.box[i, 3]) // 2
        for x, y in ((5, 9), (280, 60), (140, 190)):
            u, v, w = plane @ (x + 0.5, y + 0.5, 1.0)
            s, t, w_found = record[:9].reshape(3, 3) @ (x - x_origin, y - y_origin, 1.0)
            expected = [(q / w + 1) / 2 * (texels - 1) if texels > 1 else q / w for q in (u, v)]
            np.testing.assert_allclose([s / w_found, t / w_found, w_found], [*expected, w], rtol=1e-9)
            key = record[6] * (x - x_origin) + record[7] * (y - y_origin) + record[9]
            reference = w - key if reference is None else reference  # one number of the whole scene
            assert key == pytest.approx(w - reference, abs=1e-12)
        assert record[10] == float(projection.fade[i])
        assert record[11] == pytest.approx(1.0 / float(projection.nearest[i]) - reference, abs=2e-5)
        assert record[11] >= 1.0 / float(projection.nearest[i]) - reference


def test_boxes_hold_the_pixels_whose_centres_lie_within_the_bounds():
    projection, _, _, bins = binned(5, True)
    for box, (x0, y0, x1, y1) in zip(bins.box, projection.bounds.numpy(), strict=True):
        columns = [x for x in range(300) if x0 <= x + 0.5 <= x1]
        rows = [y for y in range(200) if y0 <= y + 0.5 <= y1]
        if columns and rows:
            assert box.tolist() == [columns[0], rows[0], columns[-1] + 1, rows[-1] + 1]
        else:
            assert box[2] <= box[0] or box[3] <= box[1]


@pytest.mark.parametrize("by_nearest", [False, True])
def test_tiles_list_what_may_touch_them_in_order(by_nearest):
    """A billboard is left out of a tile if, and only if, all pixels of the tile lie outside one of its four edges."""
    projection, rank, support, bins = binned(5, by_nearest)
    order = sorted(rank, key=lambda i: float(projection.nearest[i])) if by_nearest else list(rank)
    assert bins.order.tolist() == order
    assert bins.rank[rank].tolist() == list(range(COUNT))
    across, down = -(-300 // TILE_WIDTH), -(-200 // TILE_HEIGHT)
    skipped = 0
    for tile in range(across * down):
        expected, room = [], 0
        for i in order:
            left, top = tile % across * TILE_WIDTH, tile // across * TILE_HEIGHT
            x0, x1 = max(bins.box[i, 0], left), min(bins.box[i, 2], left + TILE_WIDTH)
            y0, y1 = max(bins.box[i, 1], top), min(bins.box[i, 3], top + TILE_HEIGHT)
            if x0 >= x1 or y0 >= y1:
                continue
            corners = np.array([(x, y, 1.0) for x in (x0 + 0.499, x1 - 0.499) for y in (y0 + 0.499, y1 - 0.499)])
            u, v, w = projection.plane[i].numpy() @ corners.T
            edges = (support * w - u, support * w + u, support * w - v, support * w + v)
            if min(edge.max() for edge in edges) < 0:
                skipped += 1
                continue
            expected.append(i)
            room += -(-(x1 - x0) // 8) * (y1 - y0)
        assert bins.members[bins.tile_start[tile] : bins.tile_start[tile + 1]].tolist() == expected
        assert bins.packets[tile] == room
    assert skipped > 20 and len(bins.members) > 50
    for k in range(COUNT):  # the same entries, billboard by billboard
        for entry in range(bins.entry_start[k], bins.entry_start[k + 1]):
            position, tile = bins.position[entry], bins.entry_tile[entry]
            assert bins.members[position] == bins.order[k]
            assert bins.tile_start[tile] <= position < bins.tile_start[tile + 1]
