"""FLAME and MANO against smplx (values and gradients), scipy rotations and analytic answers."""

import pickle

import numpy as np
import pytest
import smplx
import torch
from scipy.spatial.transform import Rotation
from smplx.lbs import find_dynamic_lmk_idx_and_bcoords

from nbavatar.bodymodels.files import landmark_arrays, model_arrays, read_flame, read_landmarks, read_mano
from nbavatar.bodymodels.flame import Flame, contour_rows, jaw_of_pose_params, rotate_about_centroid
from nbavatar.bodymodels.lbs import joint_transforms
from nbavatar.bodymodels.mano import TIP_PAIRS, Mano, mirror_axis_angle, mirror_model, shorten_tips
from nbavatar.data.synthetic.legacy_pickle import Ch, Select, dump_array, dump_legacy
from nbavatar.data.synthetic.models import flame_content, landmark_content, load_human, mano_content
from nbavatar.errors import DataError

from .modelfiles import random_flame, random_landmarks, random_mano

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


def _assert_same(ours, theirs, inputs_ours, inputs_theirs, tolerance):
    """Values, and gradients of one random projection, relative to the largest entry."""
    generator = torch.Generator().manual_seed(9)
    loss_ours = loss_theirs = torch.zeros((), dtype=ours[0].dtype)
    for a, b in zip(ours, theirs, strict=True):
        assert (a - b).abs().max() <= tolerance * b.abs().max()
        cotangent = torch.randn(a.shape, generator=generator, dtype=torch.float64).to(a.dtype)
        loss_ours, loss_theirs = loss_ours + (a * cotangent).sum(), loss_theirs + (b * cotangent).sum()
    for a, b in zip(
        torch.autograd.grad(loss_ours, inputs_ours), torch.autograd.grad(loss_theirs, inputs_theirs), strict=True
    ):
        assert (a - b).abs().max() <= tolerance * b.abs().max()


# float32 of either side carries about 1e-6; smplx's Rodrigues formula adds 1e-8 to the angle, which float64 shows.
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 2e-6), (torch.float32, 1e-5)])
def test_flame_equals_smplx(flame_dict, tmp_path, dtype, tolerance):
    (tmp_path / "FLAME_NEUTRAL.pkl").write_bytes(pickle.dumps(flame_dict, protocol=2))
    embedding = random_landmarks(3, len(flame_dict["f"]))
    static = {"lmk_face_idx": embedding["static_lmk_faces_idx"], "lmk_b_coords": embedding["static_lmk_bary_coords"]}
    (tmp_path / "flame_static_embedding.pkl").write_bytes(pickle.dumps(static, protocol=2))
    theirs = smplx.FLAME(str(tmp_path), num_betas=100, num_expression_coeffs=50, batch_size=BATCH, dtype=dtype)
    ours = Flame.build(read_flame(tmp_path / "FLAME_NEUTRAL.pkl"), dtype=dtype)
    names = ("betas", "expression", "jaw_pose", "global_orient", "neck_pose", "eyes")
    a = dict(zip(names, _values(100, 50, 3, 3, 3, 6, dtype=dtype), strict=True))
    b = {name: value.detach().clone().requires_grad_() for name, value in a.items()}
    verts, joints = ours.forward(
        a["betas"], a["expression"], a["jaw_pose"], root=a["global_orient"], neck=a["neck_pose"], eyes=a["eyes"]
    )
    eyes = b["eyes"]
    reference = theirs(
        betas=b["betas"], expression=b["expression"], jaw_pose=b["jaw_pose"], global_orient=b["global_orient"],
        neck_pose=b["neck_pose"], leye_pose=eyes[:, :3], reye_pose=eyes[:, 3:],
    )  # fmt: skip
    _assert_same(
        [verts, joints], [reference.vertices, reference.joints[:, :5]], list(a.values()), list(b.values()), tolerance
    )


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 2e-6), (torch.float32, 1e-5)])
def test_mano_equals_smplx(mano_dict, tmp_path, dtype, tolerance):
    (tmp_path / "MANO_RIGHT.pkl").write_bytes(pickle.dumps(mano_dict, protocol=2))
    theirs = smplx.MANO(
        str(tmp_path / "MANO_RIGHT.pkl"), use_pca=False, flat_hand_mean=True, batch_size=BATCH, dtype=dtype
    )
    ours = Mano.build(read_mano(tmp_path / "MANO_RIGHT.pkl"), dtype=dtype)
    a = _values(10, 45, 3, 3, dtype=dtype)
    b = [value.detach().clone().requires_grad_() for value in a]
    verts, joints = ours.forward(*a)
    reference = theirs(betas=b[0], hand_pose=b[1], global_orient=b[2], transl=b[3])
    # smplx appends the tips in an order of its own; they are vertices, compared as such.
    tips = reference.vertices[:, list(ours.tips)]
    _assert_same([verts, joints], [reference.vertices, torch.cat([reference.joints[:, :16], tips], 1)], a, b, tolerance)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_full_size_files_equal_smplx(tmp_path, dtype):
    """The synthetic subject's model files, at the counts of the originals, through the unpickler and through smplx."""
    human = load_human("full")
    head, hand = flame_content(human), mano_content(human)
    (tmp_path / "generic_model.pkl").write_bytes(dump_legacy(head, python2=True))
    (tmp_path / "MANO_RIGHT.pkl").write_bytes(dump_legacy(hand, python2=True))
    (tmp_path / "landmark_embedding.npy").write_bytes(dump_array(landmark_content(human)))
    # smplx cannot open such files without chumpy: it gets the same arrays unwrapped.
    for name, content in (("FLAME_NEUTRAL.pkl", head), ("MANO_PLAIN_RIGHT.pkl", hand)):
        plain = {k: v.x if isinstance(v, Ch) else v.a.x if isinstance(v, Select) else v for k, v in content.items()}
        (tmp_path / name).write_bytes(pickle.dumps(plain, protocol=2))
    embedding = landmark_content(human)
    static = {"lmk_face_idx": embedding["static_lmk_faces_idx"], "lmk_b_coords": embedding["static_lmk_bary_coords"]}
    (tmp_path / "flame_static_embedding.pkl").write_bytes(pickle.dumps(static, protocol=2))
    arrays = read_flame(tmp_path / "generic_model.pkl")
    ours = Flame.build(arrays, read_landmarks(tmp_path / "landmark_embedding.npy", len(arrays.faces)), dtype=dtype)
    theirs = smplx.FLAME(str(tmp_path), num_betas=100, num_expression_coeffs=50, batch_size=BATCH, dtype=dtype)
    a = _values(100, 50, 3, dtype=dtype)
    b = [value.detach().clone().requires_grad_() for value in a]
    verts = ours.forward(*a).verts
    reference = theirs(betas=b[0], expression=b[1], jaw_pose=b[2])
    assert verts.shape == (BATCH, 5023, 3)
    found = [verts, ours.landmarks(verts)[:, 17:]]
    _assert_same(found, [reference.vertices, reference.joints[:, 5:56]], a, b, 1e-5)
    mano = Mano.build(read_mano(tmp_path / "MANO_RIGHT.pkl"), dtype=dtype)
    theirs = smplx.MANO(
        str(tmp_path / "MANO_PLAIN_RIGHT.pkl"), use_pca=False, flat_hand_mean=True, batch_size=BATCH, dtype=dtype
    )
    a = _values(10, 45, 3, 3, dtype=dtype)
    b = [value.detach().clone().requires_grad_() for value in a]
    verts, joints = mano.forward(*a)
    reference = theirs(betas=b[0], hand_pose=b[1], global_orient=b[2], transl=b[3])
    assert verts.shape == (BATCH, 778, 3)
    _assert_same([verts, joints[:, :16]], [reference.vertices, reference.joints[:, :16]], a, b, 1e-5)


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


def test_contour_rows_equal_smplx():
    yaw = np.linspace(-89, 89, 179)
    rng = np.random.default_rng(2)
    tilt = np.stack([0.2 * rng.normal(size=179), np.deg2rad(yaw), 0.2 * rng.normal(size=179)], 1)
    matrices = torch.tensor(Rotation.from_euler("ZYX", tilt[:, ::-1]).as_matrix())
    table = torch.arange(79)[:, None].expand(79, 17).contiguous()
    # Their function starts from axis-angle poses of a chain; the chain of one joint is the rotation itself.
    pose = torch.tensor(Rotation.from_matrix(matrices.numpy()).as_rotvec())
    rows, _ = find_dynamic_lmk_idx_and_bcoords(
        torch.zeros(179, 1, 3).double(), pose, table, torch.zeros(79, 17, 3).double(), torch.tensor([0])
    )
    ours = contour_rows(matrices)
    assert ours.min() >= 0 and ours.max() <= 78 and len(set(ours.tolist())) == 79
    # Their mask sends yaw beyond -39 degrees to the same last row.
    assert (ours == rows[:, 0]).all()


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
