"""The synthetic dataset: what is on disk, what it means, and that the same seed gives the same bytes."""

import hashlib
import json
from pathlib import Path

import igl
import numpy as np
import pytest
import torch
import trimesh

from nbavatar.bodymodels.files import read_flame, read_landmarks, read_mano
from nbavatar.bodymodels.flame import Flame
from nbavatar.bodymodels.mano import Mano, shorten_tips
from nbavatar.camera.distortion import distort_pixels
from nbavatar.camera.pinhole import project
from nbavatar.cli import main
from nbavatar.config.synthetic import CAMERAS, RECORD, refuse_others
from nbavatar.data.capture import open_capture, read_mesh, read_topology
from nbavatar.data.synthetic.capture import labels_of
from nbavatar.data.synthetic.dataset import write_dataset
from nbavatar.data.synthetic.figure import build_figure, pose_figure
from nbavatar.data.synthetic.hair import loose_hair
from nbavatar.data.synthetic.models import EYE_ORIGIN
from nbavatar.data.synthetic.scene import build_bodies, make_scene
from nbavatar.data.synthetic.shading import ARM, CLOTH
from nbavatar.data.synthetic.studio import lens_of, make_cameras
from nbavatar.errors import ConfigError, DataError
from nbavatar.io.images import decode_image
from nbavatar.io.pickles import read_pickle
from nbavatar.io.video import probe_video, read_video
from nbavatar.math.rotations import axis_angle_to_matrix
from nbavatar.mesh.zbuffer import rasterize_mesh

FRAMES, WIDTH, HEIGHT = 8, 96, 54
OPTIONS = {
    "cameras": ("084", "108", "122"),
    "frames": FRAMES,
    "width": WIDTH,
    "height": HEIGHT,
    "mesh": "tiny",
    "supersample": 2,
}


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("synthetic")
    write_dataset(folder, subjects=("S2", "S3"), keypoint_noise=0.0, missing=0.1, **OPTIONS)
    return folder


def _subject(root: Path, name: str) -> tuple[Path, Path]:
    return root / ("test" if name == "S3" else "train"), root / "assets"


def _models(root: Path) -> tuple[Flame, Mano]:
    arrays = read_flame(root / "assets" / "generic_model.pkl")
    landmarks = read_landmarks(root / "assets" / "landmark_embedding.npy", len(arrays.faces))
    mano = read_mano(root / "assets" / "mano_v1_2" / "models" / "MANO_RIGHT.pkl")
    return Flame.build(arrays, landmarks, dtype=torch.float64), Mano.build(mano, dtype=torch.float64)


def _meshes(root: Path, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Deformed head, hand, landmarks and joints, from the files alone and by the release's rules."""
    base, assets = _subject(root, name)
    stored = read_pickle(base / "params" / name / "params_smoothed.pkl")
    flame, mano = _models(root)

    def stack(part: str, key: str) -> torch.Tensor:
        return torch.from_numpy(np.stack([stored[k][part][key] for k in sorted(stored, key=int)]).astype(np.float64))

    rotation = axis_angle_to_matrix(stack("head", "global_orient"))
    verts = flame.forward_decaf(
        stack("head", "shape_params"),
        stack("head", "expression_params"),
        stack("head", "pose_params")[:, 3:],
        stack("head", "global_orient"),
        stack("head", "transl"),
    ).numpy()
    deform = np.load(base / "deformations" / name / "deforms.npy").astype(np.float64)
    deform[:, np.load(assets / "FLAME_neck_idx.npy")] = 0
    head = verts - np.einsum("nij,nvj->nvi", rotation.numpy(), deform)
    hand, joints = mano.forward(*(stack("right_hand", k) for k in ("betas", "hand_pose", "global_orient", "transl")))
    landmarks = flame.landmarks(torch.from_numpy(head)).numpy()  # type: ignore[misc]
    return head, hand.numpy(), landmarks, shorten_tips(joints).numpy()


@pytest.mark.parametrize("name", ["S2", "S3"])
def test_the_tree_is_the_releases(root: Path, name: str) -> None:
    base, assets = _subject(root, name)
    for camera in OPTIONS["cameras"]:
        for folder in ("videos", "segmentations"):
            info = probe_video(base / folder / name / f"{camera}.mp4")
            assert (info.width, info.height, info.count) == (WIDTH, HEIGHT, FRAMES)
        for folder, shape in (
            ("head_keys", (68, 3)),
            ("right_hand_keys", (21, 3)),
            ("head_bbs", (4,)),
            ("right_hand_bbs", (4,)),
        ):
            array = np.load(base / folder / name / f"{camera}.npy")
            assert array.shape == (FRAMES, *shape) and np.isfinite(array).all()
    assert np.load(base / "deformations" / name / "deforms.npy").shape == (FRAMES, 612, 3)
    assert np.load(base / "contacts" / name / "contacts_head.npy").shape == (FRAMES, 612)
    assert np.load(base / "contacts" / name / "contacts_rh.npy").shape == (FRAMES, 200)
    poses = np.load(assets / "transformation" / base.name / f"{name}_RT_FromCanToRef_wo_poseparams.npy")
    assert poses.shape == (FRAMES, 4, 4)
    stored = read_pickle(base / "params" / name / "params_smoothed.pkl")
    assert sorted(stored, key=int) == [str(n) for n in range(FRAMES)]
    sizes = {
        "head": {"transl": 3, "global_orient": 3, "shape_params": 100, "expression_params": 50, "pose_params": 6},
        "right_hand": {"betas": 10, "global_orient": 3, "hand_pose": 45, "transl": 3},
    }
    for frame in stored.values():
        assert {p: {k: v.shape for k, v in d.items()} for p, d in frame.items()} == {
            p: {k: (n,) for k, n in d.items()} for p, d in sizes.items()
        }
    rotation = axis_angle_to_matrix(
        torch.from_numpy(np.stack([stored[str(n)]["head"]["global_orient"] for n in range(FRAMES)]).astype(np.float64))
    )
    np.testing.assert_allclose(poses[:, :3, :3], rotation.numpy(), atol=1e-6)  # parameters are float32
    (cut,) = read_pickle(base / "cutIDs" / f"{name}.pkl")
    assert cut[1] == cut[0] + 1 and 0 <= cut[0] < FRAMES - 1
    cameras = read_pickle(base / "cameras" / name / "cameras.pkl")
    assert set(cameras) == set(OPTIONS["cameras"])
    for camera in cameras.values():
        pose = np.array(camera["extrinsic"])
        assert np.shape(camera["intrinsic"]) == (3, 3) and pose.shape == (4, 4)
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        assert len(camera["distortion"]) == 5 and camera["distortion"][0] != 0
    accurate = read_pickle(assets / "accurate_shapes" / f"{name}.pkl")
    np.testing.assert_array_equal(accurate["head"]["shape_params"], stored["0"]["head"]["shape_params"])
    flip = np.load(assets / "left_right_face_corresps.npy")
    np.testing.assert_array_equal(flip[flip], np.arange(612))
    assert set(np.load(assets / "FLAME_neck_idx.npy")) < set(np.load(assets / "neck_idx.npy"))


@pytest.mark.parametrize("name", ["S2", "S3"])
def test_models_project_onto_the_keypoints(root: Path, name: str) -> None:
    """Without noise every keypoint that is there is the projection of its landmark: parameters, deformation sign and
    frame, distortion and tip shortening all have to be right for that."""
    base, _ = _subject(root, name)
    _, _, landmarks, joints = _meshes(root, name)
    cameras = read_pickle(base / "cameras" / name / "cameras.pkl")
    for camera_name, camera in cameras.items():
        for part, points in (("head", landmarks), ("right_hand", joints)):
            keys = np.load(base / f"{part}_keys" / name / f"{camera_name}.npy")
            ideal, depth = project(points, camera["intrinsic"], np.array(camera["extrinsic"]))
            assert (depth > 0.5).all()
            expected = distort_pixels(ideal, camera["intrinsic"], camera["distortion"])
            there = keys[..., 2] > 0
            assert 0.5 < there.mean() < 1.0  # some are missing
            # parameters are stored as float32: 1e-6 m at 1.3 m and 160 px focal length, and keypoints themselves
            np.testing.assert_allclose(keys[there][:, :2], expected[there], atol=2e-3)


@pytest.mark.parametrize("name", ["S2", "S3"])
def test_masks_show_the_whole_person(root: Path, name: str) -> None:
    base, _ = _subject(root, name)
    head, hand, _, _ = _meshes(root, name)
    flame, mano = _models(root)
    faces = np.concatenate([flame.faces, mano.faces + head.shape[1]])
    cameras = read_pickle(base / "cameras" / name / "cameras.pkl")
    camera = cameras["108"]
    masks = list(read_video(base / "segmentations" / name / "108.mp4", gray=True))
    images = list(read_video(base / "videos" / name / "108.mp4"))
    assert len(masks) == len(images) == FRAMES
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    bent = distort_pixels(np.stack([x, y], -1), camera["intrinsic"], camera["distortion"])
    for n in range(FRAMES):
        seen = rasterize_mesh(
            np.concatenate([head[n], hand[n]]),
            faces,
            camera["intrinsic"],
            WIDTH,
            HEIGHT,
            cam_from_world=np.array(camera["extrinsic"]),
        )[0]
        rows, columns = np.nonzero(seen >= 0)
        at = np.floor(bent[rows, columns]).astype(int)
        inside = (at[:, 0] >= 0) & (at[:, 0] < WIDTH) & (at[:, 1] >= 0) & (at[:, 1] < HEIGHT)
        person = masks[n] > 127
        assert person[at[inside, 1], at[inside, 0]].mean() > 0.98  # all but the outline's own pixels
        assert person.sum() > 1.3 * inside.sum()  # torso, arm and hair too
        assert images[n].std() > 20
    values = np.unique(np.stack(masks))
    assert ((values > 10) & (values < 245)).any()  # soft and lossy, so a reader has to threshold


def test_the_hand_touches_in_both_takes_and_boxes_go_missing(root: Path) -> None:
    base, _ = _subject(root, "S2")
    contact = np.load(base / "contacts" / "S2" / "contacts_head.npy") > 0
    (cut,) = read_pickle(base / "cutIDs" / "S2.pkl")
    assert contact[: cut[0] + 1].any() and contact[cut[1] :].any()
    assert not contact[0].any()
    boxes = np.concatenate(
        [np.load(base / f"{p}_bbs" / "S2" / f"{c}.npy") for p in ("head", "right_hand") for c in OPTIONS["cameras"]]
    )
    gone = (boxes == -1).all(1)
    assert 0 < gone.sum() < len(boxes) / 2
    assert (boxes[~gone] >= 0).all() and (boxes[~gone, 2:] > boxes[~gone, :2]).all()


def _digests(folder: Path) -> dict[str, str]:
    files = [p for p in sorted(folder.rglob("*")) if p.is_file()]
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def test_the_same_seed_gives_the_same_bytes_whatever_the_threads(tmp_path: Path) -> None:
    few = {**OPTIONS, "cameras": ("108",), "frames": 4}
    for folder, seed, workers in (("a", 3, 1), ("b", 3, 3), ("c", 4, 1)):
        write_dataset(tmp_path / folder, subjects=("S4",), seed=seed, workers=workers, **few)
    a, b, c = (_digests(tmp_path / folder) for folder in "abc")
    assert a == b
    changed = {name for name in a if a[name] != c[name]}
    assert "train/videos/S4/108.mp4" in changed and "train/params/S4/params_smoothed.pkl" in changed
    assert "assets/generic_model.pkl" not in changed


def test_odd_sizes_and_unknown_codecs_are_one_line_and_leave_nothing(tmp_path: Path) -> None:
    few = {**OPTIONS, "cameras": ("108",), "frames": 4}
    with pytest.raises(DataError, match="even"):
        write_dataset(tmp_path / "odd", subjects=("S4",), **{**few, "width": 97})
    with pytest.raises(DataError, match="codec"):
        write_dataset(tmp_path / "codec", subjects=("S4",), codec="zzzz", **few)
    assert not list((tmp_path / "codec").rglob("*.mp4"))


def test_all_cameras_of_the_release_are_offered() -> None:
    assert CAMERAS == ("084", "100", "102", "108", "110", "111", "121", "122")


def test_files_of_others_are_not_written_over(tmp_path):
    """Whoever licensed the real thing cannot make it again; what was made so before is ours to make again."""
    own = tmp_path / "assets" / "generic_model.pkl"
    own.parent.mkdir()
    own.write_bytes(b"licensed")
    with pytest.raises(ConfigError, match=r"expected a folder without files.* found assets/generic_model.pkl"):
        write_dataset(tmp_path, subjects=("S2",), **OPTIONS)
    assert own.read_bytes() == b"licensed" and len(list(tmp_path.rglob("*"))) == 2
    own.unlink()
    refuse_others(tmp_path)
    own.write_bytes(b"made before")
    (tmp_path / RECORD).write_text('{"subjects": ["S2"]}')
    refuse_others(tmp_path)


def test_a_dataset_is_known_as_synthetic_before_it_is_whole(root):
    assert json.loads((root / RECORD).read_text())["complete"] is True
    with pytest.raises(DataError, match="codec"):
        write_dataset(root.parent / "half", subjects=("S2",), **OPTIONS, codec="none!")
    assert json.loads((root.parent / "half" / RECORD).read_text())["complete"] is False
    refuse_others(root.parent / "half")


def test_a_subject_as_a_capture_passes_its_check_and_its_ponytail_is_in_no_mesh(tmp_path: Path) -> None:
    options = {"layout": "capture", "hair": "ponytail", "width": 96, "height": 96, "focal": 2.3, "frames": 4}
    options |= {"cameras": ["084", "108", "122"], "mesh": "tiny", "subjects": ["S2"], "supersample": 2}
    assert main(["synthesize", "--out", str(tmp_path), "--cfg", json.dumps(options)]) == 0
    root = tmp_path / "S2"
    assert main(["check", str(root)]) == 0
    capture = open_capture(root)
    camera, mesh = capture.camera("122"), read_mesh(capture, "00000", read_topology(root))
    label = decode_image(root / "masks/122/00000.png")
    alpha = decode_image(root / "alpha/122/00000.png")
    assert np.array_equal(np.isin(label, (1, 2)), alpha >= 128) and (label == 255).any()
    head = project(mesh["head"].astype(np.float64), camera.K, camera.cam_from_world)[0]
    x = np.flatnonzero((label == 1).any(0))
    assert x.max() > head[:, 0].max() + 8  # the ponytail, a tenth of the picture beyond the head
    assert abs(x.min() - head[:, 0].min()) < 5


def test_labels_say_nothing_where_cloth_or_arm_hide_head_or_hand() -> None:
    """Rays of libigl through pixels: the first face that they hit, and whether any is the head's or the hand's."""
    scene = make_scene(build_bodies("tiny"), "S2", 2, 0, dents=False)
    figure = build_figure(scene, "cap")
    verts = pose_figure(figure, scene, 1)[0]
    other = np.isin(figure.material, (ARM, CLOTH))
    seen = {True: 0, False: 0}
    for name, camera in make_cameras(("100", "121"), 96, 96, focal=2.3, distortion=0.0).items():
        label, _ = labels_of(lens_of(camera, 1), figure, verts)
        local = np.ascontiguousarray(verts @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3])
        pixels = [tuple(p) for p in np.argwhere(label == 255)] + [
            (y, x) for y in range(1, 96, 9) for x in range(1, 96, 9)
        ]
        for y, x in pixels:
            ray = np.linalg.solve(camera.K, [x + 0.5, y + 0.5, 1.0])
            hits = igl.ray_mesh_intersect(np.zeros(3), ray, local, figure.faces.astype(np.int64))
            faces = [hit[0] for hit in sorted(hits, key=lambda hit: hit[1])]
            hidden = bool(faces) and other[faces[0]] and not other[faces].all()
            assert (label[y, x] == 255) == hidden, (name, y, x)
            seen[hidden] += 1
    assert min(seen.values()) > 40, seen


def test_beard_stands_off_chin_and_cheeks_and_leaves_the_lips_bare() -> None:
    scene = make_scene(build_bodies("tiny"), "S2", 2, 0, dents=False)
    head = scene.head[0]
    points = (scene.bodies.human.head - EYE_ORIGIN) * 1e3
    bearded, shaved = build_figure(scene, "beard"), build_figure(scene, "cap")
    layer = pose_figure(bearded, scene, 0)[0][bearded.piece(2)[0]]
    height = np.linalg.norm(layer - head[bearded.hair_ids], axis=1)
    place = points[bearded.hair_ids]
    added = ~np.isin(bearded.hair_ids, shaved.hair_ids)
    chin = added & (np.abs(place[:, 0]) < 15) & (place[:, 1] < -95) & (place[:, 2] > -20)
    assert chin.any() and height[chin].max() > 0.015
    assert not (added & (place[:, 1] > -35)).any()
    lips = np.flatnonzero((np.abs(points[:, 0]) < 12) & (np.abs(points[:, 1] + 72) < 5) & (points[:, 2] > 0))
    assert len(lips) and not np.isin(lips, bearded.hair_ids).any()


def test_long_hair_is_of_closed_locks_that_reach_lower_than_the_head() -> None:
    scene = make_scene(build_bodies("tiny"), "S2", 2, 0, dents=False)
    verts, faces = loose_hair("long")
    locks = trimesh.Trimesh(verts, faces, process=False).split(only_watertight=False)
    assert len(locks) > 10 and all(lock.is_watertight and lock.volume > 0 for lock in locks)
    lowest = (scene.bodies.human.head - EYE_ORIGIN)[:, 1].min()
    assert verts[:, 1].min() < lowest - 0.01
    assert not len(loose_hair("cap")[0])
