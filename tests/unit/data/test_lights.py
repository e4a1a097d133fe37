"""Files of lights."""

import numpy as np
import pytest

from nbavatar.data.lights import Light, read_light, write_light
from nbavatar.errors import DataError
from nbavatar.io.arrays import write_arrays

GOOD = {"directions": np.eye(3, dtype=np.float32), "weights": np.array([1, 0, 3], np.float32)}


def test_lights_come_back_as_they_were(tmp_path) -> None:
    for light in (Light(**GOOD), Light(GOOD["directions"][:0], GOOD["weights"][:0])):
        write_light(tmp_path / "light.npz", light, {})
        for a, b in zip(read_light(tmp_path / "light.npz"), light, strict=True):
            assert a.dtype == np.float32 and np.array_equal(a, b)


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("directions", np.ones((3, 3), np.float32), "unit vectors"),
        ("directions", np.full((3, 3), np.nan, np.float32), "unit vectors"),
        ("directions", np.eye(3, dtype=np.int64), r"real numbers \[K, 3\]"),
        ("directions", np.eye(3)[:, :2], r"real numbers \[K, 3\]"),
        ("weights", np.ones(2), r"real numbers \[3\]"),
        ("weights", np.array([1.0, -0.1, 3.0]), "from 0 up"),
        ("weights", np.array([1.0, np.inf, 3.0]), "from 0 up"),
    ],
)
def test_what_is_no_light_is_refused(tmp_path, name: str, value: np.ndarray, said: str) -> None:
    write_arrays(tmp_path / "light.npz", {**GOOD, name: value}, {})
    with pytest.raises(DataError, match=rf"light\.npz: {name}: expected .*{said}"):
        read_light(tmp_path / "light.npz")
    write_arrays(tmp_path / "light.npz", {n: v for n, v in GOOD.items() if n != name}, {})
    with pytest.raises(DataError, match=name):
        read_light(tmp_path / "light.npz")
