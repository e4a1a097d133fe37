"""The tiny datasets of the data tests, for the verbs that read them."""

import importlib.util
from pathlib import Path

_spec = importlib.util.spec_from_file_location("tiny_fixtures", Path(__file__).parents[1] / "data" / "conftest.py")
_fixtures = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(_fixtures)

tiny = _fixtures.tiny
decaf_master = _fixtures.decaf_master
capture_master = _fixtures.capture_master
decaf = _fixtures.decaf
capture = _fixtures.capture
