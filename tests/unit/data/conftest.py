"""Tiny datasets, written once a session and copied where a test changes them."""

import importlib.util
import shutil
from pathlib import Path

import pytest

_spec = importlib.util.spec_from_file_location("tiny_inputs", Path(__file__).with_name("tiny.py"))
_tiny = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(_tiny)


@pytest.fixture(scope="session")
def tiny():
    """The module that writes them."""
    return _tiny


@pytest.fixture(scope="session")
def decaf_master(tmp_path_factory):
    return _tiny.write_decaf(tmp_path_factory.mktemp("decaf") / "root")


@pytest.fixture(scope="session")
def capture_master(tmp_path_factory):
    return _tiny.write_capture(tmp_path_factory.mktemp("capture") / "root")


@pytest.fixture
def decaf(decaf_master, tmp_path):
    """A Decaf root of one's own."""
    return Path(shutil.copytree(decaf_master, tmp_path / "DecafDataset"))


@pytest.fixture
def capture(capture_master, tmp_path):
    """A capture of one's own."""
    return Path(shutil.copytree(capture_master, tmp_path / "capture"))
