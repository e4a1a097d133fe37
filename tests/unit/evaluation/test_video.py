"""Videos of an avatar, and the two figures that render: on a toy avatar, through the command line."""

import json
from pathlib import Path

import numpy as np
import pytest

from nbavatar.cli import main
from nbavatar.data.sequences import read_sequence
from nbavatar.errors import DataError
from nbavatar.evaluation.features import principal_colours
from nbavatar.evaluation.orbit import focus, turntable_views
from nbavatar.io.framepack import FramePack
from nbavatar.io.images import decode_image
from nbavatar.io.video import VideoWriter, probe_video, read_video
from tests.scenes.toy import FRAMES, SIZE, write_scene
from tests.scenes.training import train_options

TRAIN = train_options({
    "steps": 4, "texels": 4, "unet": {"width": 4, "depth": 3, "max_width": 8, "convs": 1}, "weight_lpips": 0.0,
    "previews": 0, "coarse_side": 16,
})  # fmt: skip


@pytest.fixture(scope="module")
def avatar(tmp_path_factory):
    """A toy avatar in the places that the workflow would put it."""
    folder = tmp_path_factory.mktemp("avatar")
    scene = write_scene(folder / "scene")
    with FramePack(scene["packs"][0]) as pack:
        subject = str(pack.manifest["subject"])
    model = folder / "train" / subject / "full" / "model.pt"
    meshes = folder / "deform" / f"{subject}.npz"
    meshes.parent.mkdir()
    meshes.write_bytes(Path(scene["meshes"]).read_bytes())
    packs = [str(path) for path in scene["packs"]]
    command = [
        "train", "--frames", *packs[:2], "--meshes", str(meshes), "--spectral", str(scene["spectral"]),
        "--out", str(model), "--device", "cpu", "--cfg", json.dumps(TRAIN),
    ]  # fmt: skip
    assert main(command) == 0
    return {"folder": folder, "subject": subject, "model": str(model), "meshes": str(meshes), "packs": packs}


def video(avatar, out, *extra):
    given = ["--model", avatar["model"], "--meshes", avatar["meshes"], "--camera", avatar["packs"][2]]
    return main(["video", *given, "--device", "cpu", "--out", str(out), *extra])


def test_driven_video_shows_what_render_shows(avatar, tmp_path):
    assert video(avatar, tmp_path / "driven.mp4", "--cfg", '{"codec": "mp4v"}') == 0
    shown = list(read_video(tmp_path / "driven.mp4"))
    assert len(shown) == len(FRAMES) and shown[0].shape == (SIZE, SIZE, 3)
    protocol = json.dumps({"name": "all", "split": "all"})
    command = ["render", "--model", avatar["model"], "--meshes", avatar["meshes"], "--frames", avatar["packs"][2]]
    assert main([*command, "--protocol", protocol, "--out", str(tmp_path / "r.zip"), "--device", "cpu"]) == 0
    with FramePack(tmp_path / "r.zip") as pack:
        for frame, name in zip(shown, pack.frames, strict=True):
            # A lossy codec with halved colour resolution on 48 px of noise-free shapes.
            assert np.abs(frame.astype(int) - pack.read("rgb", name)).mean() < 12
    record = json.loads((tmp_path / "driven.mp4.json").read_text())
    assert record["frames"] == len(FRAMES) and record["record"]["command"] == "video"
    assert main(["video", "--render", str(tmp_path / "r.zip"), "--out", str(tmp_path / "again.mp4")]) == 0
    assert probe_video(tmp_path / "again.mp4").count == len(FRAMES)


def test_turntable_goes_around(avatar, tmp_path):
    assert (
        video(avatar, tmp_path / "turn.mp4", "--kind", "turntable", "--frame", FRAMES[1], "--cfg", '{"seconds": 0.2}')
        == 0
    )
    assert len(list(read_video(tmp_path / "turn.mp4"))) == 5
    sequence, _ = read_sequence(avatar["meshes"])
    with FramePack(avatar["packs"][0]) as pack:
        manifest, K, camera = pack.manifest, pack.intrinsics(pack.frames[0]), pack.cam_from_world
    centre = focus(sequence, 1)
    for arc in (2 * np.pi, 1.0):
        views = turntable_views(sequence, 1, manifest, K, camera, 8, arc=arc)
        places = []
        for view in views:
            pose = view.viewmat.double().numpy()
            np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-6)
            assert np.linalg.det(pose[:3, :3]) > 0
            seen = pose[:3, :3] @ centre + pose[:3, 3]
            np.testing.assert_allclose(seen[:2], 0, atol=1e-6)  # the middle of the picture
            places.append(-pose[:3, :3].T @ pose[:3, 3])
        radius = np.linalg.norm(np.array(places) - centre, axis=1)
        np.testing.assert_allclose(radius, radius[0], rtol=1e-6)
        np.testing.assert_allclose(places[0], -camera[:3, :3].T @ camera[:3, 3], atol=1e-6)
        up = -camera[1, :3]
        np.testing.assert_allclose((np.array(places) - places[0]) @ up, 0, atol=1e-6)
        # A whole turn ends one step before its start; a swing stays within half its arc on either side.
        spread = np.linalg.norm(np.array(places) - places[0], axis=1).max()
        level = radius[0] * np.sqrt(1 - ((places[0] - centre) @ up / radius[0]) ** 2)
        assert spread == pytest.approx(2 * level if arc > 6 else 2 * level * np.sin(arc / 4), rel=1e-5)


@pytest.mark.slow
def test_frames_of_a_reenactment_are_driven_without_packs_of_their_own(avatar, tmp_path):
    out = tmp_path / avatar["subject"] / "other.npz"
    assert main(["reenact", "--source", avatar["meshes"], "--target", avatar["meshes"], "--out", str(out)]) == 0
    assert video(avatar, tmp_path / "re.mp4", "--meshes", str(out), "--cfg", '{"codec": "mp4v", "max_frames": 2}') == 0
    layout = tmp_path / "figures.yaml"
    layout.write_text(
        "cross: {kind: reenactment, title: Cross, frames: 2}\nfeatures: {kind: features, title: Features}\n"
        "contact: {kind: contact, title: Contact}\n"
    )
    given = ["--layout", str(layout), "--models", avatar["model"], "--frames", avatar["packs"][2]]
    for name, sequence, shown in (("cross", str(out), 2), ("features", avatar["meshes"], 1), ("contact", str(out), 0)):
        stem = tmp_path / name
        arguments = ["--figure", name, *given, "--sequences", sequence, "--out-stem", str(stem)]
        assert main(["figure", *arguments]) == 0
        picture = decode_image(stem.with_suffix(".png"))
        assert picture.std() > 3 and stem.with_suffix(".pdf").read_bytes().startswith(b"%PDF")
        assert len(json.loads(stem.with_suffix(".json").read_text())["shown"]) == shown


def test_principal_colours_ignore_scale_and_rotation_of_the_channels(rng):
    alpha = np.zeros((20, 20))
    alpha[4:16, 4:16] = 1
    spread = np.array([3.0, 1.5, 0.7, 0.1, 0.1, 0.05])[:, None, None]
    features = rng.normal(size=(6, 20, 20)) * spread * alpha
    first = principal_colours(features, alpha)
    assert (first[0, 0] == 255).all() and first[4:16, 4:16].std() > 40
    turn, _ = np.linalg.qr(rng.normal(size=(6, 6)))
    second = principal_colours(5 * np.einsum("ij,jhw->ihw", turn, features), alpha).astype(int)
    for channel in range(3):  # a component may change its sign with the axes
        same, flipped = second[..., channel], np.where(alpha > 0, 255 - second[..., channel], 255)
        assert min(np.abs(v - first[..., channel]).max() for v in (same, flipped)) <= 2
    assert (principal_colours(np.zeros((1, 5, 5)), np.ones((5, 5))) == 128).all()


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (["--frame", "nothing", "--kind", "turntable"], "frame nothing: expected a frame of the sequence"),
        (["--cfg", '{"fps": 0}'], "--cfg.fps"),
        (["--render", "x.zip"], "--model, --meshes and --camera, or --render"),
        (["--meshes", "nothing.npz"], "nothing.npz"),
    ],
)
def test_bad_input_is_one_line_and_leaves_no_file(avatar, tmp_path, capsys, extra, message):
    assert video(avatar, tmp_path / "v.mp4", *extra) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert message in error and not list(tmp_path.iterdir())


def test_writer_refuses_changing_sizes_and_no_frames(tmp_path):
    with pytest.raises(DataError, match="one frame or more"), VideoWriter(tmp_path / "a.mp4", 25):
        pass
    with pytest.raises(DataError, match="expected 32x32"), VideoWriter(tmp_path / "a.mp4", 25, "mp4v") as writer:
        writer.add(np.zeros((32, 31, 3), np.uint8))  # odd sizes are padded
        writer.add(np.zeros((40, 32, 3), np.uint8))
    assert not list(tmp_path.iterdir())
