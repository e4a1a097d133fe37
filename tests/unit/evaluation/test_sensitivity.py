"""What a change of protocol does to figures, on images where the answer is known."""

import dataclasses
import math

import numpy as np
import pytest

from nbavatar.evaluation.sensitivity import Images, Setting, apply_setting, foreground_box, settings, sweep

SIZE = 96


@pytest.fixture
def images() -> Images:
    """A grey square of 40 px, rendered 16 levels too bright, on white."""
    alpha = np.zeros((SIZE, SIZE), np.uint8)
    alpha[30:70, 20:60] = 255
    rgb = np.full((SIZE, SIZE, 3), 100, np.uint8)
    prediction = np.where(alpha[..., None] > 0, 116, 255).astype(np.uint8).repeat(3, axis=-1)
    return Images("102", prediction, alpha.copy(), rgb, alpha)


def psnr(pair) -> float:
    return -10 * math.log10(((pair[0].astype(np.float64) - pair[1]) ** 2).mean())


def test_a_grown_mask_stays_out_of_what_is_not_known(images):
    unseen = np.zeros((SIZE, SIZE), bool)
    unseen[:, 60:] = True  # beside the square, which grows to the other sides
    known = dataclasses.replace(images, unseen=unseen)
    x, y = apply_setting(Setting(mask="grown"), known, (1, 1, 1), None)
    free = apply_setting(Setting(mask="grown"), images, (1, 1, 1), None)[1]
    np.testing.assert_array_equal(y[:, 60:], x[:, 60:])
    np.testing.assert_array_equal(y[:, :60], free[:, :60])
    assert (free[:, 60:] < 1).any()


def test_base_is_the_stored_image(images):
    x, y = apply_setting(Setting(), images, (1, 1, 1), None)
    np.testing.assert_array_equal(np.round(x * 255), images.prediction)
    assert psnr((x, y)) == pytest.approx(-10 * math.log10((16 / 255) ** 2 * (40 * 40) / SIZE**2), abs=1e-6)


@pytest.mark.parametrize("pad", [0.0, 0.1, 0.25])
def test_padding_dilutes_the_error_as_area_does(images, pad):
    box = foreground_box(images.alpha)
    assert box == (20, 30, 60, 70)
    tight = psnr(apply_setting(Setting(crop="frame"), images, (1, 1, 1), box))
    padded = psnr(apply_setting(Setting(crop="frame", pad=pad), images, (1, 1, 1), box))
    # Resampling blurs the rim of the square, which is all that is not exact.
    assert padded - tight == pytest.approx(20 * math.log10(1 + 2 * pad), abs=0.15)
    assert tight == pytest.approx(20 * math.log10(255 / 16), abs=0.1)


def test_box_beyond_the_image_is_background(images):
    x, y = apply_setting(Setting(crop="frame", pad=2.0), images, (1, 1, 1), (20, 30, 60, 70))
    assert x.shape == y.shape == (SIZE, SIZE, 3)
    np.testing.assert_array_equal(x[0], 1.0)
    assert x.min() < 0.5


def test_background_is_exchanged_behind_both(images):
    x, y = apply_setting(Setting(background=(0.0, 0.0, 0.0)), images, (1, 1, 1), None)
    assert x[0, 0].max() == y[0, 0].max() == 0
    assert psnr((x, y)) == pytest.approx(psnr(apply_setting(Setting(), images, (1, 1, 1), None)), abs=1e-9)


def test_mask_moves_the_border_of_the_truth(images):
    covered = {}
    for mask in ("soft", "hard", "grown", "shrunk"):
        _, y = apply_setting(Setting(mask=mask), images, (1, 1, 1), None)
        covered[mask] = int((y[..., 0] < 0.9).sum())
    assert covered == {"soft": 1600, "hard": 1600, "grown": 42 * 42, "shrunk": 38 * 38}


def test_half_size_is_half_the_size_for_every_filter(images):
    for setting in settings(opacity=True):
        x, y = apply_setting(setting, images, (1, 1, 1), (20, 30, 60, 70))
        assert x.shape == y.shape == ((48, 48, 3) if setting.resample else (SIZE, SIZE, 3))


def test_sweep_lists_the_base_first_and_differences_to_it(images):
    without = Images(images.camera, images.prediction, None, images.rgb, images.alpha)
    rows = sweep([without, without], (1, 1, 1), {}, {"102": (20, 30, 60, 70)})
    assert rows[0]["factor"] == "base" and rows[0]["d_psnr"] == rows[0]["d_ssim"] == 0
    assert "background" not in {row["factor"] for row in rows}
    assert len(rows) == len(settings(opacity=False))
    for row in rows:
        assert row["d_psnr"] == pytest.approx(row["psnr"] - rows[0]["psnr"])
    assert "background" in {row["factor"] for row in sweep([images], (1, 1, 1), {}, {})}


def test_empty_foreground_leaves_the_image_whole(images):
    assert foreground_box(np.zeros((5, 5), np.uint8)) is None
    x, _ = apply_setting(Setting(crop="frame", pad=0.1), images, (1, 1, 1), None)
    np.testing.assert_array_equal(np.round(x * 255), images.prediction)
