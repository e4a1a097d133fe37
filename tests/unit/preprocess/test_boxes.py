import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from nbavatar.preprocess.boxes import center_square, fill_missing, padded_square, square_window, union_box

NAN = [np.nan] * 4


def test_union_ignores_missing_rows():
    boxes = np.array([[10, 20, 30, 40], NAN, [5, 25, 12, 60]])
    np.testing.assert_array_equal(union_box(boxes), [5, 20, 30, 60])
    assert np.isnan(union_box(np.array([NAN]))).all()


def test_missing_rows_are_interpolated_and_ends_held():
    boxes = np.array([NAN, [0, 0, 10, 10], NAN, NAN, [30, 0, 40, 10], NAN])
    filled = fill_missing(boxes)
    np.testing.assert_allclose(filled[:, 0], [0, 0, 10, 20, 30, 30])
    assert np.isnan(fill_missing(np.array([NAN]))).all()


@given(
    st.tuples(st.floats(0, 150), st.floats(0, 90), st.floats(1, 50), st.floats(1, 30)),
    st.floats(0, 0.3),
)
def test_window_holds_the_box_and_stays_inside_where_it_fits(box, pad):
    x, y, w, h = box
    x0, y0, side = square_window(np.array([x, y, x + w, y + h]), 200, 120, pad=pad)
    assert side >= max(w, h) * (1 + 2 * pad) - 1e-9
    assert x0 <= x + 0.5 and y0 <= y + 0.5 and x0 + side >= x + w - 0.5 and y0 + side >= y + h - 0.5
    if side <= 120:
        assert 0 <= x0 <= 200 - side and 0 <= y0 <= 120 - side


def test_window_larger_than_the_image_holds_all_of_it():
    assert square_window(np.array([50, 10, 150, 110.0]), 200, 120, pad=0.1) == (40, 0, 120)
    x0, y0, side = square_window(np.array([50, 10, 150, 110.0]), 200, 120, pad=0.5)
    assert side == 200 and (x0, y0) == (0, -40)
    assert square_window(np.array([50, 60, 140, 120.0]), 200, 120, pad=0.5) == (5, 0, 180)
    assert square_window(np.array([50, 90, 200, 120.0]), 200, 120, pad=0.5) == (-25, -45, 300)


def test_center_of_full_hd():
    assert center_square(1920, 1080) == (420, 0, 1080)
    assert center_square(1080, 1920) == (0, 420, 1080)


def test_padded_square():
    assert padded_square(512, 512, 32) == (0, 0, 512)
    assert padded_square(500, 300, 32) == (-6, -106, 512)
