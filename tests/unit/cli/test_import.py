import json
import os
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from nbavatar.camera.distortion import distort_pixels
from nbavatar.camera.pinhole import project
from nbavatar.cli import main
from nbavatar.config.sheets import capture_subjects
from nbavatar.data.capture import open_capture, read_mesh, read_splits, read_topology
from nbavatar.data.capture_check import check_capture
from nbavatar.io.meshfiles import read_mesh_file
from tests.scenes import foreign

POINTS = 0.12 * np.random.default_rng(5).uniform(-1, 1, (200, 3))
# The promise; the chain is double precision, and text holds it exactly.
PIXELS = 1e-6


def run(*words, **more):
    return main(["import", *map(str, words)])


def errors(capfd):
    return [line for line in capfd.readouterr().err.splitlines() if "error:" in line]


def assert_cameras_see_what_the_source_sees(out, lens=None, rig=None, names=None):
    capture = open_capture(out)
    for index, camera in enumerate(rig or foreign.rig()):
        ours = capture.cameras[(names or [f"cam{i}" for i in range(3)])[index]]
        pixels = distort_pixels(project(POINTS, ours.K, ours.cam_from_world)[0], ours.K, ours.distortion)
        np.testing.assert_allclose(pixels, foreign.expected_pixels(camera, POINTS, lens), rtol=0, atol=PIXELS)


def assert_checks(out):
    report = check_capture(out)
    assert not report.defects and min(report.overlap.values()) > 0.9, (report.defects, report.overlap)


@pytest.fixture(scope="module")
def flame(tmp_path_factory):
    return foreign.write_flame(tmp_path_factory.mktemp("flame") / "generic_model.pkl")


@pytest.mark.parametrize("teeth", [False, True])
def test_vhap_with_parameters(tmp_path, flame, capfd, teeth):
    source, out = foreign.write_vhap(tmp_path / "vhap", teeth=teeth), tmp_path / "me"
    assert run("vhap", source, out, "--flame", flame) == 0
    said = capfd.readouterr().out
    assert ("120 vertices of teeth are dropped" in said) == teeth
    assert_cameras_see_what_the_source_sees(out, names=foreign.CAMERAS)
    topology = read_topology(out)
    np.testing.assert_array_equal(topology["head"][0], foreign.head_faces())
    for time, verts in enumerate(foreign.heads(teeth=teeth)[1]):
        # Both skin in double precision; the last bit of a single-precision number may round the other way.
        ours = read_mesh(open_capture(out), f"{time:05d}", topology)["head"]
        np.testing.assert_allclose(ours, verts, rtol=0, atol=1e-7)
    still = foreign.flame_parameters(0, len(verts), teeth=teeth)
    still = {key: value * (key in ("shape", "static_offset", "translation")) for key, value in still.items()}
    still["translation"] = still["translation"] * 0
    np.testing.assert_allclose(topology["head"][1], foreign.posed_head(still), rtol=0, atol=1e-7)
    splits = json.loads((out / "splits.json").read_text())
    assert splits["train"] == ["00000", "00001", "00002", "00003"] and splits["test"] == ["00004"]
    assert splits["test_camera"] == "222200037" and "cuts" not in splits
    held_out = capture_subjects(str(out), "")["me"]
    assert held_out.test_camera == "222200037" and held_out.train_cameras == ("222200036", "222200038")
    for folder, theirs in (("images", "images"), ("masks", "fg_masks")):
        for index, camera in enumerate(foreign.CAMERAS):
            ours = (out / folder / camera / "00002.png").read_bytes()
            assert ours == (source / theirs / f"00002_{index:02d}.png").read_bytes()
    assert_checks(out)


@pytest.mark.parametrize("teeth", [False, True])
def test_vhap_with_meshes(tmp_path, teeth):
    source, out = foreign.write_vhap(tmp_path / "vhap", mode="mesh", teeth=teeth, whole=False), tmp_path / "me"
    assert run("vhap", source, out, "--copy") == 0
    assert not any(path.is_symlink() for path in out.rglob("*"))
    topology = read_topology(out)
    for time in range(foreign.TIMES):
        verts, faces = read_mesh_file(source / "meshes" / f"{time:05d}.obj")
        ours = read_mesh(open_capture(out), f"{time:05d}", topology)["head"]
        np.testing.assert_array_equal(ours, verts.astype(np.float32))
        assert len(verts) == len(foreign.heads()[1][0]) + 120 * teeth
    np.testing.assert_array_equal(topology["head"][0], faces)
    np.testing.assert_array_equal(topology["head"][1], read_mesh_file(source / "canonical.obj")[0].astype(np.float32))
    assert_cameras_see_what_the_source_sees(out, names=foreign.CAMERAS)
    assert_checks(out)


def test_vhap_breaks_of_the_recording_become_cuts(tmp_path):
    source = foreign.write_vhap(tmp_path / "vhap", mode="mesh")

    def jump(frame):
        if frame["timestep_index"] > 2:
            frame["timestep_index_original"] += 100

    edit(source / "transforms.json", lambda top: [jump(frame) for frame in top["frames"]])
    assert run("vhap", source, tmp_path / "me") == 0
    assert read_splits(tmp_path / "me").frames == [f"{t:05d}" for t in range(foreign.TIMES)]
    assert json.loads((tmp_path / "me/splits.json").read_text())["cuts"] == [["00002", "00003"]]


LENSES = {
    "PINHOLE": None,
    "SIMPLE_RADIAL": {"k1": 0.12},
    "RADIAL": {"k1": 0.12, "k2": -0.03},
    "OPENCV": {"k1": 0.11, "k2": -0.06, "p1": 0.002, "p2": -0.001},
}


@pytest.mark.parametrize("moved", [False, True])
@pytest.mark.parametrize("lens", [None, foreign.LENS])
def test_nerfstudio(tmp_path, lens, moved):
    source, out = foreign.write_nerfstudio(tmp_path / "ns", lens=lens, scale=0.25, moved=moved), tmp_path / "me"
    meshes = foreign.write_meshes(tmp_path / "meshes", scale=0.25)
    assert run("nerfstudio", source, out, "--scale", 0.25, "--meshes", meshes) == 0
    rig = [{**camera, "cx": foreign.rig()[0]["cx"], "cy": foreign.rig()[0]["cy"]} for camera in foreign.rig()]
    assert_cameras_see_what_the_source_sees(out, lens, rig)
    topology = read_topology(out)
    for time, verts in enumerate(foreign.heads()[1]):
        ours = read_mesh(open_capture(out), f"{time:04d}", topology)["head"]
        np.testing.assert_allclose(ours, verts, rtol=0, atol=1e-7)
    assert (out / "masks/cam1/0003.png").read_bytes() == (source / "masks/cam1/0003.png").read_bytes()
    if lens is None:
        assert_checks(out)


def test_pixel_centres_of_the_source_may_lie_at_zero(tmp_path):
    source = foreign.write_nerfstudio(tmp_path / "ns")
    assert run("nerfstudio", source, tmp_path / "me", "--pixel-center", 0.0) == 0
    first = foreign.rig()[0]
    K = open_capture(tmp_path / "me").cameras["cam0"].K
    assert K[0, 2] == first["cx"] + 0.5 and K[1, 2] == first["cy"] + 0.5


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("model", ["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"])
def test_colmap(tmp_path, binary, model):
    lens = {"FULL_OPENCV": {**LENSES["OPENCV"], "k3": 0.02, "k4": 0.3, "k5": -0.1, "k6": 0.05}, **LENSES}.get(model)
    source, out = tmp_path / "colmap", tmp_path / "me"
    foreign.write_colmap(source, binary=binary, model=model, lens=lens, scale=2.0)
    meshes = foreign.write_meshes(tmp_path / "meshes", kind="ply")
    assert run("colmap", source, out, "--scale", 2.0, "--mesh-scale", 1.0, "--meshes", meshes) == 0
    one = "f" in foreign.COLMAP_MODELS[model][1]
    rig = [{**camera, "fy": camera["fx"]} if one else camera for camera in foreign.rig()]
    assert_cameras_see_what_the_source_sees(out, lens, rig)
    assert read_splits(out).frames == ["0000", "0001", "0002", "0003", "0004"]
    if model == "PINHOLE":
        assert_checks(out)


def test_a_rig_calibrated_from_one_picture_a_camera(tmp_path):
    source = foreign.write_colmap(tmp_path / "colmap", calibration_only=True)
    foreign.write_pictures(tmp_path / "video", masks=tmp_path / "mattes")
    meshes = foreign.write_meshes(tmp_path / "meshes")
    more = ["--images", tmp_path / "video", "--masks", tmp_path / "mattes", "--meshes", meshes]
    assert run("colmap", source, tmp_path / "me", *more) == 0
    assert_cameras_see_what_the_source_sees(tmp_path / "me")
    assert_checks(tmp_path / "me")


def test_one_moving_camera_stands_still_and_the_meshes_move(tmp_path):
    """Each of the rig's pictures of one moment becomes a moment of one camera; the meshes have to follow it."""
    pictures = tmp_path / "ns"
    foreign.write_nerfstudio(pictures)

    def one_moment(top):
        kept = [frame for frame in top["frames"] if frame["file_path"].endswith("0002.png")]
        for frame in kept:
            frame["fl_x"], frame["fl_y"] = 83.0, 84.0
        top["frames"] = kept

    edit(pictures / "transforms.json", one_moment)
    head = foreign.heads()[1][2]
    for index in range(3):
        foreign.write_obj(tmp_path / "meshes" / f"cam{index}.obj", head, foreign.head_faces())
    out = tmp_path / "me"
    assert run("nerfstudio", pictures, out, "--names", "{frame}/0002", "--meshes", tmp_path / "meshes") == 0
    camera = open_capture(out).cameras["camera"]
    topology = read_topology(out)
    for index, seen in enumerate(foreign.rig()):
        seen = {**seen, "fx": 83.0, "fy": 84.0, "cx": foreign.rig()[0]["cx"], "cy": foreign.rig()[0]["cy"]}
        verts = read_mesh(open_capture(out), f"cam{index}", topology)["head"].astype(np.float64)
        pixels, _ = project(verts, camera.K, camera.cam_from_world)
        # Meshes are stored in single precision: 0.5 m at 83 px a metre and 2^-25 of it each way.
        np.testing.assert_allclose(pixels, foreign.expected_pixels(seen, head), rtol=0, atol=2e-5)
    assert run("nerfstudio", pictures, tmp_path / "b", "--names", "{frame}/0002") == 2, "meshes are needed"


def test_mesh_files_go_into_a_capture_without_meshes(tmp_path, capfd):
    source = foreign.write_nerfstudio(tmp_path / "ns")
    assert run("nerfstudio", source, tmp_path / "me") == 0
    assert "there are no meshes; add them with: nbavatar import meshes" in capfd.readouterr().out
    meshes = foreign.write_meshes(tmp_path / "meshes", kind="ply", scale=0.001, folder=".")
    assert run("meshes", meshes, tmp_path / "me", "--scale", 0.001) == 0
    assert_checks(tmp_path / "me")
    assert run("meshes", meshes, tmp_path / "me") == 2
    assert "expected no such folder yet, or an empty one" in errors(capfd)[0]


def test_inside_out_meshes_are_repaired_where_asked(tmp_path, capfd):
    source = foreign.write_nerfstudio(tmp_path / "ns")
    faces = foreign.head_faces()
    broken = np.concatenate([faces[:, ::-1], faces[:4], [[5, 5, 6]]])
    for time, verts in enumerate(foreign.heads()[1]):
        foreign.write_obj(tmp_path / "meshes" / f"{time}.obj", verts, broken)
    assert run("nerfstudio", source, tmp_path / "me", "--meshes", tmp_path / "meshes", "--repair") == 0
    said = capfd.readouterr().out
    assert "4 repeated faces dropped" in said and "1 faces with a vertex twice dropped" in said
    assert f"{len(faces)} faces turned outwards" in said
    assert_checks(tmp_path / "me")


# --- what is refused -------------------------------------------------------------------------------------------------


def edit(path: Path, change) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def first(**values):
    return lambda top: top["frames"][0].update(values)


def turn_first(matrix):
    return first(transform_matrix=matrix)


BAD_NERFSTUDIO = {
    "path above": (first(file_path="../../etc/passwd"), "file_path: expected a path inside"),
    "absolute path": (first(file_path="/etc/passwd"), "file_path: expected a path inside"),
    "mask above": (first(mask_path="../secret.png"), "mask_path: expected a path inside"),
    "zero byte": (first(file_path="images/\0.png"), "expected a path, found"),
    "no text": (first(file_path=7), "frames[0].file_path: expected a path"),
    "no picture": (first(file_path="images/none"), "expected a picture"),
    "fisheye": (lambda top: top.update(camera_model="OPENCV_FISHEYE"), "camera_model: expected one of"),
    "instant-ngp's fisheye": (lambda top: top.update(is_fisheye=True), "found 'OPENCV_FISHEYE'"),
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
    "scale": (lambda top: top.update(applied_scale=0), "applied_scale: expected a number above 0"),
}


def assert_nothing_left(folder: Path, names: set[str]) -> None:
    assert set(os.listdir(folder)) == names


@pytest.mark.parametrize("case", BAD_NERFSTUDIO)
def test_bad_transforms_end_in_one_line_and_leave_nothing(tmp_path, capfd, case):
    change, line = BAD_NERFSTUDIO[case]
    source = foreign.write_nerfstudio(tmp_path / "a" / "ns")
    Image.new("L", (foreign.WIDTH, foreign.HEIGHT)).save(tmp_path / "a" / "secret.png")
    edit(source / "transforms.json", change)
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

    edit(source / "transforms.json", rename)
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

    edit(source / "transforms.json", collide)
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


def test_pycolmap_reads_the_same(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    source = foreign.write_colmap(tmp_path / "colmap", binary=True, model="OPENCV", lens=LENSES["OPENCV"])
    assert len(pycolmap.Reconstruction(str(source / "sparse/0")).images) == 15


def test_worlds_far_from_their_origin_keep_their_millimetres(tmp_path):
    """Coordinates of a map: 5,000 km away float32 holds half a metre."""
    far, source = np.array([4.2e6, 1.7e5, 4.8e6]), foreign.write_nerfstudio(tmp_path / "ns")

    def move(top):
        for frame in top["frames"]:
            for axis in range(3):
                frame["transform_matrix"][axis][3] += far[axis]

    edit(source / "transforms.json", move)
    for time, verts in enumerate(foreign.heads()[1]):
        foreign.write_obj(tmp_path / "meshes" / f"{time}.obj", verts + far, foreign.head_faces())
    assert run("nerfstudio", source, tmp_path / "me", "--meshes", tmp_path / "meshes") == 0
    assert_checks(tmp_path / "me")
    capture = open_capture(tmp_path / "me")
    ours = read_mesh(capture, "0002", read_topology(tmp_path / "me"))["head"] + capture.origin
    np.testing.assert_allclose(ours, foreign.heads()[1][2] + far, rtol=0, atol=1e-6)


def test_a_mesh_sequence_goes_into_a_capture(capture, tmp_path):
    """What `nbavatar fit` and `tracks` write, back into the files of a capture."""
    words = ["--layout", "capture", "--root", str(capture), "--subject", "me", "--cfg", '{"contact": "given"}']
    assert main(["tracks", *words, "--out", str(tmp_path / "meshes.npz")]) == 0
    before = {path.name: dict(np.load(path)) for path in (capture / "meshes").glob("t*[0-9].npz")}
    faces = dict(np.load(capture / "meshes/topology.npz"))
    (capture / "meshes").rename(tmp_path / "old")
    assert run("meshes", tmp_path / "meshes.npz", capture) == 0
    after = {path.name: dict(np.load(path)) for path in (capture / "meshes").glob("t*[0-9].npz")}
    assert len(after) == len(before) == 5
    for name, arrays in after.items():
        for part in ("head", "right_hand"):
            np.testing.assert_array_equal(arrays[part], before[name][part])
    topology = dict(np.load(capture / "meshes/topology.npz"))
    np.testing.assert_array_equal(topology["right_hand_faces"], faces["right_hand_faces"])
    assert not check_capture(capture).defects
