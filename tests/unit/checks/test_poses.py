"""Cameras that users mistake: each is found by its masks, and what was meant is said."""

import json
import re
import shutil

import numpy as np
import pytest
from PIL import Image

from nbavatar.checks.capture import check_capture
from tests.scenes.solid import FRAMES, write_solid

FLIP = np.diag([1.0, -1.0, -1.0])


@pytest.fixture(scope="module")
def solid(tmp_path_factory):
    return write_solid(tmp_path_factory.mktemp("solid") / "root")


def each(change):
    """Edit of `cameras.json` in which R, t of every camera become `change(R, t)`."""

    def edit(rig):
        for entry in rig.values():
            R, t = change(np.array(entry["R"]), np.array(entry["t"]))
            entry |= {"R": R.tolist(), "t": t.tolist()}

    return edit


def exchange(*names):
    def edit(rig):
        kept = {name: dict(rig[name]) for name in names}
        for name, other in zip(names, names[1:] + names[:1]):
            rig[name] = kept[other]

    return edit


def one(name, change):
    def edit(rig):
        part = {name: rig[name]}
        each(change)(part)

    return edit


INVERSE = lambda R, t: (R.T, -R.T @ t)  # noqa: E731
READINGS = {
    "camera to world": (each(INVERSE), "R, t are camera to world"),
    "camera to world, one": (one("side", INVERSE), "in side; .* R, t are camera to world"),
    "OpenGL": (each(lambda R, t: (FLIP @ R, FLIP @ t)), r"OpenGL's, y up and z backward \(y and z look flipped\)"),
    "Blender": (each(lambda R, t: (R.T @ FLIP, -R.T @ t)), "R, t are camera to world, and their axes are OpenGL's"),
    "position": (each(lambda R, t: (R, -R.T @ t)), "t is the camera's position: store -R t"),
    "R transposed": (each(lambda R, t: (R.T, t)), "R is camera to world: store R transposed"),
    "millimetres": (each(lambda R, t: (R, 1000 * t)), "t is in millimetres and the meshes in metres"),
    "centimetres": (each(lambda R, t: (R, 100 * t)), "t is in centimetres and the meshes in metres"),
    "kilometres": (each(lambda R, t: (R, t / 1000)), "the meshes are in millimetres and t in metres"),
    "position in mm": (each(lambda R, t: (R, -1000 * R.T @ t)), "position: store -R t; and t is in millimetres"),
    "z up": (each(lambda R, t: (R @ [[1, 0, 0], [0, 0, 1], [0, -1, 0]], t)), r"store vertices as \(x, -z, y\)"),
    "two exchanged": (exchange("low", "side"), "cameras low and side are exchanged"),
    "near ones exchanged": (exchange("high", "near"), "cameras high and near are exchanged"),
    "three exchanged": (exchange("low", "high", "near"), "calibrations are exchanged: near has that of low, low"),
    "moved": (one("low", lambda R, t: (R, t + [0.3, 0, 0])), "camera low: expected meshes that project onto the masks"),
}


def broken(solid, tmp_path, edit):
    for name in ("images", "masks", "meshes", "splits.json"):
        (tmp_path / name).symlink_to(solid / name)
    rig = json.loads((solid / "cameras.json").read_text())
    edit(rig)
    (tmp_path / "cameras.json").write_text(json.dumps(rig))
    return tmp_path


def test_right_cameras_have_no_misfit(solid):
    report = check_capture(solid)
    assert not report.defects and not report.notes


@pytest.mark.parametrize("mattes", [False, True])
@pytest.mark.parametrize("case", READINGS)
def test_a_mistaken_convention_is_named(solid, tmp_path, case, mattes):
    edit, words = READINGS[case]
    capture = broken(solid, tmp_path, edit)
    if mattes:  # the whole person in 0 and 255: where the mesh of a part has to be is known less well
        (capture / "masks").unlink()
        for path in solid.glob("masks/*/*.png"):
            target = capture / path.relative_to(solid)
            target.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(np.where(np.array(Image.open(path)) > 0, 255, 0).astype(np.uint8)).save(target)
    defects = check_capture(capture).defects
    assert len(defects) == 1 and "\n" not in defects[0]
    assert "cameras.json: " in defects[0] and "meshes that project onto the masks" in defects[0]
    assert re.search(words, defects[0]), defects


def test_noise_of_trackers_is_no_defect(solid, tmp_path, rng):
    """Vertices by 2 mm, cameras by half a degree: misfit, but no other reading fits better."""
    from scipy.spatial.transform import Rotation

    capture = broken(
        solid, tmp_path, each(lambda R, t: (Rotation.from_rotvec(rng.normal(0, 0.005, 3)).as_matrix() @ R, t))
    )
    (capture / "meshes").unlink()
    (capture / "meshes").mkdir()
    for path in solid.glob("meshes/*.npz"):
        noisy = {
            name: value + rng.normal(0, 2e-3, 3).astype(value.dtype) if value.dtype.kind == "f" else value
            for name, value in np.load(path).items()
        }
        np.savez(capture / "meshes" / path.name, **noisy)
    assert check_capture(capture).defects == []


def test_a_camera_that_nobody_is_in_is_a_defect(solid, tmp_path):
    capture = broken(solid, tmp_path, lambda rig: None)
    (capture / "masks").unlink()
    for path in solid.glob("masks/*/*.png"):
        target = capture / path.relative_to(solid)
        target.parent.mkdir(parents=True, exist_ok=True)
        picture = np.array(Image.open(path)) * (path.parent.name != "near")
        Image.fromarray(picture.astype(np.uint8)).save(target)
    assert [line for line in check_capture(capture).defects if "masks/near: expected labelled pixels" in line]


def pictures(change, *cameras, kinds=("images", "masks")):
    """Edit of pictures, of all cameras where none is named."""

    def edit(capture):
        for path in (path for kind in kinds for path in capture.glob(f"{kind}/*/*.png")):
            if not cameras or path.parent.name in cameras:
                Image.fromarray(np.ascontiguousarray(change(np.array(Image.open(path))))).save(path)

    return edit


def renumbered(order, pattern):
    """Edit after which frame i has the file of frame order[i]."""

    def edit(capture):
        for folder in capture.glob(pattern):
            (suffix,) = {path.suffix for path in folder.glob("f*")}
            kept = [(folder / f"{frame}{suffix}").read_bytes() for frame in FRAMES]
            for frame, source in zip(FRAMES, order):
                (folder / f"{frame}{suffix}").write_bytes(kept[source])

    return edit


def hand_elsewhere(capture):
    for path in capture.glob("meshes/f*.npz"):
        arrays = dict(np.load(path))
        np.savez(path, **arrays | {"right_hand": arrays["right_hand"] + np.float32([0, 0.3, 0])})


def alpha_only(capture):
    shutil.move(capture / "masks/side", capture / "alpha/side")
    pictures(lambda v: 255 * (v > 0).astype(np.uint8), kinds=["alpha"])(capture)


def rig(edit):
    def damage(capture):
        cameras = json.loads((capture / "cameras.json").read_text())
        edit(cameras)
        (capture / "cameras.json").write_text(json.dumps(cameras))

    return damage


OTHER_PICTURES = {
    "mirrored": (pictures(np.fliplr), r"in low, high, side, near; 100% would .* are mirrored: flip them left to right"),
    "one mirrored": (pictures(np.fliplr, "side"), "there in side; 100% would .* are mirrored: flip them left to right"),
    "one upside down": (pictures(lambda v: v[::-1, ::-1], "low"), "in low; .* are turned by 180 degrees"),
    "masks a frame late": (renumbered([0, 0, 1, 2], "masks/*"), "same moment.* meshes of the frame before"),
    "meshes a frame late": (renumbered([0, 0, 1, 2], "meshes"), "same moment.* meshes of the next frame"),
    "meshes in reverse": (renumbered([3, 2, 1, 0], "meshes"), "same moment.* of the frame as far from the end"),
    "a hand elsewhere": (hand_elsewhere, r"meshes: right_hand: expected vertices that project onto label 2"),
    "a calibration twice": (rig(lambda c: c.update(near=c["high"])), "camera near: R, t: expected a pose of its own"),
    "no light": (pictures(lambda v: v * 0, kinds=["images"]), "found one colour in all.*in low, high, side, near"),
    "one picture": (renumbered([0, 0, 0, 0], "images/side"), "images/side: expected a film.* 4 times the same"),
    "a camera without masks": (alpha_only, "masks/side: expected masks as of camera (high|low|near), found none"),
    "everything is covered": (
        pictures(lambda v: v * 0 + 255, "side", kinds=["masks"]), "masks/side: values: expected background",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", OTHER_PICTURES)
def test_pictures_that_do_not_belong_to_the_meshes_are_said(solid, tmp_path, case):
    edit, words = OTHER_PICTURES[case]
    capture = tmp_path / "capture"
    shutil.copytree(solid, capture)
    edit(capture)
    (line,) = [line for line in check_capture(capture).defects if "cameras.json: camera near: expected" not in line]
    assert re.search(words, line) and "\n" not in line, line
