"""Damaged files: read, or refused in one line, and nothing runs. Thousands a reader; `tests/fuzz` says how."""

import os
import tempfile
from pathlib import Path

import pytest

from tests.fuzz.drive import drive
from tests.fuzz.readers import READERS


@pytest.fixture
def folder():
    """A folder in memory where there is one: a disk would take most of the time."""
    with tempfile.TemporaryDirectory(dir="/dev/shm" if os.access("/dev/shm", os.W_OK) else None) as text:
        yield Path(text)


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_damaged_files_are_read_or_refused_in_one_line(name, folder, capfd):
    count = 200 if READERS[name].heavy else 2000
    outcome = drive(name, folder, count)
    assert not outcome.escapes, [(number, repr(error)[:300]) for number, error in outcome.escapes[:5]]
    assert not outcome.ran
    # Damage that is never noticed would show nothing.
    assert outcome.refused > count // 10 or not READERS[name].refuses
    capfd.readouterr()  # libraries in C say what they think of damaged files
