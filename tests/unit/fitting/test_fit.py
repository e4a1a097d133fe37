"""The refit on synthetic captures with known answers."""

import dataclasses
import json

import numpy as np
import pytest
import torch

from nbavatar.bodymodels.files import model_arrays
from nbavatar.bodymodels.mano import Mano, mirror_model
from nbavatar.cli import main
from nbavatar.cli.fit import _tell
from nbavatar.config.geometry import FitConfig
from nbavatar.data.sequences import read_sequence
from nbavatar.data.synthetic.models import load_human, mano_content
from nbavatar.data.synthetic.scene import _unwrapped
from nbavatar.errors import DataError
from nbavatar.fitting.pictures import contact_sheet
from nbavatar.fitting.stage import Bodies, fit_sequence
from nbavatar.io.arrays import write_arrays
from nbavatar.io.framepack import FramePack, FramePackWriter
from nbavatar.studies.benchmarks.fit_scene import WIDTH, perturb

from .scenes import make_take, vertex_error_mm

PLAIN = FitConfig(check_handedness=False)


def _fit(take, cfg=PLAIN, **options):
    return fit_sequence(take.frames, {}, take.extras, take.bodies, cfg, **options)


def _errors(take, fitted):
    return {part: vertex_error_mm(fitted.parts[part].verts, take.truth[part]) for part in fitted.parts}


def _perturb(extras):
    """5 mm and 3 degrees on the rigid poses, and 3 degrees on every finger joint."""
    parameters = {name: value for name, value in extras.items() if name.startswith("param.")}
    return extras | perturb(parameters, millimetres=5, degrees=3)


def test_exact_keypoints_give_exact_meshes():
    take = make_take(frames=16)
    fitted, report = _fit(take)
    errors = _errors(take, fitted)
    assert errors["head"] < 0.05 and errors["right_hand"] < 0.05
    assert report["head"]["start"] == "keypoints"
    assert fitted.extras["reprojection.head.after"][:, 0].max() < 0.02


def test_noisy_keypoints_alone():
    take = make_take(frames=24, noise=2.0, outliers=0.2, missing=0.2)
    fitted, report = _fit(take)
    errors = _errors(take, fitted)
    assert errors["head"] < 1.5 and errors["right_hand"] < 2.0
    # The noise is found: 2 px, a little less because the fit takes some of it.
    assert 1.6 < report["head"]["sigma_px"] < 2.2 and 1.6 < report["right_hand"]["sigma_px"] < 2.3
    # A fifth of the keypoints are outliers, and about so many stay unexplained.
    assert 0.12 < report["head"]["unexplained_after"] < 0.25


def test_perturbed_parameters_recover():
    take = make_take(frames=16, parameters=True)
    moved = dataclasses.replace(take, extras=_perturb(take.extras))
    fitted, report = _fit(moved)
    errors = _errors(take, fitted)
    assert errors["head"] < 0.05 and errors["right_hand"] < 0.05
    assert report["head"]["start"] == "params" and report["head"]["median_px_before"] > 1
    noisy = make_take(frames=24, noise=2.0, outliers=0.2, missing=0.2, parameters=True)
    fitted, _ = _fit(dataclasses.replace(noisy, extras=_perturb(noisy.extras)))
    errors = _errors(noisy, fitted)
    assert errors["head"] < 1.5 and errors["right_hand"] < 2.0


def test_true_parameters_stay():
    take = make_take(frames=12, parameters=True)
    fitted, _ = _fit(take)
    # What keypoints do not see of the hand is drawn a little from the truth towards common poses.
    errors = _errors(take, fitted)
    assert errors["head"] < 0.01 and errors["right_hand"] < 0.03


def test_half_outliers_and_two_cameras():
    many = make_take(frames=16, noise=1.0, outliers=0.5)
    assert _errors(many, _fit(many)[0])["head"] < 2.0
    two = make_take(frames=16, cameras=2, noise=1.0)
    errors = _errors(two, _fit(two)[0])
    assert errors["head"] < 4.0 and errors["right_hand"] < 4.0


def test_distortion_is_removed_first():
    take = make_take(frames=8, distortion=True)
    errors = _errors(take, _fit(take)[0])
    assert errors["head"] < 0.05 and errors["right_hand"] < 0.1
    ignored = {k: (np.zeros(12) if k.endswith("distortion") else v) for k, v in take.extras.items()}
    assert _errors(take, _fit(dataclasses.replace(take, extras=ignored))[0])["head"] > 0.2


def test_a_frame_without_detections_is_bridged():
    take = make_take(frames=20)
    for name in take.extras:
        if name.startswith("keypoints."):
            take.extras[name][5] = 0.0
    fitted, report = _fit(take)
    assert report["head"]["frames_without_points"] == 1
    error = 1e3 * np.linalg.norm(fitted.parts["head"].verts[5] - take.truth["head"][5], axis=-1)
    assert np.median(error) < 6.0
    rest = [n for n in range(20) if n != 5]
    assert vertex_error_mm(fitted.parts["head"].verts[rest], take.truth["head"][rest]) < 0.05


def test_smoothness_never_pulls_a_quick_hand_off_its_keypoints():
    """Twelve frames for two whole takes: accelerations are far beyond the options' typical ones."""
    take = make_take(frames=12, parameters=True, noise=1.0)
    fitted, _ = _fit(
        take, dataclasses.replace(PLAIN, smooth_rotation_deg=0.2, smooth_transl_mm=0.2, smooth_pose_deg=0.2)
    )
    assert _errors(take, fitted)["right_hand"] < 1.0


def test_smoothness_does_not_cross_a_cut():
    """Shuffling the order of two runs changes nothing but their order."""
    take = make_take(frames=16, noise=1.0)
    (a, b), (c, d) = take.extras["segments"]
    order = [*range(c, d + 1), *range(a, b + 1)]
    turned = {k: v[order] if k.startswith("keypoints.") else v for k, v in take.extras.items()}
    turned["segments"] = np.array([[0, d - c], [d - c + 1, d]])
    first, _ = _fit(take)
    second, _ = _fit(dataclasses.replace(take, extras=turned))
    np.testing.assert_allclose(second.parts["head"].verts, first.parts["head"].verts[order], atol=2e-6)


def test_badly_tracked_frames_start_from_keypoints():
    take = make_take(frames=12, parameters=True)
    take.extras["param.head.transl"][3] += 0.3
    take.extras["param.right_hand.global_orient"][7] += 2.0
    fitted, report = _fit(take)
    assert report["head"]["frames_realigned"] == 1 and report["right_hand"]["frames_realigned"] == 1
    assert max(_errors(take, fitted).values()) < 0.05


def test_parts_present_only():
    take = make_take(frames=6)
    head_only = {k: v for k, v in take.extras.items() if "right_hand" not in k}
    fitted, report = fit_sequence(take.frames, {}, head_only, Bodies(take.bodies.head, {}), PLAIN)
    assert list(fitted.parts) == ["head"] and list(report) == ["head"]
    hand_only = {k: v for k, v in take.extras.items() if ".head." not in k}
    fitted, _ = fit_sequence(take.frames, {}, hand_only, Bodies(None, take.bodies.hands), PLAIN)
    assert list(fitted.parts) == ["right_hand"]


def _both_models():
    arrays = model_arrays(_unwrapped(mano_content(load_human("tiny"))), "hand")
    return {
        "right": Mano.build(arrays, "right", dtype=torch.float64),
        "left": Mano.build(mirror_model(arrays), "left", dtype=torch.float64),
    }


def _mirror_scene(take):
    """The scene in the mirror x = 0 of the world: right hands become left; cameras move along."""
    flip = np.diag([-1.0, 1, 1, 1])
    out = {}
    for name, value in take.extras.items():
        if name.endswith("cam_from_world"):
            # The image is mirrored as well, so that the camera stays a proper one.
            out[name] = flip @ value @ flip
        elif name.startswith("keypoints."):
            camera = name.split(".")[2]
            value = value.copy()
            value[..., 0] = 2 * take.extras[f"camera.{camera}.K"][0, 2] - value[..., 0]
            out[name] = value
        else:
            out[name] = value
    return out


def test_left_hand_and_both_hands():
    take = make_take(frames=10)
    mirrored = _mirror_scene(take)
    extras = {k: v for k, v in take.extras.items() if k.startswith(("camera.", "segments"))}
    extras |= {k.replace("right_hand", "left_hand"): v for k, v in mirrored.items() if "right_hand" in k}
    extras |= {k: v for k, v in mirrored.items() if k.startswith("camera.")}
    bodies = Bodies(take.bodies.head, _both_models())
    fitted, report = fit_sequence(take.frames, {}, extras, bodies, FitConfig())
    assert list(fitted.parts) == ["left_hand"]
    assert report["left_hand"]["handedness"]["found"] == "left"
    flip = np.array([-1.0, 1, 1])
    assert vertex_error_mm(fitted.parts["left_hand"].verts, take.truth["right_hand"] * flip) < 0.1
    # The same keypoints as a right hand's: the pose is the mirror image of what the left model finds.
    both = take.extras | {k.replace("right_hand", "left_hand"): v for k, v in take.extras.items() if "right_hand" in k}
    fitted, _ = fit_sequence(take.frames, {}, both, bodies, PLAIN)
    assert list(fitted.parts) == ["head", "right_hand", "left_hand"]


@pytest.mark.parametrize("noise", [0.0, 2.0])
def test_wrong_handedness_is_found(noise):
    take = make_take(frames=10, noise=noise)
    bodies = Bodies(take.bodies.head, _both_models())
    right = {k: v for k, v in take.extras.items() if ".head." not in k}
    assert fit_sequence(take.frames, {}, right, bodies, FitConfig())[1]["right_hand"]["handedness"]["found"] == "right"
    wrong = {k.replace("right_hand", "left_hand"): v for k, v in right.items()}
    verdict = fit_sequence(take.frames, {}, wrong, bodies, FitConfig())[1]["left_hand"]["handedness"]
    assert verdict["expected"] == "left" and verdict["found"] == "right"


def test_mirrored_images_are_found():
    take = make_take(frames=6)
    extras = {k: v.copy() for k, v in take.extras.items() if ".head." not in k}
    for name, value in extras.items():
        if name.startswith("keypoints."):
            value[..., 0] = WIDTH - value[..., 0]
    with pytest.raises(DataError, match="three keypoints agree"):
        fit_sequence(take.frames, {}, extras, take.bodies, dataclasses.replace(PLAIN, inlier_px=0.5))
    some = {k: v.copy() for k, v in take.extras.items() if ".head." not in k}
    for name, value in some.items():
        # The last two frames are as they should be, so that there is something to start from.
        if name.startswith("keypoints."):
            value[:4, :, 0] = WIDTH - value[:4, :, 0]
    report = fit_sequence(take.frames, {}, some, take.bodies, FitConfig())[1]
    assert report["right_hand"]["handedness"]["found"] == "mirrored images"


def test_cameras_left_out_are_not_looked_at():
    take = make_take(frames=6)
    used = ["100", "102", "104", "106"]
    first, report = _fit(take, cameras=used)
    assert report["head"]["cameras"] == used
    take.extras["keypoints.head.101"][:] = np.nan
    second, _ = _fit(take, cameras=used)
    np.testing.assert_array_equal(first.parts["head"].verts, second.parts["head"].verts)


def test_result_is_the_same_twice():
    take = make_take(frames=8, noise=1.0)
    a, b = _fit(take)[0], _fit(take)[0]
    np.testing.assert_array_equal(a.parts["right_hand"].verts, b.parts["right_hand"].verts)


def test_convergence_is_monotone_within_a_stage():
    curve = _fit(make_take(frames=8, noise=1.0))[0].extras["convergence.head"]
    for stage in np.unique(curve[:, 0]):
        assert (np.diff(curve[curve[:, 0] == stage, 1]) <= 1e-9).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda e: e.update({"keypoints.head.100": e["keypoints.head.100"][:, :60]}), "keypoints.head.100"),
        (lambda e: e.pop("camera.101.K"), "camera.101.K"),
        (lambda e: e.update(segments=np.array([[0, 2], [2, 5]])), "segments"),
        (lambda e: e.update({"param.head.transl": np.full((6, 3), np.nan)}), "frame 0"),
        (lambda e: e.pop("param.head.jaw"), "param.head.jaw"),
        (lambda e: [e.pop(k) for k in list(e) if k.startswith("keypoints.")], "at least one part"),
        (lambda e: [e.pop(k) for k in list(e) if k.startswith("keypoints.head") and k[-1] != "0"], "two cameras"),
    ],
)
def test_bad_input_is_one_line(change, words):
    take = make_take(frames=6, parameters=True)
    change(take.extras)
    with pytest.raises(DataError) as caught:
        _fit(take)
    assert words in str(caught.value) and "\n" not in str(caught.value)


def test_command_line(tmp_path, capsys):
    """Files in, files out: body models in the official format, keypoints without any mesh."""
    from nbavatar.data.synthetic.legacy_pickle import dump_array, dump_legacy
    from nbavatar.data.synthetic.models import flame_content, landmark_content
    from nbavatar.io.images import decode_image

    human = load_human("tiny")
    assets = tmp_path / "assets"
    (assets / "mano_v1_2/models").mkdir(parents=True)
    (assets / "generic_model.pkl").write_bytes(dump_legacy(flame_content(human), python2=True))
    (assets / "mano_v1_2/models/MANO_RIGHT.pkl").write_bytes(dump_legacy(mano_content(human), python2=True))
    (assets / "landmark_embedding.npy").write_bytes(dump_array(landmark_content(human)))
    take = make_take(frames=6, cameras=4)
    write_arrays(tmp_path / "tracks.npz", {"frames": np.array(take.frames), **take.extras}, {})
    command = ["fit", "--tracks", tmp_path / "tracks.npz", "--assets", assets, "--out", tmp_path / "fit.npz"]
    command += ["--sheet", tmp_path / "fit.png", "--cfg", json.dumps({"sheet_tile": 96})]
    assert main([str(c) for c in command]) == 0
    fitted, record = read_sequence(tmp_path / "fit.npz")
    assert vertex_error_mm(fitted.parts["head"].verts, take.truth["head"]) < 0.05
    assert record["fit"]["right_hand"]["handedness"]["found"] == "right"
    assert "right_hand: side of the hand as said" in capsys.readouterr().out
    assert decode_image(tmp_path / "fit.png").shape[0] > 4 * 96
    # Packs of masks alone serve the fit; the sheet, made after it, draws their cameras on grey.
    place = {"subject": "S2", "camera": "100", "cam_from_world": np.eye(4).tolist(), "width": 8, "height": 8}
    manifest = {"stage": "masks", "frames": take.frames, "layers": {"label": ""}, **place}
    with FramePackWriter(tmp_path / "masks.zip", manifest) as writer:
        for frame in take.frames:
            writer.add("label", frame, np.ones((8, 8), np.uint8))
    with FramePack(tmp_path / "masks.zip") as pack:
        drawn = contact_sheet(fitted, {"100": pack}, frames=2, cameras=1, tile=96)
    np.testing.assert_array_equal(drawn, contact_sheet(fitted, {}, frames=2, cameras=1, tile=96))
    assert main([*map(str, command[:-2]), "--cfg", '{"iterations": -1}']) == 2
    assert "iterations" in capsys.readouterr().err
    wrong = {key.replace("right_hand", "left_hand"): value for key, value in take.extras.items() if ".head." not in key}
    write_arrays(tmp_path / "tracks.npz", {"frames": np.array(take.frames), **wrong}, {})
    assert main([*map(str, command[:-4]), "--cfg", '{"iterations": 5}']) == 0
    printed = capsys.readouterr().err
    assert "keypoints.left_hand are said to be of the left hand, but fit right better" in printed
    verdict = read_sequence(tmp_path / "fit.npz")[1]["fit"]["left_hand"]["handedness"]
    assert verdict["expected"] == "left" and verdict["found"] == "right"


def test_a_fit_that_explains_little_is_said(capsys):
    """Three cameras of four see something else."""
    take = make_take(frames=6, cameras=4, parameters=True)
    for name in ("keypoints.head.100", "keypoints.head.101", "keypoints.head.102"):
        take.extras[name][:, :, :2] += np.random.default_rng(1).uniform(-300, 300, (6, 68, 2))
    head = {name: value for name, value in take.extras.items() if "right_hand" not in name}
    _, report = fit_sequence(take.frames, {}, head, take.bodies, dataclasses.replace(PLAIN, iterations=10))
    assert report["head"]["unexplained_after"] > 0.6
    _tell("head", report["head"])
    assert "of keypoints.head are far from the fitted" in capsys.readouterr().err


@pytest.mark.slow
def test_full_size_figures():
    """Figures at full size: 5,023 + 778 vertices, 2 px noise, 20 % outliers, 20 % missing."""
    take = make_take("full", 40, noise=2.0, outliers=0.2, missing=0.2)
    errors = _errors(take, _fit(take)[0])
    assert errors["head"] < 1.5 and errors["right_hand"] < 2.0
    exact = make_take("full", 16)
    assert max(_errors(exact, _fit(exact)[0]).values()) < 0.05
