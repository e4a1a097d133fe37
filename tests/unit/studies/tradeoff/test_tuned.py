"""An avatar under settings: the default is the avatar itself, and work is counted, not timed."""

import pytest
import torch
from torch.nn import functional

from nbavatar.config.tradeoff import SettingConfig, vary
from nbavatar.data.views import View
from nbavatar.errors import DataError
from nbavatar.methods.billboards.architecture import Architecture
from nbavatar.methods.billboards.avatar import Avatar
from nbavatar.methods.billboards.billboards import Billboards, Posed
from nbavatar.methods.billboards.compression.contribution import contributions, most_contributing
from nbavatar.methods.billboards.compression.footprint import largest_footprints, texels_of
from nbavatar.methods.billboards.compression.reduce import (
    avatar_bytes,
    keep_billboards,
    keep_parts,
    resize_textures,
    size_textures,
)
from nbavatar.methods.billboards.region import region_of
from nbavatar.methods.storage import load_avatar, save_avatar
from nbavatar.rendering.billboards.functional import render_billboards
from nbavatar.studies.tradeoff.tuned import TunedAvatar, texels_needed
from tests.scenes.toy import OCTAHEDRON, OCTAHEDRON_FACES, TETRAHEDRON, TETRAHEDRON_FACES

SIZE = 64
K = torch.tensor([[120.0, 0, 33.0], [0, 120.0, 30.0], [0, 0, 1]])
VIEW = torch.eye(4)
VIEW[2, 3] = 1.0
BACKGROUND = torch.tensor([0.1, 0.5, 0.9])
# Turned and bent a little: on a symmetric shape hits have equal depths, and rounding would decide their order.
BENT = torch.from_numpy(OCTAHEDRON) + 0.1 * torch.sin(torch.arange(18.0)).reshape(6, 3)
VERTS = {
    "head": 0.12 * BENT,
    "right_hand": 0.05 * torch.from_numpy(TETRAHEDRON) + torch.tensor([0.16, 0.0, 0.0]),
}


def make_avatar(*, deferred: bool = True, texels: int = 4, normals: bool = False, gloss: bool = False) -> Avatar:
    torch.manual_seed(3)
    faces = {"head": torch.from_numpy(OCTAHEDRON_FACES), "right_hand": torch.from_numpy(TETRAHEDRON_FACES)}
    channels = 4 if deferred else 3
    features, logits = torch.randn(12, texels, texels, channels), torch.randn(12, texels, texels)
    billboards = Billboards(torch.full((12, 2), 0.7), features, logits)
    architecture = Architecture(channels, texels, deferred, 4, 3, 16, 1, True, 0.1, "ray", normals=normals, gloss=gloss)
    return Avatar(architecture, faces, {"head": 6, "right_hand": 4}, billboards).eval()


def picture(avatar, verts=VERTS, *, K=K, viewmat=VIEW, size=(SIZE, SIZE)) -> torch.Tensor:
    with torch.no_grad():
        return avatar.render(verts, viewmat, K, *size, BACKGROUND)[0]


@pytest.mark.parametrize(("deferred", "told"), [(True, False), (True, True), (False, False)])
@pytest.mark.parametrize("size", [(64, 64), (50, 37)])
def test_the_default_setting_is_the_avatar_bit_by_bit(deferred: bool, told: bool, size: tuple[int, int]) -> None:
    avatar = make_avatar(deferred=deferred, normals=told, gloss=told)
    with torch.no_grad():
        expected = avatar.render(VERTS, VIEW, K, *size, BACKGROUND)
    given = TunedAvatar(avatar, SettingConfig()).render(VERTS, VIEW, K, *size, BACKGROUND)
    for a, b in zip(given, expected, strict=True):
        assert torch.equal(a, b)


def test_an_empty_frame_is_background_and_no_work() -> None:
    tuned = TunedAvatar(make_avatar(), SettingConfig())
    behind = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])) @ VIEW
    nan = {part: torch.full_like(points, torch.nan) for part, points in VERTS.items()}
    for verts, view in ((VERTS, behind), ({}, VIEW), (nan, VIEW)):
        image, alpha, own = tuned.render(verts, view, K, SIZE, SIZE, BACKGROUND)
        assert torch.equal(image, BACKGROUND[:, None, None].expand(3, SIZE, SIZE))
        assert float(alpha.max()) == 0 and float(own.max()) == 0
    assert tuned.work.pictures == 3
    assert tuned.work.raster_calls == tuned.work.decoder_calls == tuned.work.decoded_pixels == 0


def test_a_head_only_scene_never_touches_the_hand(monkeypatch) -> None:
    avatar = make_avatar()
    seen: list[int] = []
    import nbavatar.methods.billboards.avatar as model

    original = model.face_frames
    monkeypatch.setattr(model, "face_frames", lambda verts, faces: (seen.append(len(faces)), original(verts, faces))[1])
    tuned = TunedAvatar(avatar, SettingConfig())
    head = {"head": VERTS["head"]}
    image = picture(tuned, head)
    plain = picture(avatar, head)
    assert seen == [8, 8] and tuned.work.posed == 8  # the octahedron's faces, not the tetrahedron's four
    assert torch.equal(image, picture(TunedAvatar(keep_parts(avatar, ["head"]), SettingConfig()), head))
    torch.testing.assert_close(image, plain, atol=1e-6, rtol=0)


def test_a_small_avatar_in_a_large_frame_costs_what_a_small_frame_costs() -> None:
    avatar = make_avatar()
    # The same avatar at the same scale, in a frame four times as wide.
    counts, pictures = {}, {}
    for side in (256, 1024):
        tuned = TunedAvatar(avatar, SettingConfig(roi=True))
        camera = torch.tensor([[100.0, 0, side / 2], [0, 100.0, side / 2], [0, 0, 1]])
        pictures[side] = picture(tuned, K=camera, size=(side, side))
        counts[side] = tuned.work
    assert counts[1024].decoded_pixels == counts[256].decoded_pixels <= 128 * 128
    assert counts[1024].raster_pixels == counts[256].raster_pixels and counts[1024].texels == counts[256].texels
    middle = slice(512 - 128, 512 + 128)
    torch.testing.assert_close(pictures[1024][:, middle, middle], pictures[256], atol=2e-5, rtol=0)


def test_decoding_at_half_size_works_on_a_quarter_of_the_pixels() -> None:
    avatar = make_avatar()
    work = {}
    for share in (1.0, 0.5, 0.25):
        tuned = TunedAvatar(avatar, SettingConfig(roi=False, decode=share))
        assert picture(tuned).shape == (3, SIZE, SIZE)
        work[share] = tuned.work.decoded_pixels
    assert work == {1.0: SIZE**2, 0.5: SIZE**2 // 4, 0.25: SIZE**2 // 16}


def test_layout_changes_rounding_only() -> None:
    avatar = make_avatar()
    tuned = TunedAvatar(avatar, SettingConfig(channels_last=False))
    torch.testing.assert_close(picture(tuned), picture(avatar), atol=2e-5, rtol=0)
    assert torch.equal(picture(TunedAvatar(avatar, SettingConfig())), picture(avatar))  # the avatar's own is untouched


def test_half_resolution_is_the_avatar_in_a_frame_of_half_the_size_enlarged() -> None:
    avatar = make_avatar(deferred=False)
    small = torch.cat((K[:2] / 2, K[2:]))
    tuned = TunedAvatar(avatar, SettingConfig(resolution=0.5, roi=False))
    expected = functional.interpolate(
        picture(avatar, K=small, size=(32, 32))[None], size=(SIZE, SIZE), mode="bilinear", align_corners=False
    )[0]
    torch.testing.assert_close(picture(tuned), expected, atol=1e-5, rtol=0)


def test_rasterizer_options_reach_the_rasterizer() -> None:
    avatar = make_avatar(deferred=False)
    options = {"order": "center", "t_min": 0.2, "alpha_min": 0.3, "low_pass": 3.0}
    tuned = TunedAvatar(avatar, vary(SettingConfig(roi=False), options))
    posed, _ = avatar.pose(VERTS)
    features, alpha = avatar.textures()
    image, opacity = render_billboards(*posed.planes, features, alpha, VIEW, K, SIZE, SIZE, **options)
    expected = image + (1 - opacity) * BACKGROUND[:, None, None]
    torch.testing.assert_close(picture(tuned), expected.detach(), atol=1e-5, rtol=0)


def test_contributions_are_what_removing_other_colours_shows() -> None:
    avatar = make_avatar(deferred=False)
    posed, _ = avatar.pose(VERTS)
    alpha = avatar.billboards.alpha().detach()
    given = contributions(posed, alpha, VIEW, K, SIZE, SIZE)
    # Independent: paint one billboard white and the rest black, and add up the picture.
    for index in range(12):
        paint = torch.zeros(*alpha.shape, 1)
        paint[index] = 1
        image, _ = render_billboards(*posed.planes, paint, alpha, VIEW, K, SIZE, SIZE)
        assert float(given[index]) == pytest.approx(float(image.detach().sum()), abs=2e-3)


def test_the_most_contributing_are_chosen_by_their_best_view() -> None:
    views = [torch.tensor([5.0, 0, 0, 1]), torch.tensor([0.0, 0, 4, 2])]
    assert most_contributing(views, 0.5).tolist() == [0, 2]
    assert most_contributing(views, 1.0).tolist() == [0, 1, 2, 3]
    assert most_contributing(views, 0.01).tolist() == [0]


def test_dropping_billboards_that_contribute_nothing_changes_nothing() -> None:
    avatar = make_avatar()
    with torch.no_grad():
        avatar.billboards.alpha_logit[[1, 9]] = -12.0  # fainter than any sample that is drawn
    posed, _ = avatar.pose(VERTS)
    importance = contributions(posed, avatar.billboards.alpha(), VIEW, K, SIZE, SIZE)[None]
    assert importance[0, [1, 9]].tolist() == [0, 0]
    # The window may shrink with what is dropped, so it is left out here.
    tuned = TunedAvatar(avatar, SettingConfig(billboards=10 / 12, roi=False), importance=importance)
    whole = TunedAvatar(avatar, SettingConfig(roi=False))
    assert len(tuned.avatar.billboards.mu) == 10
    torch.testing.assert_close(picture(tuned), picture(whole), atol=1e-6, rtol=0)


def test_smaller_avatars_share_the_renderer_and_count_their_bytes() -> None:
    avatar = make_avatar(texels=8)
    kept = keep_billboards(avatar, torch.tensor([0, 3, 8, 11]))
    assert kept.unet is avatar.unet and kept.face_counts == {"head": 2, "right_hand": 2}
    assert torch.equal(kept.faces, avatar.faces[[0, 3, 8, 11]])
    assert keep_billboards(avatar, torch.tensor([0, 3])).parts == ["head"]
    small = resize_textures(avatar, 4)
    assert small.architecture.texels == 4 and small.billboards.features.shape == (12, 4, 4, 4)
    # Two thirds of the billboards' texels and 64 - 16 of the 64 texels each, five floats a texel.
    assert avatar_bytes(avatar) - avatar_bytes(small) == 12 * 48 * 5 * 4


def test_textures_of_their_own_sizes_are_shown_as_they_are_kept(tmp_path) -> None:
    avatar = make_avatar(texels=8)
    sizes = torch.tensor([8, 2, 3, 8, 5, 2, 2, 4, 8, 3, 2, 7])
    sized = size_textures(avatar, sizes)
    # Four floats of features and one of opacity a texel; the sizes themselves take a byte each.
    assert avatar_bytes(avatar) - avatar_bytes(sized) == 5 * 4 * int((64 - sizes**2).sum()) - 12
    for whole, own in zip(avatar.textures(), sized.textures(), strict=True):
        assert torch.equal(whole[sizes == 8], own[sizes == 8]) and not torch.equal(whole, own)
    save_avatar(tmp_path / "model.pt", sized)
    again = load_avatar(tmp_path / "model.pt")
    assert torch.equal(again.billboards.sizes, sizes.to(torch.uint8)) and torch.equal(picture(again), picture(sized))
    assert torch.equal(picture(TunedAvatar(again, SettingConfig())), picture(sized))
    assert torch.equal(picture(size_textures(avatar, torch.full((12,), 8))), picture(avatar))
    # Sized again, and with some of its parts only, it is rendered from what it shows now.
    shown = keep_parts(sized, ["head"])
    torch.testing.assert_close(shown.textures()[1], sized.textures()[1][:8], atol=1e-5, rtol=0)


def test_the_largest_footprint_by_hand() -> None:
    avatar = make_avatar()
    meshes = {part: torch.stack([points, points]) for part, points in VERTS.items()}
    near, behind = VIEW.clone(), VIEW.clone()
    near[2, 3], behind[2, 3] = 0.5, -1.0
    views = [View(0, "c", "f", row, SIZE, SIZE, K, view) for row, view in ((0, VIEW), (1, near), (0, behind))]
    found = largest_footprints(avatar, meshes, views, most_views=10)
    posed, _ = avatar.pose(VERTS)
    expected = 2 * posed.half_extents.amax(1) * 120.0 / (posed.means[:, 2] + 0.5)
    torch.testing.assert_close(found, expected.detach(), atol=1e-4, rtol=1e-5)
    assert texels_of(torch.tensor([0.0, 2.9, 10.0]), 2.0).tolist() == [1, 7, 21]


def test_mips_are_taken_when_the_avatar_is_small_on_screen() -> None:
    avatar = make_avatar(texels=8)
    near, far = K * torch.tensor([8.0, 8, 1])[:, None], K * torch.tensor([0.01, 0.01, 1])[:, None]
    tuned = TunedAvatar(avatar, SettingConfig(mips=True, roi=False))
    picture(tuned, K=near)
    assert tuned.work.texels == 12 * 64
    picture(tuned, K=far)
    assert tuned.work.texels == 12 * (64 + 4)


def test_texels_needed_by_hand() -> None:
    count = 10
    means = torch.tensor([0.0, 0, 2]).expand(count, 3)
    extents = torch.full((count, 2), 0.01)
    posed = Posed(means, torch.tensor([1.0, 0, 0, 0]).expand(count, 4), extents, torch.zeros_like(means))
    camera = torch.tensor([[1000.0, 0, 0], [0, 1000.0, 0], [0, 0, 1]])
    # 0.01 m at 2 m and f = 1000 px is 5 px of half extent: 10 px from first to last texel centre.
    assert texels_needed(posed, torch.eye(4), camera) == 11


def test_a_visible_box_and_its_region_agree() -> None:
    posed, _ = make_avatar().pose(VERTS)
    region = region_of(posed, VIEW, K, SIZE, SIZE, multiple=8, margin=0.0)
    assert region.width % 8 == 0 and 0 <= region.x0 and region.x0 + region.width <= SIZE


def test_a_share_without_contributions_is_refused() -> None:
    with pytest.raises(DataError, match="contributions"):
        TunedAvatar(make_avatar(), SettingConfig(billboards=0.5))
