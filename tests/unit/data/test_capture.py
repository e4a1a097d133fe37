import json
import os

import numpy as np
import pytest
from PIL import Image

from nbavatar.data.capture import (
    open_capture,
    read_mesh,
    read_rgb,
    read_splits,
    read_topology,
)
from nbavatar.data.capture_tracks import build_capture_tracks
from nbavatar.data.frame_plan import plan_capture
from nbavatar.errors import DataError
from nbavatar.preprocess.capture_masks import open_masks
from nbavatar.preprocess.sources import capture_images, capture_layers

CHOICE = {"start": 0, "every": 1, "max_frames": 0, "test_fraction": 0.2, "test_blocks": 1}


def edit(path, change):
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def test_cameras_are_read_as_written(capture):
    camera = open_capture(capture).camera("right")
    assert (camera.width, camera.height, camera.distortion) == (96, 80, None)
    assert camera.cam_from_world[2, 3] == 0.6 and camera.K[0, 2] == 49.5
    assert open_capture(capture, pixel_center=0.0).camera("right").K[0, 2] == 50.0
    with pytest.raises(DataError, match="no camera 'front'; known: left, right"):
        open_capture(capture).camera("front")


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda c: c["left"].pop("R"), "camera left: R: expected this key"),
        (lambda c: c["left"].update(R=[[1, 0, 0], [0, 1, 0], [0, 0, 2]]), "R: expected a rotation"),
        (lambda c: c["left"].update(R=[[1, 0, 0], [0, 1, 0], [0, 0, -1]]), "R: expected a rotation"),
        (lambda c: c["left"].update(K=[[1, 2], [3, 4]]), "K: expected 3 x 3 finite numbers"),
        (lambda c: c["left"].update(t=[0, None, 1]), "t: expected 3 finite numbers"),
        (lambda c: c["left"].update(width="96"), "width: expected a whole number of pixels, found '96'"),
        (lambda c: c["left"].update(K=[[1, 0.1, 3], [0, 1, 3], [0, 0, 1]]), "K: expected"),
        (lambda c: c["left"].update(distortion=[1, 2]), "distortion: expected 4, 5, 8 or 12"),
        (lambda c: c.clear(), "expected a mapping from camera name"),
    ],
)
def test_cameras_that_cannot_be(capture, change, line):
    edit(capture / "cameras.json", change)
    with pytest.raises(DataError, match=line) as error:
        open_capture(capture)
    assert "\n" not in str(error.value) and "cameras.json" in str(error.value)


def test_a_split_of_the_user_s_wins_and_else_the_last_fraction_is_held_out(capture):
    plan = plan_capture(open_capture(capture), **CHOICE)
    assert list(plan.split.values()) == ["train"] * 4 + ["test"]
    edit(capture / "splits.json", lambda s: s.update(train=["t0", "t2", "t3"], test=["t1"]))
    plan = plan_capture(open_capture(capture), **CHOICE)
    assert plan.split == {"t0": "train", "t1": "test", "t2": "train", "t3": "train"}


def test_cuts_divide_all_frames_whether_they_are_used_or_not(capture):
    edit(capture / "splits.json", lambda s: s.update(cuts=[["t1", "t2"]], train=["t0", "t1", "t3"], test=["t4"]))
    splits = read_splits(capture)
    assert splits.frames == ["t0", "t1", "t3", "t4"] and splits.segments == [(0, 1), (2, 3)]
    edit(capture / "splits.json", lambda s: s.update(train=["t0", "t1"], test=[]))
    assert read_splits(capture).segments == [(0, 1)]


def test_frames_in_contact_may_be_noted(capture):
    edit(capture / "splits.json", lambda s: s.update(contact={"t1": True}))
    assert read_splits(capture).frames == [f"t{i}" for i in range(5)]


def test_cuts_divide_runs(capture):
    edit(capture / "splits.json", lambda s: s.update(cuts=[["t1", "t2"]]))
    plan = plan_capture(open_capture(capture), **{**CHOICE, "test_fraction": 0.4})
    assert plan.segments == [(0, 1), (2, 4)]
    assert list(plan.split.values()) == ["train", "test", "train", "train", "test"]


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda s: s.update(test=["t9"]), "test: expected ids that are in frames, found 't9'"),
        (lambda s: s.update(train=["t1"], test=["t1"]), "'t1', which is in both"),
        (lambda s: s.update(frames=[]), "at least one frame id"),
        (lambda s: s.update(frames=["t1", "t1"]), "each frame once"),
        # Minutes, where every frame was looked for in all before it.
        (lambda s: s.update(frames=[f"t{i}" for i in range(200_000)] + ["t7"]), "each frame once, found 't7' twice"),
        (lambda s: s.update(frames=["../t1"]), "a name of letters"),
        (lambda s: s.update(frames=["t1", "topology"]), "other names than 'topology'"),
        (lambda s: s.update(cuts=["t1"]), "pairs of frame ids"),
        (lambda s: s.update(cuts=[["1", "2"]]), "cuts: expected pairs of ids that are in frames, found '1'"),
        (lambda s: s.update(cuts=[["t2", "t1"]]), "cut 0: expected .* found .2, 1."),
        (lambda s: s.update(validation=["t1"]), "unknown key 'validation'; did you mean test?"),
        (lambda s: s.update(cut=[["t1", "t2"]]), "unknown key 'cut'; did you mean 'cuts'"),
    ],
)
def test_splits_that_cannot_be(capture, change, line):
    edit(capture / "splits.json", change)
    with pytest.raises(DataError, match=line):
        read_splits(capture)


def test_label_masks_give_labels_and_full_coverage(capture):
    opened = open_capture(capture)
    plan = plan_capture(opened, **CHOICE)
    masks = open_masks(opened, opened.camera("left"), plan.frames)
    assert capture_layers(masks) == ("rgb", "label", "alpha")
    for frame, images in capture_images(opened, masks, plan.frames):
        mask = np.array(Image.open(capture / "masks/left" / f"{frame}.png"))
        np.testing.assert_array_equal(images["label"], mask)
        np.testing.assert_array_equal(images["alpha"], np.where(mask > 0, 255, 0))


def test_alpha_beyond_the_labels_spreads_them(capture):
    opened = open_capture(capture)
    plan = plan_capture(opened, **CHOICE)
    for frame in plan.frames:
        label = np.array(Image.open(capture / "masks/left" / f"{frame}.png"))
        alpha = np.where(label > 0, 255, 0).astype(np.uint8)
        alpha[:12, 40:50] = 77  # hair that nobody labelled
        alpha[60:, :] = 0
        path = capture / "alpha/left" / f"{frame}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(alpha).save(path)
    for _, images in capture_images(opened, open_masks(opened, opened.camera("left"), plan.frames), plan.frames):
        assert ((images["label"] > 0) == (images["alpha"] > 0)).all()
        assert (images["label"][:5, 40:50] == 1).all() and (images["alpha"][:5, 40:50] == 77).all()


def test_labels_that_say_nothing_stay_so_whatever_alpha_says(capture):
    opened = open_capture(capture)
    plan = plan_capture(opened, **CHOICE)
    for frame in plan.frames:
        path = capture / "masks/left" / f"{frame}.png"
        label = np.array(Image.open(path))
        label[66:, 20:80] = 255  # a garment that reaches to the lower border, beside which alpha has a soft edge
        Image.fromarray(label).save(path)
        alpha = np.where(label > 0, 255, 0).astype(np.uint8)
        alpha[66:, 14:20] = alpha[66:, 80:86] = 90
        (capture / "alpha/left").mkdir(parents=True, exist_ok=True)
        Image.fromarray(alpha).save(capture / "alpha/left" / f"{frame}.png")
    masks = open_masks(opened, opened.camera("left"), plan.frames)
    assert masks.mask.unseen
    for _, images in capture_images(opened, masks, plan.frames):
        unseen = images["label"] == 255
        assert unseen[66:, 14:86].all() and not unseen[:60].any() and not unseen[:, :10].any()
        np.testing.assert_array_equal(images["alpha"] > 0, np.isin(images["label"], (1, 2, 3)))


def test_person_masks_and_alpha_alone_are_left_for_the_meshes_to_cut(capture):
    opened = open_capture(capture)
    camera, frames = opened.camera("left"), plan_capture(opened, **CHOICE).frames
    for frame in frames:
        path = capture / "masks/left" / f"{frame}.png"
        label = np.array(Image.open(path))
        Image.fromarray(np.where(label > 0, 255, 0).astype(np.uint8)).save(path)
    assert capture_layers(open_masks(opened, camera, frames)) == ("rgb", "person")
    (capture / "masks/left/t2.png").unlink()
    with pytest.raises(DataError, match=r"masks/left/t2\.png: expected a mask as for the other frames"):
        open_masks(opened, camera, frames)
    (capture / "alpha").mkdir()
    (capture / "masks" / "left").rename(capture / "alpha" / "left")
    Image.fromarray(np.zeros((80, 96), np.uint8)).save(capture / "alpha/left/t2.png")
    masks = open_masks(opened, camera, frames)
    assert capture_layers(masks) == ("rgb", "person", "alpha")
    pictures = dict(capture_images(opened, masks, frames))
    np.testing.assert_array_equal(pictures["t0"]["person"], masks.read_coverage("t0"))


def test_masks_of_0_and_1_are_the_person_where_no_camera_labels_a_hand(capture):
    opened = open_capture(capture)
    camera, frames = opened.camera("left"), [f"t{i}" for i in range(5)]
    for path in capture.glob("masks/left/*"):
        Image.fromarray(np.minimum(np.array(Image.open(path)), 1)).save(path)
    assert open_masks(opened, camera, frames).mask.kind == "label", "the other camera has labels of a hand"
    for path in capture.glob("masks/right/*"):
        Image.fromarray(np.minimum(np.array(Image.open(path)), 1)).save(path)
    masks = open_masks(opened, camera, frames)
    assert (masks.mask.kind, masks.mask.white) == ("person", 1)
    assert set(np.unique(masks.read_mask("t0"))) == {0, 255}
    topology = dict(np.load(capture / "meshes/topology.npz"))
    np.savez(capture / "meshes/topology.npz", head_faces=topology["head_faces"])
    assert open_masks(opened, camera, frames).mask.kind == "label", "a head and nothing else"


@pytest.mark.parametrize(
    ("files", "line"),
    [
        (["t1.PNG"], None),
        (["t1.Jpeg"], None),
        (["t1.tif"], r"t1\.tif: expected an image \(jpg, png or webp\), found \.tif; convert it to png"),
        (["t1.png", "t1.jpg"], r"left: expected one picture t1, found t1\.jpg and t1\.png; keep one of them"),
    ],
)
def test_suffixes_in_any_case_and_others_are_named(capture, files, line):
    opened = open_capture(capture)
    source = capture / "images/left/t1.png"
    expected = np.array(Image.open(source))
    picture = Image.open(source).copy()
    source.unlink()
    for file in files:
        picture.save(source.with_name(file), **({"quality": 100} if "j" in file.lower() else {}))
    if line is None:
        found = read_rgb(opened, opened.camera("left"), "t1")
        assert np.abs(found.astype(int) - expected).mean() < 6, "the loss of JPEG"
    else:
        with pytest.raises(DataError, match=line):
            read_rgb(opened, opened.camera("left"), "t1")


def test_a_pipe_is_no_picture(capture):
    (capture / "images/left/t1.png").unlink()
    os.mkfifo(capture / "images/left/t1.png")
    opened = open_capture(capture)
    with pytest.raises(DataError, match=r"t1\.png: expected an image \(jpg, png or webp\), found no plain file"):
        read_rgb(opened, opened.camera("left"), "t1")


def test_an_alpha_image_that_is_missing_is_named(capture):
    (capture / "alpha/left").mkdir(parents=True)
    for path in sorted((capture / "masks/left").iterdir())[:-1]:
        Image.fromarray(255 * (np.array(Image.open(path)) > 0).astype(np.uint8)).save(
            capture / "alpha/left" / path.name
        )
    opened = open_capture(capture)
    with pytest.raises(DataError, match=r"alpha/left/t4\.png: expected an alpha image as for the other frames"):
        open_masks(opened, opened.camera("left"), [f"t{i}" for i in range(5)])


def test_an_image_of_another_size_or_none(capture):
    opened = open_capture(capture)
    camera = opened.camera("left")
    path = capture / "images/left/t1.png"
    Image.open(path).resize((50, 40)).save(path)
    with pytest.raises(DataError, match=r"t1\.png: size: expected 96 x 80 .* found 50 x 40"):
        read_rgb(opened, camera, "t1")
    path.unlink()
    with pytest.raises(DataError, match=r"t1\.jpg: expected an image .* found none"):
        read_rgb(opened, camera, "t1")
    path.write_bytes((capture / "images/left/t2.png").read_bytes()[:100])
    with pytest.raises(DataError, match="does not decode"):
        read_rgb(opened, camera, "t1")


def test_topology_and_vertices_are_checked(capture):
    topology = read_topology(capture)
    assert list(topology) == ["head", "right_hand"] and topology["head"][0].dtype == np.int64
    mesh = dict(np.load(capture / "meshes/t1.npz"))
    for change, line in [
        ({"head": mesh["head"] * np.nan}, "head: expected finite coordinates"),
        ({"head": mesh["head"][:-1]}, "head: expected more than"),
        ({"head": mesh["head"][:, :2]}, r"head: expected numbers \[V, 3\]"),
        ({"head_rigid": np.concatenate([mesh["head"]] * 2)}, "head_rigid: expected"),
    ]:
        np.savez(capture / "meshes/t1.npz", **{**mesh, **change})
        with pytest.raises(DataError, match=line):
            read_mesh(open_capture(capture), "t1", topology)
    np.savez(capture / "meshes/t1.npz", head_rigid=mesh["head_rigid"], right_hand=mesh["right_hand"])
    with pytest.raises(DataError, match="head_rigid: expected head beside it, found head_rigid alone"):
        read_mesh(open_capture(capture), "t1", topology)
    np.savez(capture / "meshes/t1.npz", body=mesh["head"])
    with pytest.raises(DataError, match="expected vertices of head or right_hand, found only body"):
        read_mesh(open_capture(capture), "t1", topology)
    np.savez(capture / "meshes/topology.npz", faces=np.zeros((1, 3)))
    with pytest.raises(DataError, match="at least one of head_faces"):
        read_topology(capture)


def test_tracks_take_the_head_without_contact_only_where_it_is_solved(capture):
    opened = open_capture(capture)
    frames = [f"t{i}" for i in range(5)]
    solve, report = build_capture_tracks(opened, frames, contact="solve")
    given, _ = build_capture_tracks(opened, frames, contact="given")
    assert report["head"] == "head_rigid" and report["rest"] == {"head": "first frame", "right_hand": "first frame"}
    np.testing.assert_array_equal(solve.parts["head"].verts, solve.extras["head_rigid"])
    np.testing.assert_array_equal(given.parts["head"].verts, given.extras["head_final"])
    assert np.abs(solve.parts["head"].verts - given.parts["head"].verts).max() == pytest.approx(0.001, rel=1e-3)
    assert set(name for name in solve.extras if name.startswith("camera.left")) == {
        f"camera.left.{key}" for key in ("K", "cam_from_world", "distortion", "size")
    }


def test_head_rigid_in_some_frames_only_is_refused(capture):
    mesh = dict(np.load(capture / "meshes/t3.npz"))
    mesh.pop("head_rigid")
    np.savez(capture / "meshes/t3.npz", **mesh)
    with pytest.raises(DataError, match="head_rigid beside every head or none, found it in 4 of 5 frames"):
        build_capture_tracks(open_capture(capture), [f"t{i}" for i in range(5)], contact="solve")


def test_a_part_may_come_and_go(capture):
    names = [f"t{i}" for i in range(5)]
    whole, _ = build_capture_tracks(open_capture(capture), names, contact="given")
    for gone, part in (("t0", "right_hand"), ("t3", "right_hand"), ("t2", "head")):
        mesh = dict(np.load(capture / f"meshes/{gone}.npz"))
        for name in (part, *(["head_rigid"] if part == "head" else [])):
            mesh.pop(name)
        np.savez(capture / f"meshes/{gone}.npz", **mesh)
    sequence, _ = build_capture_tracks(open_capture(capture), names, contact="given")
    for part, missing in (("right_hand", [0, 3]), ("head", [2])):
        kept = [i for i in range(5) if i not in missing]
        np.testing.assert_array_equal(sequence.parts[part].verts[kept], whole.parts[part].verts[kept])
        assert np.isnan(sequence.parts[part].verts[missing]).all()
        assert np.isfinite(sequence.parts[part].rest).all()
    assert np.isnan(sequence.extras["head_rigid"][2]).all()


def test_a_part_that_is_nowhere_is_refused(capture):
    for i in range(5):
        mesh = dict(np.load(capture / f"meshes/t{i}.npz"))
        mesh.pop("right_hand")
        np.savez(capture / f"meshes/t{i}.npz", **mesh)
    with pytest.raises(DataError, match="right_hand in a frame at least, found it in none; leave right_hand_faces"):
        build_capture_tracks(open_capture(capture), [f"t{i}" for i in range(5)], contact="given")
