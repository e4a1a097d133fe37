"""Where the baselines put their Gaussians, what their losses are, when their calendars act."""

import subprocess
import sys

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from nbavatar.data.views import Sample, View
from nbavatar.math.rotations import axis_angle_to_matrix, quaternion_to_matrix
from nbavatar.methods.gaussian_avatars.avatar import GaussianAvatars
from nbavatar.methods.gaussians.density import Statistics, densify
from nbavatar.methods.gaussians.losses import Pair, compare
from nbavatar.methods.gaussians.training import Calendar, camera_extent
from nbavatar.methods.splatting_avatar.avatar import SplattingAvatar
from nbavatar.methods.splatting_avatar.training import nearest_distances, sample_surface
from nbavatar.optimization.adam import Adam
from tests.scenes.toy import OCTAHEDRON, OCTAHEDRON_FACES

REST = torch.from_numpy(0.15 * OCTAHEDRON)
FACES = torch.from_numpy(OCTAHEDRON_FACES)


def bound() -> GaussianAvatars:
    avatar = GaussianAvatars({"head": FACES}, {"head": 6}, colour=torch.zeros(8, 3), opacity=0.1, sh_degree=1)
    with torch.no_grad():
        random = torch.Generator().manual_seed(0)
        avatar.offset.normal_(generator=random)
        avatar.quat.normal_(generator=random)
        avatar.log_scale.normal_(generator=random)
    return avatar


def embedded(mode: str, count: int = 50) -> SplattingAvatar:
    random = torch.Generator().manual_seed(0)
    face, bary = sample_surface(REST, FACES, count, random, by_area=True)
    avatar = SplattingAvatar(
        {"head": FACES}, {"head": 6}, rest=REST, face=face, bary=bary, log_scale=torch.full((count, 3), -4.0),
        opacity=0.1, sh_degree=0, mode=mode,
    )  # fmt: skip
    with torch.no_grad():
        avatar.uvd.normal_(generator=random).mul_(0.05)
        avatar.quat.normal_(generator=random)
        avatar.log_scale += 0.3 * torch.randn((count, 3), generator=random)
    return avatar


@pytest.mark.parametrize("make", [bound, lambda: embedded("paper"), lambda: embedded("released")])
def test_gaussians_ride_rigidly_on_a_rigidly_moving_mesh(make) -> None:
    avatar = make()
    turn = axis_angle_to_matrix(torch.tensor([0.4, -0.9, 0.6]))
    shift = torch.tensor([0.3, -0.1, 2.0])
    still, moved = (avatar.pose(avatar.anchor({"head": verts})) for verts in (REST, REST @ turn.T + shift))
    torch.testing.assert_close(moved.means, still.means @ turn.T + shift, atol=2e-6, rtol=0)
    torch.testing.assert_close(moved.scales, still.scales, atol=2e-6, rtol=1e-5)
    covariances = []
    for posed in (still, moved):
        axes = quaternion_to_matrix(posed.quats) * posed.scales[:, None]
        covariances.append(axes @ axes.transpose(1, 2))
    expected = turn @ covariances[0] @ turn.T
    torch.testing.assert_close(covariances[1], expected, atol=3e-6 * float(expected.abs().max()) + 1e-9, rtol=1e-4)


def test_bound_gaussians_start_in_the_triangles_and_grow_with_them() -> None:
    avatar = GaussianAvatars({"head": FACES}, {"head": 6}, colour=torch.zeros(8, 3), opacity=0.1, sh_degree=3)
    small, large = (avatar.pose(avatar.anchor({"head": size * REST})) for size in (1.0, 3.0))
    torch.testing.assert_close(small.means, REST[FACES].mean(1))
    torch.testing.assert_close(large.scales, 3 * small.scales)
    corners = REST[FACES]
    edge = corners[:, 1] - corners[:, 0]
    area = torch.linalg.cross(edge, corners[:, 2] - corners[:, 0]).norm(dim=1)
    # Mean of the first edge and the height over it.
    size = 0.5 * (edge.norm(dim=1) + area / edge.norm(dim=1))
    torch.testing.assert_close(small.scales, size[:, None].expand(-1, 3))
    assert avatar.colour_rest.shape == (8, 15, 3)


def test_embedded_gaussians_sit_on_the_surface_at_their_height() -> None:
    avatar = embedded("paper")
    with torch.no_grad():
        avatar.uvd.zero_()
    verts = {"head": REST * torch.tensor([1.0, 1.3, 0.8])}
    anchor = avatar.anchor(verts)
    flat = avatar.pose(anchor).means
    expected = (avatar.bary[..., None] * verts["head"][FACES[avatar.face]]).sum(1)
    torch.testing.assert_close(flat, expected)
    with torch.no_grad():
        avatar.uvd[:, 2] = 0.02
    high = avatar.pose(anchor).means
    torch.testing.assert_close((high - flat).norm(dim=1), torch.full((50,), 0.02), atol=1e-6, rtol=0)
    assert ((high - flat) * flat).sum(1).min() > 0  # outwards
    # The steps u, v pull at the position in the one mode and at nothing in the other.
    for mode in ("paper", "released"):
        other = embedded(mode)
        other.pose(other.anchor(verts)).means.square().sum().backward()
        assert bool((other.uvd.grad[:, :2].abs() > 0).any()) == (mode == "paper")


def test_scales_follow_the_area_as_each_mode_says() -> None:
    twice = {"head": 2.0 * REST}
    paper, released = embedded("paper"), embedded("released")
    with torch.no_grad():
        local = paper.log_scale.exp()
        torch.testing.assert_close(paper.pose(paper.anchor(twice)).scales, 2 * local, rtol=1e-4, atol=0)
        a, b, c = (REST[FACES[:, i]] for i in range(3))
        area = 0.5 * torch.linalg.cross(b - a, c - a).norm(dim=1)[released.face, None]
        ratio = (4 * area + 1e-4) / (area + 1e-4)
        expected = (released.log_scale * ratio).exp()
        torch.testing.assert_close(released.pose(released.anchor(twice)).scales, expected, rtol=1e-4, atol=0)


def test_a_stretch_of_rotations_across_half_a_turn_stays_whole() -> None:
    # Neighbouring faces turned by just under and just over half a turn have quaternions of opposite sign.
    angles = torch.linspace(0, 2 * np.pi, 25)[:-1]
    for angle in angles:
        turn = axis_angle_to_matrix(torch.tensor([0.0, 0.0, float(angle)]))
        verts = REST @ turn.T
        verts = verts + 0.02 * torch.randn(6, 3, generator=torch.Generator().manual_seed(1))
        avatar = embedded("paper")
        with torch.no_grad():
            avatar.quat.zero_()
            avatar.quat[:, 0] = 1
            found = quaternion_to_matrix(avatar.pose(avatar.anchor({"head": verts})).quats)
        # Never far from the rotation that all faces share.
        cosine = 0.5 * ((found * turn).sum((1, 2)) - 1)
        assert cosine.min() > 0.8


def test_sampling_is_uniform_by_area_or_by_face() -> None:
    verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [3, 0, 0]])
    faces = torch.tensor([[0, 1, 2], [1, 3, 2]])
    random = torch.Generator().manual_seed(0)
    for by_area, share in ((True, 1 / 3), (False, 1 / 2)):
        face, bary = sample_surface(verts, faces, 20_000, random, by_area=by_area)
        assert float((face == 0).float().mean()) == pytest.approx(share, abs=0.015)  # 4 sigma
        torch.testing.assert_close(bary.sum(1), torch.ones(20_000))
        assert bary.min() >= 0
        torch.testing.assert_close(bary.mean(0), torch.full((3,), 1 / 3), atol=0.01, rtol=0)
        torch.testing.assert_close(bary.var(0), torch.full((3,), 1 / 18), atol=0.003, rtol=0)


def test_nearest_distances() -> None:
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [9, 9, 9]])
    assert float(nearest_distances(points)[0]) == pytest.approx(np.sqrt((1 + 4 + 9) / 3))
    assert torch.isfinite(nearest_distances(points[:1])).all()


def _sample(height: int, width: int) -> Sample:
    random = np.random.default_rng(0)
    pixels = torch.from_numpy(random.uniform(size=(5, 20, 17)).astype(np.float32))
    pixels[:3] *= pixels[3]
    pixels[4] = 0
    view = View(0, "c", "f", 0, width, height, torch.eye(3), torch.eye(4))
    return Sample(view, pixels, 15, 12, width, height, torch.eye(3))


def test_losses_in_the_box_are_those_of_the_whole_picture() -> None:
    sample, background = _sample(60, 70), torch.tensor([0.2, 0.9, 0.5])
    random = torch.Generator().manual_seed(0)
    alpha = torch.zeros(60, 70)
    alpha[25:40, 15:40] = torch.rand((15, 25), generator=random)
    colour = alpha * torch.rand((3, 60, 70), generator=random)
    pair = compare(colour, alpha, sample, background)
    assert pair.alpha.numel() < 60 * 70
    truth = background[:, None, None].expand(3, 60, 70).clone()
    truth[:, 12:32, 15:32] = sample.pixels[:3] + (1 - sample.pixels[3]) * background[:, None, None]
    image = colour + (1 - alpha) * background[:, None, None]
    whole = Pair(image, truth, alpha, 60 * 70)
    torch.testing.assert_close(pair.l1(), (image - truth).abs().mean())
    torch.testing.assert_close(pair.mse(), (image - truth).square().mean())
    torch.testing.assert_close(pair.dssim(), whole.dssim(), atol=1e-6, rtol=0)
    # The content is 11 px off the border, where every way to pad sees two equal pictures: scikit-image's value.
    expected = structural_similarity(
        image.double().numpy(), truth.double().numpy(), gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
        data_range=1.0, channel_axis=0, full=True,
    )[1].mean()  # fmt: skip
    assert 1.0 - float(whole.dssim()) == pytest.approx(expected, abs=2e-5)
    assert float(Pair(truth, truth, alpha, 60 * 70).dssim()) == pytest.approx(0, abs=1e-6)


def test_calendar_keeps_published_intervals_or_scales_them() -> None:
    def times(calendar: Calendar, steps: int, interval: int, floor: int = 1, rest: int = 0) -> list[int]:
        found = []
        for step in range(steps):
            calendar.advance(step, step / steps)
            if calendar.due(interval, floor) and calendar.leaves(rest):
                found.append(step + 1)
        return found

    assert times(Calendar(30_000, 500, scaled=False), 500, 100, 300) == [100, 200, 300, 400, 500]
    # A thirtieth of the steps: the same share of the training, but never more often than the floor.
    assert times(Calendar(30_000, 1_000, scaled=True), 1_000, 3_000) == list(range(100, 1_001, 100))
    assert times(Calendar(30_000, 1_000, scaled=True), 1_000, 100, 250) == [250, 500, 750, 1_000]
    assert times(Calendar(30_000, None, scaled=True), 1_100, 100, 250) == [250, 500, 750, 1_000]  # time decides
    # Opacities that are reset in the last steps leave a translucent avatar.
    assert times(Calendar(30_000, 500, scaled=False), 500, 100, 300, rest=300) == [100, 200, 300, 400, 500]
    assert times(Calendar(30_000, 1_000, scaled=True), 1_000, 100, 250, rest=250) == [250, 500, 750]
    assert times(Calendar(30_000, 1_100, scaled=True), 1_100, 100, 250, rest=250) == [250, 500, 750]
    assert times(Calendar(30_000, None, scaled=True), 1_100, 100, 250, rest=250) == [250, 500, 750]
    assert times(Calendar(30_000, 1_000, scaled=True), 100, 0) == []
    resumed = Calendar(30_000, 1_000, scaled=True)
    resumed.now = 99 * 30.0
    resumed.advance(99, 0.099)
    assert resumed.due(3_000)


def test_statistics_count_views_that_saw_a_gaussian() -> None:
    statistics = Statistics(3)
    gradient = torch.tensor([[3e-4, 4e-4], [1.0, 1.0]])
    statistics.observe(gradient, torch.tensor([2.0, 0.0]), torch.tensor([2, 0]), 200, 200)
    statistics.observe(torch.zeros(3, 2), torch.tensor([0.0, 0.0, 5.0]), None, 200, 200)
    torch.testing.assert_close(statistics.mean(), torch.tensor([0.0, 0.0, 0.025]))
    assert statistics.radius.tolist() == [0.0, 0.0, 5.0]


def test_children_of_a_split_have_its_spread_and_two_thirds_of_its_size() -> None:
    avatar = bound()
    optimizer = Adam([{"params": [getattr(avatar, name) for name in avatar.PARAMETERS], "lr": 0.0}])
    parent, size = avatar.offset[3].detach().clone(), avatar.log_scale[3].detach().clone()
    gradient = torch.zeros(8)
    gradient[3] = 1.0
    source = densify(
        avatar, optimizer, gradient, torch.ones(8), torch.Generator().manual_seed(0), threshold=0.5, split_above=0.5
    )
    assert source.tolist() == [0, 1, 2, 4, 5, 6, 7, 3, 3] and avatar.binding.tolist() == source.tolist()
    torch.testing.assert_close(avatar.log_scale[-2:], (size - np.log(1.6)).expand(2, 3).float())
    noise = torch.randn(20_000, 3, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        rows = torch.full((20_000,), 0)
        places = avatar.offspring(rows, noise)["offset"] - avatar.offset[0]
        axes = quaternion_to_matrix(torch.nn.functional.normalize(avatar.quat[0], dim=0)) * avatar.log_scale[0].exp()
        torch.testing.assert_close(
            places.T @ places / 20_000, axes @ axes.T, atol=0.05 * float(axes.max()) ** 2, rtol=0.1
        )
    assert not torch.equal(parent, avatar.offset[-1])


def test_no_face_is_emptied_and_no_avatar() -> None:
    avatar = bound()
    assert not avatar.spared(torch.ones(8, dtype=torch.bool)).any()
    other = embedded("paper")
    assert int((~other.spared(torch.ones(50, dtype=torch.bool))).sum()) == 1


def test_camera_extent() -> None:
    views = []
    for x in (-1.0, 0.0, 1.0):
        viewmat = torch.eye(4)
        viewmat[0, 3] = x
        views += [View(0, "c", "f", 0, 8, 8, torch.eye(3), viewmat)] * (3 if x < 0 else 1)
    assert camera_extent(views) == pytest.approx(1.1)
    assert camera_extent(views[:1]) == 1.0


def test_importing_the_baselines_loads_nothing_heavy() -> None:
    modules = "gaussian_avatars.training", "interact_avatar.training", "splatting_avatar.training"
    code = "import sys, " + ", ".join(f"nbavatar.methods.{name}" for name in modules)
    code += "; heavy = {'cv2', 'igl', 'scipy', 'trimesh', 'OpenEXR', 'matplotlib', 'pandas'} & set(sys.modules)"
    code += "; assert not heavy, heavy"
    subprocess.run([sys.executable, "-c", code], check=True)
