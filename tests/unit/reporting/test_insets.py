"""Zoom windows."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from nbavatar.reporting.insets import contact_window, cut


def test_window_is_centred_where_hand_meets_head():
    label = np.zeros((100, 120), np.uint8)
    label[20:80, 30:70] = 1
    label[40:60, 70:110] = 2  # touches the right side of the head
    label[90:95, 5:10] = 3  # another hand, nowhere near
    x0, y0, x1, y1 = contact_window(label, np.full(label.shape, 255, np.uint8), share=0.2)
    assert x1 - x0 == y1 - y0 == 20
    assert abs((x0 + x1) / 2 - 70) <= 1.5 and abs((y0 + y1) / 2 - 49.5) <= 1.5


def test_without_contact_the_foreground_is_shown():
    alpha = np.zeros((50, 50), np.uint8)
    alpha[30:40, 10:20] = 255
    label = np.where(alpha > 0, 1, 0).astype(np.uint8)
    for labels in (None, label):
        x0, y0, x1, y1 = contact_window(labels, alpha, share=0.2)
        assert (x0 + x1) / 2 == 15 or abs((x0 + x1) / 2 - 14.5) <= 0.5
        assert abs((y0 + y1) / 2 - 34.5) <= 0.5


@given(
    st.integers(1, 40), st.integers(1, 40), st.floats(0.01, 1.0), st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.3])
)
def test_window_is_a_square_inside_any_picture(height, width, share, seed, density):
    rng = np.random.default_rng(seed)
    label = (rng.random((height, width)) < density).astype(np.uint8) * rng.integers(0, 4, (height, width)).astype(
        np.uint8
    )
    x0, y0, x1, y1 = contact_window(label, (label > 0).astype(np.uint8) * 255, share=share)
    assert 0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height and x1 - x0 == y1 - y0
    assert cut(label, (x0, y0, x1, y1)).shape == (y1 - y0, x1 - x0)
