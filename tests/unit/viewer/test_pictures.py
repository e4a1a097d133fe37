"""Pictures of the viewer, against what `render` and plain arithmetic give."""

import numpy as np
import pytest
import torch

from nbavatar.camera.pinhole import facing_pose, project
from nbavatar.data.sequences import read_sequence
from nbavatar.io.framepack import FramePack
from nbavatar.math.rotations import matrix_to_quaternion
from nbavatar.methods.billboards.engine import installed_engines
from nbavatar.viewer.eye import Eye, free_eye, pose_of, view_angle
from nbavatar.viewer.pictures import SHOWS, Request, draw
from nbavatar.viewer.scene import Entry, Scene
from tests.scenes.toy import SIZE, camera, sequence, write_scene
from tests.unit.methods.billboards.test_model import make_avatar
from tests.unit.methods.interact_avatar.scenes import made, stirred

GREEN = (0.0, 0.5, 0.2)


@pytest.fixture
def scene(tmp_path):
    """The toy capture with two avatars, one of them without deferred rendering."""
    paths = write_scene(tmp_path)
    sequence, _ = read_sequence(paths["meshes"])
    packs = [FramePack(path) for path in paths["packs"]]
    entries = [Entry(name, lambda d=deferred: (make_avatar(deferred=d), sequence)) for name, deferred in
               (("full", True), ("no_dnr", False))]  # fmt: skip
    return Scene(entries, {str(pack.manifest["camera"]): pack for pack in packs})


def eye_of(scene, name: str = "cam0", frame: str = "f1", aspect: float = 1.0) -> Eye:
    return Eye(*scene.camera(name, frame), aspect, name)


def rendered(scene, name: str, frame: str, side: int, background=GREEN) -> np.ndarray:
    entry, (K, pose, width, _) = scene.entries[name], scene.camera("cam0", frame)
    K = np.diag([side / width, side / width, 1.0]) @ K
    verts, own = entry.vertices(frame, "cpu")
    with torch.no_grad():
        image, _, _ = entry.avatar.render(
            verts, torch.tensor(pose).float(), torch.tensor(K).float(), side, side, torch.tensor(background), frame=own
        )
    return image.permute(1, 2, 0).numpy()


def test_a_chosen_camera_shows_what_render_gives_at_any_size(scene) -> None:
    for side in (SIZE, 24):
        drawn = draw(scene, Request(eye_of(scene), "f1", "full", background=GREEN), side)
        assert drawn.size == (side, side)
        np.testing.assert_allclose(drawn.image / 255.0, rendered(scene, "full", "f1", side), atol=0.51 / 255)


def test_the_wipe_has_one_avatar_on_either_side(scene) -> None:
    request = Request(eye_of(scene), "f2", "full", "no_dnr", wipe=0.25, background=GREEN)
    shown = draw(scene, request, SIZE).image / 255.0
    left, right = (rendered(scene, name, "f2", SIZE) for name in ("full", "no_dnr"))
    border = SIZE // 4
    np.testing.assert_allclose(shown[:, : border - 1], left[:, : border - 1], atol=0.51 / 255)
    np.testing.assert_allclose(shown[:, border + 1 :], right[:, border + 1 :], atol=0.51 / 255)


def test_the_error_is_the_difference_to_the_recorded_picture(scene) -> None:
    request = Request(eye_of(scene), "f1", "no_dnr", show="error", background=GREEN)
    drawn = draw(scene, request, 512)
    assert drawn.size == (SIZE, SIZE), "there is no truth of another size"
    pack = scene.packs["cam0"]
    alpha = pack.read("alpha", "f1")[..., None] / 255.0
    truth = pack.read("rgb", "f1") / 255.0 * alpha + (1 - alpha) * np.array(GREEN)
    difference = np.abs(np.clip(rendered(scene, "no_dnr", "f1", SIZE), 0, 1) - truth)
    psnr = -10 * np.log10((difference**2).mean())
    assert any(f"{psnr:.2f} dB" in remark for remark in drawn.remarks)
    brightness = drawn.image.astype(int).sum(-1)
    strength = difference.mean(-1)
    assert strength.min() < 0.02 and strength.max() > 0.25
    order = np.argsort(strength, axis=None)
    assert (np.diff(brightness.ravel()[order]) >= -3).all(), "a larger error is drawn brighter"


def test_every_picture_fits_the_canvas_and_shows_the_avatar(scene) -> None:
    for show in SHOWS:
        drawn = draw(scene, Request(eye_of(scene, aspect=2.0), "f0", "full", show=show), SIZE)
        assert drawn.image.shape == (SIZE, 2 * SIZE, 3) and drawn.size == (SIZE, SIZE)
        middle = drawn.image[:, SIZE // 2 : -SIZE // 2]
        assert (middle != middle[0, 0]).any(-1).mean() > 0.05, show
    without = draw(scene, Request(eye_of(scene), "f0", "no_dnr", show="features"), SIZE)
    assert without.remarks[0] == "no_dnr has no features: its render"


@pytest.mark.parametrize("kind", ["eager", *installed_engines()])
def test_a_picture_names_what_decoded_it(scene, kind: str) -> None:
    name = scene.entries["full"].avatar.use_engine(kind)
    decoder = f"torch {torch.__version__}" if kind == "eager" else name
    for show, second, decoders in (
        ("render", "", [decoder]), ("alpha", "no_dnr", [decoder]), ("billboards", "", []), ("features", "", []),
    ):  # fmt: skip
        assert draw(scene, Request(eye_of(scene), "f1", "full", second, show=show), SIZE).decoders == decoders
    assert draw(scene, Request(eye_of(scene), "f1", "no_dnr"), SIZE).decoders == []
    # Too small for an engine: one row of pixels at the deepest level.
    small = draw(scene, Request(eye_of(scene), "f1", "full"), 8).decoders
    assert small == [f"torch {torch.__version__}"]


def test_the_first_view_is_the_middle_cameras_and_shows_the_avatar_without_cameras(scene) -> None:
    view, pose = scene.first_view(), camera(1)
    np.testing.assert_allclose(facing_pose(view.position, view.look_at, scene.up), pose, atol=1e-12)
    alone = Scene(list(scene.entries.values()), {})
    view = alone.first_view()
    points = np.concatenate([part.verts[0] for part in alone.entries["full"].sequence.parts.values()])
    focal = 0.5 / np.tan(0.5 * view.fov)
    K = np.array([[focal, 0, 0.5], [0, focal, 0.5], [0, 0, 1]])
    pixels, depth = project(points, K, facing_pose(view.position, view.look_at, alone.up))
    head = pixels[:6]
    assert (depth > 0).all() and 0 < head.min() and head.max() < 1 and np.ptp(head[:, 1]) > 0.5


def test_gaussians_that_a_pose_changes_are_shown_with_that_poses_opacity(scene) -> None:
    avatar = stirred(made(sequence())).avatar.eval()
    scene.entries["touched"] = Entry("touched", lambda: (avatar, sequence()))
    shown = []
    for colour in ((0.0,) * 3, (1.0,) * 3):
        drawn = draw(scene, Request(eye_of(scene), "f2", "touched", show="billboards", background=colour), SIZE)
        shown.append(drawn.image / 255.0)
    K, pose, *_ = scene.camera("cam0", "f2")
    verts, own = scene.entries["touched"].vertices("f2", "cpu")
    with torch.no_grad():
        view = torch.tensor(pose).float(), torch.tensor(K).float()
        alpha = avatar.render(verts, *view, SIZE, SIZE, torch.zeros(3), frame=own)[1].numpy()
    assert alpha.max() > 0.1
    for channel in range(3):
        np.testing.assert_allclose(1 - (shown[1] - shown[0])[..., channel], alpha, atol=1.01 / 255)


def test_the_browsers_camera_is_a_pinhole_of_the_conventions() -> None:
    pose = camera(2)
    position, forward, up = pose_of(pose)
    np.testing.assert_allclose(pose[:3, :3] @ forward, [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(pose[:3, :3] @ up, [0, -1, 0], atol=1e-12)
    wxyz = matrix_to_quaternion(torch.tensor(pose[:3, :3].T)).numpy()
    eye = free_eye(wxyz, position, 0.6, 300, 200)
    np.testing.assert_allclose(eye.cam_from_world, pose, atol=1e-12)
    # A point on the upper border of the angle of view lies on the upper border of the canvas.
    above = position + forward + np.tan(0.3) * up
    pixels, depth = project(above[None], eye.K, eye.cam_from_world)
    np.testing.assert_allclose((*pixels[0], depth[0]), (150, 0, 1), atol=1e-9)
    K = np.array([[100.0, 0, 40], [0, 100, 40], [0, 0, 1]])
    assert view_angle(K, 80, 80, 2.0) == pytest.approx(2 * np.arctan(0.4))
    assert view_angle(K, 80, 80, 0.5) == pytest.approx(2 * np.arctan(0.8)), "a narrow canvas needs more"
