"""Streaming of training views: exact pixels, bounded memory, an order that nothing but the seed moves."""

import numpy as np
import pytest
import torch

from nbavatar.data.views import ViewStore, ViewStream, check_views, shuffled, views_of
from nbavatar.errors import DataError
from nbavatar.io.framepack import FramePack, FramePackWriter
from tests.scenes.toy import FRAMES, SIZE, sequence, write_scene

PARTS = ["head", "right_hand"]


@pytest.fixture(scope="module")
def packs(tmp_path_factory: pytest.TempPathFactory) -> list[FramePack]:
    return [FramePack(path) for path in write_scene(tmp_path_factory.mktemp("scene"))["packs"]]


def _views(packs):
    return views_of(packs, FRAMES, [pack.split("train") for pack in packs], layers=("rgb", "alpha"))


def _picture(sample) -> np.ndarray:
    full = np.zeros((5, sample.height, sample.width), np.float32)
    height, width = sample.pixels.shape[-2:]
    full[:, sample.y0 : sample.y0 + height, sample.x0 : sample.x0 + width] = sample.pixels.numpy()
    return full


def test_views_of_lists_training_frames_of_all_cameras(packs) -> None:
    views = _views(packs)
    assert [(v.camera, v.frame) for v in views] == [(f"cam{c}", f) for c in range(3) for f in FRAMES[:3]]
    assert all(v.row == FRAMES.index(v.frame) for v in views)


def test_sample_is_the_premultiplied_picture(packs) -> None:
    views = _views(packs)
    picture = _picture(ViewStore(packs, views, PARTS, 10**9).sample(4))
    rgb, alpha = packs[1].read("rgb", "f1") / 255.0, packs[1].read("alpha", "f1") / 255.0
    np.testing.assert_allclose(picture[:3], (rgb * alpha[..., None]).transpose(2, 0, 1), atol=1e-6)
    np.testing.assert_allclose(picture[3], alpha, atol=1e-6)
    assert picture[4].max() == 0


@pytest.mark.parametrize("shrink", [2, 4])
def test_sample_shrinks_by_block_means_with_scaled_intrinsics(packs, shrink: int) -> None:
    views = _views(packs)
    store = ViewStore(packs, views, PARTS, 10**9)
    full, small = _picture(store.sample(0)), store.sample(0, shrink)
    blocks = full.reshape(5, SIZE // shrink, shrink, SIZE // shrink, shrink).mean((2, 4))
    np.testing.assert_allclose(_picture(small), blocks, atol=1e-6)
    torch.testing.assert_close(small.K[:2], views[0].K[:2] / shrink)
    assert small.K[2].tolist() == [0, 0, 1]


def test_sample_marks_what_the_camera_did_not_see(packs, tmp_path) -> None:
    """As in a crop that sticks out of the image at the right: coverage 0 there is no statement about the background."""
    pack = packs[0]
    with FramePackWriter(tmp_path / "out.zip", {**pack.manifest, "unseen": True}) as out:
        for frame in pack.frames:
            label, alpha = pack.read("label", frame).copy(), pack.read("alpha", frame).copy()
            label[:, 20:], alpha[:, 20:] = 255, 0
            for layer, image in (("rgb", pack.read("rgb", frame)), ("label", label), ("alpha", alpha)):
                out.add(layer, frame, image)
    with FramePack(tmp_path / "out.zip") as cut:
        picture = _picture(ViewStore([cut], _views([cut]), PARTS, 10**9).sample(0))
    before = _picture(ViewStore(packs, _views(packs), PARTS, 10**9).sample(0))
    assert (picture[4][:, 20:] == 1).all() and (picture[4][:, :20] == 0).all()
    np.testing.assert_array_equal(picture[:4, :, :20], before[:4, :, :20])
    assert before[3][:, 20:].any() and not picture[3][:, 20:].any()


def test_of_a_small_pixel_with_a_part_that_says_nothing_nothing_is_known(packs, tmp_path) -> None:
    """A neck of which a collar covers an odd number of rows: averaged, it would teach a neck half transparent."""
    pack = packs[0]
    with FramePackWriter(tmp_path / "out.zip", {**pack.manifest, "unseen": True}) as out:
        for frame in pack.frames:
            label, alpha = np.ones((SIZE, SIZE), np.uint8), np.full((SIZE, SIZE), 255, np.uint8)
            label[SIZE - 5 :], alpha[SIZE - 5 :] = 255, 0
            for layer, image in (("rgb", pack.read("rgb", frame)), ("label", label), ("alpha", alpha)):
                out.add(layer, frame, image)
    with FramePack(tmp_path / "out.zip") as cut:
        small = _picture(ViewStore([cut], _views([cut]), PARTS, 10**9).sample(0, 4))
    assert (small[4, -2:] == 1).all() and not small[:4, -2:].any()
    assert not small[4, :-2].any() and (small[3, :-2] == 1).all()


def test_sample_marks_parts_that_are_not_modelled(packs) -> None:
    picture = _picture(ViewStore(packs, _views(packs), ["head"], 10**9).sample(0))
    hand = packs[0].read("label", "f0") == 2
    assert (picture[4] == hand).all() and (picture[3][hand] == 0).all()


def test_cache_is_bounded_and_changes_nothing(packs) -> None:
    views = _views(packs)
    large, small, none = (ViewStore(packs, views, PARTS, size) for size in (10**9, 4000, 0))
    for turn in range(2):
        for index in range(len(views)):
            expected = large.sample(index)
            for store in (small, none):
                torch.testing.assert_close(store.sample(index).pixels, expected.pixels, atol=0, rtol=0)
                assert store.cached_bytes <= (4000 if store is small else 0)
    assert large.decoded == len(views)  # every frame once
    assert none.decoded == 2 * len(views)


@pytest.mark.parametrize("ahead", [0, 3])
def test_stream_follows_the_seeded_order(packs, ahead: int) -> None:
    views = _views(packs)
    stream = ViewStream(ViewStore(packs, views, PARTS, 10**9), len(views), seed=5, ahead=ahead)
    try:
        for step in range(12):
            shrink = 2 if step < 4 else 1
            sample = stream.get(step, shrink)
            assert sample.view == views[shuffled(step, len(views), 5)]
            assert sample.width == SIZE // shrink
    finally:
        stream.close()


def test_shuffled_visits_every_view_once_an_epoch() -> None:
    for epoch in range(3):
        assert sorted(shuffled(7 * epoch + i, 7, 1) for i in range(7)) == list(range(7))
    assert [shuffled(i, 50, 1) for i in range(50)] != [shuffled(50 + i, 50, 1) for i in range(50)]


def test_views_of_names_the_frame_without_a_mesh(packs) -> None:
    with pytest.raises(DataError, match=r"cam0.zip: frame f2: expected a mesh of that frame"):
        views_of(packs, FRAMES[:2], [pack.split("train") for pack in packs])


def test_views_of_refuses_an_empty_split(packs) -> None:
    with pytest.raises(DataError, match="at least one frame of the split"):
        views_of(packs, FRAMES, [[], [], []])


def test_store_refuses_pictures_of_another_size(packs) -> None:
    views = [view._replace(width=31) for view in _views(packs)]
    with pytest.raises(DataError, match=r"rgb/f0: expected 31x32, found 32x32"):
        ViewStore(packs, views, PARTS, 0).sample(0)


@pytest.mark.parametrize("offset", [(5.0, 0.0, 0.0), (0.0, 0.0, -10.0), (np.nan, 0.0, 0.0)])
def test_meshes_beside_all_masks_are_refused(packs, offset) -> None:
    """Aside, behind the cameras, nowhere."""
    meshes = {name: part.verts for name, part in sequence().parts.items()}
    check_views(packs, _views(packs), meshes, mesh_file="m.npz")
    away = {name: verts + np.float32(offset) for name, verts in meshes.items()}
    with pytest.raises(DataError, match=r"m\.npz: expected meshes that project onto the covered pixels"):
        check_views(packs, _views(packs), away, mesh_file="m.npz")


def test_views_without_a_covered_pixel_are_refused(tmp_path) -> None:
    empty = [FramePack(path) for path in write_scene(tmp_path, empty=True)["packs"]]
    meshes = {name: part.verts for name, part in sequence().parts.items()}
    with pytest.raises(DataError, match="alpha: expected covered pixels in a training view, found none in 9"):
        check_views(empty, _views(empty), meshes, mesh_file="m.npz")
