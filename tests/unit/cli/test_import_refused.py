"""What importers refuse: one line each, nothing written, nothing run."""

import os
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from nbavatar.cli import main
from nbavatar.data.capture import open_capture
from nbavatar.io.meshfiles import read_mesh_file
from tests.scenes import foreign


def run(*words):
    return main(["import", *map(str, words)])


def errors(capfd):
    return [line for line in capfd.readouterr().err.splitlines() if "error:" in line]


@pytest.fixture(scope="module")
def flame(tmp_path_factory):
    return foreign.write_flame(tmp_path_factory.mktemp("flame") / "generic_model.pkl")


def first(**values):
    return lambda top: top["frames"][0].update(values)


def turn_first(matrix):
    return first(transform_matrix=matrix)


BAD_NERFSTUDIO = {
    "path above": (first(file_path="../../etc/passwd"), "file_path: expected a path inside"),
    "absolute path": (first(file_path="/etc/passwd"), "file_path: expected a path inside"),
    "mask above": (first(mask_path="../secret.png"), "mask_path: expected a path inside"),
    "zero byte": (first(file_path="images/\0.png"), "expected a path, found"),
    "long": (first(file_path="images/" + "9" * 5000), "expected a path, found"),
    "no characters": (first(file_path="images/\ud800"), "expected a path, found"),
    "no text": (first(file_path=7), "frames[0].file_path: expected a path"),
    "no picture": (first(file_path="images/none"), "expected a picture"),
    "fisheye": (lambda top: top.update(camera_model="OPENCV_FISHEYE"), "camera_model: expected one of"),
    "instant-ngp's fisheye": (lambda top: top.update(is_fisheye=True), "found 'OPENCV_FISHEYE'"),
    "model of another type": (lambda top: top.update(camera_model={}), "camera_model: expected one of"),
    "transform of another shape": (lambda top: top.update(applied_transform=3.5), "applied_transform: expected 3 x 4"),
    "transform of a row": (lambda top: top.update(applied_transform=[1, 2, 3, 4]), "applied_transform: expected 3 x 4"),
    "fourth coefficient": (lambda top: top.update(camera_model="OPENCV", k4=0.1), "k4: expected k1, k2, k3, p1, p2"),
    "lens of a pinhole": (lambda top: top.update(k1=0.1), "k1: expected no coefficients, as PINHOLE has"),
    "size": (lambda top: top.update(w=64), "w, h: expected 56 x 48 as its picture, found 64 x 48"),
    "focal length": (first(fl_x=-3), "fl_x: expected a focal length above 0"),
    "infinite": (first(fl_x=float("inf")), "fl_x: expected a number"),
    "huge": (first(fl_x=10**400), "fl_x: expected a number"),
    "no matrix": (lambda top: top["frames"][0].pop("transform_matrix"), "transform_matrix: expected 4 x 4"),
    "scaled": (turn_first((np.eye(4) * [2, 2, 2, 1]).tolist()), "expected a rotation in its first three columns"),
    "mirrored": (turn_first((np.eye(4) * [1, 1, -1, 1]).tolist()), "determinant -1"),
    "ragged": (turn_first([[1, 0], [0]]), "transform_matrix: expected 4 x 4"),
    "frames": (lambda top: top.update(frames=3), "frames: expected a list of frames"),
    "no frame": (lambda top: top.update(frames=[]), "expected pictures with calibrations, found none"),
    "moves": (
        lambda top: top["frames"][3]["transform_matrix"][0].__setitem__(3, 0.5),
        "expected one calibration, that of frame 0000, found another pose",
    ),
    "twice": (lambda top: top["frames"].append(top["frames"][0]), "expected one picture, found"),
    "transform": (lambda top: top.update(applied_transform=[[1, 0], [2, 2]]), "applied_transform: expected 3 x 4"),
    "scale that is all but nothing": (lambda top: top.update(applied_scale=1e-320), "applied_scale: expected a number"),
    "scale": (lambda top: top.update(applied_scale=0), "applied_scale: expected a number above 0"),
}


def assert_nothing_left(folder: Path, names: set[str]) -> None:
    assert set(os.listdir(folder)) == names


@pytest.mark.parametrize("case", BAD_NERFSTUDIO)
def test_bad_transforms_end_in_one_line_and_leave_nothing(tmp_path, capfd, case):
    change, line = BAD_NERFSTUDIO[case]
    source = foreign.write_nerfstudio(tmp_path / "a" / "ns")
    Image.new("L", (foreign.WIDTH, foreign.HEIGHT)).save(tmp_path / "a" / "secret.png")
    foreign.edit(source / "transforms.json", change)
    assert run("nerfstudio", source, tmp_path / "a" / "me") == 2
    lines = errors(capfd)
    assert len(lines) == 1 and line in lines[0], lines
    assert_nothing_left(tmp_path / "a", {"ns", "secret.png"})


def test_names_are_made_harmless_and_never_collide(tmp_path, capfd):
    source = foreign.write_nerfstudio(tmp_path / "ns")
    odd = "$(touch pwned);`id`\n-x"
    (source / "images/cam1").rename(source / "images" / odd)

    def rename(top):
        for frame in top["frames"]:
            frame["file_path"] = frame["file_path"].replace("cam1", odd)

    foreign.edit(source / "transforms.json", rename)
    assert run("nerfstudio", source, tmp_path / "me") == 0
    names = sorted(open_capture(tmp_path / "me").cameras)
    assert len(names) == 3 and all(set(name) <= set("cam02__touchpwned_id_-x") for name in names)
    assert "is called" in capfd.readouterr().out
    (source / "images" / odd).rename(source / "images/cam 0")
    (source / "images/cam2").rename(source / "images/cam_0")
    swap = {odd: "cam 0", "cam2": "cam_0"}

    def collide(top):
        for frame in top["frames"]:
            for old, new in swap.items():
                frame["file_path"] = frame["file_path"].replace(old, new)

    foreign.edit(source / "transforms.json", collide)
    assert run("nerfstudio", source, tmp_path / "other") == 2
    assert "expected another name, found that of" in errors(capfd)[0]


def test_links_that_leave_the_source_are_refused_unless_allowed(tmp_path, capfd):
    source = foreign.write_nerfstudio(tmp_path / "a" / "ns")
    (source / "images").rename(tmp_path / "a" / "elsewhere")
    (source / "images").symlink_to(tmp_path / "a" / "elsewhere")
    assert run("nerfstudio", source, tmp_path / "me") == 2
    assert "name the folder that holds them all with --within" in errors(capfd)[0]
    assert run("nerfstudio", source, tmp_path / "me", "--within", tmp_path / "a") == 0


def test_what_is_there_is_never_replaced(tmp_path, capfd):
    source, out = foreign.write_nerfstudio(tmp_path / "ns"), tmp_path / "me"
    out.mkdir()
    (out / "notes.txt").write_text("mine")
    assert run("nerfstudio", source, out) == 2
    assert "expected no such folder yet, or an empty one, found files" in errors(capfd)[0]
    assert_nothing_left(out, {"notes.txt"})
    (out / "notes.txt").unlink()
    assert run("nerfstudio", source, out) == 0


def test_turned_pictures_are_refused(tmp_path, capfd):
    source = foreign.write_nerfstudio(tmp_path / "ns")
    path = source / "images/cam0/0000.png"
    exif = Image.Exif()
    exif[0x0112] = 3
    Image.open(path).save(path, exif=exif)
    assert run("nerfstudio", source, tmp_path / "me") == 2
    assert "EXIF orientation: expected 1 (upright), found 3" in errors(capfd)[0]


def change_parameters(source, **values):
    path = source / "flame_param/00001.npz"
    arrays = {**np.load(path), **values}
    np.savez(path, **{key: value for key, value in arrays.items() if value is not None})


class _Touch:
    def __reduce__(self):
        return os.mkdir, ("pwned",)


BAD_VHAP = {
    "objects": (dict(expr=np.array([_Touch()], dtype=object)), "00001.npz"),
    "width": (dict(expr=np.zeros((1, 50), np.float32)), "expr: expected numbers [1, 100], found float32 [1, 50]"),
    "missing": (dict(jaw_pose=None), "jaw_pose: expected an array of this name"),
    "NaN": (dict(translation=np.full((1, 3), np.nan)), "translation: expected finite numbers"),
    "offsets": (dict(static_offset=np.zeros((1, 5, 3))), "static_offset: expected numbers [1, 612, 3]"),
    "text": (dict(shape=np.full(300, "x")), "shape: expected numbers [1, 300]"),
}


@pytest.mark.parametrize("case", BAD_VHAP)
def test_bad_parameters_end_in_one_line(tmp_path, flame, capfd, case, monkeypatch):
    monkeypatch.chdir(tmp_path)
    values, line = BAD_VHAP[case]
    source = foreign.write_vhap(tmp_path / "vhap")
    change_parameters(source, **values)
    assert run("vhap", source, tmp_path / "me", "--flame", flame) == 2
    lines = errors(capfd)
    assert len(lines) == 1 and line in lines[0], lines
    assert_nothing_left(tmp_path, {"vhap"})


def test_vhap_without_a_model_or_with_other_meshes_is_refused(tmp_path, capfd):
    source = foreign.write_vhap(tmp_path / "vhap")
    assert run("vhap", source, tmp_path / "me") == 2
    assert "name it with --flame" in errors(capfd)[0]
    foreign.edit(source / "transforms.json", lambda top: top.update(frames=[]))
    assert run("vhap", source, tmp_path / "me") == 2
    assert "frames: expected pictures with calibrations, found none" in errors(capfd)[0]
    meshes = foreign.write_vhap(tmp_path / "meshes", mode="mesh")
    verts, faces = read_mesh_file(meshes / "meshes/00003.obj")
    foreign.write_obj(meshes / "meshes/00003.obj", verts, faces[::-1])
    assert run("vhap", meshes, tmp_path / "me") == 2
    assert "00003.obj: faces: expected those of" in errors(capfd)[0]
    foreign.write_obj(meshes / "meshes/00003.obj", verts[:-1], faces[:4])
    assert run("vhap", meshes, tmp_path / "me") == 2
    assert "00003.obj: vertices: expected 612" in errors(capfd)[0]
    assert run("vhap", source, tmp_path / "me", "--scale", 2) == 2
    assert_nothing_left(tmp_path, {"vhap", "meshes"})


def cut_short(folder: Path, name: str) -> None:
    path = folder / "sparse/0" / name
    path.write_bytes(path.read_bytes()[:-9])


def many(folder: Path) -> None:
    path = folder / "sparse/0/images.bin"
    path.write_bytes(struct.pack("<Q", 2**63) + path.read_bytes()[8:])


BAD_COLMAP = {
    "cameras cut short": (True, lambda f: cut_short(f, "cameras.bin"), "the file is cut short"),
    "images cut short": (True, lambda f: cut_short(f, "images.bin"), "the file is cut short"),
    "count": (True, many, "the file is cut short"),
    "no such file": (True, lambda f: (f / "sparse/0/images.bin").write_bytes(b""), "byte 0: expected 8 bytes more"),
    "half": (False, lambda f: (f / "sparse/0/images.txt").unlink(), "expected cameras and images, both"),
    "text": (False, lambda f: (f / "sparse/0/cameras.txt").write_text("1 PINHOLE a b\n"), "cameras.txt, line 1"),
    "model": (False, lambda f: (f / "sparse/0/cameras.txt").write_text("10 X 4 4 1\n"), "found X"),
    "path above": (
        False,
        lambda f: (f / "sparse/0/images.txt").write_text("1 1 0 0 0 0 0 0 10 ../../../x/y.png\n\n"),
        "expected a path inside",
    ),
    "quaternion": (
        False,
        lambda f: (f / "sparse/0/images.txt").write_text("1 2 0 0 0 0 0 0 10 cam0/0000.png\n\n"),
        "expected a unit quaternion",
    ),
    "camera": (
        False,
        lambda f: (f / "sparse/0/images.txt").write_text("1 1 0 0 0 0 0 0 99 cam0/0000.png\n\n"),
        "expected a camera of the other file, found 99",
    ),
}


@pytest.mark.parametrize("case", BAD_COLMAP)
def test_bad_reconstructions_end_in_one_line(tmp_path, capfd, case):
    binary, damage, line = BAD_COLMAP[case]
    source = foreign.write_colmap(tmp_path / "colmap", binary=binary)
    damage(source)
    assert run("colmap", source, tmp_path / "me", "--names", "{camera}/{frame}") == 2
    lines = errors(capfd)
    assert len(lines) == 1 and line in lines[0], lines
    assert_nothing_left(tmp_path, {"colmap"})


def test_fisheyes_of_colmap_are_refused(tmp_path, capfd):
    source = foreign.write_colmap(tmp_path / "colmap", model="OPENCV_FISHEYE", lens={"k1": 0.1})
    assert run("colmap", source, tmp_path / "me") == 2
    assert "found OPENCV_FISHEYE; let COLMAP undistort" in errors(capfd)[0]
