"""The networks themselves, on a photograph and on synthetic images with known keypoints.

They need MediaPipe's files: `pip install --no-deps mediapipe==0.10.21`, or its wheel, named by the environment variable
NBAVATAR_DETECTOR_MODELS. Without them these tests are skipped, as nothing can stand in for trained networks.
"""

import os

import numpy as np
import pytest

from nbavatar.cli import main
from nbavatar.config.detection import DetectConfig
from nbavatar.data.detector_models import read_detector_models
from nbavatar.detection.stage import Detector
from nbavatar.errors import DependencyError
from nbavatar.io.framepack import FramePackWriter

VARIABLE = "NBAVATAR_DETECTOR_MODELS"


@pytest.fixture(scope="module")
def models():
    try:
        return read_detector_models(os.environ.get(VARIABLE))
    except DependencyError as error:
        pytest.skip(f"no detector models ({error}); {VARIABLE} may name the wheel")


@pytest.fixture(scope="module")
def photograph():
    return pytest.importorskip("skimage.data").astronaut()


def detect(models, image, mask=None, labels=False, **options):
    detector = Detector(models, DetectConfig(**options))
    return next(iter(detector.run([(image, mask, labels)], [0])))


def check_face(keys, box):
    x0, y0, x1, y1 = box
    shown = keys[keys[:, 2] > 0, :2]
    assert len(shown) > 50
    assert (shown > [x0, y0]).all() and (shown < [x1, y1]).all()
    rows = {"right": range(36, 42), "left": range(42, 48), "nose": range(31, 36), "mouth": range(48, 68)}
    middle = {name: keys[list(which), :2].mean(0) for name, which in rows.items()}
    eyes = (middle["right"] + middle["left"]) / 2
    assert eyes[1] < middle["nose"][1] < middle["mouth"][1] < keys[8, 1]
    # The person's right eye is on the left of an image that is not mirrored; so are brow, nostril, corner of the mouth.
    assert middle["right"][0] < eyes[0] < middle["left"][0]
    for right, left in ((17, 26), (31, 35), (36, 45), (48, 54), (60, 64)):
        assert keys[right, 0] < keys[left, 0]


def test_a_face_is_found_and_its_sides_are_right(models, photograph):
    found = detect(models, photograph)
    # The face as one sees it: hair line to chin, ear to ear.
    check_face(found["head"], (160, 60, 285, 200))
    np.testing.assert_allclose(found["head"][[36, 45], :2].mean(0), [226, 103], atol=8)
    mirrored = detect(models, np.ascontiguousarray(photograph[:, ::-1]))
    check_face(mirrored["head"], (512 - 285, 60, 512 - 160, 200))
    assert not found["left_hand"].any() and not found["right_hand"].any()


def test_a_turned_image_turns_the_face_with_it(models, photograph):
    import cv2

    matrix = cv2.getRotationMatrix2D((225, 120), 25, 1.0)
    upright = detect(models, photograph)["head"]
    turned = detect(models, cv2.warpAffine(photograph, matrix, (512, 512)))["head"]
    both = (upright[:, 2] > 0.5) & (turned[:, 2] > 0.5)
    moved = upright[both, :2] @ matrix[:, :2].T + matrix[:, 2]
    # Eyes are 62 px apart; the network itself is not exactly invariant.
    assert both.sum() > 30 and np.median(np.linalg.norm(moved - turned[both, :2], axis=1)) < 2.5


def test_an_empty_image_has_nothing(models):
    image = np.random.default_rng(0).integers(90, 110, (240, 320, 3), dtype=np.uint8)
    assert not any(keys.any() for keys in detect(models, image).values())


@pytest.fixture(scope="module")
def touch():
    """A synthetic person who touches the face: image, matte, true keypoints of head and right hand [px]."""
    from nbavatar.camera.pinhole import project
    from nbavatar.data.synthetic.figure import build_figure, pose_figure
    from nbavatar.data.synthetic.scene import build_bodies, make_scene
    from nbavatar.data.synthetic.studio import lens_of, light_up, make_cameras
    from nbavatar.data.synthetic.studio import photograph as take

    scene = make_scene(build_bodies("full"), "S2", 4, 0)
    camera = make_cameras(("102",), 960, 540, distortion=0.0)["102"]
    figure = build_figure(scene)
    posed = pose_figure(figure, scene, 1)
    image, person = take(lens_of(camera, 1), figure, posed, light_up(posed[0], figure.faces, 512))
    truth = [project(points[1], camera.K, camera.cam_from_world)[0] for points in (scene.landmarks, scene.joints)]
    return image, person, *truth


@pytest.mark.slow
@pytest.mark.parametrize("masked", [False, True])
def test_a_hand_on_a_face_is_found_on_its_side_near_the_truth(models, touch, masked):
    image, person, landmarks, joints = touch
    found = detect(models, image, person if masked else None)
    assert not found["left_hand"].any()
    error = np.linalg.norm(found["right_hand"][:, :2] - joints, axis=1)
    # A hand of 190 px; detectors mark joints on the surface, models within, and the wrist higher up the arm.
    assert np.median(error) < 0.06 * np.ptp(joints, axis=0).max()
    inner = np.flatnonzero(found["head"][:, 2] > 0.5)
    assert len(inner) > 20
    off = np.linalg.norm(found["head"][inner, :2] - landmarks[inner], axis=1)
    assert np.median(off) < 0.05 * np.ptp(landmarks, axis=0).max()


@pytest.mark.slow
def test_in_the_mirror_the_hand_is_a_left_one(models, touch):
    image, _, _, joints = touch
    found = detect(models, np.ascontiguousarray(image[:, ::-1]))
    assert not found["right_hand"].any()
    error = np.linalg.norm(found["left_hand"][:, :2] - [960, 0] - joints * [-1, 1], axis=1)
    assert np.median(error) < 0.06 * np.ptp(joints, axis=0).max()


@pytest.mark.slow
def test_labels_overrule_the_network_and_drop_what_lies_elsewhere(models, touch):
    image, person, _, joints = touch
    label = np.zeros(person.shape, np.uint8)
    (x0, y0), (x1, y1) = (np.floor(joints.min(0)).astype(int), np.ceil(joints.max(0)).astype(int))
    label[y0:y1, x0:x1] = 3
    found = detect(models, image, label, labels=True)
    assert found["left_hand"].any() and not found["right_hand"].any()
    assert not detect(models, image, np.zeros_like(label), labels=True)["right_hand"].any()


def test_what_the_verb_writes_is_what_the_refit_reads(models, photograph, tmp_path, capsys):
    # A photograph on a wall, one metre away, seen by two cameras 0.1 m apart: all points lie in that plane.
    from nbavatar.cli.fit import _read_tracks
    from nbavatar.fitting.observe import observe

    focal, baseline = 800.0, 0.1
    packs = []
    for camera, shift in (("a", 0.0), ("b", baseline)):
        K = [[focal, 0, 256], [0, focal, 256], [0, 0, 1]]
        pose = np.eye(4)
        pose[0, 3] = -shift
        manifest = {
            "stage": "ingest", "subject": "wall", "camera": camera, "width": 512, "height": 512, "K": K,
            "cam_from_world": pose.tolist(), "frames": ["f0", "f1", "f2"], "layers": {"rgb": "colour"},
            "segments": [[0, 1], [2, 2]],
        }  # fmt: skip
        packs.append(tmp_path / f"{camera}.zip")
        with FramePackWriter(packs[-1], manifest) as pack:
            for frame in manifest["frames"]:
                pack.add("rgb", frame, np.roll(photograph, -round(shift * focal), axis=1))
    models_path = [] if VARIABLE not in os.environ else ["--models", os.environ[VARIABLE]]
    out, sheet = tmp_path / "keys.npz", tmp_path / "keys.png"
    words = ["detect", "--frames", *map(str, packs), *models_path, "--out", str(out), "--sheet", str(sheet)]
    assert (main([*words, "--cfg", '{"parts": ["head", "left_hand"]}']) or 0) == 0
    said = capsys.readouterr().out
    assert "head: in 3 of 3 frames by two cameras (a 3, b 3)" in said and "left_hand: in 0 of 3" in said
    assert sheet.stat().st_size > 10_000
    tracks = _read_tracks(str(out))
    assert tracks.frames == ["f0", "f1", "f2"] and not tracks.parts
    assert sorted(k for k in tracks.extras if k.startswith("keypoints")) == ["keypoints.head.a", "keypoints.head.b"]
    assert tracks.extras["segments"].tolist() == [[0, 1], [2, 2]]
    seen, points = observe(tracks.extras, "head", ["a", "b"], 3, threshold=4.0)
    depth = points.points[..., 2]
    # Half a pixel of 80 is 0.6 %.
    assert np.isfinite(depth).mean() > 0.8 and np.nanmedian(np.abs(depth - 1.0)) < 0.01
    assert float(seen.agree.double().mean()) > 0.8
