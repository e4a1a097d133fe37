"""Images that show nobody take no part in any mean: one rule, seen through every command that averages over images."""

import json

import numpy as np
import pytest

from nbavatar.cli import main as cli
from nbavatar.errors import DataError
from nbavatar.evaluation.truth import foreground, showing_someone
from nbavatar.io.records import read_json
from tests.scenes.toy import rewritten, write_scene

PROTOCOL = json.dumps({"name": "nv", "split": "novel_view", "background": [1.0, 1.0, 1.0]})


def test_coverage_of_one_half_is_someone() -> None:
    faint, half = np.full((4, 4), 127, np.uint8), np.zeros((4, 4), np.uint8)
    half[1, 1] = 128
    assert not foreground(faint).any() and foreground(half).sum() == 1
    assert showing_someone([faint, half, faint], lambda alpha: alpha)[0] is half
    for images in ([], [faint, faint]):
        with pytest.raises(DataError, match=f"found {len(images)} images of background"):
            showing_someone(images, lambda alpha: alpha)


def test_sensitivity_is_that_of_the_images_with_someone(tmp_path) -> None:
    pack = write_scene(tmp_path, size=64)["packs"][2]

    def render(rgb, alpha):
        return np.where(alpha[..., None] > 0, rgb // 2 + 40, 255).astype(np.uint8)  # too dark, on white

    rows = {}
    for name, frames, hide in (("with", ["f0", "f1", "f2"], ["f1"]), ("without", ["f0", "f2"], [])):
        truth = rewritten(pack, tmp_path / f"{name}-truth.zip", frames, hide=hide)
        drawn = rewritten(pack, tmp_path / f"{name}.zip", frames, hide=hide, shown_as=render, prefix="cam2/")
        words = ["--render", drawn, "--frames", truth, "--protocol", PROTOCOL, "--nets", "--out", str(tmp_path / name)]
        assert cli(["protocol-sensitivity", *words]) == 0
        rows[name] = read_json(tmp_path / f"{name}.json")
    assert rows["with"]["rows"] == rows["without"]["rows"]
    assert rows["with"]["frames"] == ["cam2/f0", "cam2/f2"]
