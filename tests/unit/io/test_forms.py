"""Forms of records: the first place that looks different is named."""

import pytest

from nbavatar.errors import DataError
from nbavatar.io.forms import check_form, matrix_form

FORM = {
    "name": str,
    "size": (Ellipsis, 2, int),
    "K": (None, matrix_form(2, 2)),
    "values": {str: (float, None)},
    "rows": [{"frame": str, "psnr?": float}],
    "extra?": (None, {"flag": bool}),
}
GOOD = {
    "name": "a", "size": [3, 4], "K": [[1, 0.5], [0, 1]], "values": {"psnr": 2, "ssim": None},
    "rows": [{"frame": "x", "more": 1}, {"frame": "y", "psnr": 1.5}], "free": object,
}  # fmt: skip


def test_what_looks_right_passes():
    for change in ({}, {"K": None}, {"extra": None}, {"extra": {"flag": True}}, {"rows": []}, {"values": {}}):
        check_form(GOOD | change, FORM, "f.json")


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"name": 3}, "f.json: name: expected text, found 3"),
        ({"size": [3]}, "f.json: size: expected a list of 2, found 1"),
        ({"size": [3, True]}, r"f.json: size\[1\]: expected a whole number, found True"),
        ({"size": [3, 4.0]}, r"f.json: size\[1\]: expected a whole number, found 4.0"),
        ({"size": "34"}, "f.json: size: expected a list of 2, found '34'"),
        ({"K": [[1, 2]]}, "f.json: K: expected a list of 2, found 1"),
        ({"K": [[1, 2], [3, float("nan")]]}, r"f.json: K\[1\]\[1\]: expected a finite number, found nan"),
        ({"K": [[1, 2], [3, 10**400]]}, r"f.json: K\[1\]\[1\]: expected a finite number"),
        ({"values": {"psnr": "2"}}, "f.json: values.psnr: expected a finite number or null, found '2'"),
        ({"values": []}, "f.json: values: expected a mapping"),
        ({"rows": [{}]}, r"f.json: rows\[0\].frame: expected this key, found only an empty mapping"),
        ({"rows": [None]}, r"f.json: rows\[0\]: expected a mapping, found None"),
        ({"extra": {}}, "f.json: extra.flag: expected this key"),
    ],
)
def test_the_first_place_that_looks_different_is_named(change, line):
    with pytest.raises(DataError, match=line):
        check_form(GOOD | change, FORM, "f.json")
    with pytest.raises(DataError, match=r"f\.json: name: expected this key"):
        check_form({key: value for key, value in GOOD.items() if key != "name"}, FORM, "f.json")
