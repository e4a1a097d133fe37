import json

import numpy as np
import pytest
import trimesh

from nbavatar.camera.distortion import distort_pixels
from nbavatar.camera.pinhole import project
from nbavatar.checks.capture import check_capture
from nbavatar.cli import main
from nbavatar.config.sheets import capture_subjects
from nbavatar.data.capture import open_capture, read_mesh, read_splits, read_topology
from nbavatar.data.foreign.flame_parameters import FlameSequence
from nbavatar.data.foreign.mesh_files import open_meshes
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

    foreign.edit(source / "transforms.json", lambda top: [jump(frame) for frame in top["frames"]])
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

    foreign.edit(pictures / "transforms.json", one_moment)
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


def test_dense_meshes_are_made_coarser_where_asked(tmp_path, capfd):
    # A ball of 25 cm in millimetres that turns, grows and moves: coarse vertices follow an affine motion exactly.
    ball = trimesh.creation.icosphere(subdivisions=4, radius=125.0)
    motions = [(1.0, 0.0, [0, 0, 0]), (1.02, 0.4, [3.0, -40, 9]), (0.98, -1.0, [500.0, 2, 1])]
    posed = []
    for i, (scale, angle, shift) in enumerate(motions):
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        posed.append((scale * turn, np.array(shift)))
        foreign.write_obj(tmp_path / "meshes" / f"{i}.obj", ball.vertices @ (scale * turn).T + shift, ball.faces)
    files = open_meshes(tmp_path / "meshes", scale=0.001, max_faces=400)
    faces = files.topology()["head"][0]
    assert 300 < len(faces) <= 400 and "5120 faces made" in files.notes[0]
    first = files.vertices("0")["head"]
    assert trimesh.Trimesh(first, faces, process=False).is_watertight and len(np.unique(faces)) == len(first)
    np.testing.assert_allclose(np.linalg.norm(first, axis=1), 0.125, rtol=3e-3)
    for i, (linear, shift) in enumerate(posed):
        np.testing.assert_allclose(files.vertices(str(i))["head"], first @ linear.T + 0.001 * shift, atol=1e-9)
    assert run("nerfstudio", foreign.write_nerfstudio(tmp_path / "ns"), tmp_path / "me", "--max-faces", 400) == 2
    assert errors(capfd)[0].endswith("--max-faces: expected mesh files, by --meshes, found none")


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

    foreign.edit(source / "transforms.json", move)
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


@pytest.mark.parametrize("kept", [(), ("static_offset",), ("dynamic_offset",)])
def test_offsets_are_optional(tmp_path, flame, kept):
    parameters = foreign.flame_parameters(2, len(foreign.flame()["v_template"]))
    parameters = {key: value for key, value in parameters.items() if "offset" not in key or key in kept}
    np.savez(tmp_path / "a.npz", **parameters)
    sequence = FlameSequence(flame, {"7": tmp_path / "a.npz"})
    np.testing.assert_allclose(sequence.vertices("007")["head"], foreign.posed_head(parameters), rtol=0, atol=1e-12)
    assert not sequence.vertices("8")
