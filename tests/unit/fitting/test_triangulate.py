"""Robust triangulation and rigid alignment: exact cases, outliers, two cameras, degenerate input."""

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from nbavatar.fitting.rigid import align_points, fill_frames
from nbavatar.fitting.triangulate import triangulate
from nbavatar.studies.benchmarks.fit_scene import arc as _arc

K0 = np.array([[3000.0, 0, 970], [0, 3010, 530], [0, 0, 1]])


def arc(centre, cameras):
    return _arc(centre, cameras, np.random.default_rng(1))


def _film(points, poses):
    camera = np.einsum("mij,...j->m...i", poses[:, :3, :3], points) + poses[:, :3, 3].reshape(
        -1, *[1] * (points.ndim - 1), 3
    )
    image = camera @ K0.T
    return image[..., :2] / image[..., 2:], np.repeat(K0[None], len(poses), 0)


def _points(*size):
    return np.array([0.1, 0.4, 1.2]) + 0.1 * np.random.default_rng(0).normal(size=(*size, 3))


@pytest.mark.parametrize("cameras", [2, 3, 8])
def test_exact_pixels_give_exact_points(cameras):
    points = _points(4, 30)
    poses = arc(points.mean((0, 1)), cameras)
    pixels, K = _film(points, poses)
    found = triangulate(pixels, np.ones(pixels.shape[:-1]), K, poses, threshold=5.0)
    np.testing.assert_allclose(found.points, points, atol=1e-11)
    assert found.inliers.all() and found.error.max() < 1e-8


def test_half_of_the_views_wrong():
    rng = np.random.default_rng(1)
    points = _points(300)
    poses = arc(points.mean(0), 8)
    pixels, K = _film(points, poses)
    pixels += 0.5 * rng.normal(size=pixels.shape)
    wrong = np.zeros((8, 300), bool)
    for column in range(300):
        wrong[rng.permutation(8)[:4], column] = True
    pixels[wrong] += rng.uniform(20, 200, (wrong.sum(), 2)) * rng.choice([-1, 1], (wrong.sum(), 2))
    found = triangulate(pixels, np.ones((8, 300)), K, poses, threshold=4.0)
    error = np.linalg.norm(found.points - points, axis=1)
    # 0.5 px at 1.7 m and f = 3000 are 0.28 mm in one view; four good views remain.
    assert np.median(error) < 3e-4 and np.mean(error < 2e-3) > 0.98
    assert (found.inliers & wrong).sum() < 0.02 * wrong.sum()


def test_refinement_is_the_least_squares_point():
    """Without outliers the result minimises the pixel error, as scipy's optimiser does."""
    rng = np.random.default_rng(2)
    points = _points(5)
    poses = arc(points.mean(0), 5)
    pixels, K = _film(points, poses)
    pixels += rng.normal(size=pixels.shape)
    found = triangulate(pixels, np.ones((5, 5)), K, poses, threshold=1e4, refinements=12)
    for i, start in enumerate(points):
        best = least_squares(lambda x, i=i: (_film(x[None], poses)[0][:, 0] - pixels[:, i]).ravel(), start, xtol=1e-15)
        np.testing.assert_allclose(found.points[i], best.x, atol=2e-7)


def test_what_cannot_be_triangulated_is_nan():
    points = _points(3)
    poses = arc(points.mean(0), 3)
    pixels, K = _film(points, poses)
    confidence = np.ones((3, 3))
    confidence[1:, 0] = 0  # one view
    pixels[1, 1], pixels[2, 1] = [5.0, 5.0], [1900.0, 1000.0]  # three views, no two agree
    pixels[0, 2] = np.nan  # two views left
    found = triangulate(pixels, confidence, K, poses, threshold=3.0)
    assert np.isnan(found.points[:2]).all() and np.isnan(found.error[:2]).all()
    assert not found.inliers[:, :2].any()
    np.testing.assert_allclose(found.points[2], points[2], atol=1e-10)
    assert found.inliers[:, 2].tolist() == [False, True, True]


def test_low_confidence_yields():
    points = _points(1)
    poses = arc(points.mean(0), 4)
    pixels, K = _film(points, poses)
    pixels[2:] += 40
    other = triangulate(pixels, np.array([[0.2], [0.2], [1], [1]]), K, poses, threshold=3.0)
    mine = triangulate(pixels, np.array([[1], [1], [0.2], [0.2]]), K, poses, threshold=3.0)
    assert mine.inliers[:, 0].tolist() == [True, True, False, False]
    np.testing.assert_allclose(mine.points, points, atol=1e-9)
    assert np.linalg.norm(other.points - points) > 1e-3 or np.isnan(other.points).any()


def test_align_points_recovers_motion_with_outliers_and_gaps():
    rng = np.random.default_rng(3)
    source = rng.normal(size=(12, 3)) * 0.05
    turns = Rotation.random(6, random_state=4)
    shift = rng.normal(size=(6, 3))
    target = np.stack([t.apply(source) + s for t, s in zip(turns, shift, strict=True)])
    target[:, 3] += 0.2
    target[:, 5] = np.nan
    target[5, 2:] = np.nan
    R, t, valid = align_points(
        torch.tensor(source), torch.tensor(target), torch.ones(6, 12).double(), scale=0.005, iterations=40
    )
    assert valid.tolist() == [True] * 5 + [False]
    # Geman-McClure weights never vanish: an outlier of 0.35 m at scale 5 mm keeps a weight of 4e-8.
    np.testing.assert_allclose(R[:5], turns.as_matrix()[:5], atol=1e-5)
    np.testing.assert_allclose(t[:5], shift[:5], atol=1e-6)
    assert torch.allclose(torch.linalg.det(R[:5]), torch.ones(5).double())


def test_align_points_is_a_rotation_for_mirrored_points():
    source = torch.randn(8, 3, generator=torch.Generator().manual_seed(0)).double()
    R, _, _ = align_points(source, (source * torch.tensor([-1.0, 1, 1]))[None], torch.ones(1, 8).double(), scale=1.0)
    assert torch.allclose(torch.linalg.det(R), torch.ones(1).double())


def test_points_on_a_line_are_not_valid():
    line = torch.linspace(0, 1, 6).double()[:, None] * torch.tensor([1.0, 2, 3]).double()
    assert not align_points(line, line[None], torch.ones(1, 6).double(), scale=1.0)[2].any()


def test_fill_frames_stays_within_the_run():
    values = torch.arange(8.0)
    valid = torch.tensor([False, True, False, False, False, False, True, False])
    assert fill_frames(values, valid, [(0, 2), (3, 5), (6, 7)]).tolist() == [1, 1, 1, 1, 6, 6, 6, 6]
