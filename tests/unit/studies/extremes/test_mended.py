"""Defects that the sweep has found, each held by the smallest example."""

import numpy as np
import pytest
import torch

from nbavatar.errors import DataError
from nbavatar.fitting.triangulate import triangulate
from nbavatar.mesh.laplacian import robust_laplacian
from nbavatar.methods.billboards.losses import loss_dice, loss_dice_haha, loss_knn
from nbavatar.methods.billboards.unet import UNet
from nbavatar.rendering.ordering import canonical_rank
from nbavatar.studies.extremes.frames import patch
from nbavatar.studies.extremes.triangulation import rig


def test_one_view_given_twice_determines_no_point():
    K, views = rig(1)
    twice = np.repeat(views, 2, 0)
    found = triangulate(np.full((2, 1, 2), 500.0), np.ones((2, 1)), np.repeat(K, 2, 0), twice, threshold=4.0)
    assert np.isnan(found.points).all()
    assert not found.inliers.any()


def test_a_nan_confidence_costs_one_view_only():
    K, views = rig(4)
    seen = (views[:, :3, 3] / views[:, 2:3, 3] @ K[0].T)[:, None, :2]  # the origin
    confidence = np.ones((4, 1))
    confidence[2] = np.nan
    found = triangulate(seen, confidence, K, views, threshold=4.0)
    np.testing.assert_allclose(found.points, 0.0, atol=1e-12)
    assert found.inliers[:, 0].tolist() == [True, True, False, True]


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda v, f: (np.where(np.arange(16)[:, None] == 3, np.nan, v), f), "NaN or infinity at vertex 3"),
        (lambda v, f: (v, f[:0]), "found none"),
        (lambda v, f: (v, f[:, [0, 0, 1]]), "found none"),
        (lambda v, f: (np.concatenate((v, v[:1])), f), "vertex 16 is not"),
        (lambda v, f: (v * 0, f), "all vertices in one place"),
    ],
)
def test_meshes_without_a_laplacian_are_refused(change, text):
    with pytest.raises(DataError, match=text):
        robust_laplacian(*change(*patch()))


@pytest.mark.parametrize("scale", [1e-100, 1e100])
def test_the_laplacian_does_not_depend_on_size(scale):
    verts, faces = patch()
    stiffness, mass = robust_laplacian(verts, faces)
    scaled, scaled_mass = robust_laplacian(verts * scale, faces)
    np.testing.assert_allclose(scaled.toarray(), stiffness.toarray(), atol=1e-12)
    np.testing.assert_allclose(scaled_mass / scale**2, mass, rtol=1e-12)


def test_half_precision_overflow_is_decoded_again():
    torch.manual_seed(0)
    net = UNet(4, width=4, depth=2, convs=1)
    features = 1e6 * torch.randn(1, 4, 8, 8)
    with torch.no_grad():
        plain = net(features)
        with torch.autocast("cpu", dtype=torch.float16):
            half = net(features)
    for a, b in zip(half, plain, strict=True):
        torch.testing.assert_close(a, b)


@pytest.mark.parametrize("loss", [loss_dice, loss_dice_haha])
def test_dice_of_half_precision(loss):
    empty = torch.zeros(4, 4, dtype=torch.float16)
    assert float(loss(empty, empty)) == 0.0
    full = torch.ones(512, 512, dtype=torch.float16)  # a sum of 262,144, beyond 65,504
    assert float(loss(full, full)) == pytest.approx(0.0, abs=1e-6)


def test_equal_neighbours_deviate_by_nothing():
    count = 4
    graph = torch.tensor([[i, (i + 1) % count, (i + 2) % count] for i in range(count)])
    quats = torch.tensor([0.9, -0.1, 0.3, 0.3]).expand(count, 4)
    assert float(loss_knn(torch.zeros(count, 3), quats, torch.full((count, 2), 0.0123), graph)) == 0.0


def test_twins_are_in_the_same_order_in_every_precision():
    random = torch.Generator().manual_seed(4)
    alpha, features = torch.rand(9, 2, 2, generator=random), torch.rand(9, 2, 2, 3, generator=random)
    geometry = [torch.ones(9, 3), torch.ones(9, 4), torch.ones(9, 2)]
    depth = torch.ones(9)
    single = canonical_rank(depth, *geometry, features, alpha)
    double = canonical_rank(depth.double(), *(g.double() for g in geometry), features.double(), alpha.double())
    assert single.tolist() == double.tolist()
