import numpy as np

from nbavatar.preprocess.foreground import estimate_foreground


def scene(backdrop):
    """A disc of smoothly changing colours with a soft edge, over a flat backdrop."""
    y, x = np.mgrid[:160, :160]
    alpha = np.clip((60 - np.hypot(x - 80, y - 75)) / 8 + 0.5, 0, 1)
    front = np.stack([180 + 0.3 * (x - 80), 120 + 0.3 * (y - 80), np.full(x.shape, 90.0)], -1)
    image = alpha[..., None] * front + (1 - alpha[..., None]) * backdrop
    return np.rint(image).astype(np.uint8), np.rint(255 * alpha).astype(np.uint8), front


def test_colours_of_the_edge_are_freed_of_the_backdrop():
    for backdrop in (0.0, 255.0, np.array([20.0, 200.0, 40.0])):
        image, alpha, front = scene(backdrop)
        edge = (alpha > 10) & (alpha < 245)
        before = np.abs(image.astype(float) - front)[edge].mean()
        after = np.abs(estimate_foreground(image, alpha).astype(float) - front)[edge].mean()
        assert before > 20 and after < 0.1 * before


def test_full_and_empty_pixels_stay():
    image, alpha, _ = scene(255.0)
    result = estimate_foreground(image, alpha)
    sure = (alpha == 0) | (alpha == 255)
    np.testing.assert_array_equal(result[sure], image[sure])
    assert (result[~sure] != image[~sure]).any()


def test_binary_coverage_changes_nothing():
    image, alpha, _ = scene(255.0)
    hard = np.where(alpha > 127, 255, 0).astype(np.uint8)
    assert estimate_foreground(image, hard) is image


def test_a_new_background_shows_no_rim():
    """The purpose: compositing on white what was seen before black."""
    dark, alpha, front = scene(0.0)
    a = alpha[..., None] / 255
    truth = a * front + (1 - a) * 255
    naive = a * dark + (1 - a) * 255
    ours = a * estimate_foreground(dark, alpha) + (1 - a) * 255
    assert np.abs(ours - truth).max() < 0.2 * np.abs(naive - truth).max()
