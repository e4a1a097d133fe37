"""`bench viewer` on a toy avatar: every decoder that is there is measured, and gives torch's picture."""

import json

import pytest

from nbavatar.cli import main
from nbavatar.methods.billboards.engine import installed_engines
from nbavatar.methods.storage import save_avatar
from tests.scenes.toy import FRAMES, write_scene
from tests.unit.methods.billboards.test_model import make_avatar


def bench(capsys, scene, model, *words: str) -> dict:
    assert main(["bench", "viewer", "--json", str(model), "--meshes", str(scene["meshes"]), *words]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.fixture
def scene(tmp_path):
    return write_scene(tmp_path / "scene")


def test_all_decoders_are_measured_at_all_sizes(scene, tmp_path, capsys) -> None:
    save_avatar(tmp_path / "model.pt", make_avatar())
    words = ("--size", "64", "96", "--repeats", "2")
    cameras = [str(path) for path in scene["packs"]]
    for extra in ((), ("--cameras", *cameras)):
        figures = bench(capsys, scene, tmp_path / "model.pt", *words, *extra)
        assert figures["primitives"] == 12 and figures["frames"] == len(FRAMES)
        for side in (64, 96):
            for kind in ("eager", *installed_engines()):
                assert figures[f"{side}_{kind}_per_s"] == pytest.approx(1000 / figures[f"{side}_{kind}_ms"])
                assert figures[f"{side}_{kind}_cpu_ms"] > 0
            for kind in installed_engines():
                assert kind in figures["engines"] and figures[f"{side}_{kind}_ratio"] > 0
                assert figures[f"{side}_{kind}_difference"] <= 1, "rounding of sums, half a step of 255 at most"


def test_an_avatar_without_a_unet_has_torch_only(scene, tmp_path, capsys) -> None:
    save_avatar(tmp_path / "model.pt", make_avatar(deferred=False))
    figures = bench(capsys, scene, tmp_path / "model.pt", "--size", "64", "--repeats", "1")
    assert figures["engines"].startswith("none") and figures["64_eager_ms"] > 0
    assert not any("ratio" in name for name in figures)


def test_sizes_out_of_range_are_one_line(scene, tmp_path, capsys) -> None:
    save_avatar(tmp_path / "model.pt", make_avatar())
    words = ["bench", "viewer", str(tmp_path / "model.pt"), "--meshes", str(scene["meshes"]), "--size", "32"]
    assert main(words) == 2
    assert "sides of 64 to 1024 px" in capsys.readouterr().err
