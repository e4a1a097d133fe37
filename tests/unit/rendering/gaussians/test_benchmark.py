"""`nbavatar bench splat` on a small scene: its figures agree with the reference."""

import argparse

import pytest

from nbavatar.errors import DataError
from nbavatar.studies.benchmarks import splat


def figures(*words):
    parser = argparse.ArgumentParser()
    splat.add_arguments(parser)
    return splat.run(parser.parse_args(words))


def test_figures_of_a_small_scene():
    result = figures("--size", "48", "--gaussians", "400", "--degree", "1", "--repeats", "1")
    assert result["gaussians"] == 400 and result["samples"] > 48 * 48 / 4
    assert result["max_abs_error"] < 1e-5 and result["max_grad_rel_error"] < 1e-4
    assert result["flipped_pixels"] <= 10


@pytest.mark.parametrize("words", [("--size", "0"), ("--gaussians", "0"), ("--degree", "4")])
def test_bad_options_are_named(words):
    with pytest.raises(DataError, match=words[0]):
        figures(*words)
