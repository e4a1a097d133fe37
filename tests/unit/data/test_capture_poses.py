"""Cameras that users mistake: each is found by its masks, and what was meant is said."""

import json
import re

import numpy as np
import pytest
from PIL import Image

from nbavatar.checks.capture import check_capture
from tests.scenes.solid import write_solid

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
