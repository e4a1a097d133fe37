"""Everything that docs/paper-to-code.md names exists: functions are imported, tests are looked up."""

import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs/paper-to-code.md").read_text(encoding="utf-8")
FUNCTIONS = sorted(set(re.findall(r"`(nbavatar(?:\.\w+)+):(\w+)`", TEXT)))
TESTS = sorted(set(re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", TEXT)))


def test_the_page_names_functions_and_tests():
    rows = [line for line in TEXT.splitlines() if line.startswith("| ") and "`nbavatar." in line]
    assert len(rows) > 25
    assert all("::" in row for row in rows)


@pytest.mark.parametrize(("module", "name"), FUNCTIONS)
def test_functions_exist(module, name):
    assert callable(getattr(importlib.import_module(module), name))


@pytest.mark.parametrize(("file", "name"), TESTS)
def test_tests_exist(file, name):
    assert re.search(rf"^def {name}\(", (ROOT / file).read_text(encoding="utf-8"), re.M)
