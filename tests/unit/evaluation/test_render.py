"""Rendering and timing from the command line, on a toy avatar."""

import json
from pathlib import Path

import numpy as np
import pytest

from nbavatar.cli import main
from nbavatar.config.evaluation import ProtocolConfig
from nbavatar.data.sequences import MeshSequence, Part, read_sequence, write_sequence
from nbavatar.data.views import views_of
from nbavatar.evaluation.render import render_views
from nbavatar.io.framepack import FramePack
from nbavatar.methods.storage import load_avatar
from tests.scenes.toy import FRAMES, SIZE, write_scene
from tests.scenes.training import train_options

TRAIN = train_options({
    "steps": 8, "texels": 4, "unet": {"width": 4, "depth": 3, "max_width": 8, "convs": 1}, "weight_lpips": 0.0,
    "previews": 0, "coarse_side": 16,
})  # fmt: skip


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> dict:
    """A toy scene with a model trained on two of its three cameras, and its paths as text."""
    folder = tmp_path_factory.mktemp("trained")
    scene = write_scene(folder / "scene")
    packs = [str(path) for path in scene["packs"]]
    model = str(folder / "model.pt")
    command = [
        "train", "--frames", *packs[:2], "--meshes", str(scene["meshes"]), "--spectral", str(scene["spectral"]),
        "--out", model, "--history", str(folder / "history.jsonl"), "--device", "cpu", "--cfg", json.dumps(TRAIN),
    ]  # fmt: skip
    assert main(command) == 0
    return {"folder": folder, "packs": packs, "meshes": str(scene["meshes"]), "model": model}


def render(trained: dict, out: Path, packs: list[str], protocol: dict, meshes: str | None = None) -> int:
    return main([
        "render", "--model", trained["model"], "--meshes", meshes or trained["meshes"], "--frames", *packs,
        "--protocol", json.dumps(protocol), "--out", str(out), "--device", "cpu",
    ])  # fmt: skip


def test_history_is_the_event_log(trained) -> None:
    events = [json.loads(line) for line in (trained["folder"] / "history.jsonl").read_text().splitlines()]
    assert events[-1]["step"] == 8 and {"loss", "mse", "psnr", "nb", "seconds"} <= events[-1].keys()


def test_render_novel_view_holds_training_frames_of_the_camera(trained, tmp_path) -> None:
    protocol = {"name": "nv1024", "split": "novel_view", "background": [0.0, 0.5, 1.0]}
    assert render(trained, tmp_path / "nv.zip", trained["packs"][2:], protocol) == 0
    pack = FramePack(tmp_path / "nv.zip")
    assert pack.frames == [f"cam2/{frame}" for frame in FRAMES[:3]]
    assert pack.manifest["background"] == [0.0, 0.5, 1.0]
    record = pack.manifest["record"]
    assert record["command"] == "render" and record["training"]["steps"] == 8
    truth = FramePack(trained["packs"][2])
    for name in pack.frames:
        rgb = pack.read("rgb", name)
        assert rgb.shape == (SIZE, SIZE, 3) and pack.read("nb_alpha", name).shape == (SIZE, SIZE)
        np.testing.assert_allclose(pack.intrinsics(name), truth.intrinsics(name[5:]), rtol=1e-6)
        corner = rgb[pack.read("alpha", name) == 0]
        assert (corner == np.array([0, 128, 255])).all()


def test_render_self_reenactment_and_limit(trained, tmp_path) -> None:
    assert render(trained, tmp_path / "sr.zip", trained["packs"][:2], {"split": "self_reenactment"}) == 0
    assert FramePack(tmp_path / "sr.zip").frames == ["cam0/f3", "cam1/f3"]
    assert render(trained, tmp_path / "all.zip", trained["packs"][:1], {"split": "all", "limit": 2}) == 0
    assert FramePack(tmp_path / "all.zip").frames == ["cam0/f0", "cam0/f3"]


def test_render_is_deterministic(trained, tmp_path) -> None:
    for name in ("a.zip", "b.zip"):
        render(trained, tmp_path / name, trained["packs"][2:], {})
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes()


def test_region_of_interest_decodes_the_same_silhouette(trained) -> None:
    avatar = load_avatar(trained["model"])
    meshes, _ = read_sequence(trained["meshes"])
    views = views_of([FramePack(trained["packs"][2])], meshes.frames, [["f0"]])
    pictures = [
        next(iter(render_views(avatar, meshes, views, ProtocolConfig(roi=roi)))) for roi in (False, True)
    ]  # fmt: skip
    # The billboards do not depend on the window; the U-Net's normalisation does, slightly.
    assert np.abs(pictures[0].nb_alpha.astype(int) - pictures[1].nb_alpha).max() <= 1


def test_render_refuses_meshes_of_another_topology(trained, tmp_path, capsys) -> None:
    meshes, _ = read_sequence(trained["meshes"])
    head = meshes.parts["head"]
    turned = Part(head.faces[::-1].copy(), head.rest, head.verts)
    write_sequence(tmp_path / "m.npz", MeshSequence(meshes.frames, {**meshes.parts, "head": turned}, {}), {})
    assert render(trained, tmp_path / "x.zip", trained["packs"][2:], {}, str(tmp_path / "m.npz")) == 2
    assert "head.faces: expected the 8 faces the avatar was trained on" in capsys.readouterr().err
    write_sequence(tmp_path / "h.npz", MeshSequence(meshes.frames, {"head": head}, {}), {})
    assert render(trained, tmp_path / "x.zip", trained["packs"][2:], {}, str(tmp_path / "h.npz")) == 2
    assert "right_hand: expected this part of the avatar" in capsys.readouterr().err
    assert not (tmp_path / "x.zip").exists()


def test_render_refuses_an_unknown_split(trained, tmp_path, capsys) -> None:
    assert render(trained, tmp_path / "x.zip", trained["packs"][2:], {"split": "nv"}) == 2
    assert "expected one of novel_view" in capsys.readouterr().err


def test_an_avatar_driven_by_another_subject_is_rendered_in_that_ones_poses_with_its_own_shape(
    trained, tmp_path
) -> None:
    """The other one is a quarter larger, turns both parts by known angles, and has frames and crops of its own."""
    own, _ = read_sequence(trained["meshes"])
    turns = [np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]]) for a in (0.2, 0.5, 0.9)]
    moves = np.array([[0.03, 0.0, 0.0], [0.0, 0.04, 0.0], [-0.05, 0.0, 0.02]])
    names = ["a0", "a1", "a2"]

    def posed(rest: np.ndarray, centres: np.ndarray) -> np.ndarray:
        local = rest - rest.mean(0)
        return np.stack([local @ turn.T + c for turn, c in zip(turns, centres, strict=True)]).astype(np.float32)

    parts = {
        name: Part(part.faces, 1.25 * part.rest, posed(1.25 * part.rest, 1.25 * part.rest.mean(0) + moves))
        for name, part in own.parts.items()
    }
    scene = write_scene(tmp_path / "other", meshes=MeshSequence(names, parts, {}))
    driven = tmp_path / "driven.npz"
    arguments = ["--source", trained["meshes"], "--target", str(scene["meshes"]), "--place", "target", "--free-hands"]
    assert main(["reenact", *arguments, "--out", str(driven)]) == 0
    found, _ = read_sequence(driven)
    packs = [str(scene["packs"][1])]
    assert render(trained, tmp_path / "driven.zip", packs, {"split": "all"}, str(driven)) == 0

    # What the pictures should show: the avatar's own rest shape under the other one's motion.
    expected = {}
    for name, part in own.parts.items():
        np.testing.assert_allclose(found.parts[name].verts.mean(1), parts[name].verts.mean(1), atol=1e-5)
        expected[name] = Part(part.faces, part.rest, posed(part.rest, parts[name].verts.mean(1)))
    write_sequence(tmp_path / "expected.npz", MeshSequence(names, expected, {"driver": np.array(names)}), {})
    assert render(trained, tmp_path / "expected.zip", packs, {"split": "all"}, str(tmp_path / "expected.npz")) == 0
    with FramePack(tmp_path / "driven.zip") as one, FramePack(tmp_path / "expected.zip") as other:
        assert one.frames == [f"cam1/{name}" for name in names]
        pictures = [one.read("rgb", name).astype(int) for name in one.frames]
        masks = [one.read("nb_alpha", name) for name in one.frames]
        for name, picture in zip(one.frames, pictures, strict=True):
            # Vertices agree to a few micrometres, which moves a value by a level at most.
            assert np.abs(picture - other.read("rgb", name)).max() <= 1
    assert all(mask.max() > 200 and mask.min() == 0 for mask in masks)
    assert np.abs(masks[0].astype(int) - masks[2]).max() > 100
