"""PSNR and SSIM against scikit-image, closed forms and each other."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage import data
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from nbavatar.errors import DataError
from nbavatar.metrics.psnr import psnr
from nbavatar.metrics.ssim import ssim, ssim_map


def tensor(image: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))[None]


@pytest.fixture(scope="module")
def pair() -> tuple[np.ndarray, np.ndarray]:
    x = data.astronaut()[20:153, 150:311].astype(np.float32) / 255
    noise = np.random.default_rng(0).normal(scale=0.07, size=x.shape)
    return x, np.clip(x * 0.95 + noise, 0, 1).astype(np.float32)


def oracle_map(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """scikit-image's map in float64, cropped to complete windows, averaged over channels."""
    _, full = structural_similarity(
        x.astype(np.float64),
        y.astype(np.float64),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=-1,
        full=True,
    )
    return full[5:-5, 5:-5].mean(axis=-1)


def test_psnr_equals_scikit_image(pair):
    x, y = pair
    expected = peak_signal_noise_ratio(x.astype(np.float64), y.astype(np.float64), data_range=1.0)
    assert psnr(tensor(x), tensor(y)).item() == pytest.approx(expected, abs=1e-9)


def test_ssim_map_and_mean_equal_scikit_image(pair):
    x, y = pair
    expected = oracle_map(x, y)
    np.testing.assert_allclose(ssim_map(tensor(x), tensor(y))[0].numpy(), expected, atol=1e-9)
    assert ssim(tensor(x), tensor(y)).item() == pytest.approx(expected.mean(), abs=1e-10)


def test_masked_metrics_equal_the_metric_of_the_masked_pixels(pair):
    x, y = pair
    mask = np.zeros(x.shape[:2], dtype=bool)
    mask[30:100, 17:140] = True
    mask[50, 60] = False
    mse = ((x.astype(np.float64) - y) ** 2)[mask].mean()
    assert psnr(tensor(x), tensor(y), torch.from_numpy(mask)[None]).item() == pytest.approx(-10 * math.log10(mse))
    expected = oracle_map(x, y)[mask[5:-5, 5:-5]].mean()
    assert ssim(tensor(x), tensor(y), torch.from_numpy(mask)[None]).item() == pytest.approx(expected, abs=1e-9)


def test_full_mask_is_no_mask(pair):
    x, y = map(tensor, pair)
    ones = torch.ones(1, *x.shape[2:])
    torch.testing.assert_close(psnr(x, y, ones), psnr(x, y), rtol=1e-12, atol=0)
    torch.testing.assert_close(ssim(x, y, ones), ssim(x, y), rtol=1e-12, atol=0)


def test_identical_images(pair):
    x = tensor(pair[0])
    assert psnr(x, x).item() == math.inf
    assert ssim(x, x).item() == pytest.approx(1.0, abs=1e-15)


@settings(max_examples=25, deadline=None)
@given(a=st.floats(0, 1), b=st.floats(0, 1))
def test_constant_images_have_their_closed_form(a, b):
    x, y = torch.full((1, 3, 12, 13), a, dtype=torch.float64), torch.full((1, 3, 12, 13), b, dtype=torch.float64)
    expected = (2 * a * b + 1e-4) / (a * a + b * b + 1e-4)
    # E[x^2] - E[x]^2 of a constant is rounding, 1e-16, against C2 = 9e-4.
    assert ssim(x, y).item() == pytest.approx(expected, abs=1e-11)
    expected_db = math.inf if (a - b) ** 2 == 0 else -10 * math.log10((a - b) ** 2)
    assert psnr(x, y).item() == pytest.approx(expected_db, abs=1e-6)


def test_empty_mask_is_nan_and_spares_its_neighbours(pair):
    x, y = (tensor(image).repeat(2, 1, 1, 1) for image in pair)
    mask = torch.ones(2, *x.shape[2:])
    mask[0] = 0
    for metric in (psnr, ssim):
        values = metric(x, y, mask)
        assert values[0].isnan() and values[1].item() == pytest.approx(metric(x, y)[1].item())


def test_metrics_are_symmetric_and_ssim_is_at_most_one(pair):
    x, y = map(tensor, pair)
    assert psnr(x, y).item() == psnr(y, x).item()
    assert ssim(x, y).item() == pytest.approx(ssim(y, x).item(), abs=1e-15)
    assert -1 <= ssim_map(x, y).min() and ssim_map(x, y).max() <= 1


def test_eight_bit_error_of_one_level_has_its_known_value():
    x = torch.zeros(1, 3, 16, 16)
    assert psnr(x, x + 1 / 255).item() == pytest.approx(20 * math.log10(255), abs=1e-5)


def test_ssim_gradient_is_correct():
    rng = torch.Generator().manual_seed(0)
    x = torch.rand(1, 2, 12, 11, generator=rng, dtype=torch.float64).requires_grad_()
    y = torch.rand(1, 2, 12, 11, generator=rng, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda image: ssim(image, y), (x,))


@pytest.mark.parametrize("metric", [psnr, ssim])
@pytest.mark.parametrize(
    ("x", "mask", "message"),
    [
        (torch.full((1, 3, 16, 16), 1.001), None, r"first image: expected values in \[0, 1\], found 1.001"),
        (torch.full((1, 3, 16, 16), math.nan), None, "found nan"),
        (torch.zeros((1, 3, 16, 16), dtype=torch.uint8), None, "divide by 255"),
        (torch.zeros((1, 3, 16, 17)), None, "of one size"),
        (torch.zeros((1, 3, 16, 16)), torch.zeros((1, 16, 15)), "expected a mask"),
        (torch.zeros((1, 3, 16, 16)), torch.full((1, 16, 16), 2.0), "mask: expected values"),
    ],
)
def test_unusable_input_is_one_clear_line(metric, x, mask, message):
    with pytest.raises(DataError, match=message):
        metric(x, torch.zeros(1, 3, 16, 16), mask)


def test_ssim_needs_one_complete_window():
    with pytest.raises(DataError, match="at least 11 px"):
        ssim(torch.zeros(1, 3, 10, 40), torch.zeros(1, 3, 10, 40))
