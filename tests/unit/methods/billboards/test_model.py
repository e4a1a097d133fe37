"""The avatar as one object and one file."""

import subprocess
import sys

import pytest
import torch

from nbavatar.errors import DataError
from nbavatar.math.rotations import axis_angle_to_matrix
from nbavatar.methods.base import compose
from nbavatar.methods.billboards.architecture import Architecture
from nbavatar.methods.billboards.avatar import Avatar
from nbavatar.methods.billboards.billboards import Billboards
from nbavatar.methods.billboards.refine import Refinement
from nbavatar.methods.storage import load_avatar, save_avatar
from tests.scenes.toy import OCTAHEDRON, OCTAHEDRON_FACES, TETRAHEDRON, TETRAHEDRON_FACES

K = torch.tensor([[60.0, 0, 16.5], [0, 60.0, 15.0], [0, 0, 1]])
VIEW = torch.eye(4)
VIEW[2, 3] = 1.0
VERTS = {
    "head": 0.15 * torch.from_numpy(OCTAHEDRON),
    "right_hand": 0.06 * torch.from_numpy(TETRAHEDRON) + torch.tensor([0.2, 0.0, 0.0]),
}


def make_avatar(
    *,
    deferred: bool = True,
    refinement: Refinement | None = None,
    roi: bool = True,
    normals: bool = False,
    gloss: bool = False,
) -> Avatar:
    """An untrained avatar with random values everywhere."""
    torch.manual_seed(3)
    faces = {"head": torch.from_numpy(OCTAHEDRON_FACES), "right_hand": torch.from_numpy(TETRAHEDRON_FACES)}
    channels = 4 if deferred else 3
    billboards = Billboards(torch.full((12, 2), 0.7), torch.randn(12, 4, 4, channels), torch.randn(12, 4, 4))
    architecture = Architecture(channels, 4, deferred, 4, 3, 16, 1, roi, 0.1, "ray", normals=normals, gloss=gloss)
    counts = {"head": 6, "right_hand": 4}
    return Avatar(architecture, faces, counts, billboards, refinement=refinement, record={"command": "test"}).eval()


def render(avatar: Avatar, verts=VERTS, **options):
    background = torch.tensor([0.1, 0.5, 0.9])
    with torch.no_grad():
        return avatar.render(verts, VIEW, K, 33, 30, background, **options)


def test_compose_equals_equation_two() -> None:
    colour, alpha = torch.rand(3, 2, 2), torch.rand(2, 2)
    background = torch.tensor([0.2, 0.4, 0.6])
    image = compose(colour, alpha, background)
    for c in range(3):
        torch.testing.assert_close(image[c], colour[c] * alpha + (1 - alpha) * background[c])


@pytest.mark.parametrize("deferred", [True, False])
@pytest.mark.parametrize("refined", [True, False])
def test_save_and_load_give_the_same_picture_bit_for_bit(tmp_path, deferred: bool, refined: bool) -> None:
    refinement = None
    if refined:
        refinement = Refinement(["a", "b"], {part: torch.randn(len(v), 2) for part, v in VERTS.items()}, rigid=True)
        with torch.no_grad():
            for value in refinement.parameters():
                value += 0.01 * torch.randn(value.shape)
    avatar = make_avatar(deferred=deferred, refinement=refinement)
    save_avatar(tmp_path / "model.pt", avatar)
    again = load_avatar(tmp_path / "model.pt")
    assert again.record == {"command": "test"} and again.parts == ["head", "right_hand"]
    for frame in ("b", None):
        for a, b in zip(render(avatar, frame=frame), render(again, frame=frame), strict=True):
            assert torch.equal(a, b)
    content = torch.load(tmp_path / "model.pt", weights_only=True)
    assert content["format"] == 1 and content["kind"] == "nbavatar avatar"


def test_load_refuses_what_is_not_an_avatar(tmp_path) -> None:
    with pytest.raises(DataError, match="no such file"):
        load_avatar(tmp_path / "absent.pt")
    (tmp_path / "text.pt").write_text("hello")
    with pytest.raises(DataError, match=r"text\.pt: expected an avatar"):
        load_avatar(tmp_path / "text.pt")
    torch.save({"kind": "other"}, tmp_path / "other.pt")
    with pytest.raises(DataError, match="kind"):
        load_avatar(tmp_path / "other.pt")
    save_avatar(tmp_path / "model.pt", make_avatar())
    content = torch.load(tmp_path / "model.pt", weights_only=True)
    torch.save({**content, "format": 99}, tmp_path / "new.pt")
    with pytest.raises(DataError, match="format: expected 1, found 99"):
        load_avatar(tmp_path / "new.pt")
    del content["state"]["billboards.mu"]
    torch.save(content, tmp_path / "lacking.pt")
    with pytest.raises(DataError, match="expected a whole avatar"):
        load_avatar(tmp_path / "lacking.pt")
    data = (tmp_path / "model.pt").read_bytes()
    (tmp_path / "cut.pt").write_bytes(data[: len(data) // 2])
    with pytest.raises(DataError, match=r"cut\.pt: expected an avatar"):
        load_avatar(tmp_path / "cut.pt")


@pytest.mark.parametrize(
    "sizes",
    [
        {"unet_width": 6000, "unet_max_width": 6000},  # 26 GB of weights
        {"unet_convs": 10**9},
        {"unet_depth": 10**9},
        {"texels": 10**6},
        {"channels": 10**7},
        {"unet_form": "lean"},
        {"unet_form": "other"},
    ],
)
def test_sizes_that_the_tensors_do_not_have_are_refused_before_anything_is_made(tmp_path, sizes) -> None:
    save_avatar(tmp_path / "model.pt", make_avatar())
    content = torch.load(tmp_path / "model.pt", weights_only=True)
    content["architecture"] |= sizes
    torch.save(content, tmp_path / "model.pt")
    with pytest.raises(DataError, match="expected a whole avatar, found contents that disagree"):
        load_avatar(tmp_path / "model.pt")


def test_load_never_runs_code_from_a_file(tmp_path) -> None:
    class Hostile:
        def __reduce__(self):
            return (exec, (f"open({str(tmp_path / 'pwned')!r}, 'w')",))

    torch.save({"kind": "nbavatar avatar", "format": 1, "x": Hostile()}, tmp_path / "bad.pt")
    with pytest.raises(DataError, match=r"bad\.pt"):
        load_avatar(tmp_path / "bad.pt")
    assert not (tmp_path / "pwned").exists()


def test_a_part_that_is_absent_in_a_frame_leaves_no_trace() -> None:
    avatar = make_avatar(deferred=False)
    lost = {**VERTS, "right_hand": torch.full((4, 3), float("nan"))}
    posed, keep = avatar.pose(lost)
    assert keep.tolist() == list(range(8)) and len(posed.means) == 8
    without = {"head": VERTS["head"]}
    for a, b in zip(render(avatar, lost), render(avatar, without), strict=True):
        assert torch.equal(a, b)
    assert not torch.equal(render(avatar)[2], render(avatar, lost)[2])


def test_an_avatar_without_any_part_in_a_frame_shows_the_background() -> None:
    image, alpha, nb_alpha = render(make_avatar(deferred=False), {})
    assert nb_alpha.max() == 0 and alpha.max() == 0
    torch.testing.assert_close(image, torch.tensor([0.1, 0.5, 0.9])[:, None, None].expand(3, 30, 33))


def test_pose_refuses_meshes_of_another_size() -> None:
    with pytest.raises(DataError, match="head: expected 6 vertices"):
        make_avatar().pose({**VERTS, "head": torch.zeros(5, 3)})


def test_without_deferred_rendering_the_picture_is_the_billboards_own() -> None:
    avatar = make_avatar(deferred=False)
    background = torch.tensor([0.1, 0.5, 0.9])
    posed, keep = avatar.pose(VERTS)
    window = avatar.window(posed, keep, VIEW, K, 33, 30, roi=False)
    expected = window.features + (1 - window.nb_alpha) * background[:, None, None]
    torch.testing.assert_close(render(avatar, roi=False)[0], expected, atol=1e-6, rtol=0)
    torch.testing.assert_close(render(avatar)[0], expected, atol=1e-4, rtol=0)


def test_gradients_without_deferred_rendering_are_those_of_blending() -> None:
    avatar = make_avatar(deferred=False)
    background = torch.tensor([0.1, 0.5, 0.9])
    posed, keep = avatar.pose(VERTS)
    gradients = []
    for direct in (True, False):
        window = avatar.window(posed, keep, VIEW, K, 33, 30, roi=False)
        if direct:
            image = window.features + (1 - window.nb_alpha) * background[:, None, None]
        else:
            image = compose(window.colour, window.alpha, background)
        parameters = list(avatar.billboards.parameters())
        gradients.append(torch.autograd.grad(image.square().sum(), parameters, retain_graph=True))
    for a, b in zip(*gradients, strict=True):
        torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-3)


def test_window_sizes_need_not_divide() -> None:
    image, alpha, nb_alpha = render(make_avatar(roi=False))
    assert image.shape == (3, 30, 33) and alpha.shape == nb_alpha.shape == (30, 33)


def test_half_precision_stays_near() -> None:
    exact, near = render(make_avatar())[0], render(make_avatar(), precision="bf16")[0]
    assert (exact - near).abs().mean() < 0.02


def test_refinement_is_centred_over_its_frames() -> None:
    basis = {part: torch.randn(len(v), 2) for part, v in VERTS.items()}
    refinement = Refinement(["a", "b"], basis, rigid=True)
    with torch.no_grad():
        refinement.get_parameter("shift_head")[:] = torch.tensor([[0.0, 0.1, 0.0], [0.0, 0.3, 0.0]])
    refinement.centre()
    for frame, shift in (("a", -0.1), ("b", 0.1)):
        moved = refinement("head", VERTS["head"], frame)[0]
        torch.testing.assert_close(moved, VERTS["head"] + torch.tensor([0.0, shift, 0.0]))


def test_refinement_leaves_unknown_frames_alone_and_starts_at_zero() -> None:
    basis = {part: torch.randn(len(verts), 3) for part, verts in VERTS.items()}
    refinement = Refinement(["a"], basis, rigid=True)
    moved, penalty = refinement("head", VERTS["head"], "a")
    torch.testing.assert_close(moved, VERTS["head"], atol=1e-6, rtol=0)
    assert penalty == 0
    with torch.no_grad():
        refinement.get_parameter("shift_head")[0] = torch.tensor([0.0, 0.1, 0.0])
    torch.testing.assert_close(refinement("head", VERTS["head"], "a")[0], VERTS["head"] + torch.tensor([0, 0.1, 0]))
    assert refinement("head", VERTS["head"], "held out")[0] is VERTS["head"]


def test_importing_the_model_loads_nothing_heavy() -> None:
    modules = "methods.billboards.avatar", "evaluation.render", "evaluation.speed", "training.loop", "data.views"
    code = "import sys, " + ", ".join(f"nbavatar.{name}" for name in modules)
    code += "; heavy = {'cv2', 'igl', 'scipy', 'trimesh', 'OpenEXR', 'matplotlib', 'pandas'} & set(sys.modules)"
    code += "; assert not heavy, heavy"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_decoder_that_sees_normals_is_told_how_the_head_is_turned(tmp_path) -> None:
    """Head and camera turned together: the same billboards in the picture, their normals turned."""
    turn = torch.eye(4)
    turn[:3, :3] = axis_angle_to_matrix(torch.tensor([0.3, 2.0, -0.5]))
    turned = {part: points @ turn[:3, :3].T for part, points in VERTS.items()}
    avatar = make_avatar(normals=True)
    with torch.no_grad():
        still = avatar.window(*avatar.pose(VERTS), VIEW, K, 33, 30, roi=False)
        moved = avatar.window(*avatar.pose(turned), VIEW @ turn.T, K, 33, 30, roi=False)
    assert still.features.shape[0] == 4 + 3
    expected = torch.cat((still.features[:4], torch.einsum("ij,jhw->ihw", turn[:3, :3], still.features[4:])))
    off = (moved.features - expected).abs().amax(0) > 1e-3
    assert off.float().mean() < 0.05  # where symmetric billboards cross, rounding decides which one is in front
    assert (moved.features[4:] - still.features[4:]).abs().max() > 0.5
    save_avatar(tmp_path / "model.pt", avatar)
    for a, b in zip(render(avatar), render(load_avatar(tmp_path / "model.pt")), strict=True):
        assert torch.equal(a, b)


def test_a_decoder_that_sees_gloss_is_told_where_faces_mirror_the_camera_to(tmp_path) -> None:
    avatar = make_avatar(normals=True, gloss=True)
    posed, _ = avatar.pose(VERTS)
    told = avatar.light_and_gloss(posed, VIEW)
    assert told.shape == (12, 3 + 3)
    eye = torch.tensor([0.0, 0.0, -1.0])
    for f in range(12):
        # Householder: the mirror at the face's plane, of what travels from the camera to the billboard.
        normal = told[f, :3].double()
        sight = torch.nn.functional.normalize(posed.means[f].detach().double() - eye.double(), dim=0)
        expected = (torch.eye(3).double() - 2 * torch.outer(normal, normal)) @ sight
        torch.testing.assert_close(told[f, 3:].double(), expected, atol=1e-6, rtol=0)
    # From elsewhere the same pose is told otherwise.
    other = VIEW.clone()
    other[0, 3] = 0.4
    assert (avatar.light_and_gloss(posed, other) - told)[:, 3:].abs().max() > 0.1
    save_avatar(tmp_path / "model.pt", avatar)
    for a, b in zip(render(avatar), render(load_avatar(tmp_path / "model.pt")), strict=True):
        assert torch.equal(a, b)


def test_nothing_moves_or_fades_for_gloss() -> None:
    avatar = make_avatar(normals=True, gloss=True)
    posed, keep = avatar.pose(VERTS)
    window = avatar.window(posed, keep, VIEW, K, 33, 30, roi=False)
    for channel, moves in ((2, True), (5, True), (8, False)):
        grads = torch.autograd.grad(
            window.features[channel].sum(), [avatar.billboards.mu, avatar.billboards.alpha_logit], retain_graph=True,
            allow_unused=True,
        ) if window.features[channel].requires_grad else [None]  # fmt: skip
        assert any(g is not None and bool(g.abs().max() > 0) for g in grads) == moves


def test_files_from_before_there_were_forms_hold_the_papers(tmp_path) -> None:
    avatar = make_avatar()
    save_avatar(tmp_path / "model.pt", avatar)
    content = torch.load(tmp_path / "model.pt", weights_only=True)
    assert content["architecture"].pop("unet_form") == "paper"
    assert content["architecture"].pop("normals") is False
    assert content["architecture"].pop("shading") is False
    assert content["architecture"].pop("gloss") is False
    torch.save(content, tmp_path / "model.pt")
    for a, b in zip(render(avatar), render(load_avatar(tmp_path / "model.pt")), strict=True):
        assert torch.equal(a, b)
