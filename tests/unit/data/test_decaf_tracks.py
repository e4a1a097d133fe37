import pickle

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nbavatar.data.decaf import read_camera, read_parameters
from nbavatar.data.decaf_files import find_subject
from nbavatar.data.decaf_tracks import build_tracks, frame_id
from nbavatar.errors import DataError
from nbavatar.io.pickles import read_pickle


def tracks(root, frames=tuple(range(12)), count=12, shape_tolerance=1e-3, rotation_tolerance=1e-3):
    subject = find_subject(root, "S2")
    cameras = {name: read_camera(subject, name)[0] for name in subject.cameras}
    return build_tracks(
        subject, cameras, list(frames), count, shape_tolerance=shape_tolerance, rotation_tolerance=rotation_tolerance
    )


def edit(path, change):
    content = read_pickle(path)
    change(content)
    path.write_bytes(pickle.dumps(content, protocol=2))


def test_head_turns_about_its_own_centroid_and_the_root_of_pose_params_is_not_applied(decaf):
    """Independent of the model: the motion between posed and unposed vertices is fitted and compared."""
    sequence, report = tracks(decaf)
    parameters = read_parameters(find_subject(decaf, "S2"))["head"]

    def still(frames):
        for frame in frames.values():
            frame["head"]["global_orient"] = np.zeros(3)
            frame["head"]["transl"] = np.zeros(3)
            frame["head"]["pose_params"][:3] = 9.0

    edit(decaf / "train/params/S2/params_smoothed.pkl", still)
    (decaf / "assets/transformation/train/S2_RT_FromCanToRef_wo_poseparams.npy").unlink()
    unposed, _ = tracks(decaf)
    for i in range(12):
        before = unposed.parts["head"].verts[i].astype(np.float64)
        centre = before.mean(0)
        R = Rotation.from_rotvec(parameters["global_orient"][i]).as_matrix()
        expected = (before - centre) @ R.T + centre + parameters["transl"][i]
        np.testing.assert_allclose(sequence.parts["head"].verts[i], expected, atol=2e-6)
    assert report["pose_params_root_max_rad"] == pytest.approx(np.abs(parameters["pose_params"][:, :3]).max())


def test_deformations_are_turned_to_the_world_negated_and_zero_on_the_neck(decaf):
    sequence, _ = tracks(decaf)
    stored = np.load(decaf / "train/deformations/S2/deforms.npy")
    orient = read_parameters(find_subject(decaf, "S2"))["head"]["global_orient"]
    stored[:, [0, 7]] = 0
    expected = np.stack([-Rotation.from_rotvec(o).apply(d) for o, d in zip(orient, stored)])
    np.testing.assert_allclose(sequence.extras["deformation.head"], expected, atol=1e-7)
    contacts = np.load(decaf / "train/contacts/S2/contacts_head.npy") != 0
    contacts[:, [0, 1]] = False
    np.testing.assert_array_equal(sequence.extras["contact.head"], contacts)
    assert sequence.extras["contact.right_hand"].dtype == bool


def test_a_choice_of_frames_is_rows_of_the_whole(decaf):
    whole, _ = tracks(decaf)
    some, _ = tracks(decaf, frames=(2, 5, 11))
    assert some.frames == [frame_id(i) for i in (2, 5, 11)] == ["000002", "000005", "000011"]
    np.testing.assert_allclose(some.parts["head"].verts, whole.parts["head"].verts[[2, 5, 11]], atol=1e-7)
    for name in ("keypoints.head.084", "boxes.right_hand.100", "deformation.head", "param.right_hand.hand_pose"):
        np.testing.assert_array_equal(some.extras[name], whole.extras[name][[2, 5, 11]])


def test_parameters_have_our_names_and_sizes(decaf):
    sequence, _ = tracks(decaf)
    sizes = {
        "head": {"shape": 100, "expression": 50, "global_orient": 3, "jaw": 3, "transl": 3},
        "right_hand": {"betas": 10, "global_orient": 3, "hand_pose": 45, "transl": 3},
    }
    for part, names in sizes.items():
        for name, size in names.items():
            assert sequence.extras[f"param.{part}.{name}"].shape == (12, size)
    assert sequence.extras["camera.100.distortion"].any() and not sequence.extras["camera.084.distortion"].any()
    assert sequence.parts["head"].rest.shape == (40, 3) and sequence.parts["right_hand"].rest.shape == (30, 3)


def test_shape_that_changes_over_time_is_refused_unless_allowed(decaf):
    def change(frames):
        frames[6]["head"]["shape_params"] = frames[6]["head"]["shape_params"] + 0.01

    edit(decaf / "train/params/S2/params_smoothed.pkl", change)
    with pytest.raises(DataError, match=r"frame 6: head\.shape_params.*accurate_shapes.*0\.01.*shape_tolerance"):
        tracks(decaf)
    _, report = tracks(decaf, shape_tolerance=0.02)
    assert report["shape_deviation.head"] == pytest.approx(0.01, rel=1e-3)


def test_without_own_shapes_the_median_is_taken_and_said(decaf):
    whole, _ = tracks(decaf)
    (decaf / "assets/accurate_shapes/S2.pkl").unlink()
    again, report = tracks(decaf)
    assert report["shape_source"] == "median over frames"
    np.testing.assert_allclose(again.parts["head"].rest, whole.parts["head"].rest, atol=1e-7)


def test_head_poses_that_contradict_the_parameters_are_refused(decaf):
    path = decaf / "assets/transformation/train/S2_RT_FromCanToRef_wo_poseparams.npy"
    poses = np.load(path)
    np.save(path, np.roll(poses, 1, axis=0))
    with pytest.raises(DataError, match=r"rotation of head\.global_orient"):
        tracks(decaf)
    path.unlink()
    _, report = tracks(decaf)
    assert report["head_pose_rotation_error"] is None and any("transformation" in name for name in report["absent"])


@pytest.mark.parametrize("name", ["deformations/S2/deforms.npy", "contacts/S2/contacts_rh.npy"])
def test_reference_data_may_be_absent_but_not_of_another_topology(decaf, name):
    path = decaf / "train" / name
    stored = np.load(path)
    np.save(path, stored[:, :-1])
    with pytest.raises(DataError, match=r"shape: expected \[frames, "):
        tracks(decaf)
    path.unlink()
    sequence, report = tracks(decaf)
    assert f"train/{name}" in report["absent"]
    assert ("deformation.head" in sequence.extras) == ("deforms" not in name)


def test_nan_in_deformations_names_the_frame(decaf):
    path = decaf / "train/deformations/S2/deforms.npy"
    stored = np.load(path)
    stored[9, 4, 1] = np.nan
    np.save(path, stored)
    with pytest.raises(DataError, match="frame 9"):
        tracks(decaf)


def test_fewer_parameters_than_frames(decaf):
    edit(decaf / "train/params/S2/params_smoothed.pkl", lambda frames: frames.pop(11))
    with pytest.raises(DataError, match=r"params_smoothed\.pkl: frames: expected 12 .*, found 11"):
        tracks(decaf)
