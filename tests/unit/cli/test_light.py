"""`nbavatar light` on pictures that were drawn in a known light, and a training that is told."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from nbavatar.cli import main
from nbavatar.data.lights import read_light
from nbavatar.data.sequences import MeshSequence, Part, read_sequence, write_sequence
from nbavatar.io.arrays import read_arrays, write_arrays
from nbavatar.io.framepack import FramePack, FramePackWriter
from nbavatar.io.images import decode_image
from nbavatar.mesh.incidence import incidence
from nbavatar.mesh.zbuffer import rasterize_mesh
from tests.scenes.toy import camera
from tests.unit.mesh.shapes import face_normals, sphere

SIZE, FRAMES, LAMP = 128, 9, np.array([[0.6, -0.64, -0.48]])  # towards the cameras' side, from above
K = np.array([[2.2 * SIZE, 0, 0.5 * SIZE], [0, 2.2 * SIZE, 0.5 * SIZE], [0, 0, 1]])


@pytest.fixture(scope="module")
def studio(tmp_path_factory):
    """A patched ball for a head, which turns in the light of a lamp and a little from everywhere; two cameras."""
    folder = tmp_path_factory.mktemp("studio")
    rest, faces = sphere(3, 0.15)
    turns = Rotation.from_euler("yxz", [[14.0 * n, 9.0 * n, 5.0 * n] for n in range(FRAMES)], degrees=True).as_matrix()
    verts = (rest @ turns.swapaxes(1, 2)).astype(np.float32)
    names = [f"f{n}" for n in range(FRAMES)]
    write_sequence(folder / "meshes.npz", MeshSequence(names, {"head": Part(faces, rest, verts)}, {}), {})
    write_arrays(folder / "spectral.npz", {"head.coords": (rest / 0.15).astype(np.float32)}, {})
    albedo = np.random.default_rng(1).uniform(0.15, 0.6, (len(faces), 3))
    paths = {"frames": [], "masks": [], "dark": []}
    for index in (0, 2):
        view = camera(index)
        base = {
            "subject": "toy", "camera": f"cam{index}", "width": SIZE, "height": SIZE, "K": K.tolist(),
            "cam_from_world": view.tolist(), "distortion": None, "frames": names,
            "split": dict.fromkeys(names, "train"), "segments": [[0, FRAMES - 1]], "record": {},
        }  # fmt: skip
        pictures = []
        for placed in verts.astype(np.float64):
            shine = 0.3 + 1.1 * incidence(placed, faces, face_normals(placed, faces), LAMP)[0]
            face, _, _ = rasterize_mesh(placed, faces, K, SIZE, SIZE, cam_from_world=view)
            linear = np.where((face >= 0)[..., None], (albedo * shine[:, None])[face], 0.02)
            srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
            pictures.append(((255 * np.clip(srgb, 0, 1)).round().astype(np.uint8), (face >= 0).astype(np.uint8)))
        for kind, layers in (("frames", ("rgb",)), ("masks", ("label", "alpha")), ("dark", ("rgb", "label", "alpha"))):
            paths[kind].append(folder / f"{kind}{index}.zip")
            manifest = base | {"stage": "crop", "layers": dict.fromkeys(layers, "")}
            with FramePackWriter(paths[kind][-1], manifest) as pack:
                for frame, (rgb, label) in zip(names, pictures, strict=True):
                    drawn = {"rgb": rgb if kind == "frames" else 0 * rgb, "label": label, "alpha": 255 * label}
                    for layer in layers:
                        pack.add(layer, frame, drawn[layer])
    return folder, {kind: [str(path) for path in found] for kind, found in paths.items()}


def _light(folder, paths, *words: str, frames: str = "frames") -> int:
    given = ["--meshes", str(folder / "meshes.npz"), "--frames", *paths[frames], "--masks", *paths["masks"]]
    return main(["light", *given, *words])


def test_the_lamp_is_found_and_drawn(studio, tmp_path, capsys) -> None:
    folder, paths = studio
    out, picture = tmp_path / "light.npz", tmp_path / "light.png"
    words = ["--out", str(out), "--set", "lights=16", "--set", "directions=96", "--set", "picture_size=64"]
    assert _light(folder, paths, *words, "--picture", str(picture)) == 0
    assert "of how skin changes in frames left out" in capsys.readouterr().out
    light = read_light(out)
    # Light from everywhere has no mean direction, so that of all lights is the lamp's.
    mean = light.weights @ light.directions
    assert mean @ LAMP[0] / np.linalg.norm(mean) > np.cos(np.radians(15.0))
    assert read_arrays(out)[1]["light"]["explained"] > 0.8
    shown = decode_image(picture.read_bytes())
    assert shown.shape == (128, (4 + 4) * 64, 3)
    # The ball in the light, grey, is brighter towards the lamp (up and right in the picture) than away from it.
    ball = shown[64:, :64].astype(float)
    assert ball[12:28, 36:52].mean() > ball[36:52, 12:28].mean() + 20
    once = out.read_bytes()
    assert _light(folder, paths, *words) == 0 and out.read_bytes() == once


def test_a_shell_keeps_no_light_from_the_head(studio, tmp_path) -> None:
    """Locks around the head: skin is seen between them, and is lit as if they were not there."""
    folder, paths = studio
    meshes, _ = read_sequence(folder / "meshes.npz")
    head = meshes.parts["head"]
    locks = head.faces[np.random.default_rng(0).random(len(head.faces)) < 0.5]
    parts = {"head": head, "shell": Part(locks, 1.2 * head.rest, 1.2 * head.verts)}
    write_sequence(tmp_path / "meshes.npz", MeshSequence(meshes.frames, parts, {}), {})
    words = ["--out", str(tmp_path / "light.npz"), "--set", "lights=16", "--set", "directions=96"]
    assert _light(tmp_path, paths, *words) == 0
    light = read_light(tmp_path / "light.npz")
    mean = light.weights @ light.directions
    assert mean @ LAMP[0] / np.linalg.norm(mean) > np.cos(np.radians(15.0))
    assert read_arrays(tmp_path / "light.npz")[1]["light"]["explained"] > 0.8


def test_where_nothing_is_seen_there_is_no_light_and_training_goes_on_without(studio, tmp_path, capsys) -> None:
    folder, paths = studio
    out = tmp_path / "light.npz"
    assert _light(folder, paths, "--out", str(out), "--set", "lights=16", frames="dark") == 0
    assert capsys.readouterr().out.startswith("no light: 0 faces")
    assert len(read_light(out).weights) == 0


def test_a_training_is_told(studio, tmp_path) -> None:
    folder, paths = studio
    assert _light(folder, paths, "--out", str(tmp_path / "light.npz"), "--set", "lights=8") == 0
    crops = []
    for rgb, mask in zip(paths["frames"], paths["masks"], strict=True):
        crops.append(str(tmp_path / rgb.rpartition("/")[2]))
        with FramePack(rgb) as one, FramePack(mask) as other:
            with FramePackWriter(
                crops[-1], one.manifest | {"layers": dict.fromkeys((*one.layers, *other.layers), "")}
            ) as pack:
                for frame in one.frames:
                    pack.add("rgb", frame, one.read("rgb", frame))
                    for layer in ("label", "alpha"):
                        pack.add(layer, frame, other.read(layer, frame))
    few = ["--set", "steps=2", "--set", "billboards.texels=2", "--set", "billboards.weight_lpips=0"]
    given = ["--frames", *crops, "--meshes", str(folder / "meshes.npz"), "--spectral", str(folder / "spectral.npz")]
    for name, words in (("lit", ["--light", str(tmp_path / "light.npz")]), ("off", ["--light"]), ("without", [])):
        assert main(["train", *given, *words, *few, "--out", str(tmp_path / f"{name}.pt"), "--device", "cpu"]) == 0
        content = torch.load(tmp_path / f"{name}.pt", weights_only=True)
        assert content["architecture"]["shading"] == (name == "lit") == ("shading.weights" in content["state"])
    refused = ["--light", str(tmp_path / "absent.npz"), "--out", str(tmp_path / "x.pt")]
    assert main(["train", *given, *few, *refused]) == 2 and not (tmp_path / "x.pt").exists()


def test_masks_of_other_cameras_are_refused(studio, tmp_path, capsys) -> None:
    folder, paths = studio
    one = {"frames": paths["frames"], "masks": paths["masks"][:1]}
    assert _light(folder, one, "--out", str(tmp_path / "light.npz")) == 2
    assert "--masks: expected masks of cam0, cam2, found cam0" in capsys.readouterr().err
    assert not (tmp_path / "light.npz").exists()
