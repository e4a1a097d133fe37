import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nbavatar.camera.distortion import (
    checked_coefficients,
    distort_pixels,
    distort_plane,
    distort_vertices,
    undistort_pixels,
    undistortion_map,
)
from nbavatar.errors import DataError

K = np.array([[900.0, 0, 951.3], [0, 905.0, 533.7], [0, 0, 1]])
COEFFICIENTS = [
    [0.1, -0.05, 0.001, -0.002],
    [-0.25, 0.08, 0.0005, 0.001, -0.01],
    [0.2, -0.1, 0.001, 0.002, 0.01, 0.15, -0.05, 0.02],
    [0.1, -0.05, 0.001, 0.002, 0.0, 0.05, 0.0, 0.0, 0.001, -0.002, 0.0015, 0.0005],
]


@pytest.mark.parametrize("coefficients", COEFFICIENTS)
def test_distortion_equals_opencv(coefficients):
    rng = np.random.default_rng(0)
    plane = rng.uniform(-0.7, 0.7, (200, 2))
    points = np.column_stack([plane, np.ones(200)])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), np.array(coefficients))
    np.testing.assert_allclose(distort_plane(plane, np.array(coefficients)), expected[:, 0], atol=1e-12)


@pytest.mark.parametrize("coefficients", COEFFICIENTS)
@given(seed=st.integers(0, 2**31))
def test_undistort_inverts_distort(coefficients, seed):
    pixels = np.random.default_rng(seed).uniform([200, 100], [1700, 950], (20, 2))
    distorted = distort_pixels(pixels, K, np.array(coefficients))
    np.testing.assert_allclose(undistort_pixels(distorted, K, np.array(coefficients)), pixels, atol=1e-6)


def test_points_where_the_lens_folds_over_come_back_as_nan():
    strong = np.array([-0.4, 0.0, 0.0, 0.0])
    assert np.isnan(undistort_pixels(np.array([[99999.0, 533.7]]), K, strong)).any()
    assert np.isfinite(undistort_pixels(np.array([[1200.0, 600.0]]), K, strong)).all()


def test_no_coefficients_change_nothing():
    pixels = np.array([[3.0, 4.0]])
    np.testing.assert_array_equal(distort_pixels(pixels, K, None), pixels)
    np.testing.assert_array_equal(undistort_pixels(pixels, K, None), pixels)


@pytest.mark.parametrize("coefficients", COEFFICIENTS)
def test_map_equals_opencv_with_its_convention_of_pixel_centres(coefficients):
    new = np.array([[700.0, 0, 310.2], [0, 710.0, 205.9], [0, 0, 1]])
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    expected = cv2.initUndistortRectifyMap(
        K - half, np.array(coefficients), np.eye(3), new - half, (640, 480), cv2.CV_32FC1
    )
    for ours, theirs in zip(undistortion_map(K, np.array(coefficients), new, 640, 480), expected):
        np.testing.assert_allclose(ours, theirs, atol=2e-4)  # float32 pixels up to 2,000


def test_distorted_vertices_project_to_distorted_pixels_and_never_fold_back():
    coefficients = np.array([-0.4, 0.05, 0.001, 0.001, 0.0])
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-0.5, 0.5, (50, 2)), np.ones(50)]) * rng.uniform(0.5, 2, (50, 1))
    moved = distort_vertices(points, coefficients, reach=1.0)
    ideal = points @ K.T
    seen = moved @ K.T
    np.testing.assert_allclose(
        seen[:, :2] / seen[:, 2:], distort_pixels(ideal[:, :2] / ideal[:, 2:], K, coefficients), atol=1e-9
    )
    np.testing.assert_array_equal(moved[:, 2], points[:, 2])
    ray = np.column_stack([np.linspace(0, 20, 200), np.zeros(200), np.ones(200)])
    x = distort_vertices(ray, np.array([-0.3, 0, 0, 0]), reach=0.9)[:, 0]
    assert (np.diff(x) > 0).all()
    behind = np.array([[0.1, 0.2, -1.0]])
    np.testing.assert_array_equal(distort_vertices(behind, coefficients, 1.0), behind)


@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_coefficients_of_all_lengths(count):
    values = np.zeros((1, count))
    values[0, 0] = 0.1
    assert checked_coefficients(values, "x").shape == (12,)
    assert checked_coefficients(np.zeros(count), "x") is None


@pytest.mark.parametrize("values", [[1, 2, 3], [np.nan, 0, 0, 0], "no", [0.0] * 13 + [0.2]])
def test_other_coefficients_are_refused(values):
    with pytest.raises(DataError, match=r"cameras\.pkl"):
        checked_coefficients(values, "cameras.pkl: 084: dist")
