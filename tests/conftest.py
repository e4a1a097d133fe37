"""What all tests share: markers that skip in one place, seeds, the profile of property tests."""

import os

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

from tests.unit.disks import small_disk  # noqa: F401
from tests.unit.users import public_folder  # noqa: F401

settings.register_profile(
    "nbavatar",
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
settings.load_profile("nbavatar")


_WHOLE_RUNS = ("workflow", "cluster")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files that take long come first; tests marked `gpu` are skipped where there is no CUDA device, only here.

    A worker of pytest-xdist takes a whole file: one of a minute that is begun last keeps all others waiting.
    """
    long = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: (item.path.parent.name not in _WHOLE_RUNS, item.path not in long))
    marked = [item for item in items if item.get_closest_marker("gpu")]
    if not marked:
        return
    import torch

    if not torch.cuda.is_available():
        for item in marked:
            item.add_marker(pytest.mark.skip(reason="no CUDA device"))


@pytest.fixture(autouse=True)
def _seed() -> None:
    """A fixed seed of torch, where a test has imported it already; NumPy is seeded through `rng`."""
    import sys

    if "torch" in sys.modules:
        sys.modules["torch"].manual_seed(0)


@pytest.fixture
def rng() -> np.random.Generator:
    """A fresh generator with a fixed seed."""
    return np.random.default_rng(0)


os.environ.setdefault("MPLBACKEND", "Agg")
