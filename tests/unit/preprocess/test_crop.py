import cv2
import numpy as np
import pytest
import skimage.transform

from nbavatar.camera.distortion import distort_pixels
from nbavatar.camera.pinhole import crop_intrinsics, project, scale_intrinsics
from nbavatar.preprocess.crop import Window, blank_unseen, resize_area, resize_labels, resize_unseen

K = np.array([[400.0, 0, 171.2], [0, 410.0, 118.6], [0, 0, 1]])


def dots(points, width, height, radius=5):
    """White discs with soft edges at sub-pixel positions (pixel centres at +0.5)."""
    y, x = np.mgrid[:height, :width] + 0.5
    image = np.zeros((height, width))
    for px, py in points:
        image = np.maximum(image, np.clip(radius + 0.5 - np.hypot(x - px, y - py), 0, 1))
    return (255 * image).astype(np.uint8)


def centroid(image):
    y, x = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
    weight = image.astype(float)
    return np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()


@pytest.mark.parametrize("size", [128, 100, 64, 300])
@pytest.mark.parametrize("distortion", [None, np.array([-0.3, 0.1, 0.002, -0.001, 0.0])])
def test_projected_points_land_where_the_new_camera_matrix_says(size, distortion):
    """The test of the whole convention: a dot drawn at the native projection is found at the cropped one."""
    x0, y0, side = 60, 20, 200
    window = Window(x0, y0, side, K, distortion)
    matrix = scale_intrinsics(crop_intrinsics(K, x0, y0), size / side, size / side)
    for point in np.array([[0.0, 0.0, 1], [0.12, -0.1, 1], [-0.15, 0.11, 1.2]]):
        native, _ = project(point[None], K, np.eye(4))
        image = dots(distort_pixels(native, K, distortion), 340, 240)
        found = centroid(resize_area(window.cut(image), size))
        expected, _ = project(point[None], matrix, np.eye(4))
        # remap and cubic growing work in steps of 1/32 pixel; a dot is deformed by the lens by less than that
        atol = 0.01 if distortion is None and size <= side else 0.03 * max(1, size / side)
        np.testing.assert_allclose(found, expected[0], atol=atol)


def test_window_outside_the_image_is_black():
    image = np.full((40, 50, 3), 200, np.uint8)
    cut = Window(-10, -5, 64, K).cut(image)
    assert cut.shape == (64, 64, 3)
    expected = np.zeros((64, 64, 3), np.uint8)
    expected[5:45, 10:60] = 200
    np.testing.assert_array_equal(cut, expected)
    assert not Window(200, 0, 16, K).cut(image).any()


@pytest.mark.parametrize(("size", "first"), [(64, (5, 10)), (32, (3, 5)), (16, (2, 3))])
def test_what_lies_outside_the_image_is_unseen(size, first):
    """Of a pixel that is partly outside nothing is known either: 5 of 64 rows are 1.25 of 16."""
    unseen = Window(-10, -5, 64, K).unseen(70, 50, size)
    expected = np.ones((size, size), bool)
    expected[first[0] :, first[1] : 60 * size // 64] = False
    np.testing.assert_array_equal(unseen, expected)
    assert not Window(10, 5, 32, K).unseen(70, 50, size).any()


@pytest.mark.parametrize("distortion", [[-0.3, 0.1, 0.002, -0.001, 0.0], [0.25, -0.05, 0.0, 0.0, 0.0]])
def test_an_undistorted_image_is_seen_as_far_as_its_pixels_reach(distortion):
    """Where each pixel's centre lies in the image as it was taken; two of its pixels are lost to interpolation."""
    window = Window(-40, -40, 400, K, np.array(distortion))
    y, x = np.mgrid[-40:360, -40:360] + 0.5
    native = distort_pixels(np.stack([x, y], -1).reshape(-1, 2), K, np.array(distortion)).reshape(400, 400, 2)
    inside = np.minimum(native, [340, 240] - native).min(-1)
    unseen = window.unseen(240, 340, 400)
    assert unseen[inside < 0].all() and not unseen[inside > 4].any()
    assert 0.01 < unseen.mean() < 0.9


@pytest.mark.parametrize(
    ("size", "rows", "columns"), [(64, (9, 12), (20, 21)), (32, (4, 6), (10, 11)), (16, (2, 3), (5, 6))]
)
def test_a_pixel_with_a_part_that_says_nothing_says_nothing(size, rows, columns):
    unseen = np.zeros((64, 64), bool)
    unseen[9:12, 20:21] = True
    expected = np.zeros((size, size), bool)
    expected[slice(*rows), slice(*columns)] = True
    np.testing.assert_array_equal(resize_unseen(unseen, size), expected)
    grown = resize_unseen(
        unseen, 128
    )  # with the pixels that have a share of it by interpolation, at most two of its own around
    assert grown[18:24, 40:42].all() and grown.sum() == grown[14:28, 36:46].sum() > 12
    assert not resize_unseen(~unseen & unseen, size).any()


def test_only_what_is_unseen_is_blanked():
    image = np.full((4, 6, 3), 7, np.uint8)
    unseen = np.zeros((4, 6), bool)
    unseen[1] = True
    blank = blank_unseen(image, unseen, (1.0, 0.5, 0.0))
    assert (blank[1] == [255, 128, 0]).all() and (np.delete(blank, 1, 0) == 7).all()
    assert blank_unseen(image, None, (1.0, 0.5, 0.0)) is image


def test_undistortion_equals_opencv():
    distortion = np.array([-0.25, 0.07, 0.001, 0.0, 0.0])
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.integers(0, 255, (240, 340, 3), dtype=np.uint8), (0, 0), 3)
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    whole = cv2.undistort(image, K - half, distortion)
    ours = Window(60, 20, 200, K, distortion).cut(image)
    # OpenCV interpolates linearly here, we cubically: a few grey levels on a blurred image
    assert np.abs(ours.astype(int) - whole[20:220, 60:260]).max() <= 6


@pytest.mark.parametrize("size", [30, 45, 20, 60, 37])
def test_shrinking_is_the_mean_over_areas(size):
    """Oracle: explicit overlap matrix of pixel intervals, exact for any ratio."""
    rng = np.random.default_rng(1)
    image = rng.integers(0, 256, (90, 90, 3), dtype=np.uint8)
    edges = np.arange(size + 1) * 90 / size
    pixels = np.arange(90)
    overlap = np.clip(np.minimum(edges[1:, None], pixels + 1) - np.maximum(edges[:-1, None], pixels), 0, None)
    overlap /= overlap.sum(1, keepdims=True)
    expected = np.einsum("ai,bj,ijc->abc", overlap, overlap, image)
    assert np.abs(resize_area(image, size) - expected).max() <= 1.0


def test_integer_shrinking_equals_scikit_image():
    image = np.random.default_rng(2).integers(0, 256, (96, 96), dtype=np.uint8)
    expected = skimage.transform.downscale_local_mean(image, (3, 3))
    assert np.abs(resize_area(image, 32) - expected).max() <= 0.51


def test_growing_keeps_positions():
    image = dots([[20.3, 11.7]], 40, 40, 3)
    np.testing.assert_allclose(centroid(resize_area(image, 100)), np.array([20.3, 11.7]) * 2.5, atol=0.03)


def test_every_covered_pixel_has_a_label_and_labels_are_the_majority():
    rng = np.random.default_rng(3)
    label = np.zeros((90, 90), np.uint8)
    label[10:70, 12:50] = 1
    label[40:81, 31:77] = 2
    alpha = np.where(label > 0, rng.integers(1, 256, label.shape), rng.integers(0, 256, label.shape)).astype(np.uint8)
    small, cover = resize_labels(label, alpha, 40)
    assert ((small > 0) == (cover > 0)).all() and set(np.unique(small)) == {0, 1, 2}
    assert (small[8:16, 8:20] == 1).all() and (small[20:34, 16:32] == 2).all()
    kept = np.where(label > 0, alpha, 0)
    np.testing.assert_allclose(cover.astype(float).sum() / kept.sum(), (40 / 90) ** 2, rtol=2e-2)
    same, again = resize_labels(label, alpha, 90)
    np.testing.assert_array_equal(same, label)
    np.testing.assert_array_equal(again, kept)


def test_labels_are_not_mixed_on_the_way():
    label = np.zeros((40, 40), np.uint8)
    label[:, :20], label[:, 20:] = 1, 3
    cut = Window(2, 2, 32, K, np.array([0.05, 0, 0, 0.0])).cut(label, labels=True)
    assert set(np.unique(cut)) <= {0, 1, 3}
    assert set(np.unique(resize_labels(label, np.full_like(label, 255), 13)[0])) == {1, 3}
