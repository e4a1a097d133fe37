"""The toy scene of training tests."""

import pytest

from tests.scenes.toy import write_scene


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> dict:
    """The toy scene at 32 px: paths of packs, meshes and spectral coordinates."""
    return write_scene(tmp_path_factory.mktemp("scene"))
