"""FLAME and MANO against plain loops (values and gradients), scipy rotations and analytic answers."""

import pickle
from functools import partial

import numpy as np
import pytest
import scipy.sparse
import torch
from scipy.spatial.transform import Rotation

from nbavatar.bodymodels.files import landmark_arrays, model_arrays, read_flame, read_mano
from nbavatar.bodymodels.flame import Flame, jaw_of_pose_params, rotate_about_centroid
from nbavatar.bodymodels.lbs import joint_transforms
from nbavatar.bodymodels.mano import TIP_PAIRS, Mano, mirror_axis_angle, mirror_model, shorten_tips
from nbavatar.errors import DataError

from .modelfiles import random_flame, random_landmarks, random_mano
from .oracle import pose_model

BATCH = 4


@pytest.fixture(scope="module")
def flame_dict():
    return random_flame()


@pytest.fixture(scope="module")
def flame(flame_dict):
    landmarks = landmark_arrays(random_landmarks(3, len(flame_dict["f"])), len(flame_dict["f"]), "landmarks")
    return Flame.build(model_arrays(flame_dict, "flame"), landmarks, dtype=torch.float64)


@pytest.fixture(scope="module")
def mano_dict():
    return random_mano()


@pytest.fixture(scope="module")
def mano(mano_dict):
    return Mano.build(model_arrays(mano_dict, "mano"), dtype=torch.float64)


def _values(*sizes, scale=0.5, seed=0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    draw = [scale * torch.randn(BATCH, n, generator=generator, dtype=torch.float64) for n in sizes]
    return [value.to(dtype).requires_grad_() for value in draw]


def _flame_by_loops(model, shape, expression, jaw, root, neck, eyes):
    coefficients = np.zeros(400)
    coefficients[:100], coefficients[300:350] = shape, expression
    return pose_model(model, coefficients, np.concatenate([root, neck, jaw, eyes]))


def _mano_by_loops(model, betas, hand, orient):
    return pose_model(model, betas, np.concatenate([orient, hand]))


def _assert_same_as_loops(forward, loops, sizes):
    """Values of every batch row, and the derivative of one random projection along one random direction."""
    inputs = _values(*sizes)
    verts, joints = forward(*inputs)
    joints = joints[:, : loops(*(value[0].detach().numpy() for value in inputs))[1].shape[0]]
    for row in range(BATCH):
        expected = loops(*(value[row].detach().numpy() for value in inputs))
        # Both are float64; sums of up to 400 directions differ in their order only.
        np.testing.assert_allclose(verts[row].detach(), expected[0], atol=1e-13)
        np.testing.assert_allclose(joints[row].detach(), expected[1], atol=1e-13)
    rng = np.random.default_rng(3)
    cotangents = [rng.normal(size=part[0].shape) for part in (verts, joints)]
    directions = [rng.normal(size=size) for size in sizes]
    row = [value[:1].detach().requires_grad_() for value in inputs]
    moved = forward(*row)
    parts = (moved[0], moved[1][:, : joints.shape[1]])
    loss = sum((part[0] * torch.tensor(c)).sum() for part, c in zip(parts, cotangents, strict=True))
    gradients = torch.autograd.grad(loss, row)
    slope = sum(float((g[0] * torch.tensor(d)).sum()) for g, d in zip(gradients, directions, strict=True))

    def projected(step):
        found = loops(*(value[0].detach().numpy() + step * d for value, d in zip(row, directions, strict=True)))
        return sum(float((part * c).sum()) for part, c in zip(found, cotangents, strict=True))

    # A central difference in steps of 1e-6: its own error is about 1e-9 of the values that are subtracted.
    assert slope == pytest.approx((projected(1e-6) - projected(-1e-6)) / 2e-6, rel=1e-6)


def test_flame_equals_plain_loops(flame, flame_dict):
    def forward(shape, expression, jaw, root, neck, eyes):
        return flame.forward(shape, expression, jaw, root=root, neck=neck, eyes=eyes)

    _assert_same_as_loops(forward, partial(_flame_by_loops, flame_dict), (100, 50, 3, 3, 3, 6))


def test_mano_equals_plain_loops(mano, mano_dict):
    _assert_same_as_loops(mano.forward, partial(_mano_by_loops, mano_dict), (10, 45, 3))


def test_flame_zero_parameters_give_the_template(flame, flame_dict):
    zeros = [torch.zeros(2, n, dtype=torch.float64) for n in (100, 50, 3)]
    verts, joints = flame.forward(*zeros)
    np.testing.assert_allclose(verts[1], flame_dict["v_template"], atol=1e-15)
    np.testing.assert_allclose(joints[0], flame_dict["J_regressor"] @ flame_dict["v_template"], atol=1e-14)


def test_flame_uses_columns_0_and_300(flame, flame_dict):
    shape, expression, jaw = (torch.zeros(1, n, dtype=torch.float64) for n in (100, 50, 3))
    shape[0, 7], expression[0, 11] = 2.0, -1.5
    expected = flame_dict["v_template"] + 2 * flame_dict["shapedirs"][..., 7] - 1.5 * flame_dict["shapedirs"][..., 311]
    np.testing.assert_allclose(flame.forward(shape, expression, jaw).verts[0], expected, atol=1e-14)


def test_one_shape_serves_many_poses(flame):
    _, expression, jaw = (v.detach() for v in _values(100, 50, 3))
    shape = torch.randn(1, 100, dtype=torch.float64)
    torch.testing.assert_close(
        flame.forward(shape, expression, jaw).verts, flame.forward(shape.expand(BATCH, -1), expression, jaw).verts
    )


def test_joint_transforms_against_scipy():
    rng = np.random.default_rng(0)
    joints, angles = rng.normal(size=(3, 3)), rng.normal(size=(3, 3))
    turns = Rotation.from_rotvec(angles)
    transforms, placed = joint_transforms(torch.tensor(joints)[None], torch.tensor(turns.as_matrix())[None], (-1, 0, 1))
    expected_1 = joints[0] + turns[0].apply(joints[1] - joints[0])
    expected_2 = expected_1 + (turns[0] * turns[1]).apply(joints[2] - joints[1])
    np.testing.assert_allclose(placed[0], [joints[0], expected_1, expected_2], atol=1e-14)
    point = rng.normal(size=3)
    moved = expected_2 + (turns[0] * turns[1] * turns[2]).apply(point - joints[2])
    np.testing.assert_allclose(
        transforms[0, 2, :, :3].numpy() @ point + transforms[0, 2, :, 3].numpy(), moved, atol=1e-14
    )


def test_subset_and_centroid_equal_the_full_mesh(flame):
    shape, expression, jaw = (v.detach() for v in _values(100, 50, 3))
    coefficients, rotations = flame.coefficients(shape, expression), flame.rotations(jaw)
    full = flame.mesh.pose(coefficients, rotations).verts
    picked = torch.tensor([5, 2, 40])
    torch.testing.assert_close(
        flame.mesh.subset(picked).pose(coefficients, rotations).verts, full[:, picked], rtol=1e-12, atol=1e-14
    )
    torch.testing.assert_close(flame.mesh.mean(coefficients, rotations), full.mean(1), rtol=1e-12, atol=1e-14)


def test_decaf_pose_rotates_about_the_centroid(flame):
    shape, expression, jaw, orient, transl = (v.detach() for v in _values(100, 50, 3, 3, 3))
    verts = flame.forward(shape, expression, jaw).verts
    posed = flame.forward_decaf(shape, expression, jaw, orient, transl)
    # The centroid moves by the translation alone, whatever the rotation.
    torch.testing.assert_close(posed.mean(1), verts.mean(1) + transl, rtol=1e-12, atol=1e-14)
    for b in range(BATCH):
        centred = (verts[b] - verts[b].mean(0)).numpy()
        expected = Rotation.from_rotvec(orient[b].numpy()).apply(centred)
        np.testing.assert_allclose(posed[b] - posed[b].mean(0), expected, atol=1e-14)


def test_root_part_of_pose_params_is_dropped():
    pose = torch.arange(6.0)[None]
    assert jaw_of_pose_params(pose).tolist() == [[3.0, 4.0, 5.0]]


def test_rotate_about_centroid_identity():
    verts = torch.randn(2, 7, 3, dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64).expand(2, 3, 3)
    torch.testing.assert_close(rotate_about_centroid(verts, eye, torch.zeros(2, 3, dtype=torch.float64)), verts)


def test_landmarks_are_points_on_their_triangles(flame, flame_dict):
    verts = torch.randn(2, 60, 3, dtype=torch.float64)
    embedding = random_landmarks(3, 90)
    corners = verts[:, flame_dict["f"][embedding["full_lmk_faces_idx"][0]].astype(np.int64)]
    expected = (corners * torch.tensor(embedding["full_lmk_bary_coords"][0])[None, :, :, None]).sum(2)
    torch.testing.assert_close(flame.landmarks(verts), expected)


def test_contour_landmarks_pick_the_row(flame):
    verts = torch.randn(2, 60, 3, dtype=torch.float64)
    rows = torch.tensor([0, 41])
    points = flame.contour_landmarks(verts, rows)
    for b in range(2):
        corners = verts[b, flame.contour.vertices[rows[b]]]
        torch.testing.assert_close(points[b], (corners * flame.contour.weights[rows[b]][..., None]).sum(1))


def test_mano_rotates_about_the_wrist(mano):
    betas, pose, orient, transl = (v.detach() for v in _values(10, 45, 3, 3))
    straight = mano.forward(betas, pose, torch.zeros_like(orient))
    turned = mano.forward(betas, pose, orient, transl)
    wrist = straight.joints[:, 0]
    torch.testing.assert_close(turned.joints[:, 0], wrist + transl, rtol=1e-12, atol=1e-13)
    for b in range(BATCH):
        expected = Rotation.from_rotvec(orient[b].numpy()).apply((straight.verts[b] - wrist[b]).numpy())
        np.testing.assert_allclose(turned.verts[b] - turned.joints[b, 0], expected, atol=1e-13)


def test_mano_tips_are_vertices_in_order(mano):
    out = mano.forward(*(v.detach() for v in _values(10, 45, 3)))
    torch.testing.assert_close(out.joints[:, 16:], out.verts[:, [744, 320, 443, 554, 671]])


def test_shorten_tips_keeps_seven_tenths_of_the_bone():
    joints = torch.randn(3, 21, 3, dtype=torch.float64)
    short = shorten_tips(joints)
    assert torch.equal(short[:, :16], joints[:, :16])
    for last, tip in TIP_PAIRS:
        torch.testing.assert_close(short[:, tip] - joints[:, last], 0.7 * (joints[:, tip] - joints[:, last]))


def test_left_hand_is_the_mirror_image(mano, mano_dict):
    left = Mano.build(mirror_model(model_arrays(mano_dict, "mano")), "left", dtype=torch.float64)
    betas, pose, orient, transl = (v.detach() for v in _values(10, 45, 3, 3))
    flip = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    right = mano.forward(betas, pose, orient, transl)
    mirrored = left.forward(betas, mirror_axis_angle(pose), mirror_axis_angle(orient), transl * flip)
    torch.testing.assert_close(mirrored.verts, right.verts * flip, rtol=1e-12, atol=1e-13)
    torch.testing.assert_close(mirrored.joints, right.joints * flip, rtol=1e-12, atol=1e-13)
    # Faces keep their outward side: the signed volume of a triangle and the origin is unchanged.
    face = 4
    a, b = right.verts[0, mano.faces[face]], mirrored.verts[0, left.faces[face]]
    torch.testing.assert_close(torch.linalg.det(a), torch.linalg.det(b))
    torch.testing.assert_close(left.mean_pose, mirror_axis_angle(mano.mean_pose))


def test_pose_statistics_reproduce_the_sample_covariance(mano, mano_dict):
    samples = mano_dict["hands_coeffs"] @ mano_dict["hands_components"]
    basis, deviation = mano.pose_basis.numpy(), mano.pose_deviation.numpy()
    np.testing.assert_allclose(basis @ basis.T, np.eye(45), atol=1e-12)
    np.testing.assert_allclose(basis.T @ np.diag(deviation**2) @ basis, np.cov(samples.T), atol=1e-12)


def test_gradcheck_of_the_decaf_head(flame):
    subset = Flame(flame.mesh.subset(torch.arange(4)), flame.faces, 100, 50)
    inputs = [torch.randn(1, n, dtype=torch.float64, requires_grad=True) for n in (100, 50, 3, 3, 3)]
    assert torch.autograd.gradcheck(subset.forward_decaf, inputs)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("weights", np.ones((59, 5)) / 5, "shape [60, 5]"),
        ("shapedirs", np.zeros((60, 3)), "shape [60, 3, any]"),
        ("v_template", np.full((60, 3), np.nan), "finite"),
        ("f", np.full((90, 3), 60), "0 to 59"),
        ("f", np.full((90, 3), 0.5), "whole numbers"),
        ("weights", np.ones((60, 5)), "sum to 1"),
        ("posedirs", None, "array of this name"),
        ("J_regressor", "text", "array of numbers"),
        ("J_regressor", [["1" * 100, "1"]], "array of numbers"),
        ("v_template", scipy.sparse.csc_array((1 << 40, 3)), "an array, found a sparse matrix"),  # 24 TB of zeros
        ("kintree_table", np.array([[2**32 - 1, 2, 1, 1, 1], [0, 1, 2, 3, 4]]), "parent before"),
    ],
)
def test_arrays_that_disagree_are_one_line(flame_dict, key, value, words):
    broken = dict(flame_dict)
    if value is None:
        del broken[key]
    else:
        broken[key] = value
    with pytest.raises(DataError) as caught:
        model_arrays(broken, "some.pkl")
    line = str(caught.value)
    assert line.startswith(f"some.pkl: {key}: ") and words in line and "\n" not in line


def test_wrong_model_is_refused(tmp_path, flame_dict, mano_dict):
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(mano_dict, protocol=2))
    with pytest.raises(DataError, match="5 joints of FLAME"):
        read_flame(tmp_path / "a.pkl")
    (tmp_path / "b.pkl").write_bytes(pickle.dumps(flame_dict, protocol=2))
    with pytest.raises(DataError, match="16 joints of MANO"):
        read_mano(tmp_path / "b.pkl")
    (tmp_path / "c.pkl").write_bytes(pickle.dumps(random_mano(verts=100), protocol=2))
    with pytest.raises(DataError, match="tip_vertices"):
        read_mano(tmp_path / "c.pkl")
    with_tips = random_mano(verts=100) | {"tip_vertices": np.arange(5)}
    (tmp_path / "d.pkl").write_bytes(pickle.dumps(with_tips, protocol=2))
    assert read_mano(tmp_path / "d.pkl").tip_vertices == (0, 1, 2, 3, 4)


def test_short_flame_file_is_refused(flame_dict):
    short = flame_dict | {"shapedirs": flame_dict["shapedirs"][..., :20]}
    with pytest.raises(DataError, match="300 shape"):
        Flame.build(model_arrays(short, "short.pkl"))
