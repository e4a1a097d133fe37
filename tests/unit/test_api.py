"""What `import nbavatar` offers to programs, and the example that shows it."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import nbavatar
from nbavatar.camera.pinhole import project
from nbavatar.data.lights import Light, write_light
from nbavatar.methods.storage import save_avatar
from tests.scenes.toy import camera, sequence, write_scene
from tests.unit.methods.billboards.test_model import make_avatar
from tests.unit.methods.gaussians.test_avatars import bound

ROOT = Path(__file__).resolve().parents[2]
# Public names; programs rely on them, so that none may go or change its meaning without a new major version.
NAMES = {
    "Camera", "NBAvatarError", "Rendered", "__version__", "load_avatar", "load_meshes", "look_at", "pose", "render",
    "train",
}  # fmt: skip


def test_the_names_are_stable_and_cost_nothing_until_they_are_used() -> None:
    assert set(nbavatar.__all__) == NAMES and set(dir(nbavatar)) >= NAMES
    code = (
        "import sys, nbavatar\n"
        "assert not {'torch', 'numpy', 'yaml'} & set(sys.modules), 'loaded at once'\n"
        "assert all(getattr(nbavatar, name) for name in nbavatar.__all__)\n"
        "try: nbavatar.rendr\n"
        "except AttributeError as error: assert 'rendr' in str(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_a_camera_that_looks_at_a_point_shows_it_in_the_middle_and_upright() -> None:
    eye, target = np.array([0.3, 0.2, 1.5]), np.array([0.1, 0.0, 0.0])
    found = nbavatar.look_at(eye, target, up=(0, 1, 0), width=200, height=100, fov=0.5)
    points = np.stack([target, target + [0, 0.01, 0], target + np.cross(eye - target, [0, 1, 0])])
    pixels, depth = project(points, found.K, found.cam_from_world)
    np.testing.assert_allclose(pixels[0], (100, 50), atol=1e-9)
    assert depth[0] == pytest.approx(np.linalg.norm(target - eye))
    assert pixels[1, 1] < 50 and abs(pixels[1, 0] - 100) < 1e-9, "up is up"
    assert pixels[2, 0] < 100, "not mirrored: seen from the front, -x of the camera is left"
    np.testing.assert_allclose(found.cam_from_world @ [*eye, 1], [0, 0, 0, 1], atol=1e-12)
    assert np.linalg.det(found.cam_from_world[:3, :3]) == pytest.approx(1)
    with pytest.raises(nbavatar.NBAvatarError, match="across the direction of view"):
        nbavatar.look_at((0, 1, 0), (0, 0, 0), up=(0, 1, 0))


@pytest.mark.parametrize("make", [make_avatar, bound])
def test_render_and_pose_are_the_avatars_own(tmp_path, make) -> None:
    save_avatar(tmp_path / "model.pt", make())
    avatar = nbavatar.load_avatar(tmp_path / "model.pt")
    vertices = {part: mesh.verts[1] for part, mesh in sequence().parts.items() if part in avatar.parts}
    K = np.array([[60.0, 0, 16.5], [0, 60.0, 15.0], [0, 0, 1]])
    seen = nbavatar.render(avatar, vertices, nbavatar.Camera("c", 33, 30, K, camera(0)), background=(0.1, 0.5, 0.9))
    with torch.no_grad():
        image, alpha, _ = avatar.render(
            {part: torch.tensor(v) for part, v in vertices.items()}, torch.tensor(camera(0)).float(),
            torch.tensor(K).float(), 33, 30, torch.tensor([0.1, 0.5, 0.9]),
        )  # fmt: skip
    assert seen.rgb.shape == (30, 33, 3) and seen.alpha.shape == (30, 33)
    assert np.array_equal(seen.rgb, image.clamp(0, 1).permute(1, 2, 0).numpy())
    assert np.array_equal(seen.alpha, alpha.clamp(0, 1).numpy())
    placed = nbavatar.pose(avatar, vertices)
    moved = nbavatar.pose(avatar, {part: v + np.float32(0.5) for part, v in vertices.items()})
    assert placed["means"].shape == (avatar.primitives, 3) and placed["quats"].shape == (avatar.primitives, 4)
    np.testing.assert_allclose(moved["means"], placed["means"] + 0.5, atol=1e-6)
    with pytest.raises(nbavatar.NBAvatarError, match="expected parts head"):
        nbavatar.render(avatar, {"nose": vertices["head"]}, nbavatar.Camera("c", 33, 30, K, camera(0)))
    bent = nbavatar.Camera("c", 33, 30, K, camera(0), np.array([0.1, 0, 0, 0]))
    with pytest.raises(nbavatar.NBAvatarError, match="camera c: distortion: expected none"):
        nbavatar.render(avatar, vertices, bent)


@pytest.mark.slow
def test_an_avatar_is_trained_from_python_and_the_example_shows_it(tmp_path) -> None:
    scene = write_scene(tmp_path / "scene")
    options = {
        "steps": 3, "previews": 0, "coarse_side": 16, "billboards": {
            "texels": 4, "weight_lpips": 0.0, "unet": {"width": 4, "depth": 3, "max_width": 8, "convs": 1},
            "rates": {"features": 1e-3},
        },
    }  # fmt: skip
    given = {"frames": scene["packs"][:2], "meshes": scene["meshes"], "spectral": scene["spectral"], "device": "cpu"}
    avatar = nbavatar.train(out=tmp_path / "model.pt", **given, **options)
    config = avatar.record["config"]
    assert config["steps"] == 3 and config["billboards"]["rates"]["features"] == 1e-3
    light = Light(np.eye(3, dtype=np.float32), np.array([1, 1, 2], np.float32))
    write_light(tmp_path / "light.npz", light, {})
    lit = nbavatar.train(out=tmp_path / "lit.pt", light=tmp_path / "light.npz", **given, **options)
    assert lit.shading.weights.tolist() == [1, 1, 2] and avatar.shading is None
    with pytest.raises(nbavatar.NBAvatarError, match="unknown key 'stepz'"):
        nbavatar.train(out=tmp_path / "other.pt", **given, stepz=3)
    example = [sys.executable, str(ROOT / "examples" / "render_avatar.py"), "model.pt", "scene/meshes.npz", "new.png"]
    done = subprocess.run(example, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    shown = np.asarray(Image.open(tmp_path / "new.png"))
    assert shown.shape == (512, 512, 3) and "512x512" in done.stdout
    assert np.abs(shown.astype(int) - shown[0, 0]).max(-1).mean() > 0.5, "the avatar is in the picture"
